"""Offsets as lines of text. Oracles: the lines worked out by hand, and a controller that shares no code with rtec."""

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtec.correction.sinks import FollowingErrorSink, OriginOffsetSink, PulseSink
from rtec.errors import ConfigError, DriverFault, DriverTimeout, DriverUnavailable
from rtec.loop.clock import RealClock
from rtec.loop.ports import OneWay
from rtec.tomlfile import validated
from rtec_drivers.ascii.offset import AsciiOffsetDriver
from rtec_drivers.ascii.offset_options import OffsetOptions, OffsetText
from rtec_drivers.pty_peer import PtyPeer
from tests.support.conformance import MACHINE, DriverLaws, Rig, soon
from tests.support.offset_controller import OffsetController, controller_over_tcp

pytestmark = pytest.mark.xdist_group("real-clock")
CLOCK = RealClock()
ACKNOWLEDGED = {
    "command": ["OFS X={X:.4f} Z={Z:.4f}"],
    "unit": "mm",
    "resolution_um": 0.1,
    "acknowledge": "OK",
    "refuse": "ERR.*",
    "restarted": "READY .*",
    "line_end": "crlf",
    "timeout_s": 0.1,
}
READ_BACK = {**ACKNOWLEDGED, "ask": "OFS?", "answer": r"OFS X=(?P<X>\S+) Z=(?P<Z>\S+)", "ask_period_s": 0.02}
SINK = OriginOffsetSink(resolution_um=0.1)


@pytest.fixture
def controller(tmp_path: Path) -> Iterator[OffsetController]:
    with PtyPeer(OffsetController(), CLOCK, tmp_path / "port", 0.001) as peer:
        yield peer.peer  # type: ignore[misc]


def made(folder: Path, options: dict[str, Any], **more: Any) -> AsciiOffsetDriver:
    table = {**options, "serial": {"port": str(folder / "port")}, **more}
    return AsciiOffsetDriver(validated(OffsetOptions, table, "run.toml"), MACHINE, CLOCK)


def has(driver: AsciiOffsetDriver) -> list[int]:
    out = np.zeros(2, np.int64)
    driver.read_output(out)
    return [int(n) for n in out]


def commanded(driver: AsciiOffsetDriver, *units: int) -> bool:
    """Repeat it, as the loop does, until the driver says that the controller has it."""

    def again() -> bool:
        driver.apply(np.array(units, np.int64))
        return has(driver) == list(units)

    return soon(CLOCK, again)


class TestOverAPort(DriverLaws):
    @pytest.fixture
    def rig(self, controller: OffsetController, tmp_path: Path) -> Rig:
        del controller
        return Rig(
            AsciiOffsetDriver,
            {**READ_BACK, "serial": {"port": str(tmp_path / "port")}},
            misspelt="comand",
            nearest="command",
            takes=SINK,
            wrong_sinks=[PulseSink(), FollowingErrorSink(resolution_um=0.1), OriginOffsetSink(resolution_um=1.0)],
            missing={"serial": {"port": str(tmp_path / "absent")}},
        )


class TestOverTcp(DriverLaws):
    @pytest.fixture
    def rig(self) -> Iterator[Rig]:
        with controller_over_tcp(OffsetController()) as port:
            yield Rig(
                AsciiOffsetDriver,
                {**READ_BACK, "tcp": {"host": "127.0.0.1", "port": port}, "actuator": "following_error"},
                misspelt="unti",
                nearest="unit",
                takes=FollowingErrorSink(resolution_um=0.1),
                wrong_sinks=[PulseSink(), SINK],
                missing={"tcp": {"host": "127.0.0.1", "port": 1}},
            )


@pytest.mark.parametrize(
    ("table", "units", "line"),
    [
        ({"command": ["O {X:.4f} {Z:+.4f}"], "unit": "mm", "resolution_um": 0.1}, (-124, 35), "O -0.0124 +0.0035"),
        ({"command": ["{X:d};{Z:d}"], "unit": "um", "resolution_um": 1.0}, (-124, 35), "-124;35"),
        ({"command": ["{X:d} {Z:+05d}"], "unit": "counts", "resolution_um": 0.5}, (-3, 12), "-3 +0012"),
        ({"command": ["{X:d} {Z:d}"], "unit": "counts", "resolution_um": 1.0}, (-3, 12), "-6 24"),
        ({"command": ["{X:.5f}/{Z:.5f}"], "unit": "inch", "resolution_um": 2.54}, (1, -2), "0.00010/-0.00020"),
        ({"command": ["{X:.1f};{Z:.1f}"], "unit": "um", "resolution_um": 0.1, "decimal": ","}, (15, -5), "1,5;-0,5"),
        (
            {"command": ["X{X:.1f} Z{Z:.1f}"], "unit": "um", "resolution_um": 0.1, "factor": {"X": -2.0}},
            (15, -5),
            "X-3.0 Z-0.5",
        ),
        ({"command": ["{{X}}={X:.0f}", "Z={Z:.0f}"], "unit": "um", "resolution_um": 1.0}, (7, -8), "{X}=7|Z=-8"),
    ],
)  # fmt: skip
def test_the_lines(table: dict[str, Any], units: tuple[int, int], line: str) -> None:
    """Oracle: worked out by hand; the turning centre has 2000 counts a mm, so a count is half a µm."""
    options = validated(OffsetOptions, {"tcp": {"host": "h", "port": 1}, **table}, "run.toml")
    assert b"|".join(OffsetText(options, MACHINE).lines(units)).decode() == line


@given(st.tuples(st.integers(-(10**6), 10**6), st.integers(-(10**6), 10**6)))
def test_what_is_printed_is_read_back_as_the_same_units(units: tuple[int, int]) -> None:
    """The law that a confirmed command rests on: the answer to a command is the command."""
    table = {**READ_BACK, "factor": {"X": -2.0}, "tcp": {"host": "h", "port": 1}}
    text = OffsetText(validated(OffsetOptions, table, "run.toml"), MACHINE)
    assert text.units(text.lines(units)[0].decode()) == {"X": units[0], "Z": units[1]}


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"command": ["X={X:.3f} Z={Z:.4f}"]}, r"\{X:\.3f\} prints 0\.000 for 0\.0001 mm.*more decimals"),
        ({"command": ["X={X:.4f}"]}, "axis Z is corrected, and {Z} is in no line"),
        ({"command": ["X={X:.4f} Z={Z:.4f} Y={Y:.4f}"]}, "'Y' is no axis"),
        ({"command": ["X={X.__class__} Z={Z:.4f}"]}, r"a number is written as \{X:\.4f\}"),
        ({"command": ["X={X:999999f} Z={Z:.4f}"]}, "a number is written as"),
        ({"command": ["X={X:.4f Z={Z:.4f}"]}, "command: "),
        ({"factor": {"Q": 2.0}}, "factor: 'Q' is no axis"),
        ({"unit": "counts", "resolution_um": 0.3, "command": ["{X:d} {Z:d}"]}, r"0\.6 counts of axis X.* is 0\.5"),
        ({"ask": "?", "answer": r"(?P<X>\S+)"}, r"answer: no group \(\?P<Z>"),
        ({"ask": "?"}, "ask and answer go together"),
        ({"acknowledge": None}, "refuse needs acknowledge"),
        ({"acknowledge": "(", "refuse": None}, "no regular expression"),
        ({"serial": {"port": "/dev/ttyS0"}}, "give either serial or tcp"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_one_message(more: dict[str, Any], message: str) -> None:
    table = {**ACKNOWLEDGED, "tcp": {"host": "h", "port": 1}, **more}
    with pytest.raises(ConfigError, match=message):
        AsciiOffsetDriver(validated(OffsetOptions, table, "run.toml"), MACHINE, CLOCK)


def test_it_has_what_was_acknowledged(controller: OffsetController, tmp_path: Path) -> None:
    with made(tmp_path, ACKNOWLEDGED) as driver:
        assert isinstance(driver, OneWay)
        assert commanded(driver, 124, -35)
        assert controller.has == {"X": 0.0124, "Z": -0.0035}
        controller.answers = False
        with pytest.raises(DriverTimeout, match=r"no answer to 'OFS X=0\.0200 Z=0\.0000'"):
            until_it_raises(driver, 200, 0)
        assert has(driver) == [124, -35], "not acknowledged, so not known"
        controller.answers = True
        assert commanded(driver, 200, 0)


def until_it_raises(driver: AsciiOffsetDriver, *units: int) -> None:
    for _ in range(1000):
        driver.apply(np.array(units, np.int64))
        CLOCK.sleep_until_ns(CLOCK.now_ns() + 2_000_000)


def test_a_refusal_is_reported_in_its_own_words_and_forgotten_when_it_is_taken(
    controller: OffsetController, tmp_path: Path
) -> None:
    controller.refuses = True
    with made(tmp_path, READ_BACK) as driver:
        assert not isinstance(driver, OneWay)
        soon(CLOCK, lambda: has(driver) == [0, 0])
        with pytest.raises(DriverFault, match=r"refuses .*ERR 12"):
            until_it_raises(driver, 5, 5)
        controller.refuses = False
        assert commanded(driver, 5, 5)
        driver.apply(np.array([5, 5], np.int64))


def test_the_read_back_is_what_counts(controller: OffsetController, tmp_path: Path) -> None:
    """A controller that says OK and does nothing never has the command; what it had at the start is taken over."""
    controller.has, controller.deaf = {"X": 0.0007, "Z": 0.0}, True
    with made(tmp_path, READ_BACK) as driver:
        soon(CLOCK, lambda: has(driver) == [7, 0])
        for _ in range(50):
            driver.apply(np.array([9, 9], np.int64))
            CLOCK.sleep_until_ns(CLOCK.now_ns() + 2_000_000)
        assert has(driver) == [7, 0]
        assert any(line == "OFS X=0.0009 Z=0.0009" for line in controller.lines)


@pytest.mark.parametrize("options", [ACKNOWLEDGED, READ_BACK], ids=["acknowledged", "read back"])
def test_after_a_restart_nothing_is_commanded_until_it_is_ordered(
    controller: OffsetController, tmp_path: Path, options: dict[str, Any]
) -> None:
    """Else its offsets would jump from nothing to the old ones. Oracle: the lines that the controller was sent."""
    with made(tmp_path, options) as driver:
        assert commanded(driver, 100, 100)
        controller.restart()
        soon(CLOCK, lambda: bool(driver.must_resume))
        sent = [line for line in controller.lines if line != "OFS?"]
        with pytest.raises(DriverFault, match="ordered to resume"):
            until_it_raises(driver, 101, 101)
        assert [line for line in controller.lines if line != "OFS?"] == sent
        assert controller.has == {"X": 0.0, "Z": 0.0}
        driver.resume()
        assert commanded(driver, 1, 1)


def test_somebody_elses_offset_is_noticed(controller: OffsetController, tmp_path: Path) -> None:
    """An operator who types an offset into the controller; no restart is printed."""
    with made(tmp_path, READ_BACK) as driver:
        assert commanded(driver, 100, 100)
        controller.has = {"X": 0.25, "Z": 0.01}
        soon(CLOCK, lambda: bool(driver.must_resume))
        assert "has X +250 µm, Z +10 µm, and was commanded X +10 µm, Z +10 µm: check" in driver.must_resume
        assert has(driver) == [2500, 100]


def test_an_answer_in_coarser_steps_is_called_that(controller: OffsetController, tmp_path: Path) -> None:
    """A controller that shows whole micrometres, commanded in tenths."""
    with made(tmp_path, READ_BACK) as driver:
        assert commanded(driver, 100, 100)
        controller.has = {"X": 0.010, "Z": 0.011}
        soon(CLOCK, lambda: bool(driver.must_resume))
        assert "does it answer in steps coarser than resolution_um?" in driver.must_resume


def test_a_silent_loss_while_an_axis_moves_is_never_made_good_by_the_next_command(
    controller: OffsetController, tmp_path: Path
) -> None:
    """Oracle: docs/ascii-offset.md, "Restarts". The controller's own list of the lines that it was sent.

    It is never asked at a time of its own (once an hour), so that only the command can be the occasion to notice it.
    """
    with made(tmp_path, READ_BACK, ask_period_s=3600.0) as driver:
        assert commanded(driver, 417, -35)
        controller.has = {"X": 0.0, "Z": 0.0}

        def holds() -> bool:
            with suppress(DriverFault):
                driver.apply(np.array([418, -35], np.int64))
            return bool(driver.must_resume)

        soon(CLOCK, holds)
        assert "OFS X=0.0418 Z=-0.0035" not in controller.lines
        assert controller.has == {"X": 0.0, "Z": 0.0}
        assert "has X +0 µm, Z +0 µm, and was commanded X +41.7 µm, Z -3.5 µm" in driver.must_resume
        driver.resume()
        assert has(driver) == [0, 0]
        assert commanded(driver, 1, 0)


def test_a_controller_that_does_not_say_what_it_has_gets_no_command(
    controller: OffsetController, tmp_path: Path
) -> None:
    """Oracle: as above; silence is no answer. It goes on as soon as the controller speaks again."""
    with made(tmp_path, READ_BACK, ask_period_s=3600.0) as driver:
        assert commanded(driver, 417, 0)
        controller.answers = False
        with pytest.raises(DriverTimeout, match=r"no answer to 'OFS\?'"):
            until_it_raises(driver, 418, 0)
        assert "OFS X=0.0418 Z=0.0000" not in controller.lines
        controller.answers = True
        assert commanded(driver, 418, 0)


def test_without_any_answer_a_line_that_was_sent_counts_and_the_last_is_sent_at_the_end(
    controller: OffsetController, tmp_path: Path
) -> None:
    """Leaving sends what was ordered just before, so that rtec's account is the controller's."""
    controller.answers = False
    silent = {k: v for k, v in ACKNOWLEDGED.items() if k not in ("acknowledge", "refuse")}
    driver = made(tmp_path, silent)
    with driver:
        assert has(driver) == [0, 0]
        driver.was_told(np.array([3, 4], np.int64))
        assert has(driver) == [3, 4]
        assert commanded(driver, 10, 20)
        driver.apply(np.array([11, 21], np.int64))
    soon(CLOCK, lambda: controller.has == {"X": 0.0011, "Z": 0.0021})


def test_a_pulled_cable_is_reported_and_comes_back(tmp_path: Path) -> None:
    with PtyPeer(OffsetController(), CLOCK, tmp_path / "port", 0.001) as peer:
        retry = {"port": str(tmp_path / "port"), "first_retry_s": 0.01, "longest_retry_s": 0.02}
        with made(tmp_path, READ_BACK, serial=retry) as driver:
            assert commanded(driver, 5, 6)
            peer.pull()
            with pytest.raises(DriverUnavailable):
                until_it_raises(driver, 5, 6)
            peer.plug()
            assert commanded(driver, 7, 8)
