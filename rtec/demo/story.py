"""The whole demo: measures one day, fits, simulates another day without and with the correction, and evaluates it."""

import signal
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Generic, Self, TypeVar

import numpy as np

from rtec.commission.example import SHIPPED
from rtec.daemon.process import SIGNALS, signals_wait
from rtec.demo import training
from rtec.demo.day import NIST_SIZE, NIST_STRAIGHT, Plan, Sizes, Track, sizes_of
from rtec.demo.hidden import draw
from rtec.demo.live import RATE_HZ, LoopSide, corrected, uncorrected
from rtec.demo.residual_sources import WHY, ResidualSources, residual_sources
from rtec.demo.second_story import Later, tell_later
from rtec.errors import ConfigError, RtecError
from rtec.machine import Machine, load_machine
from rtec.model import Model
from rtec.sim.truth import load_truth

T = TypeVar("T")


class Beside(Generic[T]):
    """Calls a function in a process of its own.

    Use as a context manager: leaving it ends the process, finished or not.

    Args:
        function: importable by name; its arguments and result are pickled.
        arguments: arguments of the function.
    """

    def __init__(self, function: Callable[..., T], *arguments: Any) -> None:
        context = get_context("spawn")
        self._here, there = context.Pipe(duplex=False)
        self._process = context.Process(target=_call, args=(there, function, arguments), daemon=True)
        with signals_wait():
            self._process.start()
        there.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._process.terminate()
        self._process.join()
        self._here.close()

    def result(self) -> T:
        """Wait for the function's result.

        Raises:
            RtecError: the function raised it, or the process died.
        """
        try:
            done, value = self._here.recv()
        except EOFError as e:
            raise RtecError("the second process of the demo ended without a result; is there enough memory?") from e
        if not done:
            raise RtecError(str(value))
        return value  # type: ignore[no-any-return]


def _call(pipe: Connection, function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole process group; the parent ends this process
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    try:
        pipe.send((True, function(*arguments)))
    except RtecError as e:
        pipe.send((False, str(e)))
    finally:
        pipe.close()


Stage = Callable[[str, int, int], None]
"""Progress callback: called with the name of a stage, the number of steps done, and their total."""

MACHINE_FILE = Path("machines") / "turning-centre.toml"
TRUTH_FILE = Path("sim") / "turning-centre.toml"
FINER = 4
"""Factor of counts of the finer encoder, whose straightness is compared last."""
FINER_PLAN = Plan(warm_h=0.5, night_h=0.0)


@dataclass(frozen=True)
class Story:
    """Result of the demo.

    Attributes:
        plan: length of the working day.
        seed, measuring_seed: seeds of the working day and of the measuring day.
        model: the fitted model.
        readings: number of probe readings.
        inside_um, held_out_um: root mean square residual of the readings in the fit, and of the held-out ones.
        off, on: records of the working day, uncorrected and corrected.
        side: samples and commands of the loop on the corrected day.
        sources: sources of the error on the corrected day.
        finer_um: straightness, worst over the first parts, with a finer encoder: uncorrected, corrected.
        later: the second story; None where it was not run.
    """

    plan: Plan
    seed: int
    measuring_seed: int
    model: Model
    readings: int
    inside_um: float
    held_out_um: float
    off: Track
    on: Track
    side: LoopSide
    sources: ResidualSources
    finer_um: tuple[float, float]
    later: Later | None = None

    @cached_property
    def sizes(self) -> tuple[Sizes, Sizes]:
        """Errors of the parts, uncorrected and corrected."""
        return sizes_of(self.off), sizes_of(self.on)

    @property
    def held_share(self) -> float:
        """Share of the recorded cycles of the cuts in which the guard held the correction."""
        return float(np.mean(self.side.held[self.on.part >= 0]))

    def figures(self) -> list[dict[str, Any]]:
        """One entry a kind of error: largest and typical, uncorrected and corrected, factors, and NIST's."""
        (off, on), nist = self.sizes, {"diameter": NIST_SIZE, "length": NIST_SIZE, "straightness": NIST_STRAIGHT}
        return [
            {
                "error": kind,
                "off_largest_um": off.largest()[kind],
                "on_largest_um": on.largest()[kind],
                "factor_largest": off.largest()[kind] / on.largest()[kind],
                "off_rms_um": off.typical()[kind],
                "on_rms_um": on.typical()[kind],
                "factor_rms": off.typical()[kind] / on.typical()[kind],
                "nist_factor": list(nist[kind]) if kind in nist else None,
            }
            for kind in off.largest()
        ]

    def facts(self) -> dict[str, Any]:
        """The result as plain data, for JSON."""
        return {
            "seed": self.seed,
            "measuring_seed": self.measuring_seed,
            "parts": int(self.on.part.max()) + 1,
            "loop_rate_hz": RATE_HZ,
            "guard_held_share": self.held_share,
            "model": {
                "sha256": self.model.hash,
                "effects": len(self.model.effects),
                "numbers": len(self.model.parameter_values()),
                "readings": self.readings,
                "noise_um": self.model.noise_um,
                "inside_rms_um": self.inside_um,
                "held_out_rms_um": self.held_out_um,
            },
            "errors": self.figures(),
            "left_uncorrected": [
                {"part": name, "rms_um": rms, "largest_um": most, "why": WHY.get(name, "")}
                for name, rms, most in self.sources.sizes()
            ],
            "across": {
                "largest_um": float(np.abs(self.sources.across_um).max()),
                "on_diameter_um": self.sources.across_on_diameter_um,
                "why": "no axis moves across the workpiece (Y)",
            },
            "straightness_with_finer_encoder": {
                "counts_for_one": FINER,
                "off_um": self.finer_um[0],
                "on_um": self.finer_um[1],
                "factor": self.finer_um[0] / self.finer_um[1],
            },
            "hidden_effect": self.later.facts() if self.later else None,
        }


def config_folder(given: Path | None = None) -> Path:
    """Folder of the demo's machine and truth: the given one, or rtec's own.

    Raises:
        ConfigError: the files are missing.
    """
    folder = given or SHIPPED
    missing = [str(folder / name) for name in (MACHINE_FILE, TRUTH_FILE) if not (folder / name).is_file()]
    if missing:
        raise ConfigError(f"{missing[0]}: no such file; without --configs the demo takes the files that come with rtec")
    return folder


def tell_story(
    seed: int,
    configs: Path,
    stage: Stage,
    plan: Plan | None = None,
    hidden_seed: int | None = None,
    hidden: str | None = None,
) -> Story:
    """Run everything; the uncorrected day and the control fits run in a second process in parallel.

    Args:
        seed: seed of the working day; the measuring day has the next seed.
        configs: folder with machine and truth.
        stage: progress callback, see `Stage`.
        plan: a shorter day.
        hidden_seed: seed of the fault of the second story; None: no second story.
        hidden: name of the fault, or None to draw it.
    """
    plan = plan or Plan()
    if hidden_seed is not None:
        draw(hidden_seed, hidden)  # a wrong name is an error before anything runs
    machine, truth = load_machine(configs / MACHINE_FILE), load_truth(configs / TRUTH_FILE)
    measuring_seed = seed + 1
    with Beside(_beside, seed, measuring_seed, configs, plan) as beside:
        day = training.measure(machine, truth, measuring_seed, _progress(stage, "measuring day"))
        stage("fitting the model", 0, 1)
        model = training.fit_day(day)
        on, side = corrected(model, configs / TRUTH_FILE, seed, plan, progress=_progress(stage, "corrected day"))
        stage("what a finer encoder would do", 0, 1)
        finer = _finer(model, configs, seed)
        later = None
        if hidden_seed is not None:
            later = tell_later(model, configs / TRUTH_FILE, hidden_seed, hidden, seed, stage)
        stage("waiting for the uncorrected day", 0, 1)
        off, clean, rms = beside.result()
    stage("taking stock", 0, 1)
    sources = residual_sources(on, side, (model, clean), truth, seed)
    return Story(plan, seed, measuring_seed, model, day.readings, *rms, off, on, side, sources, finer, later)


def _beside(seed: int, measuring_seed: int, configs: Path, plan: Plan) -> tuple[Track, Model, tuple[float, float]]:
    """Work of the second process: the uncorrected day; a fit without probe noise; a fit without some hours."""
    machine, truth = load_machine(configs / MACHINE_FILE), load_truth(configs / TRUTH_FILE)
    off = uncorrected(machine, truth, seed, plan)
    day = training.measure(machine, truth, measuring_seed)
    return off, training.fit_day(day, day.noise_free_um), training.held_out_rms_um(day)


def _finer(model: Model, configs: Path, seed: int) -> tuple[float, float]:
    """Worst straightness of the first parts with a finer encoder, uncorrected and corrected, µm."""
    machine = _with_finer_encoder(model.machine)
    truth = load_truth(configs / TRUTH_FILE)
    off = sizes_of(uncorrected(machine, truth, seed, FINER_PLAN))
    on = sizes_of(corrected(replace(model, machine=machine), configs / TRUTH_FILE, seed, FINER_PLAN)[0])
    return off.largest()["straightness"], on.largest()["straightness"]


def _with_finer_encoder(machine: Machine) -> Machine:
    return replace(
        machine, axes=tuple(replace(axis, counts_per_mm=FINER * axis.counts_per_mm) for axis in machine.axes)
    )


def _progress(stage: Stage, what: str) -> Callable[[int, int], None]:
    return lambda done, total: stage(what, done, total)
