"""The methods that are compared: each gets the user's model and measurement and says what is missing."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtec.effects import Effect
from rtec.metrology.measurement import Measurement
from rtec.model import Model

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Name:
    """What an answer calls an effect."""

    effect: str
    component: str
    sensor: str = ""

    @classmethod
    def of(cls, effect: Effect) -> "Name":
        """Name of an effect; a difference of two temperatures gives both sensors."""
        sensors = [str(getattr(effect, k)) for k in ("sensor", "front", "back") if getattr(effect, k, None)]
        return cls(effect.effect, effect.component, "-".join(sensors))

    def __str__(self) -> str:
        return f"{self.effect}({self.component}{', ' + self.sensor if self.sensor else ''})"


@dataclass(frozen=True)
class Answer:
    """What a method says.

    Attributes:
        names: best first.
        accepted: whether the first is claimed to be missing.
        group: those that the readings cannot tell from the first, with it; empty if none is claimed.
        unknown: variables of something without a name; empty if that is not said.
        p: of chance.
        adequacy: of the first, where it was worked out.
    """

    names: tuple[Name, ...]
    accepted: bool
    group: tuple[Name, ...]
    unknown: tuple[str, ...]
    p: float = 1.0
    adequacy: float | None = None


NOTHING = Answer((), False, (), ())

Method = Callable[[Model, Sequence[Measurement]], Answer]
Improver = Callable[[Model, Sequence[Measurement]], tuple[Model, list[Name], str]]
"""Gives the last model, what was added, and why it ended."""


def evidence(model: Model, measurements: Sequence[Measurement]) -> Answer:
    """The program's own diagnosis."""
    from rtec.diagnosis.search.diagnose import diagnose

    found = diagnose(model, measurements)
    findings = found.findings
    return Answer(
        tuple(Name.of(f.effect) for f in findings),
        bool(findings) and findings[0].accepted,
        tuple(Name.of(f.effect) for f in found.group),
        found.unknown.channels if found.unknown is not None else (),
        findings[0].p if findings else 1.0,
        found.adequacy,
    )


def improving(model: Model, measurements: Sequence[Measurement]) -> tuple[Model, list[Name], str]:
    """The program's own improvement; what it reports as the event of a record counts as found."""
    from rtec.diagnosis.extend.improve import improve

    done = improve(model, measurements)
    added = [Name.of(f.effect) for f in done.model.effects[len(model.effects) :]]
    events = [Name(*e.label.rstrip(")").replace("(", ", ").split(", ")[:2]) for e in done.events]
    return done.model, [*added, *events], done.reason


def naive(model: Model, measurements: Sequence[Measurement]) -> Answer:
    """What many would do: correlate what is left with every candidate, take the best, test it as if noise were white.

    Candidates come from the program's catalogue; the non-linear numbers stand at the values that it tries.
    """
    from rtec.estimation.candidates import library
    from rtec.estimation.columns import base_of
    from rtec.estimation.readings import read

    readings = read(measurements, model.reference_degc)
    base = np.concatenate([base_of(model, readings).columns, _zeros(readings.run)], axis=1)
    q = np.linalg.qr(base / np.maximum(np.linalg.norm(base, axis=0), 1e-12))[0]
    left = readings.values - q @ (q.T @ readings.values)
    best: dict[Name, float] = {}
    candidates, _ = library(readings)
    for candidate in candidates:
        for theta in candidate.thetas:
            share = _explained(readings.columns(candidate.effect, theta), left)
            name = Name.of(candidate.effect)
            best[name] = max(best.get(name, 0.0), share)
    order = sorted(best, key=lambda k: -best[k])
    top = best[order[0]] if order else 0.0
    # Chance alone explains 1/n for each number; 30 of that is beyond any table for independent noise.
    accepted = top * len(left) > 30.0
    return Answer(tuple(order[:10]), accepted, tuple(order[:1]) if accepted else (), ())


def _zeros(run: NDArray[np.int64]) -> Floats:
    return np.ones((len(run), 1))


def _explained(columns: Floats, left: Floats) -> float:
    """Share of what is left that some columns explain."""
    live = columns[:, np.ptp(columns, axis=0) > 0]
    if not live.shape[1]:
        return 0.0
    centred = live - live.mean(axis=0)
    q, r = np.linalg.qr(centred / np.maximum(np.linalg.norm(centred, axis=0), 1e-12))
    q = q[:, np.abs(np.diag(r)) > 1e-8]
    return float(np.sum((q.T @ left) ** 2) / max(np.sum(left**2), 1e-12))
