"""`rtec import`: files of other programs become measurements."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtec.cli.common import Json, print_json

if TYPE_CHECKING:
    from rtec.metrology.importing import Imported
    from rtec.metrology.readers import ForeignTable, SourceOptions


def import_(
    file: Annotated[Path | None, typer.Argument(metavar="FILE", help="File of another program.")] = None,
    map_: Annotated[Path | None, typer.Option("--map", help="Map (TOML): the meaning of each column.")] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="NAME, NAME.csv or NAME.parquet; NAME.toml goes beside it.")
    ] = None,
    reader: Annotated[str | None, typer.Option("--as", metavar="READER", help="Reader.  [default: by content]")] = None,
    machine: Annotated[Path | None, typer.Option("--machine", help="Machine file to check the result against.")] = None,
    list_: Annotated[bool, typer.Option("--list", help="List the readers.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Overwrite existing files.")] = False,
    drop_bad_rows: Annotated[bool, typer.Option("--drop-bad-rows", help="Drop rows with an unusable cell.")] = False,
    missing_code: Annotated[
        list[str] | None, typer.Option("--missing-code", help='Number or word for "no value"; repeatable.')
    ] = None,
    as_json: Json = False,
) -> None:
    """Imports a table of another program as a measurement: NAME.csv and NAME.toml.

    Without -o it prints what FILE holds, and a map to begin with. If FILE cannot be read without help (encoding,
    delimiter, decimal commas, lines to skip), give a MAP with [source] alone. The notes on the import are printed and
    kept in NAME.toml.

    Example: `rtec import scope.csv --map configs/maps/laser-decimal-comma.toml -o laser-x`
    """
    if list_:
        _list(as_json=as_json)
        return
    if file is None:
        raise typer.BadParameter("name a FILE, or ask for --list", param_hint="FILE")
    if out is None:
        _look(file, map_, reader, as_json=as_json)
        return
    if map_ is None:
        raise typer.BadParameter("-o needs a --map; without -o, a map to begin with is shown", param_hint="--map")
    _import(file, map_, out, reader, machine, (drop_bad_rows, missing_code or []), force=force, as_json=as_json)


def _import(
    file: Path,
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

    with bar(f"importing {file.name}"):
        done = api.import_table(
            file, map_, out, machine, reader=reader, drop_bad_rows=lenient[0], missing_codes=lenient[1], force=force
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
    typer.echo(f"{counted(done.rows_in, 'row')} in, {counted(done.rows_out, 'row')} out: {table} and {table.stem}.toml")
    if not facts["checked"]:
        typer.echo("not checked against a machine; --machine MACHINE.toml checks it")


def _look(file: Path, map_: Path | None, reader: str | None, *, as_json: bool) -> None:
    from rtec.errors import MeasurementError
    from rtec.metrology.importing import starter_map
    from rtec.metrology.readers import SourceOptions as Told
    from rtec.metrology.readers import read_tables
    from rtec.tomlfile import read_toml, validated

    told = read_toml(map_, MeasurementError).get("source", {}) if map_ is not None else {}
    how = validated(Told, {**told, "reader": reader} if reader else told, f"{map_}: [source]", MeasurementError)
    name, tables = read_tables(file, how)
    if as_json:
        print_json({"reader": name, "tables": [_facts(t) for t in tables]})
        return
    typer.echo(f"# {file} read as {name}: " + ", ".join(f"{t.name} ({len(t)} rows)" for t in tables))
    for note in dict.fromkeys(n for t in tables for n in t.notes):
        typer.echo(f"# {note}")
    typer.echo(starter_map(name, tables).replace("[source]\n", f"[source]\n{_as_told(how)}", 1))


def _as_told(how: "SourceOptions") -> str:
    """What the user's map says of the file, for the map that is shown."""
    import tomli_w

    return tomli_w.dumps(how.model_dump(mode="json", exclude_defaults=True, exclude={"reader", "table"}))


def _facts(table: "ForeignTable") -> dict[str, object]:
    return {
        "name": table.name,
        "rows": len(table),
        "columns": [
            {"name": n, "unit": table.units.get(n), "text": v.dtype == object} for n, v in table.columns.items()
        ],
        "notes": list(table.notes),
    }


def _list(*, as_json: bool) -> None:
    from rtec.metrology.readers.registry import READERS

    if as_json:
        print_json([{"name": n, "reads": r.title, "columns": r.gives} for n, r in READERS.items()])
        return
    for name, reader in READERS.items():
        typer.echo(f"{name:<14} {reader.title}\n{'':<14} columns: {reader.gives}")
