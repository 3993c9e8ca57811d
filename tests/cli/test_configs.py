"""Every file in configs/ loads, through the same door as in use; and each is of a kind that this test knows."""

from pathlib import Path

import pytest

from rtec.loop.clock import VirtualClock
from rtec.loop.devices import make_devices
from rtec.loop.run_file import load_setup
from rtec.loop.step import Step
from rtec.machine import load_machine
from rtec.metrology.importing import load_map
from rtec.model import load_model
from rtec.sim.campaign.settings import Settings
from rtec.sim.truth import check_truth, load_truth
from rtec.tomlfile import read_toml, validated

CONFIGS = Path(__file__).parents[2] / "configs"
FILES = sorted(p.relative_to(CONFIGS) for p in CONFIGS.rglob("*.toml"))


@pytest.mark.parametrize("name", FILES, ids=str)
def test_loads(name: Path) -> None:
    """Oracle: the loader's own checks; a truth and a model must also fit the machine of their name."""
    path, machine = CONFIGS / name, CONFIGS / "machines" / name.name
    match name.parts[:-1]:
        case ("machines",):
            load_machine(path)
        case ("sim",):
            check_truth(load_truth(path), load_machine(machine), str(path))
        case ("models",):
            load_model(path, load_machine(machine))
        case ("tutorial",) if "effect" in read_toml(path):
            load_model(path, load_machine(CONFIGS / "machines" / "turning-centre.toml"))
        case ("tutorial",):
            validated(Settings, read_toml(path), str(path))
        case ("maps",):
            load_map(path)
        case ("linuxcnc",) if name.stem.endswith("-machine"):
            load_machine(path)
        case ("linuxcnc",) if name.stem.endswith("-model"):
            load_model(path, load_machine(path.with_name(name.name.replace("-model", "-machine"))))
        case () if "capture" in read_toml(path):
            Step(load_setup(path, needs_devices=False).step_settings())
        case () | ("linuxcnc",):
            setup = load_setup(path)
            if setup.file.device:
                make_devices(setup, VirtualClock())
            Step(setup.step_settings())
        case other:
            pytest.fail(f"no loader known for configs/{'/'.join(other)}")


def test_there_is_a_set_up_to_run() -> None:
    assert Path("turning-centre-sim.toml") in FILES
