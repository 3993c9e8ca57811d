"""`rtec compare`: how wrong a model is, against the noise floor, and where."""

import json

import typer

from rtec.cli.diagnose import AsJson, Files, MachineFile, ModelFile, Report, Seed


def compare(
    model: ModelFile,
    files: Files,
    machine: MachineFile = None,
    seed: Seed = 1,
    report: Report = None,
    as_json: AsJson = False,
) -> None:
    """Say how wrong a model is against measurements, how much of that is noise, and where it is worst.

    The model is taken as it stands; nothing is fitted anew. Readings outside the range of its fit are told.

    Example: `rtec compare model.toml laser-x.csv drift.csv --report out/compare`
    """
    from rtec.cli.common import show_page, stages
    from rtec.diagnosis.compare.compare import compare as against
    from rtec.diagnosis.machine_file import load_with_machine
    from rtec.metrology.files.load import load_measurements
    from rtec.report.compare import compare_page
    from rtec.report.page import plain, write_page

    known = load_with_machine(model, machine)
    measurements = load_measurements(files, known.machine)
    with stages() as stage:
        found = against(known, measurements, seed=seed, stage=stage)
        written = write_page(compare_page(found), found.facts(), report) if report else None
    if as_json:
        facts = plain(found.facts()) | {"report": str(written) if written else None}
        typer.echo(json.dumps(facts, indent=2, ensure_ascii=False))
        return
    show_page(compare_page(found, figures=False))
    if written:
        typer.echo(f"Report: {written}")
