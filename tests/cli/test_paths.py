"""Paths that are no files, in every command. Oracle: the exit status of wrong input (2), one message, the folder."""

import os
import stat
from pathlib import Path

import pytest

from tests.support.command import here

CONFIGS = Path(__file__).parents[2] / "configs"
MACHINE = CONFIGS / "machines" / "turning-centre.toml"
RUN = CONFIGS / "turning-centre-sim.toml"
LASER = ("-i", "laser_linear", "--axis", "X")
SCALE = ("--effects", "scale:EXX")
NEW = ("add", "m.toml", "cyclic_screw", "--component", "EXX", "--data")
WRITTEN = {
    "fit": ("fit", MACHINE, "lx.csv", *SCALE, "-o"),
    "improve": ("improve", "m.toml", "lx.csv", "--yes", "-o"),
    "add": (*NEW, "lx.csv", "-o"),
    "simulated truth": ("simulate", MACHINE, *LASER, "-o", "o", "--truth-out"),
    "table": ("table", "write", "m.toml", "--axis", "X", "-o"),
}
"""A path to write, at the end."""
NAMED = {
    "simulate": ("simulate", MACHINE, *LASER, "-o"),
    "log": ("run", RUN, "--duration", "0.1", "--log"),
    "replay": ("replay", CONFIGS / "capture.toml", "x.sr", "-o"),
}
"""A name that gets an end, or a log, which is always new."""
READ = {
    "machine": ("simulate", "@", *LASER, "-o", "o"),
    "truth": ("simulate", MACHINE, *LASER, "-o", "o", "--truth", "@"),
    "settings": ("simulate", MACHINE, *LASER, "-o", "o", "--settings", "@"),
    "measurement": ("fit", MACHINE, "@", *SCALE, "-o", "o.toml"),
    "measurement of add": (*NEW, "@", "-o", "o.toml"),
    "compared": ("compare", "m.toml", "@"),
    "diagnosed": ("diagnose", "m.toml", "@"),
    "improved": ("improve", "@", "lx.csv", "--yes"),
    "improved by": ("improve", "m.toml", "@", "--yes"),
    "history": ("history", "@"),
    "planned": ("plan", MACHINE, "@", *SCALE),
    "imported": ("import", "@"),
    "map": ("import", "lx.csv", "--map", "@"),
    "iso230": ("iso230", "@"),
    "straightness": ("straightness", "@"),
    "drift": ("drift", "@"),
    "table": ("table", "read", "@", "--axis", "X", "--model", "m.toml"),
    "run": ("run", "@", "--dry-run"),
    "doctor": ("doctor", "@"),
    "replayed": ("replay", RUN, "@"),
    "status": ("status", "@"),
    "answers": ("init", "new", "--answers", "@"),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A measurement and a model of it."""
    out = tmp_path_factory.mktemp("paths")
    made = here("simulate", MACHINE, *LASER, "--effect", "scale,component=EXX,axis=X,k=12", "-o", out / "lx")
    assert made.returncode == 0, made.stderr
    made = here("fit", MACHINE, out / "lx.csv", *SCALE, "-o", out / "m.toml")
    assert made.returncode == 0, made.stderr
    return out


def refused(*command: object) -> str:
    """The message of a command that must be refused as wrong input."""
    done = here(*command)
    assert done.returncode == 2, done.stdout + done.stderr
    return done.stderr


@pytest.mark.parametrize("place", [".", "..", "/"])
@pytest.mark.parametrize("command", [*WRITTEN.values(), *NAMED.values()], ids=[*WRITTEN, *NAMED])
def test_a_folder_is_not_written(
    folder: Path, command: tuple[object, ...], place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    before = sorted(folder.iterdir())
    assert f"{place}: cannot be written: it is a folder; name a file" in refused(*command, place)
    assert sorted(folder.iterdir()) == before


@pytest.mark.parametrize("command", WRITTEN.values(), ids=WRITTEN)
def test_a_fifo_is_not_replaced(folder: Path, command: tuple[object, ...], tmp_path: Path) -> None:
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    words = [folder / w if w in ("lx.csv", "m.toml") else w for w in command]
    assert f"{fifo}: cannot be written: it is a FIFO" in refused(
        *[tmp_path / w if w == "o" else w for w in words], fifo
    )
    assert stat.S_ISFIFO(fifo.lstat().st_mode)
    assert list(tmp_path.iterdir()) == [fifo]


def test_a_link_is_followed(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "link.toml").symlink_to("target.toml")
    done = here(*[folder / w if w == "lx.csv" else w for w in WRITTEN["fit"]], tmp_path / "link.toml")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "link.toml").readlink() == Path("target.toml")
    assert "[[effect]]" in (tmp_path / "target.toml").read_text(encoding="utf-8")


@pytest.mark.parametrize("place", [".", "..", "/"])
@pytest.mark.parametrize("command", READ.values(), ids=READ)
def test_a_folder_is_not_read(
    folder: Path, command: tuple[object, ...], place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    message = refused(*[place if w == "@" else w for w in command])
    assert place in message
    assert "Traceback" not in message
