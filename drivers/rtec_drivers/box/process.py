"""`python -m rtec_drivers.box.process LINK`: a simulated encoder box in a process of its own, until its input ends."""

import argparse
import sys
from pathlib import Path

from rtec.loop.clock import RealClock
from rtec_drivers.box.simulator import BoxSimulator
from rtec_drivers.pty_peer import PtyPeer


class MovingPlant:
    """Every axis moves to and fro by `span_counts` at `counts_per_s`."""

    def __init__(self, axes: int, counts_per_s: int, span_counts: int) -> None:
        self._axes, self._speed, self._span = axes, counts_per_s, span_counts

    def counts(self, now_ns: int) -> list[int]:
        """A triangle over time."""
        way = now_ns * self._speed // 1_000_000_000 % (2 * self._span)
        return [min(way, 2 * self._span - way)] * self._axes

    def insert(self, ledger: list[int]) -> None:
        """Nobody looks."""


def main(arguments: list[str]) -> None:
    """Serve until standard input ends, which it does when whoever started this is gone."""
    parser = argparse.ArgumentParser(prog="rtec_drivers.box.process", description=__doc__)
    parser.add_argument("link", type=Path, help="name to give to the port")
    parser.add_argument("--axes", type=int, default=2)
    parser.add_argument("--counts-per-s", type=int, default=100_000)
    parser.add_argument("--span-counts", type=int, default=100_000)
    given = parser.parse_args(arguments)
    plant = MovingPlant(given.axes, given.counts_per_s, given.span_counts)
    with PtyPeer(BoxSimulator(plant, given.axes), RealClock(), given.link):
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        sys.stdin.read()


if __name__ == "__main__":
    main(sys.argv[1:])
