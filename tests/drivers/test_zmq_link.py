"""The ZeroMQ link on real sockets of this computer, with a far end that shares no code with the driver.

Oracle of every test: what the far end (`zmq_rig.Cell`, plain pyzmq and json) published or was told.
"""

import json
import re
import threading
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq
import zmq.auth

from rtec.correction.sinks import FollowingErrorSink, PulseSink
from rtec.errors import ConfigError, DriverError, DriverFault, DriverTimeout, DriverUnavailable
from rtec.loop.clock import RealClock
from rtec.tomlfile import validated
from rtec_drivers.registry import DRIVERS
from rtec_drivers.zmq import driver as zmq_driver
from rtec_drivers.zmq import link as zmq_link
from rtec_drivers.zmq.driver import ClockOffset, ZmqLinkDriver
from rtec_drivers.zmq.link import Sockets, ZmqOptions, leaves_computer
from rtec_drivers.zmq.message import KEYS, CommandAnswer, StateMessage, read_answer, read_state
from rtec_drivers.zmq.message import command as command_text
from tests.support.box_rig import SPEED
from tests.support.conformance import CONFIGS, MACHINE, DriverLaws, Rig, gives_back, open_files, soon
from tests.support.zmq_rig import Cell, ipc_cell

pytestmark = pytest.mark.xdist_group("real-clock")
MS = 1_000_000
CLOCK = RealClock()


class TestZmqLink(DriverLaws):
    @pytest.fixture(params=["shared", "own"])
    def rig(self, tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Rig]:
        with ipc_cell(tmp_path):
            yield Rig(
                ZmqLinkDriver,
                addresses(tmp_path, clock=request.param),
                misspelt="comand",
                nearest="command",
                sensors=["T_bed"],
                wrong_sinks=[FollowingErrorSink(resolution_um=1.0)],
                missing={"state": f"ipc://{tmp_path}/nothing", "open_timeout_s": 0.05},
            )


def addresses(folder: Path, **more: Any) -> dict[str, Any]:
    table = {"state": f"ipc://{folder}/state", "command": f"ipc://{folder}/command", "max_speed_mm_s": SPEED}
    return {**table, "silent_s": 0.2, **more}


def driver(table: dict[str, Any], base: Path = CONFIGS) -> ZmqLinkDriver:
    return ZmqLinkDriver(validated(ZmqOptions, table, "run.toml"), MACHINE, CLOCK, base)


def counts_of(link: ZmqLinkDriver) -> list[int]:
    counts = np.zeros(2, np.int64)
    link.read_counts(counts)
    return [int(n) for n in counts]


def command(link: ZmqLinkDriver, *output: int) -> bool:
    link.apply(np.array(output, np.int64))
    has = np.zeros(2, np.int64)
    link.read_output(has)
    return has.tolist() == list(output)


def told(link: ZmqLinkDriver, action: Any, match: str) -> None:
    """Soon it fails with these words."""

    def fails() -> bool:
        try:
            action(link)
        except DriverError as e:
            return match in str(e)
        return False

    assert soon(CLOCK, fails)


def test_counts_temperatures_spindle_and_commands_over_tcp() -> None:
    with Cell("tcp://127.0.0.1:*", "tcp://127.0.0.1:*") as cell:
        state = cell._pub.getsockopt_string(zmq.LAST_ENDPOINT)
        where = cell._router.getsockopt_string(zmq.LAST_ENDPOINT)
        with driver({"state": state, "command": where, "max_speed_mm_s": SPEED}) as link:
            assert soon(CLOCK, lambda: counts_of(link)) == [1000, -2000]
            assert soon(CLOCK, lambda: command(link, 7, -9))
            degc, times = np.full(8, np.nan), np.zeros(8, np.int64)
            link.read_temperatures(degc, times)
            assert degc[MACHINE.sensor_names.index("T_bed")] == 21.25
            assert np.count_nonzero(times) == 1
            assert link.read_spindle() == 900.0
        last = cell.output
        assert last == {"X": 7, "Z": -9}
        assert {c["boot"] for c in cell.commands} == {"a1"}
        assert [c["seq"] for c in cell.commands] == list(range(1, len(cell.commands) + 1))


def test_the_other_process_vanishes_and_comes_back_as_it_was(tmp_path: Path) -> None:
    """Silence is told, nothing else is; when it is back, all goes on by itself from the same numbers."""
    cell = ipc_cell(tmp_path)
    with driver(addresses(tmp_path, at_start="later", open_timeout_s=0.02)) as link:
        told(link, counts_of, "no message for")
        with pytest.raises(DriverUnavailable, match="has not said"):
            link.read_output(np.zeros(2, np.int64))
        for _ in range(2):
            with cell:
                assert soon(CLOCK, lambda: counts_of(link)) == [1000, -2000]
                assert soon(CLOCK, lambda: command(link, 4, 4))
            told(link, counts_of, "no message for")
            for _ in range(3):
                told(link, lambda it: it.apply(np.array([9, 9])), "takes commands")
    assert all(c["output"] == {"X": 4, "Z": 4} for c in cell.commands)  # none was kept for its return


def test_a_start_says_why_every_message_is_refused(tmp_path: Path) -> None:
    """Counts that are no whole numbers. Oracle: the key that is wrong; messages come, so silence is no reason."""
    with ipc_cell(tmp_path) as cell:
        cell.extra = {"counts": {"X": 1000.5, "Z": 0}}
        with (
            pytest.raises(DriverFault, match=r"a message: 'counts.X' must be an integer of 64 bits, found 1000.5"),
            driver(addresses(tmp_path, open_timeout_s=0.5)),
        ):
            pass


def test_an_older_message_is_not_looked_at(tmp_path: Path) -> None:
    """Twice the same number, then a lower one: what they say is of no interest."""
    with ipc_cell(tmp_path) as cell, driver(addresses(tmp_path)) as link:
        soon(CLOCK, lambda: counts_of(link))
        now_ns = CLOCK.now_ns()
        late = {**cell.message(), "boot": "a1", "counts": {"X": 1001, "Z": -2000}}
        with cell.lock:
            cell.silent = True
        for seq, taken in ((10**6, True), (10**6, False), (7, False), (10**6 + 1, True)):
            text = json.dumps({**late, "seq": seq}).encode()
            assert (link._book.take(text, now_ns) is not None) == taken


def test_numbers_that_begin_again_under_the_same_boot_are_told_and_the_order_accepts_them(tmp_path: Path) -> None:
    """A program that was restarted and kept its boot: who reads, and who only commands, hears both numbers."""
    with ipc_cell(tmp_path) as cell, driver(addresses(tmp_path)) as link:
        with cell.lock:
            cell._seq = 10**6
        assert soon(CLOCK, lambda: command(link, 12, 0) and link._book._seq > 10**6)
        with cell.lock:
            cell._seq = 0
        told(link, counts_of, "no seq above")
        link.apply(np.array([12, 0]))  # what it has already needs no state
        told(link, lambda it: it.apply(np.array([13, 0])), "did the program restart with the same boot")
        link.resume()
        assert soon(CLOCK, lambda: counts_of(link)) == [1000, -2000]
        assert soon(CLOCK, lambda: command(link, 12, 1))
        assert cell.commands[-1]["output"] == {"X": 12, "Z": 1}


def test_another_start_holds_until_ordered(tmp_path: Path) -> None:
    """Its output is zero again: counts and commands are refused, temperatures go on; the order ends that."""
    with ipc_cell(tmp_path) as cell, driver(addresses(tmp_path)) as link:
        assert soon(CLOCK, lambda: command(link, 12, 0))
        with cell.lock:
            cell.boot, cell.output, cell._seq = "b2", {"X": 0, "Z": 0}, 0
        told(link, counts_of, "restarted; the correction holds until it is ordered to resume")
        assert "restarted" in link.must_resume
        with pytest.raises(DriverFault, match="ordered to resume"):
            link.apply(np.array([30, 0]))
        degc, times = np.full(8, np.nan), np.zeros(8, np.int64)
        link.read_temperatures(degc, times)
        link.resume()
        assert soon(CLOCK, lambda: counts_of(link)) == [1000, -2000]
        told(link, lambda it: it.apply(np.array([40, 0])), "must take over its output first")
        assert soon(CLOCK, lambda: command(link, 3, 1))
        assert {c["output"]["X"] for c in cell.commands} == {12, 3}, "what was refused was not sent"


def test_garbage_is_told_and_passes(tmp_path: Path) -> None:
    """Each of these is refused by its own words; the next good message ends it. The numbers never reach the loop."""
    good = {"schema": 1, "boot": "a1", "seq": 10**6, "time_ns": CLOCK.now_ns(), "counts_time_ns": 0}
    texts: list[tuple[object, str]] = [
        (b"\xff\x00{", "is no JSON text"),
        (b"[" * 3000, "is no JSON text"),
        (b"[1]", "is no JSON object"),
        ({**good, "schema": 2}, "a message: schema 2; this program reads 1"),
        ({**good, "cuonts": {}}, "a message: unknown key 'cuonts'"),
        ({**good, "counts": {"X": 1.5, "Z": 0}}, "'counts.X' must be an integer"),
        ({**good, "counts": {"X": True, "Z": 0}}, "'counts.X' must be an integer"),
        ({**good, "counts": {"X": 10**30, "Z": 0}}, "'counts.X' must be an integer"),
        ({**good, "counts": {"X": 1}}, "counts are of X; the machine has X, Z"),
        ({**good, "degc": {"T_bad": [1, 1]}}, "no sensor 'T_bad'"),
        ({**good, "degc": {"T_bed": [float("nan"), 1]}}, "'T_bed' must be a number"),
        ({**good, "degc": {"T_bed": [1.0]}}, "must be [temperature, instant in ns]"),
        ({**good, "degc": {"T_bed": [1.0, 2**62]}}, "from after it was sent"),
        ({**good, "boot": ""}, "'boot' must be a text"),
    ]
    with ipc_cell(tmp_path) as cell, driver(addresses(tmp_path)) as link:
        assert soon(CLOCK, lambda: counts_of(link))
        for text, words in texts:
            with cell.lock:
                cell.silent = True
                cell._pub.send_multipart(
                    [b"rtec.state", text if isinstance(text, bytes) else json.dumps(text).encode()]
                )
            told(link, counts_of, words)
            with cell.lock:
                cell.silent = False
            assert soon(CLOCK, lambda: counts_of(link)) == [1000, -2000]


def test_a_message_that_is_too_large_does_not_end_the_link(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """libzmq leaves such a peer, and does not come back by itself. Oracle: the counts that the peer publishes then."""
    monkeypatch.setattr(zmq_driver, "RECONNECT_NS", 50_000_000)
    with ipc_cell(tmp_path) as cell, driver(addresses(tmp_path, silent_s=0.02)) as link:
        assert soon(CLOCK, lambda: counts_of(link)) == [1000, -2000]
        with cell.lock:
            cell.raw = b"x" * 5_000_000
        told(link, counts_of, "no message for")
        with cell.lock:
            cell.position = {"X": 1001, "Z": -2000}
        assert soon(CLOCK, lambda: counts_of(link) == [1001, -2000])
        assert soon(CLOCK, lambda: command(link, 7, -9))


def test_the_document_says_what_the_driver_reads() -> None:
    """Oracle: the JSON and TOML texts in `docs/zmq-link.md`; its table names every key that is read."""
    text = (CONFIGS.parent / "docs" / "zmq-link.md").read_text(encoding="utf-8")
    state, command, taken, refused = re.findall(r"```json\n(.*?)```", text, re.S)
    read = read_state(state.encode())
    assert read == StateMessage(
        "2f9c",
        1041,
        812000450000,
        {"X": 120044, "Z": -3},
        812000400000,
        {"T_bed": (21.25, 811900000000)},
        900.0,
        {"X": -12, "Z": 4},
    )
    assert json.loads(command_text("2f9c", 77, {"X": -13, "Z": 4})) == json.loads(command)
    assert read_answer(taken.encode()) == CommandAnswer("2f9c", 77, "")
    assert read_answer(refused.encode()).refused == "the axis is not referenced"
    named = set(re.findall(r"`(\w+)`", "".join(line.split("|")[1] for line in text.splitlines() if line[:2] == "| ")))
    assert named >= KEYS
    assert set(json.loads(state)) == KEYS
    table = tomllib.loads(re.findall(r"```toml\n(.*?)```", text, re.S)[0])["device"]["cell"]
    assert DRIVERS[table.pop("driver")][1] == "ZmqLinkDriver"
    validated(ZmqOptions, table, "zmq-link.md")


def test_counts_that_jump_are_refused(tmp_path: Path) -> None:
    """At 400 mm/s and 2000 counts/mm a million counts take 1.25 s: a slip passes, a jump that stays holds."""
    with ipc_cell(tmp_path) as cell, driver(addresses(tmp_path)) as link:
        soon(CLOCK, lambda: counts_of(link))
        with cell.lock:
            cell.position = {"X": 1_001_000, "Z": -2000}
        told(link, counts_of, "and stayed there: the position is not known")
        assert "position is not known" in link.must_resume
        link.resume()
        assert soon(CLOCK, lambda: counts_of(link)) == [1_001_000, -2000]


def test_commands_that_nobody_answers_are_told(tmp_path: Path) -> None:
    with ipc_cell(tmp_path) as cell, driver(addresses(tmp_path)) as link:
        assert soon(CLOCK, lambda: command(link, 1, 1))
        with cell.lock:
            cell.answering = False
        told(link, lambda it: it.apply(np.array([1, 1])), "no command was answered")
        with cell.lock:
            cell.answering = True
        assert soon(CLOCK, lambda: command(link, 2, 2))


def test_a_stuck_sensor_is_told(tmp_path: Path) -> None:
    """A temperature that stands still to the last digit; when it moves, that is over."""
    with ipc_cell(tmp_path) as cell, driver(addresses(tmp_path, stuck_after_s=0.05)) as link:
        degc, times = np.full(8, np.nan), np.zeros(8, np.int64)
        told(link, lambda it: it.read_temperatures(degc, times), "T_bed: has read 21.25 for 0 s: stuck")
        at_ns = int(times.max())
        with pytest.raises(DriverFault):
            link.read_temperatures(degc, times)
        assert times.max() == at_ns
        with cell.lock:
            cell.degc = {"T_bed": 22.0}

        def fresh() -> bool:
            link.read_temperatures(degc, times)
            return int(times.max()) > at_ns

        assert soon(CLOCK, fresh)


def test_a_flood_takes_no_longer_than_its_bound(tmp_path: Path) -> None:
    """However much has come, one call looks at 16 messages at most and keeps the newest."""
    with ipc_cell(tmp_path) as cell, driver(addresses(tmp_path)) as link:
        soon(CLOCK, lambda: counts_of(link))
        with cell.lock:
            for x in range(200):
                cell.position = {"X": 1000 + x, "Z": -2000}
                cell._pub.send_multipart([b"rtec.state", json.dumps(cell.message()).encode()])
        assert soon(CLOCK, lambda: counts_of(link) == [1199, -2000])
        assert link._sockets is not None
        assert len(link._sockets.states()) <= 16


@pytest.mark.parametrize("wrong", [False, True])
def test_keys(tmp_path: Path, wrong: bool) -> None:
    """With the right key of the far end messages come; with another one none do."""
    for name in ("cell", "rtec", "stranger"):
        zmq.auth.create_certificates(tmp_path, name)
    own = tmp_path / "rtec.key_secret"
    own.chmod(0o600)
    public, secret = zmq.auth.load_certificate(tmp_path / "cell.key_secret")
    keys = {"server_key_file": "stranger.key" if wrong else "cell.key", "own_key_file": "rtec.key_secret"}
    with ipc_cell(tmp_path, keys=(public, secret)):
        link = driver(addresses(tmp_path, open_timeout_s=0.3 if wrong else 3.0, **keys), tmp_path)
        if wrong:
            with pytest.raises(DriverTimeout), link:
                pass
            return
        with link:
            assert soon(CLOCK, lambda: counts_of(link)) == [1000, -2000]
            assert soon(CLOCK, lambda: command(link, 1, 2))


def test_what_the_options_refuse(tmp_path: Path) -> None:
    """Oracle: the messages."""
    zmq.auth.create_certificates(tmp_path, "rtec")
    (tmp_path / "rtec.key_secret").chmod(0o644)
    base = {"max_speed_mm_s": SPEED, "state": "ipc:///x"}
    both = {"server_key_file": "rtec.key", "own_key_file": "rtec.key_secret"}
    for table, words in (
        ({"state": "tcp://192.168.1.5:5555"}, "leaves this computer: give server_key_file"),
        ({"state": "tcp://*:5555"}, "leaves this computer"),
        ({"state": "udp://x"}, "neither tcp://host:port nor ipc://path"),
        ({"server_key_file": "rtec.key"}, "give both or none"),
        (both, "may be read by others; chmod 600"),
        ({**both, "own_key_file": "rtec.key"}, "holds no secret key"),
        ({**both, "server_key_file": "none.key"}, "cannot be read as a key"),
        ({"max_speed_mm_s": {"X": 1.0}}, "axis 'Z' is missing"),
        ({"max_speed_mm_s": {"X": 1.0, "Z": 1.0, "Zz": 2.0}}, "did you mean 'Z'"),
    ):
        with pytest.raises(ConfigError, match=words):
            driver({**base, **table}, tmp_path)
    assert driver(base).refuses(PulseSink()) == "has no address for commands (its option command)"


def test_which_addresses_leave_the_computer() -> None:
    """Oracle: RFC 1122 and 4291 on loopback addresses."""
    inside = ("ipc:///x", "tcp://127.0.0.1:1", "tcp://127.9.9.9:1", "tcp://localhost:1", "tcp://[::1]:1")
    outside = ("tcp://10.0.0.1:1", "tcp://0.0.0.0:1", "tcp://cell:1", "tcp://localhost.evil.org:1", "tcp://[::]:1")
    assert [leaves_computer(a) for a in inside] == [False] * 5
    assert [leaves_computer(a) for a in outside] == [True] * 5


def test_the_offset_of_two_clocks() -> None:
    """Oracle: a clock that is 7 s ahead and runs 50 millionths fast, messages held up by up to 40 ms."""
    rng, offset, sent_ns, errors = np.random.default_rng(1), ClockOffset(), 0, []
    for k in range(20_000):
        now_ns = k * 10 * MS
        sent_ns = 7_000_000_000 + now_ns + now_ns // 20_000
        offset.add(sent_ns, now_ns + 100_000 + int(rng.exponential(4 * MS)))
        errors.append(offset.ours(sent_ns) - now_ns)
    assert min(errors[100:]) > -4 * MS
    assert max(errors[100:]) < 1 * MS
    offset.reset()
    with pytest.raises(ValueError, match="no message yet"):
        offset.ours(0)


def test_late_messages_show_their_age(tmp_path: Path) -> None:
    """A message that lay about for half a second counts as half a second old, whatever the far end's clock says."""
    with ipc_cell(tmp_path) as cell:
        cell.skew_ns = -(10**15)
        with driver(addresses(tmp_path)) as link:
            counts = np.zeros(2, np.int64)
            soon(CLOCK, lambda: link.read_counts(counts))
            before_ns = CLOCK.now_ns()
            with cell.lock:
                cell.silent = True
                old = json.dumps(cell.message()).encode()
                asleep_ns = CLOCK.now_ns()
                CLOCK.sleep_until_ns(asleep_ns + 100 * MS)
                cell._pub.send_multipart([b"rtec.state", old])
            soon(CLOCK, lambda: link.read_counts(counts) >= before_ns)
            assert link.read_counts(counts) - asleep_ns < 20 * MS


def test_no_leak_over_1000_openings(tmp_path: Path) -> None:
    """Oracle: files and threads of the process before and after 1000 openings."""
    with ipc_cell(tmp_path):
        link = driver(addresses(tmp_path))
        with link:
            pass
        files, threads = open_files(), threading.active_count()
        for _ in range(1000):
            with link:
                pass
        assert gives_back(files, threads)


def test_a_far_end_that_comes_and_goes_a_thousand_times(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It vanishes and comes back as it was; nobody opens anything here. Oracle: files and threads of this process."""
    monkeypatch.setattr(zmq_link, "RECONNECT_MS", 1)
    cell = ipc_cell(tmp_path)
    with driver(addresses(tmp_path, at_start="later", open_timeout_s=0.02)) as link:

        def comes_and_goes() -> None:
            taken = cell._seq
            with cell:
                assert soon(CLOCK, lambda: bool(counts_of(link)) and link._book._seq > taken)

        comes_and_goes()
        files, threads = open_files(), threading.active_count()
        for _ in range(1000):
            comes_and_goes()
        assert gives_back(files, threads)


def test_a_shared_clock_that_is_behind_is_told(tmp_path: Path) -> None:
    """Messages come every millisecond, 5 s late by this PC's clock; each alone would be called stale, or nothing."""
    with ipc_cell(tmp_path) as cell, driver(addresses(tmp_path, clock="shared")) as link:
        soon(CLOCK, lambda: counts_of(link))
        with cell.lock:
            cell.skew_ns = -5_000 * MS
        told(link, counts_of, "messages come, but their time_ns is 5.0 s behind this PC's clock (CLOCK_MONOTONIC)")
        degc, times = np.full(8, np.nan), np.zeros(8, np.int64)
        told(link, lambda it: it.read_temperatures(degc, times), "5.0 s behind")
        with cell.lock:
            cell.skew_ns = 0
        assert soon(CLOCK, lambda: counts_of(link)) == [1000, -2000]
    with ipc_cell(tmp_path) as cell, driver(addresses(tmp_path, clock="own")) as link:
        cell.skew_ns = -5_000 * MS
        assert soon(CLOCK, lambda: counts_of(link)) == [1000, -2000]


def test_a_message_that_comes_while_the_socket_is_read_is_not_from_the_future(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """This process is interrupted for 50 ms before each look at the socket. Oracle: the two share one clock."""
    states = Sockets.states

    def late(sockets: Sockets) -> list[bytes]:
        CLOCK.sleep_until_ns(CLOCK.now_ns() + 50 * MS)
        return states(sockets)

    monkeypatch.setattr(Sockets, "states", late)
    with ipc_cell(tmp_path), driver(addresses(tmp_path, clock="shared")) as link:
        for _ in range(20):
            assert counts_of(link) == [1000, -2000]
