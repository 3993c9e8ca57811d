"""Sources of the corrected day's tip error.

Only a simulation knows them, because it knows the truth. Along an axis, with `e` the tip error, `g` the same relative
to the encoder position, `r` reading and `w` command, mm, `k` inserted counts, `a` the applied and `q` the requested
correction:

    e = g + (r - w)                    (the nominal motion of linear axes has no lever)
      = [r - w + k/c]                  servo: following error, the encoder's own count, waiting for a cycle
      + [-k/c - a]                     whole counts: the correction comes in steps of one
      + [a - q]                        guard: slew and acceleration limits, holds
      + [Δ from true temperatures]     sensors: lag, noise and resolution
      + [Δ from a fit without noise]   probe noise in the coefficients
      + [d]                            drift that no sensor sees
      + [play - ½ B·direction]         play: true position of the slide in it minus the model's
      + [the rest of g + q]            the model: shapes that exist on the first part, and changes by heat

The first line, and with it the sum, holds only if the simulation, its counts and the ledger agree; the tests check it.
Each Δ is the difference of two runs of the step over the recorded samples.
"""

from dataclasses import dataclass

import numpy as np

from rtec.arrays import Floats, Ints
from rtec.demo.day import CYLINDER, FACE, NS, SHOULDER, SMOOTH_MM, Track
from rtec.demo.live import LoopSide, step_settings
from rtec.effects.reversal import Backlash
from rtec.loop.records import Samples
from rtec.loop.step import Step
from rtec.model import Model
from rtec.sim.geometry import Geometry
from rtec.sim.truth import Truth

WHY = {
    "servo": "the axes follow their command with a small error, and the encoder shows whole counts",
    "whole counts": "the correction goes in by whole counts, with a dead band so that it does not chatter",
    "guard": "slew and acceleration limits hold the correction back for a moment",
    "sensors": "sensors lag behind what they are stuck on, are noisy, and read in steps of 0.1 °C",
    "probe noise": "the model was fitted to readings with a noise of 0.3 µm",
    "unseen drift": "the machine's true error drifts with something that no sensor measures",
    "play": "the correction's own small motions shift a slide within its play, and two counts of motion go by before "
    "the direction is known",
    "model, shape": "the model's shapes of guides and screws are not quite theirs, already when cold",
    "model, heat": "no sensor turns with the screws, expansion is not quite straight, the measuring day drifted too",
}


@dataclass(frozen=True)
class ResidualSources:
    """Contributions to the tip error of the corrected day.

    Attributes:
        names: names of the contributions, as in `WHY`.
        parts_um: radial on the cylinder, axial on face and shoulder, (names, n); relative to the first part.
        whole_um: their sum, the error, (n,).
        part, surface: part and surface of each row, (n,).
        across_um: the error along Y on the cylinder, which no axis can correct, (m,).
        radius_mm: radius of the cylinder.
    """

    names: tuple[str, ...]
    parts_um: Floats
    whole_um: Floats
    part: Ints
    surface: Ints
    across_um: Floats
    radius_mm: float

    def sizes(self) -> list[tuple[str, float, float]]:
        """Name, root mean square and largest size of each contribution, µm, the largest first; then the sum."""
        rows = [(n, _rms(p), float(np.abs(p).max())) for n, p in zip(self.names, self.parts_um, strict=True)]
        rows.sort(key=lambda row: -row[1])
        return [*rows, ("all together", _rms(self.whole_um), float(np.abs(self.whole_um).max()))]

    @property
    def across_on_diameter_um(self) -> float:
        """Change of a diameter by the largest error across, as the tool is beside the centre: 2·(√(R² + e²) - R)."""
        e_mm = float(np.abs(self.across_um).max()) * 1e-3
        return 1e3 * e_mm**2 / self.radius_mm


def residual_sources(
    track: Track, side: LoopSide, models: tuple[Model, Model], truth: Truth, seed: int
) -> ResidualSources:
    """Divide the tip error of the corrected day into its contributions.

    Args:
        track, side: record of the machine, and of the loop.
        models: the correcting model, and one fitted to the same readings without noise.
        truth: truth of the machine.
        seed: seed of the day.
    """
    model = models[0]
    machine = model.machine
    cutting = np.flatnonzero(track.surface >= 0)
    axis_of = np.where(track.surface[cutting] == CYLINDER, 0, 1)
    space_of = np.where(axis_of == 0, 0, 2)
    sensors, probe = _counterfactuals(track, side, models, truth)
    drift, play = _drift_um(track, model, truth, seed), side.play_um - _model_play_um(side, model)
    per_mm = np.array([a.counts_per_mm for a in machine.axes])
    put_um = -1e3 * track.inserted_counts / per_mm
    applied, requested = side.commands.applied_um, side.commands.requested_um
    geometric, moved = track.geometric_um[:, [0, 2]], 1e3 * (track.reading_mm - track.commanded_mm)
    parts = [
        moved - put_um, put_um - applied, applied - requested, sensors, probe, drift, play,
        geometric + requested - sensors - probe - drift - play,
    ]  # fmt: skip
    chosen = [p[cutting, axis_of] for p in parts]
    cut, surface = track.part[cutting], track.surface[cutting]
    place = track.commanded_mm[cutting, 1 - axis_of]
    shape = _as_on_first_part(chosen.pop(), cut, surface, place)
    rows = [_from_first_part(p, cut, surface) for p in (*chosen, *shape)]
    whole = _from_first_part(track.tip_um[cutting, space_of], cut, surface)
    on_cylinder = track.surface == CYLINDER
    radius = float(machine.chain.tip[0] @ np.array([1.0, *track.commanded_mm[on_cylinder][0]]))
    return ResidualSources(tuple(WHY), np.stack(rows), whole, cut, surface, track.tip_um[on_cylinder, 1], radius)


def _counterfactuals(track: Track, side: LoopSide, models: tuple[Model, Model], truth: Truth) -> tuple[Floats, Floats]:
    """Change of the requested correction by the sensors, and by the probe's noise, (n, 2) each, µm."""
    with_truth = _with_true_temperatures(side.samples, track, truth, models[0].machine.sensor_names)
    runs = ((models[0], side.samples), (models[0], with_truth), (models[1], with_truth))
    as_was, true_degc, no_noise = (Step(step_settings(m)).run(samples).requested_um for m, samples in runs)
    return as_was - true_degc, true_degc - no_noise


def _model_play_um(side: LoopSide, model: Model) -> Floats:
    """The model's play along each axis, (n, axes), µm."""
    out = np.zeros_like(side.direction)
    for fitted in model.effects:
        if isinstance(fitted.effect, Backlash):
            axis = model.machine.axis_names.index(fitted.effect.axis)
            out[:, axis] += 0.5 * fitted.values["B"] * side.direction[:, axis]
    return out


def _with_true_temperatures(samples: Samples, track: Track, truth: Truth, sensors: tuple[str, ...]) -> Samples:
    """The same samples with every sensor at its body's true temperature (plus its offset, which a fit absorbs)."""
    bodies = (*truth.body, "air")
    index = [bodies.index(truth.sensor[s].body) for s in sensors]
    out = samples.copy()
    out.degc[:] = track.body_degc[:, index] + np.array([truth.sensor[s].offset_degc for s in sensors])
    out.degc_time_ns[:] = out.time_ns[:, None]
    return out


def _drift_um(track: Track, model: Model, truth: Truth, seed: int) -> Floats:
    """Radial and axial error by the drift alone, (n, 2), µm."""
    bodies, here = tuple(truth.body), np.zeros((1, len(model.machine.axes)))
    plain = truth.model_copy(update={"drift_um": ()})
    both = [Geometry(model.machine, t, bodies, seed) for t in (truth, plain)]
    seconds = track.time_ns // NS
    known: dict[int, Floats] = {}
    for second in np.unique(seconds[track.part >= 0]):
        for geometry in both:
            geometry.set_temperatures(np.full(len(bodies) + 1, truth.reference_degc), float(second))
        drifted, still = (g.tip_mm(here, here)[0] for g in both)
        known[int(second)] = 1e3 * (drifted - still)[[0, 2]]
    return np.stack([known.get(int(s), np.zeros(2)) for s in seconds])


def _as_on_first_part(rest: Floats, cut: Ints, surface: Ints, place: Floats) -> tuple[Floats, Floats]:
    """A remainder at the same place of the first part, and its change since then."""
    cell = np.floor(place / SMOOTH_MM).astype(np.int64)
    shape = np.zeros_like(rest)
    for s in (CYLINDER, FACE, SHOULDER):
        first = (cut == 0) & (surface == s)
        mean = {int(c): float(rest[first & (cell == c)].mean()) for c in np.unique(cell[first])}
        here = surface == s
        shape[here] = [mean.get(int(c), 0.0) for c in cell[here]]
    return shape, rest - shape


def _from_first_part(value: Floats, cut: Ints, surface: Ints) -> Floats:
    """Values relative to the mean on the first part, where the operator sets the offsets; linear, so that sums hold."""
    out = value.copy()
    for group in ((CYLINDER,), (FACE, SHOULDER)):
        here = np.isin(surface, group)
        out[here] -= value[here & (cut == 0)].mean()
    return out


def _rms(value: Floats) -> float:
    return float(np.sqrt(np.mean(value**2)))
