"""The public API, which the commands call too: load, simulate, fit, compare, diagnose, add, improve, plan, evaluate.

Paths are `str` or `Path`. A model, a machine or a measurement is given as its file or as the loaded object.
Long calls report with `progress(stage, done, total)`: the stage in words, the amount done, and the total.
Every error is an `rtec.errors.RtecError`, and its message says what to do.
"""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from rtec.errors import ConfigError, MeasurementError, ModelError, RtecError
from rtec.files import target_of
from rtec.machine import Machine
from rtec.machine import load_machine as _load_machine
from rtec.metrology.measurement import Measurement
from rtec.model import Model, save_model
from rtec.result import Result

if TYPE_CHECKING:
    from rtec.characterise.result import Characterisation
    from rtec.diagnosis.compare.result import Comparison, Traces
    from rtec.diagnosis.extend.add import Added
    from rtec.diagnosis.extend.improve import Improved, ProposedStep
    from rtec.diagnosis.plan.answer import Answer
    from rtec.diagnosis.result import Diagnosis, Finding
    from rtec.effects import Effect
    from rtec.metrology.ball_bar.design import Centre
    from rtec.metrology.ball_bar.diagnosis import BallBarDiagnosis, Choice
    from rtec.metrology.ball_bar.phase import Phase
    from rtec.metrology.files.toml import Leniency
    from rtec.metrology.grid.compare import GridEvaluation
    from rtec.metrology.importing import Imported, ImportProposal
    from rtec.metrology.procedures.drift import Drift
    from rtec.metrology.procedures.iso230_2 import PositioningTests
    from rtec.metrology.procedures.straightness import ParallelismResult, StraightnessResult
    from rtec.model.history import History
    from rtec.playback.replay import Replayed
    from rtec.sim.campaign.campaign import Simulated

PathLike = str | Path
MachineLike = Machine | PathLike
ModelLike = Model | PathLike
MeasurementLike = Measurement | PathLike
Progress = Callable[[str, int, int], None]
R = TypeVar("R", bound=Result)
Bounds = tuple[float, float, float]

__all__ = [
    "add",
    "ballbar",
    "compare",
    "diagnose",
    "drift",
    "fit",
    "grid",
    "history",
    "import_table",
    "improve",
    "iso230",
    "load_machine",
    "load_measurement",
    "load_model",
    "parallelism",
    "plan",
    "propose_import",
    "replay",
    "simulate",
    "straightness",
]


def load_machine(path: PathLike) -> Machine:
    """Read a machine file.

    Raises:
        ConfigError: all faults of the file, with file, section, key and what is allowed.
    """
    return _load_machine(Path(path))


def load_model(path: PathLike, machine: MachineLike | None = None) -> Model:
    """Read a model file.

    Args:
        path: path of the model.
        machine: machine of the model; None: the machine file beside the model.

    Raises:
        ModelError: the file cannot be used, or there is no machine file for it.
    """
    return _model(path, machine)[0]


def load_measurement(path: PathLike, machine: MachineLike, leniency: "Leniency | None" = None) -> Measurement:
    """Read a measurement: a table and the TOML beside it.

    Args:
        path: table, TOML, or their common stem.
        machine: machine of the measurement.
        leniency: faults to accept, in addition to those that the TOML accepts.

    Raises:
        MeasurementError: all faults of the table, by row, each with a way out.
    """
    from rtec.metrology.files.load import load_measurement as load

    return load(Path(path), _machine(machine), leniency)


def propose_import(
    path: PathLike,
    machine: MachineLike | None = None,
    answers: Mapping[str, str] | None = None,
    *,
    temperatures: PathLike | None = None,
) -> "ImportProposal":
    """Propose how to read another program's table: its columns, first values, guesses with reasons, questions.

    Args:
        path: the table.
        machine: machine of the measurement; its axes and sensors are matched with the columns.
        answers: answers to questions, by key; `ImportProposal.answered` adds more.
        temperatures: log of temperatures in a file of its own, also of spindle speed, feed or load; matched by date or
            time of day.

    Raises:
        MeasurementError: the file is no table, or an answer is not allowed.
    """
    from rtec.metrology.importing import beside, propose

    preset = {} if temperatures is None else {"temperatures": {"file": beside(Path(temperatures), Path(path))}}
    return propose(Path(path), None if machine is None else _machine(machine), preset, answers)


def import_table(
    path: PathLike | Sequence[PathLike],
    map: "PathLike | ImportProposal",
    out: PathLike,
    machine: MachineLike | None = None,
    *,
    reader: str | None = None,
    drop_bad_rows: bool = False,
    missing_codes: Sequence[str] = (),
    force: bool = False,
) -> "Imported":
    """Read another program's table, and write it as a measurement: NAME.csv (or .parquet) and NAME.toml.

    Args:
        path: the table; several of one form become runs.
        map: TOML with the meaning of each column; or a proposal, which is then written as NAME-map.toml.
        out: NAME, NAME.csv or NAME.parquet.
        machine: machine to check the result against; without it, and without a proposal's, `Imported.measurement` is
            None.
        reader: reader of the table; None: the one that recognises its content.
        drop_bad_rows, missing_codes: faults to accept; recorded in NAME.toml.
        force: overwrite existing files.

    Raises:
        MeasurementError: the table or the map is at fault, or the proposal has open questions; line, column or key, and
            a way out.
    """
    from rtec.metrology.importing import ImportProposal, import_to_files, load_map, save_map

    proposal = map if isinstance(map, ImportProposal) else None
    how = map.import_map() if isinstance(map, ImportProposal) else load_map(Path(map))
    on = None if machine is None else _machine(machine)
    done = import_to_files(
        [Path(path)] if isinstance(path, str | Path) else [Path(p) for p in path],
        how,
        Path(out),
        on or (proposal.machine if proposal else None),
        reader=reader,
        drop_bad_rows=drop_bad_rows,
        missing_codes=missing_codes,
        force=force,
    )
    return done if proposal is None or done.table is None else replace(done, map=save_map(proposal, done.table))


def simulate(
    machine: MachineLike,
    instrument: str,
    *,
    axis: str | None = None,
    component: str | None = None,
    setup: Mapping[str, Any] | None = None,
    truth: ModelLike | None = None,
    effects: Sequence[str] = (),
    settings: PathLike | None = None,
    changes: Mapping[str, Any] | None = None,
    seed: int = 1,
    out: PathLike | None = None,
    truth_out: PathLike | None = None,
) -> "Simulated":
    """Simulate a measurement on a machine with true effects of your choice; the same seed gives the same numbers.

    Args:
        machine: machine to measure.
        instrument: name of the instrument, for example "laser_linear".
        axis: axis that the instrument follows.
        component: component error that it reads directly, without lever arm.
        setup: keys of its set-up, as under `[setup]` of a measurement: `{"beam_offset_mm": [0, 0, 150]}`.
        truth: model with the true effects.
        effects: further true effects, each as `NAME,key=value,…`.
        settings: TOML file with targets, phases, temperatures, noise.
        changes: keys and tables that replace those of `settings`: `{"cycles": 3, "noise": {"white_um": 0.1}}`; None
            changes nothing.
        seed: seed of noise, weather and nuisances.
        out: NAME or NAME.csv or NAME.parquet for the measurement.
        truth_out: file for the true effects as a model.

    Raises:
        ConfigError, ModelError, MeasurementError: an impossible argument; the message lists the possible ones.
    """
    from rtec.metrology.files.load import save_measurement
    from rtec.sim.campaign.campaign import simulate_with_truth
    from rtec.sim.campaign.settings import instrument_of, settings_of, table_path
    from rtec.sim.campaign.truth import truth_of

    described = _machine(machine)
    made = instrument_of(described, instrument, axis, component, setup or {})
    known = truth if isinstance(truth, Model) or truth is None else load_model(truth, described)
    true = truth_of(described, known, effects)
    tables = {k: v for k, v in (changes or {}).items() if isinstance(v, Mapping)}
    heads = {k: v for k, v in (changes or {}).items() if k not in tables}
    chosen = settings_of(None if settings is None else Path(settings), tables, heads)
    table = None if out is None else table_path(Path(out))
    if table is not None:
        inputs = [p for p in (machine, truth, settings) if isinstance(p, str | Path)]
        _check_not_read([table, table.with_suffix(".toml")], inputs)
    if truth_out is not None:
        target_of(Path(truth_out), ModelError)
    result = simulate_with_truth(true, made, chosen, seed, "simulated" if table is None else table.stem)
    written: dict[str, Path | None] = {"table": table, "toml": None if table is None else table.with_suffix(".toml")}
    if table is not None:
        save_measurement(result.measurement, table)
    if truth_out is not None:
        save_model(true, Path(truth_out))
    return replace(result, written=written)


def fit(
    machine: MachineLike,
    measurements: MeasurementLike | Iterable[MeasurementLike],
    *,
    effects: str | Iterable[str] | None = None,
    leave_out_h: float | None = None,
    name: str | None = None,
    out: PathLike | None = None,
    report: PathLike | None = None,
    progress: Progress | None = None,
) -> "Characterisation":
    """Characterise a machine: choose effects and temperatures on held-out runs, and fit them.

    Args:
        machine: machine that was measured.
        measurements: one or several, of any instruments.
        effects: fit only these, each as `scale` or `mount_expansion:EXX:sensor=T_bed`.
        leave_out_h: hold out stretches of this many hours instead of runs.
        name: name of the model; None: that of its file.
        out: file for the model.
        report: folder for the report with figures.
        progress: called with stage, done and total.

    Raises:
        ModelError: nothing can be fitted, or the readings do not show a requested effect.
        MeasurementError: a measurement cannot be read or used.
    """
    from rtec.characterise import characterise, read_wanted

    known, given = _machine(machine), _listed(measurements)
    target = _check_out(out, [p for p in (machine, *given) if isinstance(p, str | Path)])
    names = effects if isinstance(effects, str) or effects is None else ",".join(effects)
    wanted = read_wanted(names, known) if names else None
    if progress:
        progress("reading", 0, 1)
    read, paths = _measurements(given, known)
    result = characterise(
        read,
        wanted=wanted,
        leave_out_h=leave_out_h,
        name=name or (target.stem if target else "model"),
        stage=progress,
    )
    if target is not None:
        save_model(result.model, target)
    return _finished(result, target, paths, report, {"model_file": target})


def compare(
    model: ModelLike,
    measurements: MeasurementLike | Iterable[MeasurementLike],
    *,
    machine: MachineLike | None = None,
    seed: int = 1,
    report: PathLike | None = None,
    progress: Progress | None = None,
    residual: "Callable[[Traces], None] | None" = None,
) -> "Comparison":
    """Compare a model with measurements: the residual, how much of it is noise, and where it is largest.

    Args:
        model: model to compare, without a refit.
        measurements: one or several, of any instruments.
        machine: machine of the model; None: the machine file beside the model.
        seed: seed of the random draws.
        report: folder for the report with figures.
        progress: called with stage, done and total.
        residual: called with measured and predicted value of each reading as soon as they are known, which may be long
            before noise floor and worst regions.

    Raises:
        ModelError, MeasurementError: a file cannot be read or used.
    """
    from rtec.diagnosis.compare.compare import compare as compare_with

    known, path, machine_path = _model(model, machine)
    read, paths = _measurements(_listed(measurements), known.machine)
    result = compare_with(known, read, seed=seed, stage=progress, residual=residual)
    return _finished(_of_machine(result, path, machine_path), path, paths, report)


def diagnose(
    model: ModelLike,
    measurements: MeasurementLike | Iterable[MeasurementLike],
    *,
    machine: MachineLike | None = None,
    only: Iterable[str] | None = None,
    alpha: float = 0.05,
    seed: int = 1,
    report: PathLike | None = None,
    progress: Progress | None = None,
) -> "Diagnosis":
    """Name the physical effect that a model lacks, with the evidence, the rivals and what could not be tested.

    Args:
        model: model to diagnose.
        measurements: one or several, of any instruments.
        machine: machine of the model; None: the machine file beside the model.
        only: test these effects only.
        alpha: accepted false-positive rate, above 0 and at most 0.5.
        seed: seed of the random draws; same seed, same result.
        report: folder for the report with figures.
        progress: called with stage, done and total.

    Raises:
        ModelError, MeasurementError: a file cannot be read or used; an effect of `only` does not exist.
        ConfigError: `alpha` is out of range.
    """
    from rtec.diagnosis.search.diagnose import diagnose as find
    from rtec.effects import effect_class

    if not 0.0 < alpha <= 0.5:
        raise ConfigError(f"diagnose: alpha {alpha:g}: above 0 and at most 0.5")
    names = None if only is None else list(only)
    for name in names or ():
        effect_class(name, "--only")
    known, path, machine_path = _model(model, machine)
    read, paths = _measurements(_listed(measurements), known.machine)
    result = find(known, read, seed=seed, alpha=alpha, only=names, explain=True, stage=progress)
    return _finished(_of_machine(result, path, machine_path), path, paths, report)


def add(
    model: ModelLike,
    measurements: MeasurementLike | Iterable[MeasurementLike],
    effect: "str | Effect | Finding | None" = None,
    *,
    component: str | None = None,
    expr: str | None = None,
    params: Mapping[str, Bounds] | Sequence[str] = (),
    arguments: Mapping[str, Any] | None = None,
    machine: MachineLike | None = None,
    out: PathLike | None = None,
    force: bool = False,
    report: PathLike | None = None,
    progress: Progress | None = None,
) -> "Added":
    """Add an effect to a model, refit all of it, and give the error before and after.

    Args:
        model: model to extend; it is unchanged, and the new one is `Added.model`.
        measurements: one or several, to refit with.
        effect: name of an effect, an effect, or a finding of `diagnose`; without it and without `expr` the model's own
            numbers are refitted and nothing is added.
        component: component error of a named effect or an expression, for example "EXX".
        expr: an effect of your own, `A*sin(2*pi*x/p + phi)`.
        params: its non-linear parameters: `{"p": (start, low, high)}`.
        arguments: further arguments of a named effect, `{"sensor": "T_bed"}`.
        machine: machine of the model; None: the machine file beside the model.
        out: file for the new model; not written unless the error on held-out runs falls by at least 0.1 %.
        force: write it in any case.
        report: folder for the report with figures.
        progress: called with stage, done and total.

    Raises:
        ModelError, MeasurementError: a file cannot be read or used; the model has the effect already, no reading shows
        it,
            or something that it needs is missing.
    """
    from rtec.diagnosis.extend.add import add as add_effects

    given = _listed(measurements)
    wanted = _check_out(out, [p for p in given if isinstance(p, str | Path)])
    known, _, _ = _model(model, machine)
    read, paths = _measurements(given, known.machine)
    new = _new_effects(known, effect, component, expr, params, arguments or {})
    added = add_effects(known, new, read, stage=progress)
    target = wanted if added.better or force else None
    if target is not None:
        save_model(added.model, target)
    return _finished(added, target, paths, report, {"model_file": target})


def improve(
    model: ModelLike,
    measurements: MeasurementLike | Iterable[MeasurementLike],
    *,
    ask: "Callable[[ProposedStep], Finding | None] | None" = None,
    ask_made: "Callable[[Added], bool] | None" = None,
    step: "Callable[[Added], None] | None" = None,
    seed: int = 1,
    machine: MachineLike | None = None,
    out: PathLike | None = None,
    report: PathLike | None = None,
    progress: Progress | None = None,
) -> "Improved":
    """Diagnose and add, one effect after the other, until no significant effect is missing.

    Args:
        model: model to extend; it is unchanged, and the new one is `Improved.model`.
        measurements: one or several, of any instruments.
        ask: selects the candidate to add; None: stop. Without it the best one is added.
        ask_made: decides whether to keep an improvement without a cause: a refit of the model's own numbers (no
            labels), a further temperature of one of its effects, or an expansion in place of a changed scale error
            (`Added.question`); without it, it is kept.
        step: called with the refit and each addition as soon as it is made and written.
        seed: seed of the random draws.
        machine: machine of the model; None: the machine file beside the model.
        out: file for the new model, written after each step; not written where nothing is added.
        report: folder for the report with figures.
        progress: called with stage, done and total.

    Raises:
        ModelError, MeasurementError: a file cannot be read or used.
    """
    from rtec.diagnosis.extend.improve import improve as go_on

    given = _listed(measurements)
    target = _check_out(out, [p for p in given if isinstance(p, str | Path)])
    known, path, machine_path = _model(model, machine)
    read, paths = _measurements(given, known.machine)
    done: list[Path] = []

    def keep(added: "Added") -> None:
        if target is not None:
            save_model(added.model, target)
            done.append(target)
        if step:
            step(added)

    result = go_on(known, read, ask=ask, ask_made=ask_made, seed=seed, stage=progress, step=keep)
    written = done[-1] if done else None
    last = written or path
    return _finished(_of_machine(result, last, machine_path), last, paths, report, {"model_file": written})


def history(model: ModelLike, *, machine: MachineLike | None = None, report: PathLike | None = None) -> "History":
    """Every change of a model, with the error on held-out runs before and after it.

    Args:
        model: model with the history.
        machine: machine of the model; None: the machine file beside the model.
        report: folder for the report with its figure.

    Raises:
        ModelError: the file cannot be read.
    """
    from rtec.model.history import History

    return _finished(History(_model(model, machine)[0]), None, None, report)


def plan(
    machine: MachineLike,
    tests: MeasurementLike | Iterable[MeasurementLike],
    *,
    effects: str | Iterable[str] | None = None,
    model: PathLike | None = None,
    rivals: str | Iterable[str] | None = None,
    ball_bar: Literal["linear", "non-linear"] | None = None,
    centre: Literal["shared", "each"] = "shared",
    noise: float = 0.5,
    suggest: bool = True,
    report: PathLike | None = None,
    progress: Progress | None = None,
) -> "Answer":
    """Which parameters planned tests separate, which stay confounded, and which test to add.

    Args:
        machine: machine to measure.
        tests: measurements, or TOML files of planned tests; nothing needs to be measured yet.
        effects: effects to separate, each as `scale:EXX`; None: the usual ones.
        model: take the effects of this model instead.
        rivals: rank tests by how well they separate these effects.
        ball_bar: the parameters of a ball-bar diagnosis instead: of straight guides, or of bent ones.
        centre: for a ball bar: one centre of the table-side ball for all tests, or one for each.
        noise: white noise of a reading, µm or µrad.
        suggest: look for tests to add?
        report: folder for the report.
        progress: called with stage, done and total.

    Raises:
        ConfigError, ModelError: an argument does not fit the tests or the machine.
    """
    from rtec.diagnosis.plan.answer import Question, answer
    from rtec.diagnosis.plan.tests import load_test, thinned

    known = _machine(machine)
    if progress:
        progress("reading the tests", 0, 1)
    given = [thinned(t if isinstance(t, Measurement) else load_test(Path(t), known)) for t in _listed(tests)]
    question = Question(
        _joined(effects), None if model is None else Path(model), ball_bar, _joined(rivals), centre, noise, suggest
    )
    return _finished(answer(known, given, question, progress), None, None, report)


def ballbar(
    machine: MachineLike,
    tests: MeasurementLike | Iterable[MeasurementLike],
    *,
    model: "Choice" = "auto",
    window_deg: float = 5.0,
    centre: "Centre" = "shared",
    phase: "Phase" = "auto",
    dynamic: bool = True,
    orders: int = 15,
    report: PathLike | None = None,
    progress: Progress | None = None,
) -> "BallBarDiagnosis":
    """Diagnose ball-bar tests of one plane together: scales, squareness, clearance, servo, bent guides, dynamics.

    Args:
        machine: machine that was measured.
        tests: one or several, of instrument ball_bar.
        model: straight guides ("linear"), bent ones ("non-linear"), or by the readings ("auto").
        window_deg: readings within this angle of a quadrant are not fitted, degrees; with dynamic effects they are.
        centre: one centre of the table-side ball for all tests ("shared"), or one for each ("each").
        phase: the servo phase is one "angle" in all tests, or one "time".
        dynamic: test dynamic effects and those of the drive?
        orders: number of harmonics, at least 3.
        report: folder for the report with figures.
        progress: called with stage, done and total.

    Raises:
        MeasurementError: other instruments, planes or machines; too few readings.
    """
    from rtec.metrology.ball_bar.diagnosis import diagnose as find
    from rtec.wording import counted

    read, paths = _measurements(_listed(tests), _machine(machine))
    if progress:
        progress(f"diagnosing {counted(len(read), 'test')}", 0, 1)
    result = find(read, model, window_deg, centre, orders, dynamic=dynamic, phase=phase)
    return _finished(result, _path(machine), paths, report)


def grid(
    machine: MachineLike,
    measurements: MeasurementLike | Iterable[MeasurementLike],
    *,
    corner_mm: tuple[float, float] | None = None,
    trim_mm: float = 2.0,
    magnification: float | None = None,
    report: PathLike | None = None,
) -> "GridEvaluation":
    """Evaluate grid-encoder paths: squareness, linear deviation, straightness and pitch, with uncertainties.

    Args:
        machine: machine that was measured.
        measurements: one set-up each; several are compared.
        corner_mm: report on the edges that meet here; None: the first corner.
        trim_mm: length skipped at both ends of each straight piece.
        magnification: magnification of the figures; None: a round one.
        report: folder for the report with figures.

    Raises:
        MeasurementError: other instruments or machines; no straight pieces.
    """
    from rtec.metrology.grid.compare import evaluate

    read, paths = _measurements(_listed(measurements), _machine(machine))
    return _finished(evaluate(read, corner_mm, trim_mm, magnification), _path(machine), paths, report)


def iso230(
    tests: MeasurementLike | Iterable[MeasurementLike],
    *,
    machine: MachineLike | None = None,
    pitch_mm: float | None = None,
    swap: bool = False,
    report: PathLike | None = None,
) -> "PositioningTests":
    """Evaluate positioning after ISO 230-2: A, R, E, M and B, coverage factor 2.

    Args:
        tests: `.dat` files of ecmc, or measurements of instrument laser_linear.
        machine: machine of a measurement.
        pitch_mm: pitch of the screw; None: that of the machine's axis.
        swap: in a `.dat` file, take FWD as backward.
        report: folder for the report with figures.

    Raises:
        MeasurementError: a file cannot be read or used, or has fewer than two readings at a target.
        ConfigError: a measurement without a machine.
    """
    from rtec.metrology.procedures.iso230_2 import PositioningTests, positioning, visits_of
    from rtec.metrology.procedures.tables import read_dat

    results, notes, given = [], {}, _listed(tests)
    if swap and not any(not isinstance(test, Measurement) and Path(test).suffix == ".dat" for test in given):
        raise MeasurementError("--swap is for the directions of a .dat; a measurement has them from its positions")
    for test in given:
        if not isinstance(test, Measurement) and Path(test).suffix == ".dat":
            results.append(positioning(read_dat(Path(test), swap), pitch_mm))
            continue
        measured = _measured(test, machine)
        visits, axis = visits_of(measured), str(measured.instrument.axis)
        results.append(positioning(visits, pitch_mm or measured.machine.axis(axis).pitch_mm))
        notes[measured.name] = measured.notes
    return _finished(PositioningTests(tuple(results), notes), None, None, report)


def straightness(
    table: MeasurementLike,
    *,
    machine: MachineLike | None = None,
    method: str | None = None,
    report: PathLike | None = None,
) -> "StraightnessResult":
    """Evaluate straightness: an arbor and its reversal, a pair of probes, or a turned face with orthogonality.

    Args:
        table: CSV with `x_mm` (or another axis), `spindle_deg`, `probe1_um`, `probe2_um`, `run`; or a measurement of
            instrument straightness with reversed runs.
        machine: machine of a measurement.
        method: "reversal", "pair" or "face" for a table; None: by its columns. A measurement is always that of an
            artefact that is reversed.
        report: folder for the report with figures.

    Raises:
        MeasurementError: the table lacks columns of the method.
        ConfigError: a measurement without a machine.
    """
    from rtec.metrology.procedures.tables import straightness_of, straightness_table

    plain = _plain_table(table)
    result = straightness_table(plain, method) if plain else straightness_of(_measured(table, machine), method)
    return _finished(result, None, None, report)


def parallelism(table: PathLike, *, report: PathLike | None = None) -> "ParallelismResult":
    """Evaluate parallelism of a motion to the spindle axis, from circles of two probes on a turning arbor.

    Args:
        table: CSV with `z_mm` (place along the motion, two or more), `angle_deg`, `probe1_um`, `probe2_um`.
        report: folder for the report with figures.

    Raises:
        MeasurementError: a column is missing, or there are too few places.
    """
    from rtec.metrology.procedures.tables import parallelism_table

    return _finished(parallelism_table(Path(table)), None, None, report)


def drift(
    table: MeasurementLike,
    *,
    machine: MachineLike | None = None,
    columns: Mapping[str, str] | None = None,
    distance_mm: float | None = None,
    report: PathLike | None = None,
) -> "Drift":
    """Evaluate thermal drift of the spindle: radial, axial and tilt, a time constant for each constant speed.

    Args:
        table: CSV with `time_s`, `spindle_rpm`, probes and temperatures; or a measurement of instrument spindle_drift.
        machine: machine of a measurement.
        columns: names of the probes "radial1", "radial2", "axial" in a CSV, where they differ.
        distance_mm: distance of the radial probes, for the tilt.
        report: folder for the report with figures.

    Raises:
        MeasurementError: a column is missing, times do not rise, or there are too few rows.
        ConfigError: a measurement without a machine.
    """
    from rtec.metrology.procedures.tables import drift_of, drift_table

    plain = _plain_table(table)
    if plain is None:
        result = drift_of(_measured(table, machine), distance_mm, columns)
    else:
        result = drift_table(plain, columns or {}, distance_mm)
    return _finished(result, None, None, report)


def replay(
    config: PathLike,
    log: PathLike,
    *,
    check: bool = False,
    out: PathLike | None = None,
    progress: Progress | None = None,
) -> "Replayed":
    """Replay a log, a folder of logs, or a logic-analyser capture through the same step as the daemon.

    Args:
        config: run file: machine, model, limits.
        log: a log of `rtec run`, a folder of logs (always checked), or a capture (`.sr`).
        check: compare with the commands in the log, bit for bit.
        out: file for the recomputed commands; None: beside the log, and no file where it is checked.
        progress: called with stage, done and total.

    Raises:
        ConfigError, LogError: the run file, the log or the capture cannot be used.
    """
    from rtec.playback.replay import replayed

    return replayed(Path(config), Path(log), None if out is None else Path(out), check=check, progress=progress)


def _machine(machine: MachineLike) -> Machine:
    if isinstance(machine, Machine):
        return machine
    return load_machine(_file(machine, "machine", ConfigError))


def _model(model: ModelLike, machine: MachineLike | None) -> tuple[Model, Path | None, Path | None]:
    """The model, its file and its machine's file; None for a file that is unknown."""
    from rtec.diagnosis.machine_file import load_with_machine, machine_file
    from rtec.model import load_model as load

    if isinstance(model, Model):
        return model, None, None
    path = _file(model, "model", ModelError)
    if isinstance(machine, Machine):
        return load(path, machine), path, None
    described = machine_file(path, None if machine is None else Path(machine))
    return load_with_machine(path, described), path, described


def _of_machine(result: R, model: Path | None, machine: Path | None) -> R:
    """The result with its machine's file, and with the option that names it where the model does not lead to it."""
    from rtec.diagnosis.machine_file import machine_file

    if model is None or machine is None:
        return replace(result, machine_file=machine)
    try:
        leads = machine_file(model).samefile(machine)
    except ModelError:
        leads = False
    return replace(result, machine_file=machine, machine_option=() if leads else ("--machine", str(machine)))


def _listed(items: MeasurementLike | Iterable[MeasurementLike]) -> list[MeasurementLike]:
    items = [items] if isinstance(items, str | Path | Measurement) or not isinstance(items, Iterable) else list(items)
    for item in items:
        if not isinstance(item, Measurement):
            _file(item, "measurement", MeasurementError)
    return items


def _file(thing: object, kind: str, error: type[RtecError]) -> Path:
    """The path of a file.

    Raises:
        error: it is no path; as where arguments are in the wrong order.
    """
    if isinstance(thing, str | os.PathLike):
        return Path(thing)
    name = type(thing).__name__
    article = "an" if name[0].lower() in "aeiou" else "a"
    raise error(f"{article} {name} is given where a {kind} or its file is expected")


def _path(thing: object) -> Path | None:
    return Path(thing) if isinstance(thing, str | Path) else None


def _plain_table(table: MeasurementLike) -> Path | None:
    """The table of a procedure; None for a measurement, which has a TOML beside it or is Parquet."""
    path = _path(table)
    if path is None or path.suffix in (".toml", ".parquet") or _toml_beside(path).is_file():
        return None
    return path


def _measured(item: MeasurementLike, machine: MachineLike | None) -> Measurement:
    """A measurement of a procedure; reads it if it is a path."""
    if isinstance(item, Measurement):
        return item
    if machine is None:
        raise ConfigError(f"{item}: is a measurement; name the machine that it was made on with --machine")
    return load_measurement(item, machine)


def _joined(names: str | Iterable[str] | None) -> str | None:
    return names if isinstance(names, str) or names is None else ",".join(names)


def _measurements(
    given: Sequence[MeasurementLike], machine: Machine
) -> tuple[tuple[Measurement, ...], tuple[Path, ...] | None]:
    """Measurements; paths are read, with all faults together. And the paths, if all are paths."""
    from rtec.metrology.files.load import load_measurements

    paths = [Path(item) for item in given if isinstance(item, str | Path)]
    read = iter(load_measurements(paths, machine))
    whole = tuple(item if isinstance(item, Measurement) else next(read) for item in given)
    return whole, tuple(paths) if len(paths) == len(given) else None


def _new_effects(
    model: Model,
    effect: "str | Effect | Finding | None",
    component: str | None,
    expr: str | None,
    params: Mapping[str, Bounds] | Sequence[str],
    arguments: Mapping[str, Any],
) -> "list[Any]":
    """The effects to add: none, one, or a finding with its partner."""
    from rtec.diagnosis.extend.add import asked_effect, new_effect
    from rtec.diagnosis.result import Finding
    from rtec.effects.expression import expression_from_text

    if effect is not None and expr is not None:
        raise ModelError("add: an effect and an expression together: give one of them")
    if expr is not None:
        if component is None:
            raise ModelError("add: name the component error that the expression feeds, for example EXX (--component)")
        texts = (
            [f"{name}={start!r}:{low!r}..{high!r}" for name, (start, low, high) in params.items()]
            if isinstance(params, Mapping)
            else list(params)
        )
        return [new_effect(expression_from_text(expr, texts, component, model.machine), model)]
    if effect is None:
        return []
    if isinstance(effect, str):
        return [asked_effect(effect, component, arguments, model)]
    if isinstance(effect, Finding):
        findings = [effect, *([effect.partner] if effect.partner else [])]
        return [new_effect(f.effect, model, f.theta, {k: n.value for k, n in f.parameters.items()}) for f in findings]
    return [new_effect(effect, model)]


def _finished(
    result: R,
    first: Path | None,
    measurements: tuple[Path, ...] | None,
    report: PathLike | None,
    written: Mapping[str, Path | None] | None = None,
) -> R:
    """The result with its files and, if one is requested, its report."""
    files = (first, *measurements) if first is not None and measurements is not None else ()
    whole = replace(result, files=files, written={**(written or {}), "report": None})
    return whole if report is None else whole.save_report(report)


def _check_out(out: PathLike | None, inputs: Sequence[PathLike]) -> Path | None:
    """Before a long fit: check that the model's file replaces no input, and may be written; make its folder."""
    if out is None:
        return None
    target = Path(out)
    read = {os.path.realpath(p) for path in map(Path, inputs) for p in (path, _toml_beside(path))}
    if os.path.realpath(target_of(target, ModelError)) in read:
        raise ModelError(f"{target}: is read by this fit (a table's TOML counts); name another file with -o")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise ModelError(f"{target}: cannot be written: {e.strerror or e}") from e
    return target


def _check_not_read(written: Sequence[Path], inputs: Sequence[PathLike]) -> None:
    """Refuse to replace an input."""
    read = {os.path.realpath(p) for p in inputs}
    for path in written:
        if os.path.realpath(path) in read:
            raise MeasurementError(
                f"{path}: is read by this simulation, and would be replaced; give another name with -o"
            )


def _toml_beside(table: Path) -> Path:
    return table.with_suffix(".toml") if table.name else table
