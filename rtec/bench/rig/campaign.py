"""Measurements on the rig: lines in both directions, plates, drift probes; their readings, and the noise of these.

The noise has forms that resemble effects, and forms that violate a method's assumptions.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtec.bench.rig.machine import SENSORS, TRAVEL_MM, Day, displaced, sensors, turned

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Rng = np.random.Generator

FORMS = ("white", "memory", "wander", "warm_up", "zeros", "bursts", "quantised")
"""White; first-order autoregressive; random walk; warming up and cooling down of the instrument; a zero for each run;
outliers in separate bursts of up to five; a coarse display."""
APART = 20
"""Number of readings for each burst of outliers at most."""


@dataclass(frozen=True)
class DrawnNoise:
    """Noise of one column.

    Attributes:
        values: µm or µrad, (n,).
        wrong: whether each reading is an outlier, (n,).
        step: resolution of the display.
    """

    values: Floats
    wrong: Bools
    step: float = 0.1


def draw_noise(rng: Rng, form: str, time_s: Floats, run: Ints) -> DrawnNoise:
    """Noise of one column; white part 0.3 to 0.8."""
    n, sigma = len(time_s), rng.uniform(0.3, 0.8)
    wrong, step = np.zeros(n, dtype=np.bool_), 0.1
    out = sigma * rng.standard_normal(n)
    first = np.flatnonzero(np.diff(run, prepend=run[0] - 1))
    if form == "memory":
        out += rng.uniform(0.3, 0.9) * _memory(rng, time_s, 60.0 * rng.uniform(8.0, 70.0))
    elif form == "wander":
        walk = np.cumsum(rng.standard_normal(n) * np.sqrt(np.diff(time_s, prepend=time_s[0])))
        out += rng.uniform(0.3, 0.9) * (walk - walk.mean()) / max(float(walk.std()), 1e-12)
    elif form == "warm_up":
        out += rng.choice([-1.0, 1.0]) * rng.uniform(0.8, 2.5) * _heat(rng, time_s)
    elif form == "zeros":
        out += np.repeat(rng.uniform(0.2, 0.5) * rng.standard_normal(len(first)), np.diff([*first, n]))
    elif form == "bursts":
        for block in rng.permutation(n // APART)[: max(n // 120, 2)]:
            at = APART * int(block) + int(rng.integers(0, APART // 2))
            burst = slice(at, at + int(rng.integers(1, 6)))
            out[burst] += rng.choice([-1.0, 1.0]) * rng.uniform(8.0, 60.0)
            wrong[burst] = True
    elif form == "quantised":
        step = rng.uniform(0.4, 1.0)
    return DrawnNoise(out, wrong, step)


def _memory(rng: Rng, time_s: Floats, tau_s: float) -> Floats:
    keep = np.exp(-np.diff(time_s) / tau_s)
    out = np.empty(len(time_s))
    out[0] = rng.standard_normal()
    for i, k in enumerate(keep.tolist(), 1):
        out[i] = k * out[i - 1] + np.sqrt(1.0 - k * k) * rng.standard_normal()
    return out


def _heat(rng: Rng, time_s: Floats) -> Floats:
    """Drift of an instrument that warms up, and cools down after its lamp is switched off."""
    whole = float(time_s[-1] - time_s[0])
    tau, off = whole * rng.uniform(0.06, 0.25), whole * rng.uniform(0.5, 0.75)
    t = time_s - time_s[0]
    rise = 1.0 - np.exp(-np.minimum(t, off) / tau)
    return np.asarray(np.where(t < off, rise, rise * np.exp(-(t - off) / (tau * rng.uniform(0.8, 2.0)))))


Errors = Mapping[str, Floats]

LOADS_KG = (0.0, 150.0, 300.0, 450.0)
FEEDS_MM_MIN = (400.0, 1000.0, 2500.0, 6000.0)
BEAM_MM = (20.0, -15.0, 30.0)


@dataclass(frozen=True)
class ReadingColumn:
    """One reading column.

    Attributes:
        name: name of the column.
        letter: direction X Y Z of a displacement, or rotation A B C.
        offset_mm: vector from the tool tip to the measured point.
    """

    name: str
    letter: str
    offset_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class CampaignPlan:
    """A measurement without its readings.

    Attributes:
        instrument, setup, axis: as in measurement files.
        probes: the reading columns.
        run, time_s: (n,).
        pose_mm, direction, velocity_mm_s: by axis, (n,).
        since_mm: distance of the line's axis since its last reversal, (n,).
        load_kg: (n,).
        speed: whether feeds were recorded.
    """

    instrument: str
    setup: Mapping[str, Any]
    axis: str | None
    probes: tuple[ReadingColumn, ...]
    run: Ints
    time_s: Floats
    pose_mm: Mapping[str, Floats]
    direction: Mapping[str, Floats]
    velocity_mm_s: Mapping[str, Floats]
    since_mm: Floats
    load_kg: Floats

    def __len__(self) -> int:
        return len(self.run)

    @property
    def q(self) -> Floats:
        """Position of the line's axis, mm."""
        return self.pose_mm[self.axis or "X"]

    def scaled(self, axis: str) -> Floats:
        """Position of an axis, -1 to 1 over its travel."""
        low, high = TRAVEL_MM[axis]
        return (2.0 * self.pose_mm[axis] - low - high) / (high - low)


@dataclass(frozen=True)
class Record:
    """A measurement with the content of its file.

    Attributes:
        name: name of the file.
        plan: its plan.
        channels: recorded channels, (n,) each.
        readings: by column, (n,); NaN where they are held back.
        noise: noise in each reading, with the rounding of the display, by column, (n,); NaN for an outlier.
        held_back: readings that are NaN in `readings`, NaN elsewhere, by column, (n,); empty where there are none.
    """

    name: str
    plan: CampaignPlan
    channels: Mapping[str, Floats]
    readings: Mapping[str, Floats]
    noise: Mapping[str, Floats] = field(default_factory=dict)
    held_back: Mapping[str, Floats] = field(default_factory=dict)


def line(
    rng: Rng,
    kind: str = "laser",
    axis: str = "X",
    *,
    runs: int = 16,
    per_way: int = 26,
    hours: float = 8.0,
    step_mm: float | None = None,
    across: str = "Z",
    lengths: Sequence[int] | None = None,
    alike: bool = False,
) -> CampaignPlan:
    """Plan of a line, in both directions in each run; load, feed and positions of other axes change from run to run.

    Args:
        rng: source of random numbers.
        kind: laser, straightness or angular.
        axis: axis of the line.
        runs, per_way, hours: number of runs, number of targets each way, duration.
        step_mm: distance of equally spaced targets; None for random targets, different in each run.
        across: direction or rotation that a straightness probe or an angular laser reads.
        lengths: number of targets each way of each run, where it differs.
        alike: other axes, load and feed are the same in all runs.
    """
    low, high = TRAVEL_MM[axis]
    counts = list(lengths or [per_way] * runs)
    q, way, run = [], [], []
    for k, count in enumerate(counts, 1):
        if step_mm is None:
            edges = np.linspace(low + 3.0, high - 3.0, count + 1)
            there = edges[:-1] + rng.uniform(0.02, 0.98, count) * np.diff(edges)
            back = (edges[:-1] + rng.uniform(0.02, 0.98, count) * np.diff(edges))[::-1]
        else:
            there = np.arange(low + 5.0, high, step_mm)
            back = there[::-1]
        q += [there, back]
        way += [np.ones(len(there)), -np.ones(len(back))]
        run += [np.full(len(there) + len(back), k)]
    position, ways, runs_of = np.concatenate(q), np.concatenate(way), np.concatenate(run)
    others = [a for a in "XYZ" if a != axis]
    at_run = np.zeros_like(runs_of) if alike else runs_of - 1
    pose = {axis: position} | {a: _levels(rng, a, len(counts), alike)[at_run] for a in others}
    feed = (np.full(1, 1000.0) if alike else rng.choice(FEEDS_MM_MIN, len(counts)))[at_run] / 60.0
    still = np.zeros(len(position))
    made: dict[str, tuple[str, dict[str, Any], ReadingColumn]] = {
        "laser": ("laser_linear", {"beam_offset_mm": list(BEAM_MM)}, ReadingColumn("reading_um", axis, BEAM_MM)),
        "straightness": ("straightness", {"direction": across}, ReadingColumn("reading_um", across)),
        "angular": ("laser_angular", {"about": across}, ReadingColumn("reading_urad", across)),
    }
    instrument, setup, probe = made[kind]
    return CampaignPlan(
        instrument,
        setup,
        axis,
        (probe,),
        runs_of,
        _times(rng, runs_of, hours),
        pose,
        {axis: ways} | {a: _last_way(pose[a]) for a in others},
        {axis: ways * feed, **dict.fromkeys(others, still)},
        _since(position, ways),
        (np.zeros(1) if alike else rng.choice(LOADS_KG, len(counts)))[at_run],
    )


def plate(rng: Rng, *, runs: int = 6, grid: int = 11, hours: float = 4.0) -> CampaignPlan:
    """Plan of an artefact plate over X and Y, probed in another order in each run, at two heights of Z."""
    xs = np.linspace(TRAVEL_MM["X"][0] + 30.0, TRAVEL_MM["X"][1] - 30.0, grid)
    ys = np.linspace(TRAVEL_MM["Y"][0] + 20.0, TRAVEL_MM["Y"][1] - 20.0, grid)
    places = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
    order = np.concatenate([rng.permutation(len(places)) for _ in range(runs)])
    run = np.repeat(np.arange(1, runs + 1), len(places))
    z = np.where(run % 2 == 0, 60.0, 240.0)
    pose = {"X": places[order, 0], "Y": places[order, 1], "Z": z}
    still = np.zeros(len(run))
    probes = tuple(ReadingColumn(f"reading_{d.lower()}_um", d) for d in "XYZ")
    return CampaignPlan(
        "tool_tip", {}, None, probes, run, _times(rng, run, hours), pose, {a: _last_way(pose[a]) for a in "XYZ"},
        dict.fromkeys("XYZ", still), still, still + 100.0,
    )  # fmt: skip


def drift(rng: Rng, *, runs: int = 20, points: int = 17, hours: float = 9.0) -> CampaignPlan:
    """Plan of three probes at the spindle of a machine at rest."""
    run = np.repeat(np.arange(1, runs + 1), points)
    pose = {a: np.full(len(run), 0.4 * TRAVEL_MM[a][1]) for a in "XYZ"}
    probes = (
        ReadingColumn("reading_axial_um", "Z"),
        ReadingColumn("reading_near_um", "X"),
        ReadingColumn("reading_far_um", "X", (0.0, 0.0, 90.0)),
    )
    setup = {"probe": {p.name.split("_")[1]: {"direction": p.letter, "offset_mm": list(p.offset_mm)} for p in probes}}
    still = np.zeros(len(run))
    return CampaignPlan(
        "spindle_drift", setup, None, probes, run, _times(rng, run, hours), pose,
        dict.fromkeys("XYZ", still + 1.0), dict.fromkeys("XYZ", still), still,
        rng.choice(LOADS_KG, runs)[run - 1],
    )  # fmt: skip


def recorded(plan: CampaignPlan, of: Day, rng: Rng, names: tuple[str, ...] = SENSORS) -> dict[str, Floats]:
    """Channels of a file: positions, directions, speeds, load, spindle speed, sensors."""
    out = {a.lower(): plan.pose_mm[a] for a in "XYZ"}
    if plan.instrument != "spindle_drift":
        out |= {f"d_{a.lower()}": plan.direction[a] for a in "XYZ"}
    if plan.axis is not None:
        out |= {f"v_{a.lower()}": plan.velocity_mm_s[a] for a in "XYZ"}
    out["load_kg"] = plan.load_kg
    index = np.searchsorted(of.time_s, plan.time_s, side="right") - 1
    out["spindle_rpm"] = of.rpm[index]
    return out | sensors(of, rng, plan.time_s, names)


def read(
    plan: CampaignPlan, errors: Errors, rng: Rng, form: str, channels: Mapping[str, Floats], name: str = "record"
) -> Record:
    """Readings of an instrument: exact kinematics, noise of a form, an unknown zero, resolution of the display."""
    readings, noises = {}, {}
    for probe in plan.probes:
        if probe.letter in "XYZ":
            true = displaced(errors, plan.pose_mm, probe.offset_mm)[:, "XYZ".index(probe.letter)]
        else:
            true = turned(errors, probe.letter, len(plan))
        drawn = draw_noise(rng, form, plan.time_s, plan.run)
        true += rng.uniform(-15.0, 15.0)
        readings[probe.name] = np.round((true + drawn.values) / drawn.step) * drawn.step
        noises[probe.name] = np.where(drawn.wrong, np.nan, readings[probe.name] - true)
    return Record(name, plan, dict(channels), readings, noises)


def with_runs_held_back(record: Record, every: int = 4) -> Record:
    """The same with the readings of every n-th run held back, for prediction."""
    back = record.plan.run % every == 0
    return replace(
        record,
        readings={k: np.where(back, np.nan, v) for k, v in record.readings.items()},
        held_back={k: np.where(back, v, np.nan) for k, v in record.readings.items()},
    )


def one_way(plan: CampaignPlan) -> CampaignPlan:
    """The first way of the first run only."""
    keep = np.flatnonzero((plan.run == 1) & (plan.direction[plan.axis or "X"] > 0))
    return at(plan, keep)


def at(plan: CampaignPlan, keep: Ints) -> CampaignPlan:
    """Some rows of a plan."""
    return replace(
        plan,
        run=plan.run[keep],
        time_s=plan.time_s[keep],
        pose_mm={k: v[keep] for k, v in plan.pose_mm.items()},
        direction={k: v[keep] for k, v in plan.direction.items()},
        velocity_mm_s={k: v[keep] for k, v in plan.velocity_mm_s.items()},
        since_mm=plan.since_mm[keep],
        load_kg=plan.load_kg[keep],
    )


def _levels(rng: Rng, axis: str, runs: int, alike: bool) -> Floats:
    low, high = TRAVEL_MM[axis]
    if alike:
        return np.full(1, low + 0.4 * (high - low))
    return rng.permutation(np.resize(np.linspace(low + 0.1 * (high - low), high - 0.1 * (high - low), 4), runs))


def _times(rng: Rng, run: Ints, hours: float) -> Floats:
    """Times of consecutive runs with pauses; nearly equal intervals within a run."""
    runs = int(run[-1])
    each, out = hours * 3600.0 / runs, np.empty(len(run))
    for k in range(1, runs + 1):
        here = np.flatnonzero(run == k)
        gap = 0.85 * each / len(here)
        out[here] = (k - 1) * each + 20.0 + gap * (np.arange(len(here)) + rng.uniform(-0.3, 0.3, len(here)))
    return np.round(out, 1)


def _last_way(position: Floats) -> Floats:
    step = np.sign(np.diff(position, prepend=position[0] - 1.0))
    last = np.maximum.accumulate(np.where(step != 0, np.arange(len(step)), 0))
    return np.asarray(step[last])


def _since(position: Floats, way: Floats) -> Floats:
    """Distance since the reversal, which was 1 mm beyond the targets before it and after it."""
    out, turn = np.empty_like(position), position[0] - 900.0 * way[0]
    for i in range(len(position)):
        if i and way[i] != way[i - 1]:
            turn = (min(position[i - 1] * way[i], position[i] * way[i]) - 1.0) * way[i]
        out[i] = abs(position[i] - turn)
    return out
