"""The encoder box's gateware, simulated clock by clock by Verilator; it replaces the box in software.

`make -C drivers/box sim` makes the library. `GatewareBox` receives and sends bytes as `BoxSimulator` does, UART and
all, so the two are interchangeable. The controller's counts are decoded from the output lines.

`python -m rtec_drivers.box.gateware LINK --library LIBRARY` is one behind a serial port, in a process of its own.
"""

import argparse
import ctypes
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from rtec.errors import ConfigError
from rtec.loop.clock import Clock, RealClock
from rtec_drivers.box.simulator import MovingPlant, Plant, until_input_ends
from rtec_drivers.pty_peer import PtyPeer

LIMIT: Final = 2**31 - 1
LONGEST_ANSWER_CLOCKS: Final = 100_000
PIPELINE_CLOCKS: Final = 100
"""Clocks after which an encoder's edge is counted and output, whatever filter the board has."""
PERIOD_S: Final = 0.0005
"""Behind a port the chip is run at this period, so that it has little to catch up when a question comes."""
LONGEST_MS: Final = 20
"""Longest time that it catches up behind a port: on a slow computer the chip's own clock is slow, too."""
Bytes = NDArray[np.uint8]
_CHIP: Final = ctypes.c_void_p
_CALLS: Final[dict[str, tuple[Any, list[Any]]]] = {
    "sizes": (None, [ctypes.POINTER(ctypes.c_int64)]),
    "new": (_CHIP, []),
    "delete": (None, [_CHIP, ctypes.c_char_p]),
    "settings": (None, [_CHIP, ctypes.POINTER(ctypes.c_uint32)]),
    "reset": (None, [_CHIP]),
    "power": (None, [_CHIP, ctypes.c_int, ctypes.c_uint32, ctypes.c_uint32, ctypes.c_int64]),
    "broken": (None, [_CHIP, ctypes.c_uint32]),
    "pace": (None, [_CHIP, ctypes.c_double]),
    "glitch": (None, [_CHIP, ctypes.c_int]),
    "time": (None, [_CHIP, ctypes.c_uint32, ctypes.c_uint32]),
    "freeze": (None, [_CHIP, ctypes.c_int]),
    "relay": (ctypes.c_int, [_CHIP]),
    "resumed": (ctypes.c_int, [_CHIP]),
    "commands": (ctypes.c_int64, [_CHIP]),
    "send": (None, [_CHIP, ctypes.c_char_p, ctypes.c_int]),
    "receive": (ctypes.c_int, [_CHIP, ctypes.c_char_p, ctypes.c_int]),
    "run": (ctypes.c_int64, [_CHIP, ctypes.c_int64, ctypes.POINTER(ctypes.c_int64)]),
    "settle": (ctypes.c_int64, [_CHIP, ctypes.c_int64]),
    "spi": (None, [_CHIP, ctypes.c_char_p, ctypes.c_char_p, ctypes.c_int, ctypes.c_int]),
    "lines": (None, [_CHIP, ctypes.c_int, ctypes.c_int64, *[ctypes.c_void_p] * 6]),
    "ledger": (None, [_CHIP, ctypes.c_int, ctypes.POINTER(ctypes.c_int64)]),
}


@dataclass(frozen=True)
class AxisLedger:
    """Counts of one axis of the chip.

    Attributes:
        raw, inserted: the chip's registers.
        corrected: decoded from its lines by an independent counter.
        illegal: output transitions of both lines at once.
        closest: least distance of two output edges, clocks.
        at_index: the chip's register.
    """

    raw: int
    inserted: int
    corrected: int
    illegal: int
    closest: int
    at_index: int


class Chip:
    """One simulated chip.

    Args:
        library: library that `make sim` made.
        coverage: file for the coverage, where the library was made with COVERAGE=1.

    Attributes:
        library: path of the library.
        axes, clk_hz, baud: parameters of the library.

    Raises:
        ConfigError: the library does not exist or is not one.
    """

    def __init__(self, library: Path, coverage: Path | None = None) -> None:
        self.library = library
        try:
            self._lib = ctypes.CDLL(str(library.resolve()))
            for name, (result, arguments) in _CALLS.items():
                call = getattr(self._lib, f"chip_{name}")
                call.restype, call.argtypes = result, arguments
        except (OSError, AttributeError) as e:
            raise ConfigError(f"{library}: no simulated gateware: {e}; `make -C drivers/box sim` makes one") from None
        sizes = (ctypes.c_int64 * 4)()
        self._lib.chip_sizes(sizes)
        self.axes, self.clk_hz, self.baud = (int(n) for n in sizes[:3])
        self._coverage = str(coverage or "").encode()
        self._chip = self._lib.chip_new()
        self._owner = os.getpid()
        self.settings()
        self.reset()

    def settings(
        self,
        *,
        filter_length: int = 0,
        whole_cycles: bool = False,
        interval: int | None = None,
        limit: int = LIMIT,
        boot: int = 1,
        box_serial: int = 42,
        counter_bits: int = 32,
        hold_after_ms: int = 100,
        counts_per_s: int = 20_000,
    ) -> None:
        """Set the board's constants; `interval` None: that of `counts_per_s`."""
        clocks = max(1, self.clk_hz // counts_per_s) if interval is None else interval
        given = (
            filter_length, int(whole_cycles), clocks, limit, boot, box_serial, counter_bits, hold_after_ms,
            counts_per_s,
        )  # fmt: skip
        self._lib.chip_settings(self._chip, (ctypes.c_uint32 * len(given))(*given))

    def check_axes(self, axes: int) -> None:
        """Check the number of axes.

        Raises:
            ConfigError: the library has another one.
        """
        if self.axes != axes:
            raise ConfigError(
                f"{self.library}: gateware of {self.axes} axes, the machine has {axes}; "
                f"`make -C drivers/box sim AXES={axes}` makes another"
            )

    def close(self) -> None:
        """End the simulation; a copy of it in a forked process is dropped, as its threads are not there to be ended."""
        if self._chip and os.getpid() == self._owner:
            self._lib.chip_delete(self._chip, self._coverage)
        self._chip = None

    def __enter__(self) -> Self:
        """Return the chip itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """End the simulation."""
        self.close()

    def __del__(self) -> None:
        """End a simulation that was not closed."""
        if getattr(self, "_chip", None):
            self.close()

    def reset(self) -> None:
        """Power off and on, with the encoders at zero."""
        self._lib.chip_reset(self._chip)

    def power(self, *, rst: bool, a: int, b: int, clocks: int) -> None:
        """Apply reset and lines (a bit an axis) for so many clocks; the controller counts from the reset on."""
        self._lib.chip_power(self._chip, int(rst), a, b, clocks)

    def broken(self, mask: int) -> None:
        """Give these encoders, a bit each, an improper signal at their receivers."""
        self._lib.chip_broken(self._chip, mask)

    def pace(self, faster: float) -> None:
        """Let the other end of the serial line send faster than the chip expects: 0.01 means by 1 %."""
        self._lib.chip_pace(self._chip, self.clk_hz / self.baud / (1.0 + faster))

    def glitch(self, clocks: int) -> None:
        """Hold the serial line low for so many clocks."""
        self._lib.chip_glitch(self._chip, clocks)

    def since(self, start_us: int, heard_ms: int) -> None:
        """Set the time since its start, and since its last command."""
        self._lib.chip_time(self._chip, start_us, heard_ms)

    def freeze(self, frozen: bool) -> None:
        """Freeze the register of the chip's time, or release it."""
        self._lib.chip_freeze(self._chip, int(frozen))

    @property
    def relay(self) -> bool:
        """Do the outputs go to the controller?"""
        return bool(self._lib.chip_relay(self._chip))

    @property
    def resumed(self) -> bool:
        """Has it been ordered to resume since its start?"""
        return bool(self._lib.chip_resumed(self._chip))

    @property
    def commands(self) -> int:
        """Number of accepted commands since its start; a repeated number counts once."""
        return int(self._lib.chip_commands(self._chip))

    def run(self, clocks: int, places: list[int]) -> int:
        """Move the encoders to their places, evenly, at most one count a clock; give the clocks that it took.

        Of a jump that no machine can make, most is written to the counters.
        """
        return int(self._lib.chip_run(self._chip, clocks, (ctypes.c_int64 * self.axes)(*places)))

    def settle(self) -> int:
        """Run until nothing is on its way into or out of the link; give the clocks that it took."""
        return int(self._lib.chip_settle(self._chip, LONGEST_ANSWER_CLOCKS))

    def lines(self, axis: int, a: Bytes, b: Bytes, z: Bytes) -> tuple[Bytes, Bytes, Bytes]:
        """Feed lines, a sample a clock; give the output at each clock."""
        lines = [np.ascontiguousarray(line, np.uint8) for line in (a, b, z)]
        out = [np.empty(len(a), np.uint8) for _ in range(3)]
        self._lib.chip_lines(self._chip, axis, len(a), *(line.ctypes.data for line in (*lines, *out)))
        return out[0], out[1], out[2]

    def send(self, data: bytes) -> None:
        """Queue bytes on the serial line; they go at its rate."""
        self._lib.chip_send(self._chip, data, len(data))

    def received(self) -> bytes:
        """The bytes that the chip has sent."""
        room = ctypes.create_string_buffer(4096)
        n = self._lib.chip_receive(self._chip, room, len(room))
        return room.raw[:n]

    def spi(self, data: bytes, half: int = 4) -> bytes:
        """Exchange bytes as an SPI master does, with `half` clocks of the chip for half a clock of the line."""
        came = ctypes.create_string_buffer(len(data))
        self._lib.chip_spi(self._chip, data, came, len(data), half)
        return came.raw

    def ledger(self, axis: int) -> AxisLedger:
        """Counts of one axis."""
        out = (ctypes.c_int64 * 6)()
        self._lib.chip_ledger(self._chip, axis, out)
        return AxisLedger(*out)


class GatewareBox:
    """The gateware with the interface of `BoxSimulator`: bytes in, bytes out, wired to a plant.

    The chip follows the clock, but of what it has to catch up it skips the part beyond `longest_ms`; while its line
    carries a frame it may be ahead. After a start its counters begin at the plant's counts, as after homing.

    Args:
        chip: a simulated chip that is this box's alone.
        plant: its encoders and the controller behind it.
        axes: number of axes; must be the library's.
        counter_bits, hold_after_ms, counts_per_s, box_serial, boot: as of `BoxSimulator`.
        longest_ms: longest time that it catches up at once.

    Raises:
        ConfigError: the chip has another number of axes.
    """

    def __init__(
        self,
        chip: Chip,
        plant: Plant,
        axes: int,
        counter_bits: int = 32,
        hold_after_ms: int = 100,
        counts_per_s: int = 20_000,
        box_serial: int = 42,
        boot: int = 1,
        longest_ms: int = 1000,
    ) -> None:
        self.chip, self.plant, self.axes = chip, plant, axes
        self._longest = longest_ms * chip.clk_hz // 1000
        self._settings: dict[str, Any] = {
            "counter_bits": counter_bits, "hold_after_ms": hold_after_ms, "counts_per_s": counts_per_s,
            "box_serial": box_serial, "boot": boot - 1,
        }  # fmt: skip
        chip.check_axes(axes)
        self._clocks, self._start_ns = 0, -1
        self._broken = self._frozen = False
        self._inserted = [0] * axes
        self.reset()

    def reset(self) -> None:
        """Power off and on: ledger zero, another start, no insertion before it is ordered to resume."""
        self._boot = (self._boot + 1) & 0xFFFF
        self.chip.reset()
        self._inserted = [0] * self.axes
        self.plant.insert(list(self._inserted))

    @property
    def _boot(self) -> int:
        """Number of its start."""
        return int(self._settings["boot"])

    @_boot.setter
    def _boot(self, number: int) -> None:
        self._settings["boot"] = number
        self.chip.settings(**self._settings)

    @property
    def _resumed(self) -> bool:
        """Has it been ordered to resume since its start?"""
        return self.chip.resumed

    @property
    def commands(self) -> int:
        """Number of accepted commands."""
        return self.chip.commands

    @property
    def encoder_fault(self) -> bool:
        """Does an encoder's receiver get an improper signal?"""
        return self._broken

    @encoder_fault.setter
    def encoder_fault(self, broken: bool) -> None:
        self._broken = broken
        self.chip.broken(int(broken))

    @property
    def frozen(self) -> bool:
        """Is its time frozen, so that its encoders seem to stand still?"""
        return self._frozen

    @frozen.setter
    def frozen(self, frozen: bool) -> None:
        self._frozen = frozen
        self.chip.freeze(frozen)

    _places: tuple[int, ...] = ()

    def receive(self, data: bytes, now_ns: int) -> bytes:
        """Process bytes at the line's rate, with the encoders where they are now; run until the answer is out."""
        out = self.idle(now_ns)
        self.chip.send(data)
        self._clocks += self.chip.settle()
        self._tell()
        return out + self.chip.received()

    def idle(self, now_ns: int) -> bytes:
        """Advance time; encoders move."""
        if self._start_ns < 0:
            self._start_ns = now_ns
        due = (now_ns - self._start_ns) * self.chip.clk_hz // 10**9 - self._clocks
        places = self._places if self._frozen else tuple(self.plant.counts(now_ns))
        moved, self._places = places != self._places, places
        if due > 0 or moved:
            clocks = min(max(due, 0), self._longest)
            took = self.chip.run(clocks, list(places))
            took += self.chip.run(PIPELINE_CLOCKS, list(places)) if moved else 0
            self._clocks += max(due - clocks, 0) + took
        self._tell()
        return self.chip.received()

    def tick(self, now_ns: int) -> None:
        """Advance time; bytes from the chip are dropped, but there are none."""
        self.idle(now_ns)

    def close(self) -> None:
        """End the simulation."""
        self.chip.close()

    def _tell(self) -> None:
        """Report the controller's surplus over the encoders, by its own count, to the plant."""
        ledgers = [self.chip.ledger(i) for i in range(self.axes)]
        inserted = [ledger.corrected - ledger.raw for ledger in ledgers]
        if inserted != self._inserted:
            self._inserted = inserted
            self.plant.insert(list(inserted))


def on_a_port(box: GatewareBox, clock: Clock, link: Path) -> PtyPeer:
    """The box behind a serial port; it needs about a third of a processor for each 2 MHz."""
    return PtyPeer(box, clock, link, PERIOD_S)


def main(arguments: list[str]) -> None:
    """Serve until standard input ends, as it does when the parent process has ended."""
    parser = argparse.ArgumentParser(prog="rtec_drivers.box.gateware", description=__doc__)
    parser.add_argument("link", type=Path, help="name to give to the port")
    parser.add_argument("--library", type=Path, required=True, help="what `make -C drivers/box sim` made")
    parser.add_argument("--counts-per-s", type=int, default=100_000)
    parser.add_argument("--span-counts", type=int, default=100_000)
    given = parser.parse_args(arguments)
    with Chip(given.library) as chip:
        plant = MovingPlant(chip.axes, given.counts_per_s, given.span_counts)
        with on_a_port(GatewareBox(chip, plant, chip.axes, longest_ms=LONGEST_MS), RealClock(), given.link):
            until_input_ends()


if __name__ == "__main__":
    main(sys.argv[1:])
