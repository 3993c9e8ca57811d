"""Orders from outside to the loop: their names, and the words of shared memory that carry them.

An operator, a control socket or a signal calls `Supervisor.order`. The supervisor writes these words; the loop reads
them once a cycle, between two cycles. A mode is a level: the last one counts. Orders to resume and to reload are
counted, so that each is carried out once, however often the loop reads the word, and none is lost while the supervisor
is stopped. An order to home goes to the loop as a reload does.
"""

from enum import StrEnum
from typing import Final

from rtec.arrays import Ints
from rtec.correction.flags import MODE_HOLD, MODE_OFF, MODE_ON
from rtec.errors import RtecError


class Order(StrEnum):
    """The orders."""

    ENABLE = "enable"
    """The correction follows the model, from its present value, within its limits."""
    HOLD = "hold"
    """The correction stays where it is."""
    FADE = "fade"
    """The correction returns to zero at its slew limit."""
    RESUME = "resume"
    """Devices that stopped by themselves (a box that restarted, a lost position) go on from their present state."""
    HOME = "home"
    """The axes are at these positions, after the device of the counts was without supply."""
    RELOAD = "reload"
    """Run file and model are read again; limits and model change without a jump of the correction."""
    MARK = "mark"
    """Writes a text into the log's events, and does nothing else."""


MODE_OF: Final = {Order.ENABLE: MODE_ON, Order.HOLD: MODE_HOLD, Order.FADE: MODE_OFF}
"""The mode that each order sets."""
LONGEST_TEXT: Final = 400
YES: Final = "yes"
"""Text of an order to reload that also accepts a change that reverses the correction, or moves it by much."""


class OrderRefused(RtecError):
    """An order that cannot be carried out; the message has the reason and what can be done."""


def order_named(name: str) -> Order:
    """Give the order of that name.

    Raises:
        OrderRefused: no order has that name; the message lists the names.
    """
    try:
        return Order(name)
    except ValueError:
        raise OrderRefused(f"no order {name[:40]!r}; there are {', '.join(Order)}") from None


class OrderWords:
    """The orders in shared memory. One writer (the supervisor), one reader (the loop); a single word is never torn.

    Args:
        words: three int64: the mode, the number of orders to resume, the number of changes: reloads and new zeros.
    """

    def __init__(self, words: Ints) -> None:
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
        """Number of orders to resume so far."""
        return int(self._words[1])

    @resumes.setter
    def resumes(self, value: int) -> None:
        self._words[1] = value

    @property
    def reloads(self) -> int:
        """Number of the change to take over; its content came through the pipe before."""
        return int(self._words[2])

    @reloads.setter
    def reloads(self, value: int) -> None:
        self._words[2] = value
