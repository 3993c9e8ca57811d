"""Builds the simulated gateware for tests, and what tests measure with it.

A build is kept in a folder for passing things, by the hash of all that it is made of: other worktrees, other runs and
the other processes of this one take it from there.
"""

import ctypes
import hashlib
import os
import shutil
import struct
import subprocess
import tempfile
from functools import cache
from itertools import count
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtec.loop.clock import RealClock
from rtec_drivers.box import gateware
from rtec_drivers.box.simulator import Plant, crc32, stuff, unstuff
from rtec_drivers.pty_peer import PtyPeer

FOLDER: Final = Path(os.environ.get("RTEC_GATEWARE", Path(__file__).parents[2] / "drivers" / "box"))
CLK_HZ: Final = 4_000_000
BAUD: Final = 2_000_000
SEPARATION: Final = 4
REAL_CLOCK: Final = {"CLK_HZ": 2_000_000, "BAUD": 1_000_000}
"""As many clocks a second as a busy computer simulates."""
BOARD: Final = {"CLK_HZ": 12_000_000, "BAUD": 3_000_000, "SEPARATION": 16}
"""As the boards have it."""
SPI_BYTE_US: Final = 8 * 6 / 12
SPI_CYCLE_BYTES: Final = 60
"""At 2 MHz: 240 of the 250 µs of a cycle at 4 kHz."""
WHOLE: Final = bool(os.environ.get("RTEC_WHOLE_GATEWARE"))
"""`make gateware`: what is long runs on the gateware too."""
Bytes = NDArray[np.uint8]
_NUMBERS = count()


def missing() -> str:
    """What this computer lacks to simulate gateware; "" where nothing is."""
    lacks = [tool for tool in ("verilator", "g++", "make", "flock") if shutil.which(tool) is None]
    return f"needs {', '.join(lacks)} (Debian: apt-get install verilator g++ make)" if lacks else ""


def library(**settings: int) -> Path:
    """Build the simulation of a chip, once for each set of sizes.

    Args:
        settings: AXES, CLK_HZ, BAUD, SEPARATION, SPI, COVERAGE; see `drivers/box/Makefile`.
    """
    sizes = {"AXES": 2, "CLK_HZ": CLK_HZ, "BAUD": BAUD, "SEPARATION": SEPARATION, "SPI": 0} | settings
    name = "chip-" + "-".join(str(sizes[k]) for k in ("AXES", "CLK_HZ", "BAUD", "SEPARATION", "SPI"))
    name += "-coverage" if sizes.get("COVERAGE") else ""
    return _built("sim", name, tuple(sizes.items()))


@cache
def _builds() -> Path:
    """Folder of the builds of these sources, by these tools; nobody else may write there."""
    digest = hashlib.sha256()
    for tool in ("verilator", "g++"):
        digest.update(subprocess.run([tool, "--version"], capture_output=True, check=True).stdout)
    for path in sorted([*FOLDER.glob("gateware/*"), *FOLDER.glob("sim/*"), FOLDER / "Makefile"]):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    mine = Path(tempfile.gettempdir()) / f"rtec-gateware-{os.getuid()}"
    mine.mkdir(mode=0o700, exist_ok=True)
    assert mine.stat().st_uid == os.getuid(), f"{mine} belongs to somebody else"
    return mine / digest.hexdigest()[:16]


@cache
def _built(target: str, name: str, sizes: tuple[tuple[str, int], ...]) -> Path:
    """Make a library where it is not there, one process at a time."""
    out = _builds() / f"{name}.so"
    if out.exists():
        return out
    out.parent.mkdir(exist_ok=True)
    words = [f"{key}={value}" for key, value in sizes]
    command = [
        "flock",
        str(out.parent / "lock"),
        "make",
        "-s",
        "-C",
        str(FOLDER),
        target,
        f"BUILD={out.parent}",
        *words,
    ]
    # The make that runs the tests must not lend its jobs and options to this one.
    clean = {k: v for k, v in os.environ.items() if k not in ("MAKEFLAGS", "MFLAGS", "MAKELEVEL")}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=clean)
    assert done.returncode == 0, done.stdout + done.stderr
    return out


def chip(axes: int = 2, **sizes: int) -> gateware.Chip:
    """A simulated chip; `sizes` as of `library`.

    Where RTEC_GATEWARE_COVERAGE names a folder, the chip leaves there what was covered of it (`make coverage`).
    """
    if folder := os.environ.get("RTEC_GATEWARE_COVERAGE"):
        name = f"{os.getpid()}-{next(_NUMBERS)}.dat"
        return gateware.Chip(library(AXES=axes, COVERAGE=1, **sizes), Path(folder) / name)
    return gateware.Chip(library(AXES=axes, **sizes))


def gateware_on_a_port(plant: Plant, link: Path, **box_options: int) -> PtyPeer:
    """The gateware behind a pseudo terminal."""
    slow = chip(**REAL_CLOCK)
    box = gateware.GatewareBox(slow, plant, slow.axes, longest_ms=gateware.LONGEST_MS, **box_options)
    return gateware.on_a_port(box, RealClock(), link)


class GatewareBox(gateware.GatewareBox):
    """The gateware as a box, built where it is needed."""

    def __init__(self, plant: Plant, axes: int, *positional: int, **options: int) -> None:
        super().__init__(chip(axes), plant, axes, *positional, **options)


@cache
def _insertion(separation: int) -> ctypes.CDLL:
    return ctypes.CDLL(str(_built("inserter", f"inserter-{separation}", (("SEPARATION", separation),))))


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
    lib = _insertion(separation)
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


def line_times(cycles: int = 400) -> tuple[float, float, int]:
    """What the box link takes with three axes, at 12 MHz and 3 Mbaud, by the chip's own clocks.

    Args:
        cycles: of 250 µs, with a READ and a COMMAND in each.

    Returns:
        µs from the first bit of a READ to the last of its answer, from the first bit of a COMMAND to its first inserted
        count, and how many of the latches at 4 kHz were lost.
    """
    with chip(3, **BOARD) as box:
        box.settings(interval=12, counts_per_s=1_000_000)
        box.send(frame(4, 1, (1).to_bytes(2, "little")))
        box.run(6000, [0, 0, 0])
        box.received()
        box.send(frame(2, 2))
        read_us = 0
        answer = b""
        while answer.count(0) < 2:
            box.run(12, [0, 0, 0])
            answer += box.received()
            read_us += 1
        box.send(frame(3, 3, struct.pack("<H3i", 1, 5, 5, 5)))
        command_us = 0
        while not box.ledger(0).inserted:
            box.run(12, [0, 0, 0])
            command_us += 1
        came, places = b"", 0
        for n in range(cycles):
            box.send(frame(2, n) + frame(3, n, struct.pack("<H3i", 1, n % 7, -n % 5, n % 3)))
            places += 50
            box.run(3000, [places, places, places])
            came += box.received()
        box.run(3000, [places, places, places])
        return float(read_us), float(command_us), cycles - _latches(came + box.received())


def spi_times(cycles: int = 400) -> tuple[float, float, int]:
    """What `line_times` gives, over SPI without an adapter, at a sixth of the chip's 12 MHz, the most it takes.

    The master reads on while the chip thinks, so the answer comes in the same transfer as the question.
    """
    with chip(3, **BOARD, SPI=1) as box:
        box.settings(interval=12, counts_per_s=1_000_000)
        box.run(500, [0, 0, 0])
        boot = unstuff(box.spi(frame(1, 1) + bytes(80), half=3).strip(b"\0"))[4:6]
        came = box.spi(frame(2, 2) + bytes(100), half=3)
        read_us = (len(came.rstrip(b"\0")) + 1) * SPI_BYTE_US
        box.spi(frame(4, 3, boot) + bytes(100), half=3)
        command = frame(3, 4, boot + struct.pack("<3i", 5, 5, 5))
        box.spi(command, half=3)
        command_us = len(command) * SPI_BYTE_US
        while not box.ledger(0).inserted:
            box.run(6, [0, 0, 0])
            command_us += 0.5
        came, places = b"", 0
        for n in range(cycles):
            sent = frame(2, n) + frame(3, n, boot + struct.pack("<3i", n % 7, -n % 5, n % 3))
            sent += bytes(SPI_CYCLE_BYTES - len(sent))
            came += box.spi(sent, half=3)
            places += 50
            box.run(3000 - 48 * len(sent) - 12, [places, places, places])
        came += box.spi(bytes(SPI_CYCLE_BYTES), half=3)
        return read_us, command_us, cycles - _latches(came)


def frame(kind: int, number: int, payload: bytes = b"", version: int = 1) -> bytes:
    """A frame of the box link, as it goes over the wire."""
    body = bytes((version, kind)) + number.to_bytes(2, "little") + payload
    return b"\0" + stuff(body + crc32(body).to_bytes(4, "little")) + b"\0"


def _latches(came: bytes) -> int:
    """How many questions were answered by counts of one instant."""
    answers = [unstuff(block) for block in came.split(b"\0") if block]
    return len({int.from_bytes(a[2:4], "little") for a in answers if _at_one_instant(a)})


def _at_one_instant(state: bytes) -> bool:
    """Is this a whole STATE of three axes that move as one, latched together?"""
    raw = {state[13 + 8 * i : 17 + 8 * i] for i in range(3)}
    return crc32(state[:-4]) == int.from_bytes(state[-4:], "little") and state[1] == 0x82 and len(raw) == 1
