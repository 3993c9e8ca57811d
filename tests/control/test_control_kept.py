"""An ordered hold is on disk, or it is answered "not kept". Oracle: answers written down here."""

from typing import Any

import pytest

from rtec.control.client import LONGEST_NS, carry_out
from rtec.loop.clock import VirtualClock
from rtec.loop.orders import Order

MODES = {Order.HOLD: "hold", Order.FADE: "off", Order.ENABLE: "on"}


class Answers:
    """A daemon that takes every order; what it says of itself follows the clock."""

    def __init__(self, order: Order, clock: VirtualClock, then: tuple[str, ...] = (), **status: Any) -> None:
        self._order, self._clock, self._status, self._ordered_ns = order, clock, status, -1
        self._then = then

    def status(self) -> dict[str, Any]:
        """As it would be some time after the order."""
        now_ns, done = self._clock.now_ns(), self._ordered_ns >= 0
        usual = {"flags": [], "reasons": [], "devices": {}, "parts": {}, "log": "", "applied_um": {"X": 1.0}}
        status = {"mode": MODES[self._order] if done else "other", "time_ns": now_ns, "kept_mode": "", **usual}
        status |= {
            key: value(now_ns - self._ordered_ns) if callable(value) else value for key, value in self._status.items()
        }
        event = {"what": str(self._order), "time_ns": self._ordered_ns, "text": "", "who": "ann", "utc": "12:00"}
        events = [event, *({**event, "what": what, "who": "bob"} for what in self._then)] * done
        return {"pid": 1, "status": status, "events_total": len(events), "events": events}

    def order(self, order: Order, text: str = "") -> str:
        """Taken."""
        self._ordered_ns = self._clock.now_ns()
        return f"{order} ordered {text}".strip()


@pytest.mark.parametrize("order", [Order.HOLD, Order.FADE])
def test_an_order_is_done_when_it_is_on_disk(order: Order) -> None:
    """Half a second later, in spite of a log that stopped."""
    clock = VirtualClock(1)
    daemon = Answers(order, clock, log="logging stopped", kept_mode=lambda ns: MODES[order] if ns > 5e8 else "before")
    found = carry_out(daemon, order, "", clock)  # type: ignore[arg-type]
    assert found.done
    assert "not kept" not in found.text
    assert clock.now_ns() > 5e8


@pytest.mark.parametrize("order", [Order.HOLD, Order.FADE])
@pytest.mark.parametrize("where", [{"log": "the state is not on disk: Input/output error"}, {"parts": {"disk": "EIO"}}])
def test_what_the_disk_does_not_take_is_answered_not_kept(order: Order, where: dict[str, Any]) -> None:
    clock = VirtualClock(1)
    found = carry_out(Answers(order, clock, **where), order, "", clock)  # type: ignore[arg-type]
    assert not found.done
    assert "; but not kept: " in found.text
    assert clock.now_ns() < 1e9


def test_a_disk_that_does_not_answer_keeps_nothing_and_the_operator_is_told() -> None:
    clock = VirtualClock(1)
    found = carry_out(Answers(Order.HOLD, clock, kept_mode="on"), Order.HOLD, "", clock)  # type: ignore[arg-type]
    assert (found.done, found.text) == (False, "hold ordered, and not kept: it is not on disk after 15 s")
    assert clock.now_ns() > LONGEST_NS


def test_without_a_folder_nothing_is_kept_and_it_is_said() -> None:
    clock = VirtualClock(1)
    found = carry_out(Answers(Order.HOLD, clock, kept_mode=None), Order.HOLD, "", clock)  # type: ignore[arg-type]
    assert found.done
    assert "not kept over a power cut: the run file names no state_folder" in found.text


def test_to_enable_needs_no_disk() -> None:
    clock = VirtualClock(1)
    assert carry_out(Answers(Order.ENABLE, clock), Order.ENABLE, "", clock).done  # type: ignore[arg-type]


@pytest.mark.parametrize("order", [Order.HOLD, Order.FADE])
def test_an_order_that_another_terminal_overtakes_is_answered_at_once(order: Order) -> None:
    """Both orders came before the next row; the mode is that of the second."""
    clock = VirtualClock(1)
    daemon = Answers(order, clock, then=("note", "enable"), mode="on")
    found = carry_out(daemon, order, "", clock)  # type: ignore[arg-type]
    assert (found.done, found.text) == (False, f"{order} ordered, and then enable, by bob at 12:00")
    assert clock.now_ns() < 1e9
