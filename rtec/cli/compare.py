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
    from rtec import api
    from rtec.cli.common import show, stages

    with stages() as stage:
        comparison = api.compare(model, files, machine=machine, seed=seed, report=report, progress=stage)
    show(comparison, as_json=as_json, full=full)
