"""Devices that print lines. Oracle of each test: the text that was printed, worked out by hand."""

import os
import threading
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtec.doctor.readings import ways
from rtec.errors import ConfigError, DriverError, DriverFault, DriverTimeout, DriverUnavailable
from rtec.loop.clock import RealClock, VirtualClock
from rtec.tomlfile import validated
from rtec_drivers.ascii.driver import AsciiLinesDriver
from rtec_drivers.ascii.text import AsciiOptions, LineParser, LineReader
from rtec_drivers.pty_peer import PtyPeer
from tests.support.conformance import MACHINE, DriverLaws, Rig, open_files, soon

pytestmark = pytest.mark.xdist_group("real-clock")
MS = 1_000_000
SECOND = 1000 * MS
TWO = r"T1=\s*(?P<T_bed>\S+) T2=\s*(?P<T_air>\S+)"
BED, AIR = MACHINE.sensor_names.index("T_bed"), MACHINE.sensor_names.index("T_air")


class Board:
    """Prints a line whenever it may speak."""

    def __init__(self, line: bytes) -> None:
        self.line = line

    def receive(self, data: bytes, now_ns: int) -> bytes:
        del now_ns
        return b"T1= 30.5 T2= 18\r\n" if data == b"READ?\r" else b""

    def idle(self, now_ns: int) -> bytes:
        del now_ns
        return self.line


class TestAsciiLines(DriverLaws):
    @pytest.fixture
    def rig(self, tmp_path: Path) -> Iterator[Rig]:
        with PtyPeer(Board(b"T1= 21.5 T2= 17.25 S=900 X=10.0 Z=-5.5\r\n"), RealClock(), tmp_path / "port", 0.001):
            yield Rig(
                AsciiLinesDriver,
                {
                    "port": str(tmp_path / "port"),
                    "patterns": [TWO + r" S=(?P<spindle_rpm>\d+) X=(?P<X>\S+) Z=(?P<Z>\S+)"],
                    "units": {"X": "mm", "Z": "mm"},
                    "max_speed_mm_s": {"X": 400.0, "Z": 400.0},
                },
                misspelt="pattern",
                nearest="patterns",
                sensors=["T_bed", "T_air"],
                missing={"port": str(tmp_path / "nothing"), "at_start": "required"},
            )


class Wire:
    """A pseudo terminal that the test writes into by hand, and a driver on a virtual clock."""

    def __init__(self, **options: Any) -> None:
        self.clock = VirtualClock(10**12)
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        table = {"port": os.ttyname(self.slave), "patterns": [TWO], **options}
        self.driver = AsciiLinesDriver(validated(AsciiOptions, table, "run.toml"), MACHINE, self.clock)
        self.degc, self.times = np.full(8, np.nan), np.zeros(8, np.int64)

    def __enter__(self) -> Self:
        self.driver.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self.driver.__exit__(None, None, None)
        for fd in (self.master, self.slave):
            os.close(fd)

    def says(self, text: bytes) -> str:
        """It prints this, a millisecond later the driver looks; give what it tells."""
        os.write(self.master, text)
        return self.look()

    def look(self, after_ns: int = MS) -> str:
        self.clock.sleep_until_ns(self.clock.now_ns() + after_ns)
        try:
            self.driver.read_temperatures(self.degc, self.times)
        except DriverError as e:
            return f"{type(e).__name__}: {e}"
        return ""


@pytest.fixture
def wire() -> Iterator[Wire]:
    with Wire() as wire:
        wire.says(b"\n")
        yield wire


def test_values_and_instants(wire: Wire) -> None:
    """The instant is that of the look before: the line came after it. Other sensors are left as they were."""
    before_ns = wire.clock.now_ns()
    assert wire.says(b"T1=21.5 T2= -3e0\r\n") == ""
    assert (wire.degc[BED], wire.degc[AIR]) == (21.5, -3.0)
    assert wire.times[[BED, AIR]].tolist() == [before_ns] * 2
    assert np.count_nonzero(wire.times) == 2
    assert wire.look() == ""
    assert wire.times[BED] == before_ns


def test_half_a_line_is_never_a_number(wire: Wire) -> None:
    """`T1=121.5` in pieces: nothing is taken before its end has come; attached in mid-line, nothing of it."""
    for piece in (b"T1=12", b"1.5 T2", b"=17.0"):
        assert wire.says(piece) == ""
        assert np.isnan(wire.degc[BED])
    assert wire.says(b"5\n") == ""
    assert (wire.degc[BED], wire.degc[AIR]) == (121.5, 17.05)
    with Wire(patterns=[r"(?P<T_bed>\S+)"]) as late:
        assert late.says(b"1.5\n21.5\n") == ""
        assert late.degc[BED] == 21.5


def test_garbage_is_told_and_passes(wire: Wire) -> None:
    """Not one of these gives a number; the next good line is taken and ends the complaint."""
    for text, words in (
        (b"\xff\xfe\x80\x00gibberish\n", "fits no pattern"),
        (b"T1=OPEN T2=17\n", "T_bed: 'OPEN' is no number"),
        (b"T1=nan T2=17\n", "T_bed: 'nan' is no number"),
        (b"T1=1e999 T2=17\n", "T_bed: '1e999' is no number"),
        (b"T1=2_1 T2=17\n", "T_bed: '2_1' is no number"),
        (b"T1=21,5 T2=17\n", "T_bed: '21,5' is no number"),
        (b"T1=21.5 T2=17 T3=4\n", "fits no pattern"),
    ):
        told = wire.says(text)
        assert words in told
        assert told.startswith("DriverFault")
        assert np.isnan(wire.degc[BED])
        assert wire.says(b"T1=21.5 T2=17\n") == ""
        assert wire.degc[BED] == 21.5
        wire.degc[:] = np.nan
        wire.driver._book.values.clear()


def test_of_a_line_with_one_bad_number_the_others_are_taken(wire: Wire) -> None:
    """An open thermocouple takes nothing from its neighbour."""
    assert "T_bed" in wire.says(b"T1=OPEN T2=17.5\n")
    assert wire.degc[AIR] == 17.5
    assert np.isnan(wire.degc[BED])


def test_lines_that_never_end(wire: Wire) -> None:
    """A hundred kilobytes without a line end: memory stays small, and the first whole line after it is read."""
    for _ in range(100):
        wire.says(b"x" * 1000)
        assert len(wire.driver._reader._rest) < 5000
    wire.look()
    assert wire.driver._reader.too_long == 1
    wire.says(b"9 T2=9\n")
    assert wire.says(b"T1=21.5 T2=17\n") == ""
    assert wire.degc[BED] == 21.5


@given(st.lists(st.integers(0, 9), max_size=40), st.integers(1, 30))
def test_lines_do_not_depend_on_how_they_come(lengths: list[int], piece: int) -> None:
    """Oracle: all lines but the first, which may be half a one, and those that are too long."""
    lines = [bytes([65 + k % 26]) * n for k, n in enumerate(lengths)]
    data = b"".join(line + b"\n" for line in lines)
    reader = LineReader(b"\n", 7)
    got = [x for i in range(0, len(data), piece) for x in reader.feed(data[i : i + piece])]
    assert got == [line for line in lines[1:] if len(line) <= 7]


@pytest.mark.parametrize(
    ("options", "text", "degc"),
    [
        ({"decimal": ","}, b"T1=21,5 T2=1e1\n", 21.5),
        ({"units": {"T_bed": "degf"}}, b"T1=212 T2=1\n", 100.0),
        ({"units": {"T_bed": "kelvin"}}, b"T1=293.15 T2=1\n", 20.0),
        ({"units": {"T_bed": "0.1degc"}}, b"T1=+215 T2=1\n", 21.5),
        ({"line_end": "cr"}, b"T1=21.5 T2=1\r", 21.5),
        ({"line_end": "crlf"}, b"T1=21.5 T2=1\r\n", 21.5),
        ({"patterns": [r"1 (?P<T_air>\S+)", r"2 (?P<T_bed>\S+)"]}, b"2 21.5\n1 4\n", 21.5),
        ({"patterns": [r"(?P<T_bed>\S+) \xb0C"]}, b"21.5 \xb0C\n", 21.5),
        ({"bytesize": 7, "parity": "even", "stopbits": 2, "baud": 1200}, b"T1=21.5 T2=1\n", 21.5),
    ],
)
def test_what_devices_print(options: dict[str, Any], text: bytes, degc: float) -> None:
    with Wire(**options) as wire:
        wire.says(b"\r\n" if options.get("line_end") != "cr" else b"\r")
        assert wire.says(text) == ""
        assert wire.degc[BED] == pytest.approx(degc, abs=1e-9)


def test_a_decimal_point_where_a_comma_is_expected() -> None:
    """Thousands written with a point must not become a thousandth."""
    with Wire(decimal=",") as wire:
        wire.says(b"\n")
        for text in (b"1.021,5", b"1.021"):
            assert f"T_bed: '{text.decode()}' is no number" in wire.says(b"T1=%s T2=1\n" % text)


def test_lines_without_their_end_are_shown_as_they_came() -> None:
    """Oracle: the bytes that were written. They never end as `line_end` says, so they are no line."""
    with Wire(patterns=[r"X(?P<X>\S+) Z(?P<Z>\S+)"], max_speed_mm_s={"X": 400.0, "Z": 400.0}) as wire:
        os.write(wire.master, b"X=58.46 Z=1" * 5)
        wire.clock.sleep_until_ns(wire.clock.now_ns() + 100 * MS)
        with pytest.raises(DriverTimeout, match=r"positions yet; received: '.*X=58\.46 Z=1'") as told:
            wire.driver.read_counts(np.zeros(2, np.int64))
        place = wire.driver.options
        assert not any("switched on" in way for way in ways(place, told.value, heard=False))
        assert "received" in wire.look(11_000 * MS)


def test_a_number_that_was_read_again_is_no_fault_though_the_position_is_lost() -> None:
    """Oracle: the newest line is good; only the lost position is reported, which waits for the order to resume."""
    options = {"patterns": [r"X(?P<X>\S+) Z(?P<Z>\S+)"], "max_speed_mm_s": {"X": 400.0, "Z": 400.0}}
    with Wire(**options, units={"X": "mm", "Z": "mm"}) as wire:
        assert wire.says(b"\nX1.5 Z0\n") == ""
        assert "'1,5' is no number" in wire.says(b"X1,5 Z0\n")
        for _ in range(3):
            told = wire.says(b"X300 Z0\n")
        assert "is no number" not in told
        assert "the position is not known" in told


def test_silence_is_told_and_the_port_opened_again(wire: Wire) -> None:
    """After `silent_reopen_s` of nothing, or of nothing that fits. The last value keeps its old instant."""
    wire.says(b"T1=21.5 T2=17\n")
    at_ns = wire.times[BED]
    for _ in range(9):
        assert wire.look(SECOND) == ""
    assert "nothing to be understood for" in wire.look(1010 * MS)
    assert wire.times[BED] == at_ns
    assert soon(RealClock(), lambda: wire.look(100 * MS) == "" or None)
    wire.says(b"T2=17\n")
    assert wire.says(b"T1=22.5 T2=17\n") == ""
    assert wire.degc[BED] == 22.5
    assert wire.times[BED] > at_ns


def test_a_stuck_sensor() -> None:
    """Ten minutes at the same tenth of a degree, allowed are five. Its neighbour goes on."""
    with Wire(stuck_after_s=300.0, silent_reopen_s=100.0) as wire:
        wire.says(b"\n")
        for k in range(10):
            told = wire.says(b"T1=21.5 T2=%d\n" % (17 + k % 2))
            if k < 9:
                wire.look(60 * SECOND - MS)
        assert "T_bed: has read 21.5 for" in told
        assert wire.times[BED] < wire.times[AIR]
        assert wire.says(b"T1=21.6 T2=17\n") == ""
        assert wire.degc[BED] == 21.6


def test_an_hour_at_one_temperature_is_a_fault_and_an_hour_at_one_speed_is_none() -> None:
    """As delivered. A reading a minute for 62 minutes: T_bed and spindle always the same, T_air never."""
    with Wire(patterns=[TWO + r" S=(?P<spindle_rpm>\d+)"], silent_reopen_s=100.0) as wire:
        wire.says(b"\n")
        told = []
        for k in range(62):
            wire.look(60 * SECOND)
            told.append(wire.says(b"T1=21.5 T2=%d S=2400\n" % (17 + k % 2)))
        assert set(told[:60]) == {""}
        assert told[-1].endswith("T_bed: has read 21.5 for 3660 s: stuck")
        assert wire.times[BED] < wire.times[AIR]
        wire.says(b"T1=21.6 T2=17 S=2400\n")
        assert wire.driver.read_spindle() == 2400.0


def test_devices_that_must_be_asked(tmp_path: Path) -> None:
    """It prints only when it is asked, once a period."""
    clock = RealClock()
    with PtyPeer(Board(b""), clock, tmp_path / "port"):
        table = {"port": str(tmp_path / "port"), "patterns": [TWO], "request": "READ?\r", "request_period_s": 0.005}
        degc, times = np.full(8, np.nan), np.zeros(8, np.int64)
        with AsciiLinesDriver(validated(AsciiOptions, table, "run.toml"), MACHINE, clock) as driver:

            def read() -> bool:
                driver.read_temperatures(degc, times)
                return bool(degc[BED] == 30.5)

            assert soon(clock, read)


def test_positions_in_counts() -> None:
    """2000 counts a mm; text has no check sum, so what the machine cannot do is refused."""
    options = {"patterns": [r"X(?P<X>\S+) Z(?P<Z>\S+)"], "units": {"X": "mm", "Z": "inch"}}
    with Wire(**options, max_speed_mm_s={"X": 400.0, "Z": 400.0}) as wire:
        counts = np.zeros(2, np.int64)

        def says(text: bytes) -> list[int]:
            os.write(wire.master, text)
            wire.clock.sleep_until_ns(wire.clock.now_ns() + 100 * MS)
            wire.driver.read_counts(counts)
            return [int(n) for n in counts]

        with pytest.raises(DriverTimeout, match="no line with the axes' positions"):
            says(b"\n")
        assert says(b"X1.5 Z-0.1\n") == [3000, -5080]
        with pytest.raises(DriverFault, match="axis X jumped by"):
            says(b"X151.5 Z-0.1\n")
        assert says(b"X2 Z-0.1\n") == [4000, -5080]
        with pytest.raises(DriverFault, match="axis X jumped by"):
            says(b"X300 Z-0.1\n")
        with pytest.raises(DriverFault, match="the position is not known"):
            says(b"X300 Z-0.1\n")
        wire.driver.resume()
        assert says(b"X300 Z-0.1\n") == [600_000, -5080]
    with Wire() as other, pytest.raises(DriverFault, match="no pattern names the axes X, Z"):
        other.driver.read_counts(counts)


def test_cable_pulled_and_put_back(tmp_path: Path) -> None:
    """In mid-line; what comes after is read, and nothing of the torn line. A thousand times without a leak."""
    clock, files, threads = RealClock(), open_files(), threading.active_count()
    board = Board(b"T1=21.5 T2=17\n")
    table = {"port": str(tmp_path / "port"), "patterns": [TWO], "first_retry_s": 0.001, "longest_retry_s": 0.01}
    degc, times = np.full(8, np.nan), np.zeros(8, np.int64)
    seen = set()
    driver = AsciiLinesDriver(validated(AsciiOptions, table, "run.toml"), MACHINE, clock)

    def fresh(since_ns: int) -> bool:
        driver.read_temperatures(degc, times)
        seen.add(float(degc[BED]))
        return bool(times[BED] > since_ns)

    def gone() -> bool:
        try:
            driver.read_temperatures(degc, times)
        except DriverUnavailable as e:
            return "trying again" in str(e)
        return False

    with driver:
        assert soon(clock, gone)
        for _ in range(1000):
            with PtyPeer(board, clock, tmp_path / "port", 0.001) as peer:
                since_ns = clock.now_ns()
                assert soon(clock, lambda: fresh(since_ns))  # noqa: B023 - called at once
                with peer.lock:
                    peer.faults.cut_next = 5
            assert soon(clock, gone)
    assert seen <= {21.5} or all(np.isnan(x) or x == 21.5 for x in seen)
    assert (open_files(), threading.active_count()) == (files, threads)


def test_what_the_options_refuse() -> None:
    """Oracle: the messages."""
    for more, words in (
        ({"patterns": ["(?P<T_bad>x)"]}, "group 'T_bad' is no sensor or axis .* did you mean 'T_bed'"),
        ({"patterns": ["T=(x"]}, "no regular expression"),
        ({"patterns": ["abc"]}, "has no named group"),
        ({"patterns": []}, "patterns"),
        ({"patterns": ["(?P<X>x)"]}, "gives axis X; one line must give all: X, Z"),
        ({"patterns": ["(?P<X>x)(?P<Z>x)"]}, "max_speed_mm_s: axis 'X' is missing"),
        ({"units": {"T_bed": "celsius"}}, "T_bed = 'celsius'.*allowed: .*degc"),
        ({"units": {"T_x_nut": "degc"}}, "units: no group 'T_x_nut'"),
        ({"decimal": ";"}, "decimal"),
    ):
        table = {"port": "/dev/none", "patterns": [TWO], **more}
        with pytest.raises(ConfigError, match=words):
            AsciiLinesDriver(validated(AsciiOptions, table, "run.toml"), MACHINE, VirtualClock())


def test_every_pattern_gives_what_it_names() -> None:
    """Oracle: the groups."""
    options = validated(AsciiOptions, {"port": "x", "patterns": [TWO, r"S(?P<spindle_rpm>\d+)"]}, "run.toml")
    parser = LineParser(options, MACHINE)
    assert parser.groups == ("T_bed", "T_air", "spindle_rpm")
    said = parser.parse(b"S1200")
    assert said is not None
    assert said.values == {"spindle_rpm": 1200.0}
