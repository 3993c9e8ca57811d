"""Readings that follow a column that nothing reads, as a humidity: any other name would be wrong."""

import math
import re
from collections.abc import Sequence

import numpy as np

from rtec.arrays import Floats
from rtec.diagnosis.doubts.doubt import Doubt
from rtec.estimation import floor
from rtec.estimation.candidates import REAL
from rtec.estimation.gls import solve
from rtec.estimation.judge import Judgement
from rtec.estimation.readings import Readings
from rtec.metrology.instruments.laser import LaserLinear
from rtec.metrology.measurement import Measurement
from rtec.metrology.unread import is_rotary, joined, not_read, ranged
from rtec.wording import ERROR_UNITS, listed, significant, sizes

MOSTLY = 0.5
"""Share of the mean square that the column must leave at most."""
FOLLOWS, LIKE_RANKS, SAME_SLOPE = 0.9, 0.8, 0.75
"""Correlation of the residual with a column from which on it follows it, in the record and in both of its halves; of
their ranks; and smaller slope of a half over the larger."""
POSITION = "the position along {}"
CLEAR = 1.5
"""From this many times the noise floor on, correlations are those of what is no noise."""
OWN = 0.25
"""Least share of its mean square, and of the residual's, that a column has beside all channels that are read."""
COPY = 0.9995
"""Correlation from which on a column is the reading once more."""
ENOUGH = 40
ALIKE = 1.2
"""A column leaves at most this many times what an effect leaves: the readings do not decide between them."""
PHYSICAL = 1.5
"""The slope over the pressure may differ from that of the air by this factor."""
SAME = 0.999
"""Correlation with a channel from which on a column is that channel, in another unit."""
PRESSURE = re.compile(r"(.*[\W_])?(pressure|press|druck|baro\w*|h?pa|kpa|m?bar|mmhg|torr|p)([\W_].*)?")
HPA = ((870.0, 1085.0, 1.0), (87.0, 108.5, 10.0), (650.0, 815.0, 1.3332), (0.87, 1.085, 1e3), (8.7e4, 1.085e5, 0.01))
"""Pressures of the air that occur, in five units, and the hPa of one of each."""
AIR_UM_PER_M_HPA = 0.268
"""Change of a wavelength in air, µm per metre and hPa: that of the index of air at 20 °C."""
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
    for what, by in (*_positions(readings), *_directions(readings)):
        both = floor.cleaned(readings, np.hstack([read, read * by[:, 1:]]))
        ways.append((by, f", times {what}", both))
    for by, words, known in ways:
        for name, column in columns.items():
            left = _beside(judged, floor.cleaned(readings, column[:, None] * by), known)
            if left is not None and (best is None or left**2 < (MOSTLY if words != best[2] else 1.0) * best[0] ** 2):
                best = left, name, words
    return best


def as_well(judged: Judgement, readings: Readings, base: Floats, columns: Floats, label: str) -> Doubt | None:
    """Doubt about an effect where a column that nothing reads explains the readings nearly as well, along an axis.

    No effect is named where that is the air of a laser's beam: the slope over its pressure is that of physics.

    Args:
        judged: the model.
        readings: those of the search, of the same series.
        base: columns of the model, (m, p).
        columns: of the effect, (m, k).
        label: name of the effect.
    """
    names = set.intersection(*(set(m.unread) for m in readings.measurements))
    if not names or len(readings) < ENOUGH:
        return None
    known, values = floor.cleaned(readings, base), floor.cleaned(readings, readings.values)

    def left(more: Floats) -> tuple[float, Floats]:
        whole = np.hstack([known, floor.cleaned(readings, more)])
        found = solve(whole, values)
        return floor.pooled(readings, floor.rms_by_series(readings, values - whole @ found), judged.scale), found

    none, mine = left(np.zeros((len(values), 0)))[0], left(columns)[0]
    read, best = _read(readings), None
    for name in sorted(n for n in names if not is_rotary(n)):
        column = _column(readings, name)
        if column is None or not _is_own(column, read, values, readings):
            continue
        for what, by in (*_positions(readings), *_directions(readings)):
            rest, found = left(column[:, None] * by)
            if rest <= min(ALIKE * mine, math.sqrt(MOSTLY) * none) and (best is None or rest < best[0]):
                best = rest, name, what, float(found[-1])
    if best is None:
        return None
    rest, name, what, slope = best
    every = joined({name: m.unread[name]} for m in readings.measurements)
    size, other = sizes(rest, mine)
    air = _of_pressure(readings, name, what, slope, every[name])
    well = "nearly as well as" if rest > mine else "at least as well as"
    message = (
        f"{ranged(name, every[name])}, which rtec does not read, times {what} explains the readings "
        f"{well} {label}: they leave {size} and {other} {ERROR_UNITS[judged.unit]}.{air}"
    )
    step = "Correct the readings for the pressure first." if air else f"Measure again with {name} held constant."
    return Doubt("not_read", message, step, fatal=bool(air))


def _is_own(column: Floats, read: Floats, values: Floats, readings: Readings) -> bool:
    """Whether a column is neither what is read in another unit, nor the reading."""
    same = max(abs(_correlation(column, one)) for one in read.T) > SAME
    return not same and abs(_correlation(floor.cleaned(readings, column), values)) < FOLLOWS


def _of_pressure(readings: Readings, name: str, what: str, slope: float, column: Floats) -> str:
    """Words where the slope is that of a laser's beam over the pressure of the air; else empty.

    Args:
        what: what the column is multiplied with; only the position along an axis is the length of a beam.
        slope: µm over the ranges of column and position.
    """
    lasers = all(isinstance(m.instrument, LaserLinear) for m in readings.measurements)
    hpa = next((to for low, high, to in HPA if low < np.nanmin(column) and np.nanmax(column) < high), None)
    if not lasers or hpa is None or PRESSURE.fullmatch(name.strip().lower()) is None:
        return ""
    along = next((a for a in readings.machine.axes if what == POSITION.format(a.name)), None)
    if along is None:
        return ""
    per = abs(slope) / (float(np.ptp(column)) * hpa * float(np.ptp(readings.channel(along.channel))) * 1e-3)
    if not AIR_UM_PER_M_HPA / PHYSICAL < per < AIR_UM_PER_M_HPA * PHYSICAL:
        return ""
    return (
        f" Its slope, {significant(per)} µm per metre and hPa, is that of a laser's beam in air ({AIR_UM_PER_M_HPA:g}) "
        "where nothing corrects the pressure."
    )


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
    """Positions of axes that move, in words, and one beside them from the mean in parts of their range, (m, 2)."""
    return _times(readings, [(POSITION.format(a.name), a.channel) for a in readings.machine.axes])


def _directions(readings: Readings) -> list[tuple[str, Floats]]:
    """Directions of axes that reverse, as `_positions`: a reversal may depend on a load or a pressure."""
    return _times(readings, [(f"the direction of {a.name}", a.direction_channel) for a in readings.machine.axes])


def _times(readings: Readings, named: Sequence[tuple[str, str]]) -> list[tuple[str, Floats]]:
    values = [(name, readings.channel(channel)) for name, channel in named]
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
    clear = _attainable(judged)
    if abs(_correlation(read, beside)) > COPY or abs(_correlation(_ranks(left), _ranks(beside))) < clear * LIKE_RANKS:
        return None
    late = np.concatenate([s.time_s > np.median(s.time_s) for s in judged.readings.series])
    slopes = []
    for part in (np.ones(len(late), dtype=np.bool_), late, ~late):
        if abs(_correlation(left[part], beside[part])) < clear * FOLLOWS:
            return None
        slopes.append(float(left[part] @ beside[part]) / float(beside[part] @ beside[part]))
    if min(slopes[1:], key=abs) / max(slopes[1:], key=abs) < SAME_SLOPE:
        return None
    rest = judged.pooled(judged.left - column * float(judged.left @ column) / float(column @ column))
    return rest if rest**2 < MOSTLY * judged.residual**2 else None


def _attainable(judged: Judgement) -> float:
    """Correlation of a residual with its cause, which noise lowers; 1 where it is hardly above the noise."""
    if judged.residual < CLEAR * judged.noise_floor:
        return 1.0
    return math.sqrt(1.0 - (judged.noise_floor / judged.residual) ** 2)


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
