"""The program's own answers to the benchmark's trials."""

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from time import process_time

from rtec.bench.score import TrialAnswer
from rtec.bench.sets import measurements_of, model_of
from rtec.bench.trials import Right, Trial
from rtec.diagnosis.extend.improve import improve
from rtec.diagnosis.result import Diagnosis
from rtec.diagnosis.search.diagnose import diagnose
from rtec.effects import Effect
from rtec.parallel import one_blas_thread

SEVERAL = "plates"
"""The group whose effects are added one after the other."""


def own_answers(trials: Sequence[Trial], jobs: int, tell: Callable[[int, int], None]) -> dict[str, TrialAnswer]:
    """Answers by the label of the trial.

    Args:
        trials: data sets.
        jobs: processes.
        tell: told how many are done, and of how many.
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
    """What `rtec diagnose` says of a trial; of several effects what `rtec improve` adds."""
    with one_blas_thread():
        model, measurements = model_of(trial), measurements_of(trial)
        start = process_time()
        found = diagnose(model, measurements)
        seconds = process_time() - start
        claimed = tuple(_name(f.effect) for f in found.group)
        if trial.group == SEVERAL:
            done = improve(model, measurements)
            claimed = tuple(_name(f.effect) for f in done.model.effects[len(model.effects) :])
    return TrialAnswer(
        found.verdict,
        tuple(_name(f.effect) for f in found.findings),
        claimed,
        frozenset(found.unknown.channels) if found.unknown is not None else frozenset(),
        _doubts(found),
        seconds,
    )


def _name(effect: Effect) -> Right:
    sensors = [str(getattr(effect, k)) for k in ("sensor", "front", "back") if getattr(effect, k, None)]
    return Right(effect.effect, effect.component, "-".join(sensors))


def _doubts(found: Diagnosis) -> frozenset[str]:
    kinds: set[str] = {d.kind for d in found.doubts}
    if found.findings and any("targets stand every" in a.why for a in found.findings[0].confused_with):
        kinds.add("alias")
    return frozenset(kinds)
