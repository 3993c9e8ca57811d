"""Orders from outside to the loop: what they are called, and the words of shared memory that carry them.

An operator, a control socket or a signal calls `Supervisor.order`. The supervisor writes these words; the loop reads
them once a cycle, between two cycles. A mode is a level: the last one counts. To resume and to reload are counted, so
that an order is carried out once, however often the word is read, and none is lost while the supervisor stands still.
"""

from enum import StrEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtec.correction.flags import MODE_HOLD, MODE_OFF, MODE_ON
from rtec.errors import RtecError


class Order(StrEnum):
    """What can be ordered."""

    ENABLE = "enable"
    """The correction follows the model, from where it stands, within its limits."""
    HOLD = "hold"
    """The correction stays where it is."""
    FADE = "fade"
    """The correction goes to nothing at its slew limit."""
    RESUME = "resume"
    """Devices that stopped by themselves (a box that started anew, a lost position) go on as they are now."""
    RELOAD = "reload"
    """Run file and model are read again; limits and model change without a jump."""
    MARK = "mark"
    """Nothing but an entry with a text beside the log."""


MODE_OF: Final = {Order.ENABLE: MODE_ON, Order.HOLD: MODE_HOLD, Order.FADE: MODE_OFF}
"""The mode that an order stands for."""
LONGEST_TEXT: Final = 400
YES: Final = "yes"
"""Text of an order to reload that also takes what turns the correction round, or moves it by much."""


class OrderRefused(RtecError):
    """An order that cannot be carried out; the message says why and what can be done."""


def order_named(name: str) -> Order:
    """Give the order of that name.

    Raises:
        OrderRefused: there is none; the message lists them.
    """
    try:
        return Order(name)
    except ValueError:
        raise OrderRefused(f"no order {name[:40]!r}; there are {', '.join(Order)}") from None


class OrderWords:
    """The orders in shared memory: one writer (the supervisor), one reader (the loop), single words, so never torn.

    Args:
        words: three int64: mode, how often to resume was ordered, how often to reload.
    """

    def __init__(self, words: NDArray[np.int64]) -> None:
        self._words = words

    @property
    def mode(self) -> int:
        """MODE_OFF, MODE_ON or MODE_HOLD."""
        return int(self._words[0])

    @mode.setter
    def mode(self, value: int) -> None:
        self._words[0] = value

    @property
    def resumes(self) -> int:
        """How often the devices were ordered to resume."""
        return int(self._words[1])

    @resumes.setter
    def resumes(self, value: int) -> None:
        self._words[1] = value

    @property
    def reloads(self) -> int:
        """Generation of what was ordered to be loaded; its content came through the pipe before."""
        return int(self._words[2])

    @reloads.setter
    def reloads(self, value: int) -> None:
        self._words[2] = value
