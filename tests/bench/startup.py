"""How long the commands take to answer."""

import subprocess
import sys
from timeit import default_timer

from tests.bench.table import Row

RUNS = 7


def rows() -> list[Row]:
    """All figures of this file."""
    bare = _median([sys.executable, "-c", "pass"])
    return [
        _row("import rtec", [sys.executable, "-c", "import rtec"], bare),
        _row("rtec --help", [sys.executable, "-m", "rtec.cli.main", "--help"], bare),
    ]


def _row(name: str, command: list[str], bare_s: float) -> Row:
    seconds = _median(command)
    return Row(name, f"{seconds:.3f} s", seconds / bare_s, f"bare Python: {bare_s:.3f} s", "< 0.5 s", seconds < 0.5)


def _median(command: list[str]) -> float:
    times = []
    for _ in range(RUNS):
        start = default_timer()
        subprocess.run(command, check=True, capture_output=True)
        times.append(default_timer() - start)
    return sorted(times)[RUNS // 2]
