"""One data set put to a method, and what came of it as plain numbers."""

from collections.abc import Sequence
from dataclasses import dataclass
from timeit import default_timer

import numpy as np

from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.discovery import translate
from tests.discovery.generator.cases import Case
from tests.discovery.generator.dataset import (
    Dataset,
    build,
    centred,
    floor_of,
    left_of,
    left_over,
    model_error,
    oracle_cut,
    rms,
)
from tests.discovery.generator.truth import Truth, filled
from tests.discovery.methods import NOTHING, Answer, Improver, Method, Name

ALIKE_SENSORS = 0.99
"""A sensor counts as a true variable where its true temperature goes with that of a true one at least so well."""
NEAR_FLOOR = 1.1


@dataclass(frozen=True)
class Outcome:
    """What a method made of a data set.

    Attributes:
        case: which.
        answer: what was said.
        right: place of the first right name, from 1; 0 if none.
        in_group: whether a right name is among those that are claimed.
        names_true_only: for the unknown: only true variables are named, and at least one.
        added: what was added by improving.
        ended: why it ended there.
        found: how many of the hidden effects are among those.
        wrong: how many of those are none of them.
        held_out, floor: of readings in the runs left out, after improving, and of noise alone there, µm.
        before, after, oracle: error of the model there: current, improved, and fitted with the true shapes, µm.
        hidden, left: size of each hidden effect, and what known errors leave of it, µm.
        seconds: for the diagnosis alone.
        failure: message, where the method raised one.
    """

    case: Case
    answer: Answer
    right: int = 0
    in_group: bool = False
    names_true_only: bool = False
    added: tuple[Name, ...] = ()
    ended: str = ""
    found: int = 0
    wrong: int = 0
    held_out: float = float("nan")
    floor: float = float("nan")
    before: float = float("nan")
    after: float = float("nan")
    oracle: float = float("nan")
    hidden: tuple[float, ...] = ()
    left: tuple[float, ...] = ()
    seconds: float = float("nan")
    failure: str = ""

    @property
    def at_floor(self) -> bool:
        """Whether the improved model leaves the runs left out at the noise."""
        return self.held_out <= NEAR_FLOOR * self.floor


def judge(case: Case, method: Method, improver: Improver | None = None) -> Outcome:
    """Put a case to a method; where it is a single or a pair, improve the model too."""
    dataset = build(case)
    measurement = translate.measurement_of(dataset)
    model = translate.base_model(dataset, measurement)
    start = default_timer()
    try:
        answer = method(model, [measurement])
        seconds = default_timer() - start
        improved: Model = model
        added: list[Name] = []
        ended = ""
        if improver is not None and case.group in ("singles", "pairs"):
            improved, added, ended = improver(model, [measurement])
    except Exception as e:  # noqa: BLE001  # a crash is a result here, and is counted and shown
        return Outcome(case, NOTHING, failure=f"{type(e).__name__}: {e}")
    return _scored(dataset, measurement, model, improved, answer, added, ended, seconds)


def _scored(
    dataset: Dataset,
    measurement: Measurement,
    model: Model,
    improved: Model,
    answer: Answer,
    added: Sequence[Name],
    ended: str,
    seconds: float,
) -> Outcome:
    truths = dataset.truths
    before, oracle = oracle_cut(dataset)
    current, said = (translate.said_by(m, measurement) for m in (model, improved))
    return Outcome(
        case=dataset.case,
        answer=answer,
        right=next((i for i, name in enumerate(answer.names, 1) if _names(truths, name, dataset)), 0),
        in_group=any(_names(truths, name, dataset) for name in answer.group),
        names_true_only=_only_true(answer.unknown, dataset),
        added=tuple(added),
        ended=ended,
        found=sum(any(_names([t], name, dataset) for name in added) for t in truths),
        wrong=sum(not _names(truths, name, dataset) for name in added),
        held_out=left_over(dataset, said),
        floor=floor_of(dataset),
        before=model_error(dataset, current),
        after=model_error(dataset, said),
        oracle=oracle if truths else before,
        hidden=tuple(rms(centred(h)) for h in dataset.hidden) if truths else (),
        left=tuple(left_of(dataset, i) for i in range(len(truths))),
        seconds=seconds,
    )


def _names(truths: Sequence[Truth], name: Name, dataset: Dataset) -> bool:
    return any(t.accepts(name.effect, name.component, name.sensor, dataset.campaign) for t in truths)


def _only_true(named: Sequence[str], dataset: Dataset) -> bool:
    """Whether only true variables are named, and one at least."""
    true = {filled(v, dataset.campaign) for t in dataset.truths for v in t.variables}
    body = dataset.world.weather.body
    for sensor in body:
        alike = [abs(float(np.corrcoef(body[sensor], body[t])[0, 1])) for t in true if t in body]
        if alike and max(alike) >= ALIKE_SENSORS:
            true.add(sensor)
    return bool(named) and set(named) <= true
