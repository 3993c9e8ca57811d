"""The encoder box's gateware, simulated clock by clock by Verilator, in the place of the box in software.

`GatewareBox` takes and gives bytes as `BoxSimulator` does, so that everything that tests the box link can be run
against the gateware, its UART included. What the controller has is decoded from the lines that go out.
"""

import ctypes
import os
import shutil
import struct
import subprocess
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtec_drivers.box.simulator import Plant, crc32, stuff, unstuff

FOLDER: Final = Path(__file__).parents[2] / "drivers" / "box"
CLK_HZ: Final = 4_000_000
BAUD: Final = 1_000_000
SEPARATION: Final = 8
LIMIT: Final = 2**31 - 1
STEP: Final = 100
QUIET: Final = 12
"""An answer begins within so many steps of so many clocks."""
Bytes = NDArray[np.uint8]


def missing() -> str:
    """What this computer lacks to simulate gateware; "" where nothing is."""
    lacks = [tool for tool in ("verilator", "g++", "make") if shutil.which(tool) is None]
    return f"needs {', '.join(lacks)} (Debian: apt-get install verilator g++ make)" if lacks else ""


def library(**settings: int) -> ctypes.CDLL:
    """Build the simulation, once for each set of sizes, and load it.

    Args:
        settings: AXES, CLK_HZ, BAUD, SEPARATION, SPI, COVERAGE; see `drivers/box/Makefile`.
    """
    sizes = {"AXES": 2, "CLK_HZ": CLK_HZ, "BAUD": BAUD, "SEPARATION": SEPARATION, "SPI": 0} | settings
    name = "chip-" + "-".join(str(sizes[k]) for k in ("AXES", "CLK_HZ", "BAUD", "SEPARATION", "SPI"))
    name += "-coverage" if sizes.get("COVERAGE") else ""
    lib = _built("sim", name, sizes)
    lib.chip_new.restype = ctypes.c_void_p
    lib.chip_run.restype = ctypes.c_int64
    for call in (
        "delete",
        "settings",
        "reset",
        "broken",
        "relay",
        "send",
        "pending",
        "receive",
        "run",
        "lines",
        "ledger",
        "spi",
    ):
        getattr(lib, f"chip_{call}").argtypes = _ARGUMENTS[call]
    return lib


def _built(target: str, name: str, sizes: dict[str, int]) -> ctypes.CDLL:
    """Make a library, one process at a time, and load it."""
    lock = FOLDER / "build" / f"{name}.lock"
    lock.parent.mkdir(exist_ok=True)
    words = [f"{key}={value}" for key, value in sizes.items()]
    command = ["flock", str(lock), "make", "-s", "-C", str(FOLDER), target, *words]
    # The make that runs the tests must not lend its jobs and options to this one.
    clean = {k: v for k, v in os.environ.items() if k not in ("MAKEFLAGS", "MFLAGS", "MAKELEVEL")}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=clean)
    assert done.returncode == 0, done.stdout + done.stderr
    return ctypes.CDLL(str(FOLDER / "build" / f"{name}.so"))


def insert(
    lines: tuple[Bytes, Bytes, Bytes], target: NDArray[np.int32], separation: int, *, whole_cycles: bool, interval: int
) -> tuple[Bytes, Bytes, Bytes, int, int]:
    """Run the inserter alone over samples, a clock each.

    Args:
        lines: A, B and index, 0 or 1, (n,) each.
        target: inserted counts wanted at each sample, (n,).
        separation: least clocks between an inserted edge and another.
        whole_cycles: four counts at a time.
        interval: least clocks from one inserted count to the next.

    Returns:
        A, B and index as they go out, (n,) each, with the latency taken off; raw and inserted counts at the end.
    """
    lib = _built("inserter", f"inserter-{separation}", {"SEPARATION": separation})
    given = [np.ascontiguousarray(line, np.uint8) for line in lines]
    wanted = np.ascontiguousarray(target, np.int32)
    out = [np.empty(len(wanted), np.uint8) for _ in range(3)]
    ledger = np.zeros(2, np.int32)
    arrays: list[NDArray[Any]] = [*given, wanted, *out, ledger]
    pointers = [ctypes.c_void_p(array.ctypes.data) for array in arrays]
    lib.inserter_run(
        ctypes.c_int64(len(wanted)),
        separation,
        *pointers[:4],
        int(whole_cycles),
        ctypes.c_uint32(interval),
        *pointers[4:],
    )
    return out[0], out[1], out[2], int(ledger[0]), int(ledger[1])


_ARGUMENTS: Final[dict[str, list[Any]]] = {
    "delete": [ctypes.c_void_p],
    "settings": [ctypes.c_void_p, ctypes.POINTER(ctypes.c_uint32)],
    "reset": [ctypes.c_void_p],
    "broken": [ctypes.c_void_p, ctypes.c_uint32],
    "relay": [ctypes.c_void_p],
    "send": [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_int],
    "pending": [ctypes.c_void_p],
    "receive": [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_int],
    "run": [ctypes.c_void_p, ctypes.c_int64, ctypes.POINTER(ctypes.c_int64), ctypes.c_int],
    "lines": [ctypes.c_void_p, ctypes.c_int, ctypes.c_int64, *[ctypes.c_void_p] * 6],
    "ledger": [ctypes.c_void_p, ctypes.c_int, ctypes.POINTER(ctypes.c_int64)],
    "spi": [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_char_p, ctypes.c_int, ctypes.c_int],
}


class Chip:
    """One simulated chip.

    Args:
        axes: encoders.
        sizes: see `library`.
    """

    def __init__(self, axes: int = 2, **sizes: int) -> None:
        self.axes = axes
        self._lib = library(AXES=axes, **sizes)
        clk, baud = sizes.get("CLK_HZ", CLK_HZ), sizes.get("BAUD", BAUD)
        self._chip = self._lib.chip_new(axes, clk // baud)
        self.settings()
        self.reset()

    def settings(
        self,
        *,
        filter_length: int = 0,
        whole_cycles: bool = False,
        interval: int = CLK_HZ // 20_000,
        limit: int = LIMIT,
        boot: int = 1,
        box_serial: int = 42,
        counter_bits: int = 32,
        hold_after_ms: int = 100,
        counts_per_s: int = 20_000,
    ) -> None:
        """What the board's top would tie."""
        given = (
            filter_length, int(whole_cycles), interval, limit, boot, box_serial, counter_bits, hold_after_ms,
            counts_per_s,
        )  # fmt: skip
        self._lib.chip_settings(self._chip, (ctypes.c_uint32 * len(given))(*given))

    def close(self) -> None:
        """End the simulation."""
        if self._chip:
            self._lib.chip_delete(self._chip)
            self._chip = None

    def reset(self) -> None:
        """Power off and on."""
        self._lib.chip_reset(self._chip)

    def broken(self, mask: int) -> None:
        """Encoders, a bit each, whose receiver sees no proper signal."""
        self._lib.chip_broken(self._chip, mask)

    @property
    def relay(self) -> bool:
        """Do the outputs go to the controller?"""
        return bool(self._lib.chip_relay(self._chip))

    def run(self, clocks: int, places: list[int], gap: int = 1) -> int:
        """Let the encoders go to their places, evenly, at most a count in `gap` clocks; give the clocks it took."""
        return int(self._lib.chip_run(self._chip, clocks, (ctypes.c_int64 * self.axes)(*places), gap))

    def lines(self, axis: int, a: Bytes, b: Bytes, z: Bytes) -> tuple[Bytes, Bytes, Bytes]:
        """Feed lines, a sample a clock; give what goes out at each clock."""
        lines = [np.ascontiguousarray(line, np.uint8) for line in (a, b, z)]
        out = [np.empty(len(a), np.uint8) for _ in range(3)]
        self._lib.chip_lines(self._chip, axis, len(a), *(line.ctypes.data for line in (*lines, *out)))
        return out[0], out[1], out[2]

    def send(self, data: bytes) -> None:
        """Put bytes on the serial line; they go at its rate."""
        self._lib.chip_send(self._chip, data, len(data))

    @property
    def sending(self) -> bool:
        """Is something still on its way to the chip?"""
        return bool(self._lib.chip_pending(self._chip))

    def received(self) -> bytes:
        """What came from the chip."""
        room = ctypes.create_string_buffer(4096)
        n = self._lib.chip_receive(self._chip, room, len(room))
        return room.raw[:n]

    def spi(self, data: bytes, half: int = 4) -> bytes:
        """Clock bytes out and in as an SPI master does, `half` clocks of the chip for half a clock of the line."""
        came = ctypes.create_string_buffer(len(data))
        self._lib.chip_spi(self._chip, data, came, len(data), half)
        return came.raw

    def ledger(self, axis: int) -> "Ledger":
        """Counts of one axis."""
        out = (ctypes.c_int64 * 6)()
        self._lib.chip_ledger(self._chip, axis, out)
        return Ledger(*out)


def line_times(cycles: int = 400) -> tuple[float, float, int]:
    """What the box link takes with three axes, at 12 MHz and 3 Mbaud, by the chip's own clocks.

    Args:
        cycles: of 250 µs, with a READ and a COMMAND in each.

    Returns:
        µs from the first bit of a READ to the last of its answer, from the first bit of a COMMAND to its first inserted
        count, and how many of the latches at 4 kHz were lost.
    """
    chip = Chip(3, CLK_HZ=12_000_000, BAUD=3_000_000, SEPARATION=16)
    try:
        chip.settings(interval=12, counts_per_s=1_000_000)
        chip.send(frame(4, 1, (1).to_bytes(2, "little")))
        chip.run(6000, [0, 0, 0])
        chip.received()
        chip.send(frame(2, 2))
        read_us = 0
        answer = b""
        while answer.count(0) < 2:
            chip.run(12, [0, 0, 0])
            answer += chip.received()
            read_us += 1
        chip.send(frame(3, 3, struct.pack("<H3i", 1, 5, 5, 5)))
        command_us = 0
        while not chip.ledger(0).inserted:
            chip.run(12, [0, 0, 0])
            command_us += 1
        came, places = b"", 0
        for n in range(cycles):
            chip.send(frame(2, n) + frame(3, n, struct.pack("<H3i", 1, n % 7, -n % 5, n % 3)))
            places += 50
            chip.run(3000, [places, places, places])
            came += chip.received()
        chip.run(3000, [places, places, places])
        answers = [unstuff(block) for block in (came + chip.received()).split(b"\0") if block]
        good = {int.from_bytes(a[2:4], "little") for a in answers if _at_one_instant(a)}
        return float(read_us), float(command_us), cycles - len(good)
    finally:
        chip.close()


def frame(kind: int, number: int, payload: bytes = b"", version: int = 1) -> bytes:
    """A frame of the box link, as it goes over the wire."""
    body = bytes((version, kind)) + number.to_bytes(2, "little") + payload
    return b"\0" + stuff(body + crc32(body).to_bytes(4, "little")) + b"\0"


def _at_one_instant(state: bytes) -> bool:
    """Is this a whole STATE of three axes that move as one, latched together?"""
    raw = {state[13 + 8 * i : 17 + 8 * i] for i in range(3)}
    return crc32(state[:-4]) == int.from_bytes(state[-4:], "little") and state[1] == 0x82 and len(raw) == 1


class Ledger:
    """Counts of one axis of the chip.

    Attributes:
        raw, inserted, at_index: registers of the chip.
        corrected: decoded from its lines by an independent counter.
        illegal: transitions of both lines at once that went out.
        closest: least clocks between two edges that went out.
    """

    def __init__(self, raw: int, inserted: int, corrected: int, illegal: int, closest: int, at_index: int) -> None:
        self.raw, self.inserted, self.corrected = raw, inserted, corrected
        self.illegal, self.closest, self.at_index = illegal, closest, at_index


class GatewareBox:
    """The gateware with the interface of `BoxSimulator`: bytes in, bytes out, wired to a plant.

    Args:
        plant: its encoders and the controller behind it.
        axes: how many.
        counter_bits, hold_after_ms, counts_per_s, box_serial, boot: as of `BoxSimulator`.
    """

    def __init__(
        self,
        plant: Plant,
        axes: int,
        counter_bits: int = 32,
        hold_after_ms: int = 100,
        counts_per_s: int = 20_000,
        box_serial: int = 42,
        boot: int = 1,
    ) -> None:
        self.plant, self.axes = plant, axes
        self._boot = boot - 1
        self._fixed: dict[str, Any] = {
            "counter_bits": counter_bits, "hold_after_ms": hold_after_ms, "counts_per_s": counts_per_s,
            "box_serial": box_serial, "interval": max(1, CLK_HZ // counts_per_s),
        }  # fmt: skip
        self.chip = Chip(axes)
        self._clocks = 0
        self._start_ns = -1
        self.reset()

    def reset(self) -> None:
        """Power off and on: the counters begin at zero, with the encoders at zero."""
        self._boot = (self._boot + 1) & 0xFFFF
        self.chip.settings(boot=self._boot, **self._fixed)
        self.chip.reset()
        self.plant.insert([0] * self.axes)

    @property
    def encoder_fault(self) -> bool:
        """Does an encoder's receiver see no proper signal?"""
        return self._broken

    @encoder_fault.setter
    def encoder_fault(self, broken: bool) -> None:
        self._broken = broken
        self.chip.broken(int(broken))

    _broken = False

    def receive(self, data: bytes, now_ns: int) -> bytes:
        """Take in bytes at the line's rate; run until the answer is out."""
        out = self.idle(now_ns)
        self.chip.send(data)
        quiet = 0
        while quiet < QUIET:
            self._clocks += self.chip.run(STEP, self.plant.counts(now_ns))
            came = self.chip.received()
            out += came
            quiet = 0 if came or self.chip.sending else quiet + 1
        self._tell()
        return out

    def idle(self, now_ns: int) -> bytes:
        """Time goes by. The chip is ahead by what its line took; of a long silence a second is enough."""
        if self._start_ns < 0:
            self._start_ns = now_ns
        due = (now_ns - self._start_ns) * CLK_HZ // 10**9 - self._clocks
        if due > 0:
            self.chip.run(min(due, CLK_HZ), self.plant.counts(now_ns))
            self._clocks += due
        self._tell()
        return self.chip.received()

    def tick(self, now_ns: int) -> None:
        """Time goes by; what comes from the chip is lost, and none does."""
        self.idle(now_ns)

    def _tell(self) -> None:
        """What the controller has more than the encoders, by its own count."""
        ledgers = [self.chip.ledger(i) for i in range(self.axes)]
        self.plant.insert([ledger.corrected - ledger.raw for ledger in ledgers])

    def close(self) -> None:
        """End the simulation."""
        self.chip.close()
