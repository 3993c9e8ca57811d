"""`rtec table`: compensation tables from a model, for controllers that take a file."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from rtec.cli.common import Json, print_json, show_page
from rtec.cli.diagnose import MachineFile, ModelFile

if TYPE_CHECKING:
    from rtec.correction.tables.table import CompensationTable
    from rtec.model import Model


class _MakesByDefault(TyperGroup):
    """`rtec table MODEL` is `rtec table write MODEL`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put the name of the command in where there is none."""
        if args and args[0] not in (*self.commands, "--help", "-h"):
            args = ["write", *args]
        return super().parse_args(ctx, args)


app = typer.Typer(
    cls=_MakesByDefault,
    no_args_is_help=True,
    help="""Writes and reads compensation tables, for controllers that take a file and no signals.

`rtec table MODEL ...` writes one (`rtec table write --help`); `rtec table read FILE` compares one with a model.
""",
)

Format = Annotated[str, typer.Option("--format", "-f", help="Format; `rtec table formats` lists them.")]
AxisName = Annotated[str, typer.Option("--axis", "-a", help="Axis that moves.", show_default=False)]
At = Annotated[
    list[str] | None,
    typer.Option(
        "--at", metavar="NAME=VALUE,…", help="Temperatures, °C, spindle_rpm, other axes, mm.", show_default=False
    ),
]


@app.command()
def write(
    model: ModelFile,
    axis: AxisName,
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write.", show_default=False)],
    format_name: Format = "linuxcnc",
    at: At = None,
    cross: Annotated[
        str | None,
        typer.Option(
            metavar="COMPONENT", help="Table between two axes, as EYX: error of Y along X.", show_default=False
        ),
    ] = None,
    grid: Annotated[float, typer.Option(min=1e-3, help="Distance of points, mm.")] = 10.0,
    machine: MachineFile = None,
    as_json: Json = False,
) -> None:
    """Writes the table of an axis at given temperatures, and says in µm what it cannot express.

    Positions of axes that `--at` does not name are the middle of their travel.

    Example: `rtec table write model.toml --axis X --at T_x=24,T_y=22 --format linuxcnc -o x.comp`
    """
    from dataclasses import asdict

    from rtec.correction.tables import table_format
    from rtec.correction.tables.predict import checked, conditions, grid_mm, residuals, table_of
    from rtec.errors import ConfigError
    from rtec.report.tables import written_page
    from rtec.wholefile import write_text

    form = table_format(format_name, "--format")
    loaded = _model(model, machine)
    moved = _axis(loaded, axis)
    corrected = moved if cross is None else _corrected(loaded, cross, moved.name)
    wanted = table_of(loaded, moved, corrected, grid_mm(moved, grid), conditions(loaded, moved, _values(at)))
    table = checked(wanted, form)
    left = residuals(loaded, table)
    write_text(form.text(table), out, ConfigError)
    if as_json:
        print_json({**_facts(table, format_name), "file": str(out), "residual": [asdict(r) for r in left]})
        return
    show_page(written_page(table, form, left, out))
    typer.echo(f"Table: {out}")


@app.command()
def read(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Table.", show_default=False)],
    axis: AxisName,
    model: Annotated[Path | None, typer.Option("--model", help="Model to compare with.", show_default=False)] = None,
    format_name: Format = "linuxcnc",
    at: At = None,
    machine: MachineFile = None,
    as_json: Json = False,
) -> None:
    """Reads a table that is there, and compares it with a model.

    Example: `rtec table read x.comp --axis X --model model.toml --at T_x=24,T_y=22`
    """
    from rtec.correction.tables import table_format
    from rtec.correction.tables.predict import conditions, table_of
    from rtec.errors import ConfigError
    from rtec.report.tables import compared_page

    form = table_format(format_name, "--format")
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as e:
        raise ConfigError(f"{file}: cannot be read as a table: {e}") from e
    table = form.read(text, str(file), axis)
    if model is None:
        print_json(_facts(table, format_name))
        return
    loaded = _model(model, machine)
    moved = _axis(loaded, axis)
    said = table_of(loaded, moved, moved, table.positions_mm, conditions(loaded, moved, _values(at)))
    if as_json:
        differences = {
            "model_minus_table_forward_um": said.forward_um - table.forward_um,
            "model_minus_table_backward_um": said.backward_um - table.backward_um,
        }
        print_json({**_facts(table, format_name), **differences})
        return
    show_page(compared_page(table, said, form, file))


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
        typer.echo(
            f"{name}: {form.title}; up to {limits.most_points} points, {ways}, steps of {limits.quantum_um:g} µm"
        )
        typer.echo(f"    columns: {form.sign}")


def _model(model: Path, machine: Path | None) -> "Model":
    from rtec.diagnosis.machine_file import load_with_machine

    return load_with_machine(model, machine)


def _axis(model: "Model", name: str) -> Any:
    from rtec.errors import ConfigError
    from rtec.tomlfile import nearest

    if name not in model.machine.axis_names:
        raise ConfigError(f"--axis: the machine has no axis {name!r}{nearest(name, model.machine.axis_names)}")
    return model.machine.axis(name)


def _corrected(model: "Model", component: str, moved: str) -> Any:
    """Axis that a component such as EYX shifts, when X moves."""
    from rtec.errors import ConfigError

    if len(component) < 3 or component[0] != "E" or component[2:] != moved:
        raise ConfigError(f"--cross {component}: write E, the axis that is wrong, and the one that moves, as EY{moved}")
    return _axis(model, component[1])


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
    return {
        "format": form,
        "axis": table.axis,
        "corrects": table.corrects,
        "at": dict(table.at),
        "positions_mm": table.positions_mm,
        "forward_um": table.forward_um,
        "backward_um": table.backward_um,
    }
