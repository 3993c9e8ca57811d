"""LinuxCNC's servo thread without rtec and with it, in turns: its own component `latencybins`, every servo period.

Without: neither daemon nor bridge. With: the bridge and `rtec run`, correcting. The same programme runs all the time.
MINUTES=10 measures for so long; one minute where it is not said.
"""

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from tests.bench.table import Row
from tests.support.linuxcnc_loop import Floats, run_files, start_daemon, until_pins
from tests.support.linuxcnc_session import BRIDGE, PYTHON, Session, why_not

NAME = "latency of LinuxCNC's servo thread"
STINT_S = 10.0
HAL = """\
loadrt latencybins
addf latencybins.0 servo-thread
addf sampler.2 servo-thread
setp latencybins.0.nsbinsize 1000
setp latencybins.0.maxbinnumber 1000
setp sampler.2.enable 0
net latency latencybins.0.latency => sampler.2.pin.0
"""
SAMPLER = "depth=4000,16000 cfg=fffbb,ffffffffffb"
EDITS = {
    "mill.hal": [(SAMPLER, "depth=4000,16000,64000 cfg=fffbb,ffffffffffb,s")],
    "mill.ini": [("HALFILE = mill-plant.hal\n", "HALFILE = mill-plant.hal\nHALFILE = latency.hal\n")],
}
MOTION = "G21 G90\nO100 while [1]\nG0 X80 Y80 Z80\nG0 X-80 Y-80 Z-80\nO100 endwhile\nM2\n"
GOAL = "≤ 1.5 × without"
SHARES = (("p50", 50.0), ("p99", 99.0), ("p99.9", 99.9), ("max", 100.0))


def rows() -> list[Row]:
    """Percentiles of the latency with rtec, beside those without; one row where LinuxCNC is not there."""
    why = why_not()
    if why:
        return [Row(NAME, "-", None, why, "", False)]
    stints = max(1, round(60.0 * float(os.environ.get("MINUTES", "1")) / (2.0 * STINT_S)))
    without, with_rtec = measured(stints, STINT_S)
    out = []
    for name, share in SHARES:
        ours, theirs = (float(np.percentile(v, share)) for v in (with_rtec, without))
        goal, met = (GOAL, ours <= 1.5 * theirs) if name == "p99" else ("", True)
        out.append(Row(f"{NAME}, {name}", f"{ours:.0f} µs", ours / theirs, f"without rtec: {theirs:.0f} µs", goal, met))
    return out


def measured(stints: int, stint_s: float) -> tuple[Floats, Floats]:
    """Latencies without and with rtec: of each servo period how far it was from its time, µs."""
    found: tuple[list[Floats], list[Floats]] = ([], [])
    with Session("mill", EDITS, {"latency.hal": HAL, "motion.ngc": MOTION}) as mill:
        mill.state("estop_reset")
        mill.state("on")
        mill.home()
        end_bridges(mill)
        mill.begin("motion.ngc")
        for k in range(stints):
            found[0].append(latencies_us(mill, f"without-{k}.txt", stint_s))
            with corrected(mill):
                found[1].append(latencies_us(mill, f"with-{k}.txt", stint_s))
        mill.abort()
    return np.concatenate(found[0]), np.concatenate(found[1])


def latencies_us(mill: Session, name: str, seconds: float) -> Floats:
    """How far each servo period of so long was from its time, µs."""
    mill.record(2, name)
    mill.rest(seconds)
    mill.stop_record(2)
    return np.asarray(np.abs(mill.recorded(name)[:, 1]) * 1e-3)


@contextmanager
def corrected(mill: Session) -> Iterator[None]:
    """The bridge, and `rtec run` as a user starts it."""
    line = next(x for x in (mill.folder / "mill.hal").read_text().splitlines() if x.startswith("loadusr -Wn rtec"))
    words = line.split(str(BRIDGE))[1].split()
    mill.start("bridge", PYTHON, str(BRIDGE), *words)
    before = mill.gets("x-correction")
    run = start_daemon(mill, run_files(mill), mill.folder / "rtec.log")
    try:
        until_pins(mill, ["x-correction"], lambda mm: abs(mm[0] - before) > 1e-4)
        yield
    finally:
        run.send_signal(signal.SIGTERM)
        run.wait(30)
        end_bridges(mill)


def end_bridges(mill: Session) -> None:
    """kill -9 of the bridges of this LinuxCNC and of who keeps watch over them: the signals keep their values."""
    for entry in sorted(Path("/proc").glob("[0-9]*"), key=lambda p: int(p.name)):  # who keeps watch is older
        try:
            words = (entry / "cmdline").read_bytes().split(b"\0")
            if str(BRIDGE).encode() in words and (entry / "cwd").resolve() == mill.folder:
                os.kill(int(entry.name), signal.SIGKILL)
        except OSError:
            continue
