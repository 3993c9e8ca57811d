"""The example of the "try it" button: the machine of the tutorial, which has an effect that its model lacks."""

from pathlib import Path
from typing import Final

from rtec.errors import RtecError
from rtec.studio.folder import Folder
from rtec.studio.jobs import Reporter

MACHINE, MODEL = "turning-centre.toml", "model.toml"
EFFECTS: Final = "scale,axis_expansion:EXX:sensor=T_x_nut"
BEAMS: Final = {"laser-x": (1, ()), "beside": (2, ("beam_offset_mm=[0,0,150]",))}
"""Measurements: seed, and set-up of the laser."""


def configs() -> Path:
    """Folder of the shipped machine files."""
    import rtec

    package = Path(rtec.__file__).parent
    found = next((p for p in (package / "configs", package.parent / "configs") if p.is_dir()), None)
    if found is None:
        raise RtecError("the example's machine file is not installed; install rtec again")
    return found


def write(line: Reporter, folder: Path) -> None:
    """Write it, as the commands of the tutorial do.

    Raises:
        RtecError: a file of that name is in the folder already.
    """
    from rtec.characterise import characterise, read_wanted
    from rtec.machine import load_machine
    from rtec.metrology.files.load import load_measurements, save_measurement
    from rtec.model import save_model
    from rtec.sim.campaign.campaign import simulate
    from rtec.sim.campaign.request import SimulationOrder, settings_of
    from rtec.sim.campaign.truth import truth_of

    names = [MACHINE, MODEL, *(f"{n}{end}" for n in BEAMS for end in (".csv", ".toml"))]
    there = [n for n in names if (folder / n).exists()]
    if there:
        raise RtecError(f"{', '.join(there)}: in the folder already; open an empty folder for the example")
    shipped = configs()
    Folder(folder).write(MACHINE, (shipped / "machines" / MACHINE).read_bytes())
    machine = load_machine(folder / MACHINE)
    truth = truth_of(machine, shipped / "tutorial" / "hidden.toml")
    settings = settings_of(shipped / "tutorial" / "day.toml", {}, {})
    for k, (name, (seed, setup)) in enumerate(BEAMS.items()):
        line.stage("measuring the example's machine", k, len(BEAMS))
        instrument = SimulationOrder("laser_linear", "X", None, setup).make(machine)
        save_measurement(simulate(truth, instrument, settings, seed, name), folder / f"{name}.csv")
    files = [folder / f"{name}.csv" for name in BEAMS]
    line.stage("fitting a first model", 0, 0)
    result = characterise(
        load_measurements(files[:1], machine),
        wanted=read_wanted(EFFECTS, machine),
        name=Path(MODEL).stem,
        stage=line.stage,
    )
    save_model(result.model, folder / MODEL)
