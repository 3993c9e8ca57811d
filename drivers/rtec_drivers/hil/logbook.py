"""Summary of the daemon's log: holds, age of the sensors' readings, and jumps."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtec.correction.flags import HOLD_REASONS, MODE_TAKEN_OVER, ORDER_MASK
from rtec.log.reader import LogReader
from rtec.loop.records import Commands, Samples
from rtec.loop.run_file import Setup

NS = 1e-9


@dataclass(frozen=True)
class Logbook:
    """Summary of a log.

    Attributes:
        time_ns: instant of every cycle, (n,).
        held: was the correction held? (n,).
        age_s: by sensor, age of its reading, s, (n,), in single precision.
        fastest: largest rate of change of the correction between two cycles, relative to its slew limit, over all axes.
        commanded: output of every cycle, (n, axes).
        output: the last output, by axis.
    """

    time_ns: NDArray[np.int64]
    held: NDArray[np.bool_]
    age_s: Mapping[str, NDArray[np.float32]]
    fastest: float
    commanded: NDArray[np.int64]
    output: Mapping[str, int]

    def seconds(self, start_ns: int) -> NDArray[np.float64]:
        """Time of every cycle since an instant, s, (n,)."""
        return np.asarray((self.time_ns - start_ns) * NS)


def read_logbook(path: Path, setup: Setup) -> Logbook:
    """Read a log once; memory grows by some ten bytes an axis and four a sensor for every cycle."""
    times, held, ages, outputs, fastest = [], [], [], [], 0.0
    before: tuple[Samples, Commands] | None = None
    with LogReader(path) as reader:
        layout = reader.layout
        slew = np.array([setup.file.limits[a].slew_um_s if a in setup.file.limits else np.inf for a in layout.axes])
        for samples, commands in reader.blocks():
            times.append(samples.time_ns.copy())
            held.append((commands.flags & HOLD_REASONS) != 0)
            ages.append(((samples.time_ns[:, None] - samples.degc_time_ns) * NS).astype(np.float32))
            fastest = max(fastest, _fastest(before, samples, commands, slew))
            before = (
                samples.rows(len(samples) - 1, len(samples)).copy(),
                commands.rows(len(samples) - 1, len(samples)).copy(),
            )
            outputs.append(commands.output.copy())
    age_s, commanded = np.concatenate(ages), np.concatenate(outputs)
    return Logbook(
        np.concatenate(times),
        np.concatenate(held),
        {name: age_s[:, k] for k, name in enumerate(layout.sensors)},
        fastest,
        commanded,
        dict(zip(layout.axes, commanded[-1].tolist(), strict=True)),
    )


def _fastest(
    before: tuple[Samples, Commands] | None, samples: Samples, commands: Commands, slew: NDArray[np.float64]
) -> float:
    """Largest change of a block, and from the block before, relative to what the slew limit allows in that time.

    A row whose ledger was taken over from the box is no change: the box had it already.
    """
    time_ns, applied, mode = samples.time_ns, commands.applied_um, samples.mode & ORDER_MASK
    if before is not None:
        time_ns = np.concatenate([before[0].time_ns, time_ns])
        applied = np.concatenate([before[1].applied_um, applied])
        mode = np.concatenate([before[0].mode & ORDER_MASK, mode])
    if len(time_ns) < 2:
        return 0.0
    allowed = np.diff(time_ns)[:, None] * NS * slew
    share = np.abs(np.diff(applied, axis=0)) / allowed
    share[mode[1:] == MODE_TAKEN_OVER] = 0.0
    share[mode[:-1] == MODE_TAKEN_OVER] = 0.0
    return float(share.max())


def held_spans(logbook: Logbook, start_ns: int) -> Sequence[tuple[float, float]]:
    """Begin and end of every hold, s since an instant."""
    seconds, held = logbook.seconds(start_ns), logbook.held
    edges = np.flatnonzero(np.diff(np.concatenate([[0], held.astype(np.int8), [0]])))
    return [
        (float(seconds[a]), float(seconds[min(b, len(seconds) - 1)]))
        for a, b in zip(edges[::2], edges[1::2], strict=True)
    ]
