"""Orders: names, words, refusals, and the supervisor that hands them on. Oracles: the words of the ring; the loop."""

from pathlib import Path

import numpy as np
import pytest

from rtec.correction.flags import MODE_HOLD, MODE_OFF, MODE_ON
from rtec.daemon.ring import Ring
from rtec.daemon.status import Status
from rtec.daemon.supervisor import Supervisor
from rtec.log.recording import Event
from rtec.loop.orders import MODE_OF, Order, OrderRefused, OrderWords, order_named
from rtec.loop.records import MODES_BY_NAME, Layout
from tests.support import setups


def test_names_and_modes() -> None:
    assert [str(o) for o in Order] == ["enable", "hold", "fade", "resume", "home", "reload", "mark"]
    assert MODE_OF == {Order.ENABLE: MODE_ON, Order.HOLD: MODE_HOLD, Order.FADE: MODE_OFF}
    assert set(MODE_OF.values()) == set(MODES_BY_NAME.values())
    assert order_named("resume") is Order.RESUME


def test_an_order_that_does_not_exist_names_those_that_do() -> None:
    with pytest.raises(OrderRefused, match="no order 'stop'; there are enable, hold, fade, resume, home, reload, mark"):
        order_named("stop")
    with pytest.raises(OrderRefused) as e:
        order_named("x" * 10_000)
    assert len(str(e.value)) < 200


def test_words_are_plain_numbers_in_the_order_of_the_description() -> None:
    memory = np.zeros(3, np.int64)
    words = OrderWords(memory)
    words.mode, words.resumes, words.reloads = MODE_HOLD, 7, 9
    assert memory.tolist() == [MODE_HOLD, 7, 9]
    assert (words.mode, words.resumes, words.reloads) == (MODE_HOLD, 7, 9)


def test_both_sides_of_a_ring_see_the_same_orders() -> None:
    with Ring.create(Layout(("X",), ()), 8) as ring:
        with Ring.attach(ring.name) as other:
            ring.orders.mode, ring.orders.resumes, ring.orders.reloads = MODE_ON, 3, 4
            assert (other.orders.mode, other.orders.resumes, other.orders.reloads) == (MODE_ON, 3, 4)
            assert (ring.stop_requested, ring.overruns, ring.tail) == (0, 0, 0)
        ring.close()
        assert ring.orders.resumes == 3  # a closed ring still tells what stood there, from memory of its own


def test_the_supervisor_carries_orders_out_in_turn_and_notes_them(tmp_path: Path) -> None:
    supervisor = Supervisor(setups.setup(tmp_path), None)
    with Ring.create(supervisor.layout, 8) as ring:
        supervisor.order(Order.HOLD, "tool change", "operator")
        supervisor.order(Order.RESUME)
        supervisor.order(Order.RESUME)
        assert supervisor.order(Order.MARK, "first part") == "mark ordered"
        supervisor._carry_out(ring)
        assert (ring.orders.mode, ring.orders.resumes) == (MODE_HOLD, 2)
    noted = [(e.what, e.text, e.who) for e in supervisor.events.newest]
    assert noted[0] == ("hold", "tool change", "operator")
    assert [what for what, _, _ in noted] == ["hold", "resume", "resume", "mark"]


def test_rows_that_found_no_room_on_the_disk_are_in_the_status(tmp_path: Path) -> None:
    """Those of a full ring and those of a full disk: 3 + 5. Oracle: the sum, by hand."""
    supervisor = Supervisor(setups.setup(tmp_path), None)
    supervisor._watch.status = Status(overruns=3)
    with supervisor._to_disk() as disk:
        disk.dropped = 5
        assert supervisor.status.overruns == 8
        assert supervisor.status.log == ""


def test_warnings_become_events_once(tmp_path: Path) -> None:
    """When they are said, not at the end of a run of weeks."""
    heard: list[Event] = []
    supervisor = Supervisor(setups.setup(tmp_path), None, on_event=heard.append)
    supervisor.warnings.append("no real-time treatment for memory")
    for now_ns in (1, 2):
        supervisor._tell_what_is_wrong(now_ns)
    supervisor.warnings.append("logging stopped")
    supervisor._tell_what_is_wrong(3)
    assert [(e.what, e.text) for e in heard] == [
        ("note", "no real-time treatment for memory"),
        ("note", "logging stopped"),
    ]
    assert list(supervisor.events.newest) == heard


def test_what_the_supervisor_refuses(tmp_path: Path) -> None:
    supervisor = Supervisor(setups.setup(tmp_path), None)
    with pytest.raises(OrderRefused, match="a mark needs a text"):
        supervisor.order(Order.MARK, "  ")
    supervisor._reload._reader.busy = True
    with pytest.raises(OrderRefused, match="an earlier order to reload or to home is not done with yet"):
        supervisor.order(Order.RELOAD)


def test_a_reload_that_comes_with_the_rows_cuts_the_log_before_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The loop takes it over while the supervisor drains: the cut is asked for before these rows are handed on."""
    supervisor = Supervisor(setups.setup(tmp_path), None)
    told: list[str] = []

    class Disk:
        def write(self, *_: object) -> None:
            told.append("write")

    monkeypatch.setattr(supervisor._reload, "look", lambda ring, _disk: told.append(f"look at {ring.reloads}"))
    with Ring.create(supervisor.layout, 8) as ring:
        drain = ring.drain

        def drain_while_the_loop_goes_on() -> object:
            ring.reloads = 1
            samples, _ = ring.slots[0]
            samples.time_ns[0] = 1
            ring.publish()
            return drain()

        monkeypatch.setattr(ring, "drain", drain_while_the_loop_goes_on)
        assert supervisor._drain(ring, Disk()) == 1  # type: ignore[arg-type]
    assert told == ["look at 1", "write"]
