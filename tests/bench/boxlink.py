"""Counts to command over the serial box link at 1 kHz, beside a bare echo over a pseudo terminal in the same run.

The driver's round trip: READ sent, STATE received and checked, COMMAND sent. The echo's: the bytes of a STATE written
and read back, from a Python process too that does nothing else. Both wait for the next millisecond first, and run at
the loop's priority where the system grants it.
"""

import os
import select
import subprocess
import sys
import tempfile
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from timeit import default_timer

import numpy as np

from rtec.loop.clock import RealClock
from rtec.tomlfile import validated
from rtec_drivers.box.driver import BoxOptions, SerialBoxDriver
from tests.bench.table import Row
from tests.support.gateware import line_times, missing, spi_times
from tests.support.machines import turning_centre

CYCLES = 5000
WARM_UP = 200
PERIOD_NS = 1_000_000
PRIORITY = 80
ANSWER_BYTES = 36
MICROFRAME_US = 125.0
"""USB 2.0 at high speed hands bytes over so often: each way waits so long at most."""
ECHO = """
import os, tty
master, slave = os.openpty()
tty.setraw(slave)
print(os.ttyname(slave), flush=True)
while True:
    data = os.read(master, 4096)
    os.write(master, data)
"""


def rows() -> list[Row]:
    """All figures of this file."""
    box, echo = [], []
    with _real_time() as priority:
        for _ in range(2):  # in turns, so that what else this computer does meets both
            echo.append(_echo())
            box.append(_box())
    theirs, ours = np.concatenate(echo), np.concatenate(box)
    link = [
        Row(
            f"counts to command over the serial box link at 1 kHz, 2 axes, {name}",
            f"{np.percentile(ours, percent):.0f} µs",
            float(np.percentile(ours, percent) / np.percentile(theirs, percent)),
            f"bare pty echo of {ANSWER_BYTES} bytes: {np.percentile(theirs, percent):.0f} µs, {priority}",
            "",
            True,
        )
        for name, percent in (("p50", 50), ("p99", 99))
    ]
    return [*link, *_gateware(float(np.percentile(ours, 50)))]


def _gateware(software_us: float) -> list[Row]:
    """The simulated gateware by its own clocks: the line and the chip, without a computer at the other end."""
    if why := missing():
        return [Row("gateware of the encoder box", "not simulated", None, why, "", True)]
    read_us, command_us, lost = line_times()
    spi_read_us, spi_command_us, spi_lost = spi_times()
    beside = f"round trip of the box in software: {software_us:.0f} µs"
    times = {
        "3 Mbaud": (read_us, command_us),
        "SPI of 2 MHz": (spi_read_us, spi_command_us),
        "SPI of 2 MHz behind high-speed USB (computed)": (
            spi_read_us + 2 * MICROFRAME_US,
            spi_command_us + MICROFRAME_US,
        ),
    }
    out = []
    for line, both in times.items():
        for what, us in zip(("READ to the end of its answer", "COMMAND to its first count"), both, strict=True):
            out.append(Row(f"gateware, 3 axes, {line}: {what}", f"{us:.0f} µs", us / software_us, beside, "", True))
    for line, n in (("3 Mbaud", lost), ("SPI of 2 MHz", spi_lost)):
        name = f"gateware, 3 axes, {line}: latches lost at 4 kHz"
        out.append(Row(name, f"{n}", None, "400 cycles of 250 µs", "0", n == 0))
    return out


def _box() -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Times of round trips, µs."""
    with tempfile.TemporaryDirectory() as folder, _process(["-m", "rtec_drivers.box.simulator", f"{folder}/box"]):
        table = {"port": f"{folder}/box", "max_speed_mm_s": {"X": 400.0, "Z": 400.0}, "timeout_ms": 20.0}
        clock, machine = RealClock(), turning_centre()
        counts, output = np.zeros(2, np.int64), np.zeros(2, np.int64)
        with SerialBoxDriver(validated(BoxOptions, table, "bench"), machine, clock, Path(folder)) as driver:

            def cycle() -> None:
                driver.read_counts(counts)
                driver.apply(output)

            return _times(clock, cycle)


def _echo() -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    with _process(["-c", ECHO]) as (_, name):
        fd = os.open(name, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(fd)
        message = b"\x55" * ANSWER_BYTES

        def cycle() -> None:
            os.write(fd, message)
            got = 0
            while got < ANSWER_BYTES:
                select.select((fd,), (), ())
                got += len(os.read(fd, 4096))

        try:
            return _times(RealClock(), cycle)
        finally:
            os.close(fd)


def _times(clock: RealClock, cycle: Callable[[], None]) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    out = np.empty(CYCLES)
    for i in range(-WARM_UP, CYCLES):
        clock.sleep_until_ns((clock.now_ns() // PERIOD_NS + 1) * PERIOD_NS)
        start = default_timer()
        cycle()
        if i >= 0:
            out[i] = default_timer() - start
    return out * 1e6


@contextmanager
def _real_time() -> Iterator[str]:
    """Run at the loop's priority, and so do processes that are started meanwhile; say how."""
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except PermissionError:
        yield "both at ordinary priority"
        return
    try:
        yield f"both SCHED_FIFO {PRIORITY}"
    finally:
        os.sched_setscheduler(0, *before)


@contextmanager
def _process(arguments: list[str]) -> "Iterator[tuple[subprocess.Popen[str], str]]":
    """A process that says one line when it is ready; that line."""
    command = [sys.executable, *arguments]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield process, process.stdout.readline().strip()
        finally:
            process.terminate()
