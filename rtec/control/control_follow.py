"""Gives an order and waits for what comes of it."""

from dataclasses import dataclass
from typing import Any, Final

from rtec.control.client import Client
from rtec.control.facts import held, um_text
from rtec.errors import RtecError
from rtec.loop.clock import Clock
from rtec.loop.orders import MODE_OF, Order
from rtec.loop.records import MODES_BY_NAME

LONGEST_NS: Final = 15_000_000_000
PERIOD_NS: Final = 50_000_000
SEEN_NS: Final = 100_000_000
"""Rows that are so much newer than an order were made under it."""
_MODE_NAMES: Final = {number: name for name, number in MODES_BY_NAME.items()}
_TOGETHER: Final = {
    Order.ENABLE: "the correction follows the model",
    Order.HOLD: "the correction stays where it is",
    Order.FADE: "the correction goes to nothing at its slew limit",
}


@dataclass(frozen=True)
class Outcome:
    """What came of an order.

    Attributes:
        done: it was carried out; False: the daemon could not (the text says why), or it took longer than was waited.
        text: in a sentence.
        status: of the daemon afterwards.
    """

    done: bool
    text: str
    status: dict[str, Any]


def carry_out(client: Client, order: Order, text: str, clock: Clock) -> Outcome:
    """Give an order, wait until it is carried out.

    Raises:
        OrderRefused: it is not taken.
        RtecError: the daemon does not answer.
    """
    before = client.status()
    answer = client.order(order, text)
    last_ns = clock.now_ns() + LONGEST_NS
    while True:
        after = client.status()
        outcome = _outcome(order, before, after)
        if outcome is not None:
            return outcome
        if clock.now_ns() >= last_ns:
            return Outcome(False, f"{answer}, and not carried out after {LONGEST_NS / 1e9:g} s", after)
        clock.sleep_until_ns(clock.now_ns() + PERIOD_NS)


def _outcome(order: Order, before: dict[str, Any], after: dict[str, Any]) -> Outcome | None:
    """What came of it; None: nothing yet."""
    if after["pid"] != before["pid"]:
        raise RtecError("the daemon was started anew meanwhile; look at `rtec status`")
    status = after["status"]
    count = after["events_total"] - before["events_total"]
    new = [e for e in after["events"][-count:] if e["what"] in _NOTED.get(order, (str(order),))] if count else []
    if order in MODE_OF:
        done = status["mode"] == _MODE_NAMES[MODE_OF[order]]
        return _ordered(order, status, new, after) if done else None
    if order is Order.RESUME:
        return _resumed(before["status"], status, after) if new else None
    if not new:
        return None
    if order is Order.MARK:
        return Outcome(True, f"marked row {new[-1]['row']}, {new[-1]['utc']}: {new[-1]['text']}", after)
    return Outcome(new[-1]["what"] == "reloaded", new[-1]["text"], after)


_NOTED: Final = {Order.MARK: ("mark",), Order.RELOAD: ("reloaded", "not reloaded"), Order.RESUME: ("resume",)}


def _ordered(order: Order, status: dict[str, Any], new: list[dict[str, Any]], after: dict[str, Any]) -> Outcome | None:
    """What came of an order that is a mode; None: no row that was made under it has been seen."""
    why = held(status)
    if not why:
        return Outcome(True, _mode_text(order, status), after)
    if not new or status["time_ns"] - new[-1]["time_ns"] < SEEN_NS:
        return None
    return Outcome(False, f"enabled, but the correction stays where it is: {why}", after)


def _mode_text(order: Order, status: dict[str, Any]) -> str:
    units = {axis: "" if um is None else " µm" for axis, um in status["applied_um"].items()}
    applied = ", ".join(f"{axis} {um_text(um)}{units[axis]}" for axis, um in status["applied_um"].items())
    return f"{_TOGETHER[order]}; applied now: {applied}"


def _resumed(before: dict[str, Any], status: dict[str, Any], after: dict[str, Any]) -> Outcome | None:
    if status["takeovers"] == before["takeovers"]:
        return None
    wrong = [f"{name}: {'; '.join(texts)}" for name, texts in status["devices"].items()]
    if wrong:
        return Outcome(False, f"resumed, but {' | '.join(wrong)}", after)
    return Outcome(True, "the devices go on from where they are", after)
