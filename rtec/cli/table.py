"""`rtec table`: compensation tables from a model, for controllers that take a file."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtec.cli.common import Json, completes, print_json, show_page, writable_file
from rtec.cli.help import App, Group
from rtec.cli.model import MachineFile, ModelFile

if TYPE_CHECKING:
    from rtec.correction.tables.table import CompensationTable, TableAxes
    from rtec.model import Model


class _MakesByDefault(Group):
    """`rtec table MODEL` is `rtec table write MODEL`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Insert `write` where no command is named."""
        if args and args[0] not in (*self.commands, "--help", "-h"):
            args = ["write", *args]
        return super().parse_args(ctx, args)


app = App(
    cls=_MakesByDefault,
    help="""Writes and reads compensation tables, for controllers that take a file and no signals.

`rtec table MODEL ...` writes one (`rtec table write --help`); `rtec table read FILE` compares one with a model.
""",
)


def _formats() -> list[str]:
    from rtec.correction.tables import FORMATS

    return list(FORMATS)


Format = Annotated[
    str,
    typer.Option("--format", "-f", help="Format; `rtec table formats` lists them.", autocompletion=completes(_formats)),
]
AxisName = Annotated[
    str | None,
    typer.Option("--axis", "-a", help="Axis of the table; not needed where --cross names it.", show_default=False),
]
At = Annotated[
    list[str] | None,
    typer.Option(
        "--at",
        metavar="NAME=VALUE,…",
        help="Temperatures (°C), spindle_rpm, positions of other axes (mm).",
        show_default=False,
    ),
]


Cross = Annotated[
    str | None,
    typer.Option(
        metavar="COMPONENT",
        help="Table between axes, instead of --axis; EYX is the error of Y along X, EZXY that of Z over X and Y.",
        show_default=False,
    ),
]


@app.command()
def write(
    model: ModelFile,
    *,
    axis: AxisName = None,
    out: Annotated[
        Path, typer.Option("--out", "-o", callback=writable_file, help="Write the table here.", show_default=False)
    ],
    format_name: Format = "linuxcnc",
    at: At = None,
    cross: Cross = None,
    grid: Annotated[float, typer.Option(min=1e-3, help="Distance between the points, mm.")] = 10.0,
    machine: MachineFile = None,
    as_json: Json = False,
) -> None:
    """Writes the table of an axis at given temperatures, and says in µm what it cannot express.

    Positions of axes that `--at` does not name are the middle of their travel.

    Example: `rtec table write model.toml --axis X --at T_x_nut=24,T_z_nut=22 --format linuxcnc -o x.comp`

    Example, the error of Z along X: `rtec table write model.toml --cross EZX --at T_x_nut=24,T_z_nut=22 --format
    siemens-cec -o z_along_x.cec`
    """
    from dataclasses import asdict

    from rtec.correction.tables import table_format
    from rtec.correction.tables.predict import beyond, checked, conditions, grids_mm, residuals, table_of, with_heat
    from rtec.errors import ConfigError
    from rtec.files import write_text
    from rtec.report.tables import written_page

    form = table_format(format_name, "--format")
    loaded = _model(model, machine)
    moved, corrected, second = _axes(loaded, axis, cross)
    known = conditions(loaded, moved, _values(at))
    positions, across = grids_mm(form, moved, second, grid)
    table = checked(table_of(loaded, moved, corrected, positions, known, None, second, across), form)
    table = with_heat(loaded, table) if form.limits.adds_heat else table
    left = residuals(loaded, table)
    outside = beyond(loaded, table.at, [moved, *([second] if second else [])])
    write_text(form.text(table), out, ConfigError)
    if as_json:
        residual = {"residual": [asdict(r) for r in left], "beyond": outside}
        print_json({**_facts(table, format_name), "file": str(out), **residual})
        return
    show_page(written_page(table, form, left, out, outside))
    typer.echo(f"Table: {out}")


@app.command()
def read(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Table.", show_default=False)],
    axis: AxisName = None,
    model: Annotated[Path | None, typer.Option("--model", help="Model to compare with.", show_default=False)] = None,
    format_name: Format = "linuxcnc",
    at: At = None,
    cross: Cross = None,
    machine: MachineFile = None,
    as_json: Json = False,
) -> None:
    """Reads an existing table, and compares it with a model.

    Example: `rtec table read x.comp --axis X --model model.toml --at T_x_nut=24,T_z_nut=22`
    """
    from rtec.correction.tables import table_format
    from rtec.correction.tables.predict import beyond, conditions, table_of
    from rtec.correction.tables.table import TableAxes, table_text
    from rtec.errors import ConfigError
    from rtec.report.tables import compared_page

    form = table_format(format_name, "--format")
    try:
        text = table_text(file)
    except FileNotFoundError as e:
        raise ConfigError(f"{file}: cannot be read as a table: no such file") from e
    if model is None:
        print_json(_facts(form.read(text, str(file), _named(axis, cross)), format_name))
        return
    loaded = _model(model, machine)
    moved, corrected, second = _axes(loaded, axis, cross)
    table = form.read(text, str(file), TableAxes(moved.name, corrected.name, second.name if second else ""))
    known = conditions(loaded, moved, _values(at))
    said = table_of(loaded, moved, corrected, table.positions_mm, known, None, second, table.second_mm)
    said = form.limits.zeroed(said)
    outside = beyond(loaded, known, [moved, *([second] if second else [])])
    if as_json:
        differences = {
            "model_minus_table_forward_um": said.forward_um - table.forward_um,
            "model_minus_table_backward_um": said.backward_um - table.backward_um,
            "zero_um": said.zero_um,
            "beyond": outside,
        }
        print_json({**_facts(table, format_name), **differences})
        return
    show_page(compared_page(table, said, form, file, moved.travel_mm, outside))


@app.command()
def formats(as_json: Json = False) -> None:
    """Lists the formats: points, directions, smallest step, sign.

    Example: `rtec table formats`
    """
    from dataclasses import asdict

    from rtec.correction.tables import FORMATS

    if as_json:
        print_json({name: {"title": f.title, "sign": f.sign, **asdict(f.limits)} for name, f in FORMATS.items()})
        return
    for name, form in FORMATS.items():
        limits = form.limits
        ways = "both directions" if limits.both_directions else "one value for both directions"
        of = {"own": "one axis", "between": "two axes", "either": "one axis or two", "plane": "a plane"}[limits.takes]
        typer.echo(f"{name}: {form.title}{' (to type in)' if limits.typed else ''}")
        typer.echo(f"    {of}, up to {limits.most_points} points, {ways}, steps of {limits.quantum_um:g} µm")
        typer.echo(f"    {form.sign}")


def _model(model: Path, machine: Path | None) -> "Model":
    from rtec.diagnosis.machine_file import load_with_machine

    return load_with_machine(model, machine)


def _axes(model: "Model", axis: str | None, cross: str | None) -> Any:
    """The axis that moves, the one that is corrected, and the second one that moves (or None)."""
    from rtec.correction.tables.predict import table_axes
    from rtec.errors import ConfigError
    from rtec.tomlfile import nearest

    names = model.machine.axis_names
    if axis is not None and axis not in names:
        raise ConfigError(f"--axis: the machine has no axis {axis!r}{nearest(axis, names)}")
    if cross is None:
        return table_axes(model.machine, _needed(axis))
    try:
        first, corrected, second = table_axes(model.machine, cross)
    except ConfigError as e:
        raise ConfigError(f"--cross: {e}") from e
    if axis not in (None, first.name) or first is corrected:
        says = "is one axis: write --axis" if first is corrected else f"moves {first.name}: leave --axis {axis} out"
        raise ConfigError(f"--cross {cross} {says}")
    return first, corrected, second


def _named(axis: str | None, cross: str | None) -> "TableAxes":
    """Names of the axes of a table, without a machine; those of a plane are letters."""
    from rtec.correction.tables.table import TableAxes
    from rtec.errors import ConfigError

    if cross is None:
        return TableAxes(_needed(axis), _needed(axis))
    corrected, moved = cross[1:2], cross[2:]
    first = axis or (moved[:1] if len(moved) == 2 and moved.isalpha() else moved)
    if cross[:1] != "E" or not first or not moved.startswith(first):
        raise ConfigError(
            f"--cross {cross}: write E, the axis that is wrong, and the one that moves, as EY{axis or 'X'}"
        )
    return TableAxes(first, corrected, moved.removeprefix(first))


def _needed(axis: str | None) -> str:
    from rtec.errors import ConfigError

    if axis is None:
        raise ConfigError("--axis: name the axis of the table; or --cross, as EYX for the error of Y along X")
    return axis


def _values(at: list[str] | None) -> dict[str, float]:
    from rtec.errors import ConfigError

    out: dict[str, float] = {}
    for word in (w for text in at or [] for w in text.split(",") if w):
        name, equals, value = word.partition("=")
        try:
            out[name.strip()] = float(value)
        except ValueError:
            equals = ""
        if not equals:
            raise ConfigError(f"--at {word}: write NAME=NUMBER, as T_x=24")
    return out


def _facts(table: "CompensationTable", form: str) -> dict[str, Any]:
    from dataclasses import asdict

    return {
        "format": form,
        "axis": table.axis,
        "corrects": table.corrects,
        "at": dict(table.at),
        "positions_mm": table.positions_mm,
        **({"second": table.second, "second_mm": table.second_mm} if table.second else {}),
        **({"heat": [asdict(h) for h in table.heat]} if table.heat else {}),
        "forward_um": table.forward_um,
        "backward_um": table.backward_um,
    }
