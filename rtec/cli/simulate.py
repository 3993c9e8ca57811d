"""`rtec simulate`: measurements from a machine whose true effects are chosen."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtec.cli.common import Json, print_json, writable_file

if TYPE_CHECKING:
    from rtec.sim.campaign.campaign import Simulated

_Machine = Annotated[Path, typer.Argument(metavar="MACHINE", help="Machine file.", show_default=False)]
_Instrument = Annotated[str, typer.Option("--instrument", "-i", help="Instrument, for example laser_linear.")]
_Out = Annotated[
    Path,
    typer.Option(
        "--out", "-o", metavar="NAME", callback=writable_file, help="Writes NAME.csv (or .parquet) and NAME.toml."
    ),
]
_Axis = Annotated[str | None, typer.Option(help="Axis that the instrument follows.")]
_Component = Annotated[
    str | None,
    typer.Option(help="Component error that it reads directly, without lever arm."),
]
_Setup = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="A key of its set-up; repeatable.")
]
_Truth = Annotated[Path | None, typer.Option(metavar="MODEL", help="Model file with the true effects.")]
_Effect = Annotated[
    list[str] | None, typer.Option(metavar="EFFECT", help="One more true effect: NAME,key=value,...; repeatable.")
]
_TruthOut = Annotated[
    Path | None, typer.Option(metavar="MODEL", callback=writable_file, help="Write the true effects as a model file.")
]
_Seed = Annotated[int, typer.Option(min=0, help="Same seed, same files.")]
_Settings = Annotated[
    Path | None, typer.Option(metavar="TOML", help="Targets, phases, temperatures, noise; options override it.")
]
_Protocol = Annotated[str | None, typer.Option(help="warm_up, cold, drift or parts.", show_default="by instrument")]
_Cycles = Annotated[int | None, typer.Option(min=1, help="Measuring cycles in a phase.", show_default="5")]
_Span = Annotated[
    tuple[float, float] | None, typer.Option("--range", metavar="LOW HIGH", help="First and last target, mm.")
]
_Step = Annotated[float | None, typer.Option(help="Distance between targets, mm.")]
_KeepStep = Annotated[
    bool, typer.Option("--keep-step", help="Keep a step that is a multiple of the pitch and hides the cyclic error.")
]
_Dwell = Annotated[float | None, typer.Option(help="Dwell at each target, s.", show_default="3")]
_OneWay = Annotated[bool, typer.Option("--one-way", help="Read in the positive direction only.")]
_Noise = Annotated[float | None, typer.Option(help="White noise, µm or µrad.", show_default="0.3")]
_Drift = Annotated[float | None, typer.Option(help="Drift from reading to reading, µm or µrad.")]
_DriftTau = Annotated[float | None, typer.Option(help="Correlation time of the drift, s.", show_default="1800")]
_RunOffset = Annotated[float | None, typer.Option(help="Offset from run to run, µm or µrad.")]
_Resolution = Annotated[float | None, typer.Option(help="Resolution of the display, µm or µrad.")]
_Outliers = Annotated[float | None, typer.Option(help="Share of wrong readings, 0 to 1.")]
_Lost = Annotated[float | None, typer.Option(help="Share of missing readings, 0 to 1.")]


def simulate(
    machine: _Machine,
    instrument: _Instrument,
    out: _Out,
    axis: _Axis = None,
    component: _Component = None,
    setup: _Setup = None,
    truth: _Truth = None,
    effect: _Effect = None,
    truth_out: _TruthOut = None,
    seed: _Seed = 1,
    settings: _Settings = None,
    protocol: _Protocol = None,
    cycles: _Cycles = None,
    span: _Span = None,
    step: _Step = None,
    keep_step: _KeepStep = False,
    dwell: _Dwell = None,
    one_way: _OneWay = False,
    noise: _Noise = None,
    drift: _Drift = None,
    drift_tau: _DriftTau = None,
    run_offset: _RunOffset = None,
    resolution: _Resolution = None,
    outliers: _Outliers = None,
    lost: _Lost = None,
    as_json: Json = False,
) -> None:
    """Simulates a measurement on a machine whose true effects you choose; the same seed gives the same files.

    Example: `rtec simulate configs/machines/turning-centre.toml --instrument laser_linear --axis X
    --effect scale,component=EXX,axis=X,k=12 -o out/laser-x --seed 3`

    Temperatures follow the warm-up of NIST's guidelines: cycles cold, then after each step of warming up. Targets
    avoid multiples of the pitch. Noise is in the unit of the reading, µm or µrad.
    """
    from rtec import api
    from rtec.sim.campaign.settings import setup_table

    targets = {"range_mm": span, "step_mm": step, "keep_step": keep_step or None, "dwell_s": dwell}
    wrong = {"run_offset_um": run_offset, "resolution_um": resolution, "outliers": outliers, "lost": lost}
    changes: dict[str, Any] = {
        "targets": {**targets, "both_directions": False if one_way else None},
        "noise": {"white_um": noise, "drift_um": drift, "drift_tau_s": drift_tau, **wrong},
        "protocol": protocol,
        "cycles": cycles,
    }
    result = api.simulate(
        machine,
        instrument,
        axis=axis,
        component=component,
        setup=setup_table(setup or ()),
        truth=truth,
        effects=effect or (),
        settings=settings,
        changes=changes,
        seed=seed,
        out=out,
        truth_out=truth_out,
    )
    if as_json:
        print_json(result.to_dict())
    else:
        _show(result)


def _show(result: "Simulated") -> None:
    from rtec.characterise.warnings import unused_offset
    from rtec.wording import counted

    facts, path = result.facts(), Path(result.to_dict()["table"])
    typer.echo(
        f"{counted(facts['rows'], 'row')} in {counted(facts['runs'], 'run')} over {facts['hours']:.1f} h: "
        f"{path} and {path.with_suffix('.toml').name}"
    )
    for phase in facts["phases"]:
        typer.echo(f"  {phase['name']}: {counted(phase['rows'], 'row')}")
    for note in facts["notes"]:
        typer.echo(f"- {note}")
    if unused := unused_offset(result.measurement.instrument):
        typer.echo(f"- {unused}; omit --component to use it")
