"""A studio that is killed while it writes. Oracle: the files in the folder: each is whole, or as it was before."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

import rtec
from rtec.model import Model, save_model
from rtec.tasks.folder import Folder
from tests.studio.studio_rig import MACHINE

KILLED = """
import os, signal, sys
from pathlib import Path
import rtec
from rtec.model import save_model
from rtec.tasks.folder import Folder
folder, what, when = Path(sys.argv[1]), sys.argv[2], sys.argv[3]
model = rtec.load_model(folder / "model.toml", folder / "machine.toml")
def die(*_, **__):
    os.kill(os.getpid(), signal.SIGKILL)
setattr(os, when, die)
if when == "replace":
    Path.replace = die
save_model(model, folder / "model.toml") if what == "model" else Folder(folder).write("new.csv", b"1" * 100_000)
"""


@pytest.mark.parametrize(
    ("what", "when"), [("model", "fsync"), ("model", "replace"), ("file", "fsync"), ("file", "link")]
)
def test_killed_while_it_saves_nothing_is_lost(what: str, when: str, tmp_path: Path) -> None:
    """Before the content is on disk, and before it has its name: the old model is whole, no half file is listed."""
    machine = tmp_path / "machine.toml"
    machine.write_bytes(MACHINE.read_bytes())
    save_model(Model(rtec.load_machine(machine), ()), tmp_path / "model.toml")
    before = (tmp_path / "model.toml").read_bytes()
    killed = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path), what, when], check=False)
    assert killed.returncode == -signal.SIGKILL
    assert (tmp_path / "model.toml").read_bytes() == before
    listing = Folder(tmp_path).listing()
    assert (listing.machines, listing.models, listing.foreign) == (("machine.toml",), ("model.toml",), ())
    Folder(tmp_path).write("new.csv", b"2")
    assert (tmp_path / "new.csv").read_bytes() == b"2"
