"""`rtec simulate`: measurements from a machine whose true effects are chosen."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from rtec.sim.campaign import Simulated


def simulate(
    machine: Annotated[Path, typer.Argument(metavar="MACHINE", help="Machine file.", show_default=False)],
    instrument: Annotated[str, typer.Option("--instrument", "-i", help="For example laser_linear.")],
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="NAME", help="Writes NAME.csv (or .parquet) and NAME.toml.")
    ],
    axis: Annotated[str | None, typer.Option(help="Axis that the instrument follows.")] = None,
    component: Annotated[str | None, typer.Option(help="Component error that it reads directly.")] = None,
    setup: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="A key of its set-up; repeatable.")
    ] = None,
    truth: Annotated[Path | None, typer.Option(metavar="MODEL", help="Model file whose effects are true.")] = None,
    effect: Annotated[
        list[str] | None,
        typer.Option(metavar="EFFECT", help="One more true effect: NAME,key=value,...; repeatable."),
    ] = None,
    truth_out: Annotated[Path | None, typer.Option(metavar="MODEL", help="Write what is true as a model file.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same files.")] = 1,
    settings: Annotated[
        Path | None, typer.Option(metavar="TOML", help="Targets, phases, temperatures, noise; options win over it.")
    ] = None,
    protocol: Annotated[str | None, typer.Option(help="warm_up, cold, drift or parts; by instrument.")] = None,
    cycles: Annotated[int | None, typer.Option(min=1, help="Measuring cycles in a phase.  [default: 5]")] = None,
    span: Annotated[
        tuple[float, float] | None, typer.Option("--range", metavar="LOW HIGH", help="First and last target, mm.")
    ] = None,
    step: Annotated[float | None, typer.Option(help="Between targets, mm.")] = None,
    keep_step: Annotated[
        bool, typer.Option("--keep-step", help="Even where it is a multiple of the pitch and hides the cyclic error.")
    ] = False,
    dwell: Annotated[float | None, typer.Option(help="At each target, s.  [default: 3]")] = None,
    one_way: Annotated[bool, typer.Option("--one-way", help="Read in the positive direction only.")] = False,
    noise: Annotated[float | None, typer.Option(help="White noise, µm or µrad.  [default: 0.3]")] = None,
    drift: Annotated[float | None, typer.Option(help="Noise that goes on from reading to reading.")] = None,
    drift_tau: Annotated[float | None, typer.Option(help="Its correlation time, s.  [default: 1800]")] = None,
    run_offset: Annotated[float | None, typer.Option(help="What each run is off as a whole.")] = None,
    resolution: Annotated[float | None, typer.Option(help="Steps of the display.")] = None,
    outliers: Annotated[float | None, typer.Option(help="Share of wrong readings, 0 to 1.")] = None,
    lost: Annotated[float | None, typer.Option(help="Share of missing readings, 0 to 1.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print what was made as JSON.")] = False,
) -> None:
    """Make a measurement on a machine whose true effects are chosen; the same seed gives the same files.

    Temperatures follow the warm-up of NIST's guidelines: cycles cold, then after each step of warming up. Targets
    avoid multiples of the pitch. Noise is in the unit of the reading, µm or µrad.

    Example: `rtec simulate configs/machines/turning-centre.toml --instrument laser_linear --axis X
    --effect scale,component=EXX,axis=X,k=12 -o out/laser-x --seed 3`
    """
    from rtec.machine import load_machine
    from rtec.metrology.files import save_measurement
    from rtec.model import save_model
    from rtec.sim.campaign import simulate_with_truth
    from rtec.sim.campaign_order import Order, settings_of, table_path
    from rtec.sim.campaign_truth import truth_of

    described = load_machine(machine)
    made = Order(instrument, axis, component, setup or ()).make(described)
    true = truth_of(described, truth, effect or ())
    options: dict[str, dict[str, Any]] = {
        "targets": {
            "range_mm": span,
            "step_mm": step,
            "keep_step": keep_step or None,
            "dwell_s": dwell,
            "both_directions": False if one_way else None,
        },
        "noise": {
            "white_um": noise,
            "drift_um": drift,
            "drift_tau_s": drift_tau,
            "run_offset_um": run_offset,
            "resolution_um": resolution,
            "outliers": outliers,
            "lost": lost,
        },
    }
    chosen = settings_of(settings, options, {"protocol": protocol, "cycles": cycles})
    path = table_path(out)
    result = simulate_with_truth(true, made, chosen, seed, path.stem)
    save_measurement(result.measurement, path)
    if truth_out is not None:
        save_model(true, truth_out)
    _show(result, path, as_json)


def _show(result: "Simulated", path: Path, as_json: bool) -> None:
    facts = result.facts() | {"table": str(path), "toml": str(path.with_suffix(".toml"))}
    if as_json:
        typer.echo(json.dumps(facts, indent=2))
        return
    typer.echo(
        f"{facts['rows']} rows in {facts['runs']} runs over {facts['hours']:.1f} h: "
        f"{path} and {path.with_suffix('.toml').name}"
    )
    for phase in facts["phases"]:
        typer.echo(f"  {phase['name']}: {phase['rows']} rows")
    for note in facts["notes"]:
        typer.echo(f"- {note}")
