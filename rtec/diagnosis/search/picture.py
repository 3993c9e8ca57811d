"""Data of a finding's figure: residuals, the variable that drives them, and the part that the finding explains."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from rtec.arrays import Floats
from rtec.diagnosis import words
from rtec.diagnosis.result import Diagnosis, Finding, OnCircle, Picture
from rtec.diagnosis.search.confounded import period_mm
from rtec.effects import Effect
from rtec.estimation import floor
from rtec.estimation.gls import solve
from rtec.estimation.noise import Whitener
from rtec.estimation.readings import Readings, Series
from rtec.metrology.instruments.ball_bar import BallBar
from rtec.model import FittedEffect

PANELS = 3
HARDLY = 0.3
"""Columns to which a finding contributes less than this share of its largest contribution are not shown."""


def of_effect(
    readings: Readings,
    base: Floats,
    whitener: Whitener,
    label: str,
    effect: Effect,
    theta: Mapping[str, float],
    beside: Sequence[FittedEffect] = (),
) -> Picture | None:
    """Picture of an effect.

    Args:
        readings: the readings.
        base: columns of the model, (m, p).
        whitener: the noise.
        label: short name of the effect.
        effect, theta: the effect and its non-linear parameters.
        beside: effects that are fitted with it and subtracted from the residual; the title names them.
    """
    channels = effect.channels(readings.machine)
    others = [readings.columns(f.effect, f.theta) for f in beside]
    whole = np.concatenate([base, *others], axis=1)
    less = f"{label}{words.less([f.effect.label for f in beside])}"
    shown = _picture(readings, whole, whitener, readings.columns(effect, theta), label, channels, less)
    period = period_mm(effect, theta)
    if shown is None or period is None:
        return shown
    return replace(shown, period_mm=period, others=tuple(replace(other, period_mm=period) for other in shown.others))


def of_finding(d: Diagnosis, f: Finding) -> Picture | None:
    """Picture of a candidate of a diagnosis; None where no reading shows it, or the diagnosis has no readings.

    That of rank 1 is the picture of the diagnosis itself, where it has one.
    """
    if f.rank == 1 and d.shows_rank_1:
        return d.picture
    if d.judged is None:
        return None
    j = d.judged
    return of_effect(j.readings, j.base.columns, j.noise, f.label, f.effect, f.theta, _beside(d, f))


def _beside(d: Diagnosis, f: Finding) -> list[FittedEffect]:
    """The effects named together with a finding, or with rank 1 where the finding is as likely in its place."""
    members = [m.fitted for m in d.together]
    own = [m for m in members if m.effect == f.effect]
    if not own and f.group:
        own = [m for m in members if m.effect == d.findings[0].effect]
    return [m for m in members if m not in own] if own else []


def of_shape(
    readings: Readings, base: Floats, whitener: Whitener, columns: Floats, variables: Sequence[str]
) -> Picture | None:
    """Picture of a shape without a name: its columns, (m, k), and what it depends on."""
    label = f"what depends on {' and '.join(map(words.named, variables))}"
    return _picture(readings, base, whitener, columns, label, variables, label)


def _picture(
    readings: Readings,
    base: Floats,
    whitener: Whitener,
    columns: Floats,
    label: str,
    channels: Sequence[str],
    title: str,
) -> Picture | None:
    whole = np.concatenate([base, columns], axis=1)
    values = solve(whitener(whole), whitener(readings.values))
    part = columns @ values[base.shape[1] :]
    residual = readings.values - base @ values[: base.shape[1]]
    # The same zero of each run is removed from both, so that they coincide where the effect explains the residual.
    part, residual = floor.cleaned(readings, part), floor.cleaned(readings, residual)
    moved = np.array([
        float(np.std(part[s.part])) / max(float(np.std(residual[s.part])), 1e-9) for s in readings.series
    ])  # fmt: skip
    if not moved.max(initial=0.0) > 0.0:
        return None
    strongest = np.argsort(-moved, kind="stable")[:PANELS]
    shown = [
        _of_series(readings, readings.series[i], residual, part, label, channels, title)
        for i in strongest
        if moved[i] >= HARDLY * moved.max()
    ]
    return replace(shown[0], others=tuple(shown[1:]))


def _of_series(
    readings: Readings, series: Series, residual: Floats, part: Floats, label: str,
    channels: Sequence[str], title: str,
) -> Picture:  # fmt: skip
    rows, machine = series.part, readings.machine
    drivers = [(name, readings.channel(name)[rows]) for name in _by_interest(readings, channels)]
    known = [(n, "degC" if n in machine.sensor_names else words.unit_of_channel(n), v) for n, v in drivers]
    # A channel that was constant in this measurement drives nothing.
    known = sorted((d for d in known if np.isfinite(d[2]).all()), key=lambda d: np.ptp(d[2]) == 0.0)
    direction = None
    axis = next((a for a in machine.axes if known and a.channel == known[0][0]), None)
    if axis is not None:
        way = readings.channel(axis.direction_channel)[rows]
        direction = way if np.isfinite(way).all() and np.ptp(way) > 0 else None
    circle, place = _on_circle(readings, series), series_name(readings, series)
    # The angle shows more than the positions of two axes.
    known = [*([("angle_deg", "deg", np.rad2deg(circle.angle_rad))] if circle else []), *known]
    return Picture(
        label, "urad" if series.unit == "urad" else "um", residual[rows], part[rows], tuple(known), direction,
        readings.time_s[rows], series.run, f"{title}, in {place}", place, circle=circle,
    )  # fmt: skip


def _on_circle(readings: Readings, series: Series) -> OnCircle | None:
    """Angles of a ball bar; None for other instruments."""
    instrument = readings.measurements[series.source].instrument
    angle = readings.states[series.source].channels.get("angle_deg")
    if not isinstance(instrument, BallBar) or angle is None:
        return None
    setup = instrument.setup
    return OnCircle(setup.letters[:2], setup.sense, np.deg2rad(instrument.on_arc_deg(angle[series.row])))


def series_name(readings: Readings, series: Series) -> str:
    """Name of the measurement; with the column, where it has several."""
    name = readings.measurements[series.source].name
    several = sum(s.source == series.source for s in readings.series) > 1
    column = series.column.removeprefix("reading_").removesuffix("um").removesuffix("urad").strip("_")
    return f"{name}, {column}" if several and column else name


def _by_interest(readings: Readings, channels: Sequence[str]) -> list[str]:
    """Positions first; directions last and never alone: a figure over two places shows little."""
    machine = readings.machine
    positions = [a.channel for a in machine.axes]
    directions = {a.direction_channel: a.channel for a in machine.axes}
    named = [directions.get(c, c) for c in channels]
    return sorted(dict.fromkeys(named), key=lambda c: (c not in positions, named.index(c)))
