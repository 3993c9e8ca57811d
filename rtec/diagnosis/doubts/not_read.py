"""Readings that follow a column that nothing reads, as a humidity: any other name would be wrong."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rtec.diagnosis.doubts.doubt import Doubt
from rtec.estimation import floor
from rtec.estimation.candidates import REAL
from rtec.estimation.gls import solve
from rtec.estimation.judge import Judgement
from rtec.estimation.readings import Readings
from rtec.metrology.measurement import Measurement
from rtec.metrology.unread import is_rotary, joined, not_read, ranged
from rtec.wording import ERROR_UNITS, listed, sizes

Floats = NDArray[np.float64]

MOSTLY = 0.5
"""Share of the mean square that the column must leave at most."""
FOLLOWS, LIKE_RANKS, SAME_SLOPE = 0.9, 0.8, 0.75
"""Correlation of the residual with a column from which on it follows it, in the record and in both of its halves; of
their ranks; and smaller slope of a half over the larger."""
OWN = 0.25
"""Least share of its mean square, and of the residual's, that a column has beside all channels that are read."""
COPY = 0.9995
"""Correlation from which on a column is the reading once more."""
ENOUGH = 40
HOLD = (
    "No effect can read that column. Hold constant what it shows while you measure, or leave these readings out; a "
    "temperature can be a sensor of the machine file."
)


def follows(judged: Judgement) -> list[Doubt]:
    """A doubt where the residual follows a column that nothing reads, beside all channels that are read."""
    readings = judged.readings
    names = set.intersection(*(set(m.unread) for m in readings.measurements))
    if not names or len(readings) < ENOUGH:
        return []
    best = _best(judged, {n: c for n in sorted(names) if not is_rotary(n) and (c := _column(readings, n)) is not None})
    if best is None:
        return []
    after, name, words = best
    there, here = sizes(judged.residual, after)
    every = joined({name: m.unread[name]} for m in readings.measurements)
    line = "that product" if words else "a straight line in it"
    message = (
        f"The residual follows {ranged(name, every[name])}, which rtec does not read{words}: {line} lowers it "
        f"from {there} to {here} {ERROR_UNITS[judged.unit]}."
    )
    return [Doubt("not_read", message, HOLD, fatal=True)]


def _best(judged: Judgement, columns: dict[str, Floats]) -> tuple[float, str, str] | None:
    """What the column that explains most leaves, its name, and words on the position that it is multiplied with."""
    readings = judged.readings
    read, best = _read(readings), None
    ways = [(np.ones((len(read), 1)), "", floor.cleaned(readings, read))]
    for axis, by in _positions(readings):
        both = floor.cleaned(readings, np.hstack([read, read * by[:, 1:]]))
        ways.append((by, f", times the position along {axis}", both))
    for by, words, known in ways:
        for name, column in columns.items():
            left = _beside(judged, floor.cleaned(readings, column[:, None] * by), known)
            if left is not None and (best is None or left**2 < (MOSTLY if words != best[2] else 1.0) * best[0] ** 2):
                best = left, name, words
    return best


def _column(readings: Readings, name: str) -> Floats | None:
    """A column that nothing reads, from its mean in parts of its range, (m,); None if it does not vary."""
    column = np.concatenate([readings.measurements[s.source].unread[name][s.row] for s in readings.series])
    varies = np.isfinite(column).all() and np.ptp(column) > 0.0
    return (column - column.mean()) / np.ptp(column) if varies else None


def _read(readings: Readings) -> Floats:
    """Positions, directions, temperatures and the time, each from its mean in parts of its range, (m, k)."""
    machine = readings.machine
    names = [c for a in machine.axes for c in (a.channel, a.direction_channel)]
    values = [readings.channel(n) for n in (*names, *machine.sensor_names, "time_s")]
    values = [(v - v.mean()) / np.ptp(v) for v in values if np.isfinite(v).all() and np.ptp(v) > 0.0]
    return np.stack(values, axis=1)


def _positions(readings: Readings) -> list[tuple[str, Floats]]:
    """Names of the axes that move, and one beside their positions from the mean in parts of their range, (m, 2)."""
    values = [(a.name, readings.channel(a.channel)) for a in readings.machine.axes]
    return [
        (name, np.stack([np.ones(len(v)), (v - v.mean()) / np.ptp(v)], axis=1))
        for name, v in values
        if np.isfinite(v).all() and np.ptp(v) > 0.0
    ]


def _beside(judged: Judgement, columns: Floats, known: Floats) -> float | None:
    """What columns that the residual follows leave of it; None where it does not follow them.

    Args:
        judged: the model.
        columns: less what the instruments cannot know, (m, q).
        known: what is read, less what the instruments cannot know, (m, k).
    """
    whole = np.column_stack([judged.left, floor.cleaned(judged.readings, judged.readings.values), columns])
    own = whole - known @ solve(known, whole)
    left, read = own[:, 0], own[:, 1]
    mixed = solve(own[:, 2:], left[:, None])
    column, beside = (columns @ mixed)[:, 0], (own[:, 2:] @ mixed)[:, 0]
    if beside @ beside < OWN * (column @ column) or left @ left < OWN * (judged.left @ judged.left):
        return None
    if abs(_correlation(read, beside)) > COPY or abs(_correlation(_ranks(left), _ranks(beside))) < LIKE_RANKS:
        return None
    late = np.concatenate([s.time_s > np.median(s.time_s) for s in judged.readings.series])
    slopes = []
    for part in (np.ones(len(late), dtype=np.bool_), late, ~late):
        if abs(_correlation(left[part], beside[part])) < FOLLOWS:
            return None
        slopes.append(float(left[part] @ beside[part]) / float(beside[part] @ beside[part]))
    if min(slopes[1:], key=abs) / max(slopes[1:], key=abs) < SAME_SLOPE:
        return None
    rest = judged.pooled(judged.left - column * float(judged.left @ column) / float(column @ column))
    return rest if rest**2 < MOSTLY * judged.residual**2 else None


def _correlation(one: Floats, other: Floats) -> float:
    return float(one @ other) / max(float(np.sqrt((one @ one) * (other @ other))), 1e-300)


def _ranks(values: Floats) -> Floats:
    ranks = np.asarray(np.argsort(np.argsort(values)), dtype=np.float64)
    return np.asarray(ranks - ranks.mean())


def unread_beside(measurements: Sequence[Measurement], doubts: Sequence[Doubt] = ()) -> str:
    """A sentence, to follow others, on columns that vary and that nothing reads; empty where a doubt is about them."""
    if any(d.kind == "not_read" for d in doubts):
        return ""
    said = not_read(joined(m.unread for m in measurements))
    return f" {said}" if said else ""


def not_logged_beside(measurements: Sequence[Measurement]) -> str:
    """A sentence, to follow others, on temperatures that vary in one file and are not in another; else empty.

    An effect of such a temperature is no candidate for any error that the other file reads as well.
    """
    sensors = [s for s in measurements[0].machine.sensor_names if any(_varies(m, s) for m in measurements)]
    without = {m.name: [s for s in sensors if s not in m.channels] for m in measurements}
    missing = [s for s in sensors if any(s in lacks for lacks in without.values())]
    if not missing:
        return ""
    files = listed([name for name, lacks in without.items() if lacks])
    reads = "read" if " and " in files else "reads"
    return (
        f" Not tested: effects of {listed(missing)} on what {files} {reads}, without these temperatures. "
        f"Leave {files} out, or write the temperature into the file: rtec import --answer {missing[0]}_degc=VALUE."
    )


def _varies(measurement: Measurement, sensor: str) -> bool:
    values = measurement.channels.get(sensor)
    return values is not None and float(np.ptp(values)) > REAL["degc"]
