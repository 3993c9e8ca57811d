"""`rtec compare`: the residual of a model against the noise floor, and where it is largest."""

from rtec.cli.common import Full, Json, Report
from rtec.cli.diagnose import Files, MachineFile, ModelFile, Seed


def compare(
    model: ModelFile,
    files: Files,
    machine: MachineFile = None,
    seed: Seed = 1,
    full: Full = False,
    report: Report = None,
    as_json: Json = False,
) -> None:
    """Compares a model with measurements: the residual, how much of it is noise, and where it is largest.

    The model is taken as it is; nothing is refitted. Readings outside the range of its fit are reported.

    Example: `rtec compare model.toml laser-x.csv drift.csv --report out/compare`
    """
    from rtec.cli.common import give, stages
    from rtec.diagnosis.compare.compare import compare as compare_with
    from rtec.diagnosis.machine_file import load_with_machine
    from rtec.metrology.files.load import load_measurements
    from rtec.report.compare import compare_page

    known = load_with_machine(model, machine)
    measurements = load_measurements(files, known.machine)
    with stages() as stage:
        comparison = compare_with(known, measurements, seed=seed, stage=stage)
    give(
        lambda figures: compare_page(comparison, figures, [model, *files]),
        comparison.facts(),
        as_json=as_json,
        report=report,
        full=full,
    )
