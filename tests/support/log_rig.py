"""Folders of logs for tests: files as the daemon names them, at dates that a test chooses."""

from pathlib import Path

import numpy as np

from rtec.log.reader import open_log
from rtec.log.writer import LogWriter
from rtec.loop.records import Commands, Layout, Samples

LAYOUT = Layout(("X", "Z"), ("T_bed", "T_air"))
NOON_NS = 1_773_057_600_000_000_000
"""2026-03-09 12:00:00 UTC."""
Block = tuple[Samples, Commands]


def rows(first: int, n: int, *, layout: Layout = LAYOUT, seed: int = 3) -> Block:
    """Rows at 1 kHz, numbered by their instant; every bit pattern that matters is among the numbers."""
    rng = np.random.default_rng([seed, first])
    samples, commands = Samples.empty(layout, n), Commands.empty(layout, n)
    for array in (*samples.arrays().values(), *commands.arrays().values()):
        if array.dtype == np.float64:
            array[:] = rng.normal(size=array.shape) * 10.0 ** rng.integers(-200, 200, array.shape)
            array.reshape(-1)[::7] = np.nan
            array.reshape(-1)[3::11] = -0.0
            array.reshape(-1)[5::13] = -np.inf
        else:
            limits = np.iinfo(array.dtype)
            array[:] = rng.integers(limits.min, limits.max, array.shape, endpoint=True)
    commands.requested_um.reshape(-1).view(np.int64)[1::17] = 0x7FF0_0000_0000_0ABC  # a NaN that carries something
    followed = rng.random(n) < 0.9
    commands.applied_um[followed] = commands.requested_um[followed]
    samples.time_ns[:] = (first + np.arange(n)) * 1_000_000
    return samples, commands


def write(
    path: Path, first: int, n: int, *, noon_at_ns: int | None = 0, layout: Layout = LAYOUT, flush: int = 0
) -> Path:
    """Write a log of rows; `noon_at_ns` is the monotonic instant at which the clock on the wall shows NOON_NS."""
    header = {"host": "pc", "first_row": str(first)}
    if noon_at_ns is not None:
        header |= {"monotonic_ns": str(first * 1_000_000), "wall_ns": str(NOON_NS + first * 1_000_000 - noon_at_ns)}
    with LogWriter(path, layout, header) as log:
        block = rows(first, n, layout=layout)
        for start in range(0, n, flush or max(n, 1)):
            stop = start + (flush or n)
            log.write(block[0].rows(start, stop), block[1].rows(start, stop))
            log.flush()
    return path


def read(path: Path) -> list[Block]:
    """All rows of a log."""
    with open_log(path) as log:
        return list(log.blocks())


def same(found: list[Block], wanted: Block) -> bool:
    """Bit for bit."""
    arrays = wanted[0].arrays() | wanted[1].arrays()
    parts = [s.arrays() | c.arrays() for s, c in found]
    return all(b"".join(p[name].tobytes() for p in parts) == array.tobytes() for name, array in arrays.items())
