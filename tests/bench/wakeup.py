"""Wake-up latency of the loop at 1 kHz beside cyclictest, same priority and processor, in turns."""

import os
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

from rtec.daemon.supervisor import Supervisor
from tests.bench.table import Row
from tests.support import setups

SECONDS = 10
PRIORITY = 80


def rows() -> list[Row]:
    """All figures of this file; one row that says so where cyclictest is not installed."""
    goal = "≤ 2 × cyclictest"
    if shutil.which("cyclictest") is None:
        return [
            Row("wake-up latency at 1 kHz", "-", None, "cyclictest is not installed (Debian rt-tests)", goal, False)
        ]
    theirs, ours = [], []
    for _ in range(2):
        theirs.append(_cyclictest())
        ours.append(_loop())
    out = []
    for k, name in enumerate(("p50", "p99.9", "max")):
        mine, other = min(o[k] for o in ours), min(t[k] for t in theirs)
        met = name != "p99.9" or mine <= 2 * other
        shown = goal if name == "p99.9" else ""
        out.append(
            Row(
                f"wake-up latency at 1 kHz, {name}",
                f"{mine:.0f} µs",
                mine / other,
                f"cyclictest: {other:.0f} µs",
                shown,
                met,
            )
        )
    return out


def _loop() -> tuple[float, float, float]:
    with tempfile.TemporaryDirectory() as folder:
        setup = setups.setup(Path(folder))
        report = Supervisor(setup, Path(folder) / "bench.arrows").run(SECONDS)
    times = report.summary["wake_up"]
    return times["p50_us"], times["p99_9_us"], times["max_us"]


def _cyclictest() -> tuple[float, float, float]:
    """p50, p99.9 and largest from its histogram of 1 µs bins."""
    cpu = max(os.sched_getaffinity(0))
    command = ["cyclictest", "-m", "-q", f"-p{PRIORITY}", "-i1000", f"-l{SECONDS * 1000}", f"-a{cpu}", "-h20000"]
    text = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    bins = [(int(a), int(b)) for a, b in re.findall(r"^(\d{6}) (\d+)$", text, re.M)]
    total, seen, found = sum(b for _, b in bins), 0, []
    for share in (0.5, 0.999):
        seen, index = 0, 0
        while seen < share * total:
            seen += bins[index][1]
            index += 1
        found.append(float(bins[index - 1][0] + 1))
    return found[0], found[1], float(max(a for a, b in bins if b))
