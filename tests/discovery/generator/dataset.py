"""A data set: readings as an instrument shows them, and everything that is true behind them."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tests.discovery.generator import noise as noises
from tests.discovery.generator.base import Known, known
from tests.discovery.generator.campaign import RUNS, Campaign, campaign
from tests.discovery.generator.cases import Case
from tests.discovery.generator.thermal import SENSORS, read_sensor, weather
from tests.discovery.generator.truth import Truth
from tests.discovery.generator.world import World

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

HIDDEN_UM = (1.0, 3.0)
LEFT_OUT = 4
"""Whole runs that the method never reads."""


@dataclass(frozen=True)
class Dataset:
    """One measurement with its truth.

    Attributes:
        case: which.
        world: what truly happened.
        channels: what was recorded, by the program's channel names, (n,) each.
        readings: as displayed, (columns, n).
        clean: what the machine alone would give, (columns, n).
        noise: what was added, (columns, n).
        outlier: readings with a jump of their own, (columns, n).
        unseen: rows of the runs that are left out, (n,).
        base: errors that the current model has.
        base_columns: what one unit of each adds, (base, columns, n).
        hidden: what each hidden effect adds, (hidden, columns, n).
    """

    case: Case
    world: World
    channels: Mapping[str, Floats]
    readings: Floats
    clean: Floats
    noise: Floats
    outlier: Bools
    unseen: Bools
    base: tuple[Known, ...]
    base_columns: Floats
    hidden: Floats

    @property
    def campaign(self) -> Campaign:
        """What was done."""
        return self.world.campaign

    @property
    def truths(self) -> tuple[Truth, ...]:
        """What is hidden."""
        return self.case.truths


def build(case: Case) -> Dataset:
    """Make a data set; the same case gives the same bits."""
    truths = case.truths
    day = weather(case.rng("weather"), case.passive)
    world = World(_campaign(case, truths), day)
    c = world.campaign
    replaced = {key for t in truths for key in t.replaces}
    base = tuple(k for k in known(c) if k.key not in replaced)
    sizes = case.rng("base")
    columns = np.array([k.columns(world) for k in base]).reshape(len(base), len(c.columns), len(c.run))
    coefficient = np.array([k.size * sizes.uniform(0.5, 1.5) * sizes.choice([-1.0, 1.0]) for k in base])
    hidden = np.stack(
        [_sized(case.rng(f"size {t.name}"), t.contribution(world, case.rng(f"shape {t.name}"))) for t in truths]
        or [np.zeros((len(c.columns), len(c.run)))]
    )
    clean = np.tensordot(coefficient, columns, axes=1) + hidden.sum(axis=0)
    drawn = [noises.draw(case.rng(f"noise {column.name}"), case.noise, c.time_s, c.run) for column in c.columns]
    added = np.stack([n.values for n in drawn])
    zero = case.rng("zero").uniform(-20.0, 20.0, (len(c.columns), 1))
    left_out = case.rng("left out").choice(np.arange(2, RUNS + 1), LEFT_OUT, replace=False)
    return Dataset(
        case,
        world,
        recorded(world, case.rng("sensors")),
        noises.quantised(clean + added + zero),
        clean,
        added,
        np.stack([n.outlier for n in drawn]),
        np.isin(c.run, left_out),
        base,
        columns,
        hidden,
    )


def recorded(world: World, rng: np.random.Generator) -> dict[str, Floats]:
    """The channels as a file would hold them."""
    c = world.campaign
    out = {a.lower(): c.pose_mm[a] for a in "XYZ"}
    out |= {f"d_{a.lower()}": values for a, values in c.direction.items()}
    if "velocity" in c.recorded:
        out |= {f"v_{a.lower()}": values for a, values in c.velocity_mm_s.items()}
    if "acceleration" in c.recorded:
        out |= {f"a_{a.lower()}": values for a, values in c.acceleration_mm_s2.items()}
    if "feed" in c.recorded:
        out["feed_mm_min"] = c.feed_mm_min
    out["load_kg"] = c.load_kg
    out["spindle_rpm"] = world.krpm * 1e3
    for sensor in SENSORS:
        out[sensor] = read_sensor(rng, world.weather.at(world.weather.sensor[sensor], c.time_s))
    return out


def centred(values: Floats) -> Floats:
    """Less the mean of each column, which the instrument's zero takes away, (…, n)."""
    return np.asarray(values - values.mean(axis=-1, keepdims=True))


def rms(values: Floats) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def left_of(dataset: Dataset, which: int) -> float:
    """Root mean square of a hidden effect once known errors and zeros have taken their share."""
    design, _ = _flat(dataset)
    y = centred(dataset.hidden[which]).ravel()
    found = np.linalg.lstsq(design, y, rcond=None)[0]
    return rms(y - design @ found)


def floor_of(dataset: Dataset) -> float:
    """Root mean square of noise alone in the runs left out, about the zero of the others; outliers apart."""
    fair = ~dataset.outlier
    return rms(without_unknowns(dataset, dataset.noise, fair)[dataset.unseen & fair])


def oracle_cut(dataset: Dataset) -> tuple[float, float]:
    """Error of the known model and of one that also has the true shapes, on the runs left out, µm.

    Both are fitted by least squares to the same noisy readings, outliers apart.
    """
    out = []
    for with_truth in (False, True):
        design, seen = _flat(dataset, with_truth)
        y = dataset.readings.ravel()
        found = np.linalg.lstsq(design[seen], y[seen], rcond=None)[0]
        out.append(model_error(dataset, (design @ found).reshape(dataset.readings.shape)))
    return out[0], out[1]


def model_error(dataset: Dataset, said: Floats) -> float:
    """What a model says wrong in the runs left out, root mean square; it knows neither zero nor artefact's slope."""
    fair = np.ones_like(dataset.outlier)
    return rms(without_unknowns(dataset, said - dataset.clean, fair)[:, dataset.unseen])


def left_over(dataset: Dataset, said: Floats) -> float:
    """What a model leaves of the readings in the runs left out, root mean square; outliers apart."""
    fair = ~dataset.outlier
    return rms(without_unknowns(dataset, dataset.readings - said, fair)[dataset.unseen & fair])


def without_unknowns(dataset: Dataset, off: Floats, fair: Bools) -> Floats:
    """Less the zero of each column (and the artefact's slope), found on fair readings of the runs that were read."""
    out = np.empty_like(off)
    for i, (row, good) in enumerate(zip(off, fair & ~dataset.unseen, strict=True)):
        unknown = _unknowns(dataset)
        out[i] = row - unknown @ np.linalg.lstsq(unknown[good], row[good], rcond=None)[0]
    return out


def _unknowns(dataset: Dataset) -> Floats:
    """What the set-up of one column cannot know, (n, unknowns)."""
    one = np.ones(len(dataset.unseen))
    return np.stack([one, dataset.world.u] if dataset.campaign.kind == "straightness" else [one], axis=1)


def _flat(dataset: Dataset, with_truth: bool = False) -> tuple[Floats, Bools]:
    """Columns of base, unknowns and (if asked for) truths over all readings in one row, and which may be fitted."""
    columns, n = dataset.readings.shape
    parts = [
        dataset.base_columns.reshape(len(dataset.base), columns * n).T,
        np.kron(np.eye(columns), _unknowns(dataset)),
    ]
    if with_truth:
        parts.append(dataset.hidden.reshape(len(dataset.hidden), -1).T)
    seen = (~dataset.unseen & ~dataset.outlier).ravel()
    return np.concatenate(parts, axis=1), seen


def _campaign(case: Case, truths: tuple[Truth, ...]) -> Campaign:
    rng = case.rng("campaign")
    allowed = [a for a in "XYZ" if all(a in t.axes for t in truths)]
    vertical = any(t.component == "EZ{a}" for t in truths)
    return campaign(rng, case.kind, str(rng.choice(allowed)), case.passive, "Z" if vertical else "")


def _sized(rng: np.random.Generator, values: Floats) -> Floats:
    """Scaled to its size in the readings that see it, either sign."""
    moving = centred(values)
    sees = moving.std(axis=1) > 1e-9 * max(float(np.abs(moving).max()), 1e-300)
    size = rng.uniform(*HIDDEN_UM) * rng.choice([-1.0, 1.0])
    return np.asarray(size * values / rms(moving[sees]))
