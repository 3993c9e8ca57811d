#!/usr/bin/env python3
"""Prints what fits: `table.py FOLDER` reads the logs of nextpnr (*.nextpnr) from `make synth` and `make ecp5`.

Exit status 1: a board's largest clock is below 25 MHz, or its log does not have it.
"""

import re
import sys
from pathlib import Path

LEAST_MHZ = 25.0
CELLS = re.compile(r"(ICESTORM_LC|TRELLIS_COMB):\s*(\d+)/\s*(\d+)")
CLOCK = re.compile(r"Max frequency for clock .*: ([\d.]+) MHz")


def row(log: str) -> tuple[int, int, float]:
    """Used cells, available cells, and the largest clock after routing, MHz: the last one in the log.

    Raises:
        ValueError: the log does not have it.
    """
    cells, clocks = CELLS.findall(log), CLOCK.findall(log)
    if not cells or not clocks:
        raise ValueError("no utilisation or no clock in it")
    return int(cells[-1][1]), int(cells[-1][2]), float(clocks[-1])


def main(folder: Path) -> int:
    """Print the table; give the exit status."""
    bad = 0
    sys.stdout.write("board          logic cells         largest clock\n")
    for log in sorted(folder.glob("*.nextpnr")):
        try:
            used, there, mhz = row(log.read_text(encoding="utf-8"))
        except ValueError as e:
            sys.stdout.write(f"{log}: {e}\n")
            bad += 1
            continue
        good = mhz >= LEAST_MHZ
        bad += not good
        words = "" if good else f", below {LEAST_MHZ:g} MHz"
        sys.stdout.write(f"{log.stem:12} {used:6} of {there:6} ({100 * used / there:2.0f} %) {mhz:8.1f} MHz{words}\n")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
