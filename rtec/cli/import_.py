"""`rtec import`: files of other programs become measurements."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtec.cli.common import Json, completes, print_json, writable_file

if TYPE_CHECKING:
    from rtec.metrology.importing import Imported, ImportProposal


def _readers() -> list[str]:
    from rtec.metrology.readers.registry import READERS

    return list(READERS)


def import_(
    files: Annotated[
        list[Path] | None, typer.Argument(metavar="FILE...", help="File of another program; several become runs.")
    ] = None,
    map_: Annotated[Path | None, typer.Option("--map", help="Map (TOML): the meaning of each column.")] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "-o", "--out", callback=writable_file, help="NAME, NAME.csv or NAME.parquet; NAME.toml goes beside it."
        ),
    ] = None,
    reader: Annotated[
        str | None,
        typer.Option(
            "--as", metavar="READER", help="Reader.", show_default="by content", autocompletion=completes(_readers)
        ),
    ] = None,
    machine: Annotated[
        Path | None, typer.Option("--machine", "-m", help="Machine file: its axes and sensors; checks the result.")
    ] = None,
    answer: Annotated[
        list[str] | None,
        typer.Option("--answer", "-a", metavar="KEY=VALUE", help="What the file does not say; repeatable."),
    ] = None,
    temperatures: Annotated[
        Path | None,
        typer.Option(
            "--temperatures",
            metavar="LOG",
            help="Log of temperatures, also of spindle speed, feed or load; matched by date or time of day.",
        ),
    ] = None,
    list_: Annotated[bool, typer.Option("--list", help="List the readers.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Overwrite existing files.")] = False,
    drop_bad_rows: Annotated[bool, typer.Option("--drop-bad-rows", help="Drop rows with an unusable cell.")] = False,
    missing_code: Annotated[
        list[str] | None,
        typer.Option("--missing-code", metavar="CODE", help='Number or word for "no value"; repeatable.'),
    ] = None,
    as_json: Json = False,
) -> None:
    """Imports tables of other programs as a measurement: NAME.csv and NAME.toml.

    Example: `rtec import scope.csv --machine machine.toml --answer axis=X -o laser-x`

    Without --map it finds out how FILE is written and what its columns are, and shows a proposed map with reasons. It
    asks only what the file does not say: on a terminal, else with --answer. With -o it writes the measurement, and the
    map that made it as NAME-map.toml. The notes on the import are printed and kept in NAME.toml. Temperatures that a
    logger wrote into a file of its own come with --temperatures.
    """
    if list_:
        _list(as_json=as_json)
        return
    if not files:
        raise typer.BadParameter("name a FILE, or ask for --list", param_hint="FILE")
    if map_ is not None and out is not None and not answer and temperatures is None and _is_whole(map_):
        _import(files, map_, out, reader, machine, (drop_bad_rows, missing_code or []), force=force, as_json=as_json)
        return
    proposal = _proposal(files[0], map_, reader, machine, answer or [], temperatures)
    if _somebody_is_there() and not as_json:
        proposal = _ask_user(proposal)
        out = out or _name_for(files[0])
    if out is None:
        if as_json:
            print_json(proposal.facts())
        else:
            typer.echo(proposal.toml())
        return
    _write(files, proposal, out, (drop_bad_rows, missing_code or []), force=force, as_json=as_json)


def _proposal(
    file: Path,
    map_: Path | None,
    reader: str | None,
    machine: Path | None,
    answers: list[str],
    temperatures: Path | None,
) -> "ImportProposal":
    """The proposal, with the answers of the command line."""
    from rtec.errors import MeasurementError
    from rtec.machine import load_machine
    from rtec.metrology.importing import beside, propose
    from rtec.tomlfile import read_toml

    preset = read_toml(map_, MeasurementError) if map_ is not None else {}
    if reader is not None:
        preset = preset | {"source": {**preset.get("source", {}), "reader": reader}}
    if temperatures is not None:
        known = preset.get("temperatures")
        known = known if isinstance(known, dict) else {}
        preset = preset | {"temperatures": {**known, "file": beside(temperatures, file)}}
    given = {}
    for text in answers:
        # A column's name may contain "=", as may an answer that is a table: probe={z={direction="Z"}}.
        key, mark, value = text.partition("={") if "={" in text else text.rpartition("=")
        value = mark.removeprefix("=") + value
        if not mark:
            raise typer.BadParameter(f"{text!r}: write KEY=VALUE", param_hint="--answer")
        given[key.strip()] = value.strip()
    return propose(file, load_machine(machine) if machine is not None else None, preset, given)


def _is_whole(map_: Path) -> bool:
    """Whether a map has all that an import needs."""
    from rtec.errors import MeasurementError
    from rtec.metrology.importing.map import WHOLE
    from rtec.tomlfile import read_toml

    return read_toml(map_, MeasurementError).keys() >= WHOLE


def _somebody_is_there() -> bool:
    return sys.stdin.isatty() and sys.stdout.isatty()


def _name_for(file: Path) -> Path | None:
    """Path of the measurement to write, from the user; None: write nothing."""
    name = str(typer.prompt("Write the measurement as (- for not at all)", default=file.stem, err=True)).strip()
    return None if name == "-" else Path(name)


def _ask_user(proposal: "ImportProposal") -> "ImportProposal":
    """Ask all questions of a proposal; Enter accepts the default of a question that has one."""
    from rtec.errors import MeasurementError

    typer.echo(proposal.toml(), err=True)
    while proposal.questions:
        question = proposal.questions[0]
        allowed = ", ".join(question.choices) or question.hint
        choices = f" ({allowed})" if allowed else ""
        given = typer.prompt(f"{question.words}{choices}", default=question.default, err=True)
        try:
            proposal = proposal.answered({question.key: str(given)})
        except MeasurementError as e:
            typer.echo(str(e), err=True)
    return proposal


def _write(
    files: list[Path],
    proposal: "ImportProposal",
    out: Path,
    lenient: tuple[bool, list[str]],
    *,
    force: bool,
    as_json: bool,
) -> None:
    """Write the measurement and its map."""
    from rtec import api
    from rtec.cli.common import bar
    from rtec.wording import counted

    with bar(f"importing {files[0].name}"):
        done = api.import_table(
            files, proposal, out, proposal.machine, drop_bad_rows=lenient[0], missing_codes=lenient[1], force=force
        )
    if as_json:
        print_json(done.to_dict())
        return
    if not proposal.whole:
        typer.echo(f"  concluded from the beginning of the file, {counted(proposal.rows, 'row')}:")
    for line in proposal.conclusions:
        typer.echo(f"  {line}")
    _show(done)
    typer.echo(f"map: {done.facts()['map']}")


def _import(
    files: list[Path],
    map_: Path,
    out: Path,
    reader: str | None,
    machine: Path | None,
    lenient: tuple[bool, list[str]],
    *,
    force: bool,
    as_json: bool,
) -> None:
    from rtec import api
    from rtec.cli.common import bar

    with bar(f"importing {files[0].name}"):
        done = api.import_table(
            files, map_, out, machine, reader=reader, drop_bad_rows=lenient[0], missing_codes=lenient[1], force=force
        )
    if as_json:
        print_json(done.to_dict())
    else:
        _show(done)


def _show(done: "Imported") -> None:
    from rtec.wording import counted

    facts = done.facts()
    for note in facts["notes"]:
        typer.echo(f"  {note}")
    table = Path(facts["table"])
    rows = f"{counted(done.rows_in, 'row')} in, {counted(done.rows_out, 'row')} out"
    if done.measurement is not None and len(done.measurement) < done.rows_out:
        rows += f", {len(done.measurement)} of them used"
    typer.echo(f"{rows}: {table} and {table.stem}.toml")
    if not facts["checked"]:
        typer.echo("not checked against a machine; --machine MACHINE.toml checks it")


def _list(*, as_json: bool) -> None:
    from rtec.metrology.readers.registry import READERS

    if as_json:
        print_json([{"name": n, "reads": r.title, "columns": r.gives} for n, r in READERS.items()])
        return
    for name, reader in READERS.items():
        typer.echo(f"{name:<14} {reader.title}\n{'':<14} columns: {reader.gives}")
