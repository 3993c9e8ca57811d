"""rtec's own answers to the benchmark's trials."""

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from time import process_time

import numpy as np

from rtec.arrays import Floats
from rtec.bench.score import TrialAnswer
from rtec.bench.sets import measurements_of, model_of
from rtec.bench.trials import Right, Trial
from rtec.diagnosis.extend.improve import improve
from rtec.diagnosis.result import Diagnosis
from rtec.diagnosis.search.diagnose import diagnose
from rtec.effects import Effect
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from rtec.parallel import one_blas_thread

IMPROVED = ("plates", "improve")
"""Groups that are answered by `rtec improve`, which adds several effects."""


def own_answers(trials: Sequence[Trial], jobs: int, tell: Callable[[int, int], None]) -> dict[str, TrialAnswer]:
    """Answers by the label of the trial.

    Args:
        trials: data sets.
        jobs: number of processes.
        tell: progress callback, called with the number of trials done and in total.
    """
    out: dict[str, TrialAnswer] = {}
    if jobs <= 1:
        for trial in trials:
            out[trial.label] = own_answer(trial)
            tell(len(out), len(trials))
        return out
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        for trial, answer in zip(trials, pool.map(own_answer, trials), strict=True):
            out[trial.label] = answer
            tell(len(out), len(trials))
    return out


def own_answer(trial: Trial) -> TrialAnswer:
    """Answer of `rtec diagnose` to a trial; for several effects the additions of `rtec improve`."""
    with one_blas_thread():
        model, measurements = model_of(trial), measurements_of(trial)
        start = process_time()
        found = diagnose(model, measurements)
        seconds = process_time() - start
        claimed = tuple(_name(f.effect) for f in found.group)
        predicted: dict[str, Floats] = {}
        if trial.group in IMPROVED:
            done = improve(model, measurements).model
            claimed = tuple(_name(f.effect) for f in done.effects[len(model.effects) :])
            if trial.records[0].held_back:
                predicted = _predicted(done, measurements[0])
    return TrialAnswer(
        found.verdict,
        tuple(_name(f.effect) for f in found.findings),
        claimed,
        frozenset(found.unknown.channels) if found.unknown is not None else frozenset(),
        _doubts(found),
        seconds,
        predicted,
    )


def _predicted(model: Model, measurement: Measurement) -> dict[str, Floats]:
    """Predictions of a model for each reading, on the recorded channels, (n,) by column."""
    state = model.state(measurement.time_s, measurement.channels)
    pose, columns = state.positions_mm(), measurement.instrument.columns()
    out = np.zeros((len(columns), len(state)))
    for fitted, value in zip(model.effects, model.effect_components(state), strict=True):
        out += measurement.instrument.arms_of(model.machine, pose, fitted.effect.component) * value
    return dict(zip(columns, out, strict=True))


def _name(effect: Effect) -> Right:
    sensors = [str(getattr(effect, k)) for k in ("sensor", "front", "back") if getattr(effect, k, None)]
    return Right(effect.effect, effect.component, "-".join(sensors))


def _doubts(found: Diagnosis) -> frozenset[str]:
    kinds: set[str] = {d.kind for d in found.doubts}
    if found.unknown is not None and found.unknown.aliases_mm:
        kinds.add("alias")
    if found.findings and any("targets stand every" in a.why for a in found.findings[0].confused_with):
        kinds.add("alias")
    return frozenset(kinds)
