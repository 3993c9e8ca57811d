"""Paths that are no files, in every command. Oracle: the exit status of wrong input (2), one message, the folder."""

import os
import stat
from pathlib import Path

import pytest
import typer

from rtec.cli.main import application
from rtec.files import cannot_be_made
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


@pytest.mark.parametrize(
    "command",
    [
        ("compare", "none.toml", "none.csv", "--report"),
        ("fit", MACHINE, "none.csv", "-o", "m2.toml", "--report"),
        ("fit", MACHINE, "none.csv", "-o"),
        ("improve", "none.toml", "none.csv", "--yes", "-o"),
        ("add", "none.toml", "scale", "--data", "none.csv", "-o"),
        ("simulate", MACHINE, *LASER, "-o"),
        ("simulate", MACHINE, *LASER, "-o", "o", "--truth-out"),
        ("import", "none.csv", "-o"),
        ("hil", "none.toml", "--report"),
        ("demo", "--out"),
        ("demo", "--model-out"),
    ],
    ids=lambda c: f"{c[0]} {c[-1]}",
)
def test_where_nothing_can_be_written_is_said_before_the_work(folder: Path, command: tuple[object, ...]) -> None:
    """Oracle: the inputs do not exist, so a message on the output comes before any is read. Nothing is made."""
    a_file = folder / "lx.csv"
    before = sorted(folder.iterdir())
    said = refused(*command, a_file / "new" / "x")
    assert "cannot be written" in " ".join(said.replace("│", " ").split())
    assert sorted(folder.iterdir()) == before


def test_a_report_is_checked_in_every_command() -> None:
    """Oracle: the command line itself."""
    group = typer.main.get_command(application())
    found = [
        (name, option)
        for name, command in getattr(group, "commands").items()  # noqa: B009
        for option in command.params
        if "--report" in option.opts
    ]
    assert len(found) > 12
    for name, option in found:
        with pytest.raises(typer.BadParameter, match="is no folder"):
            option.process_value(typer.Context(group), f"{__file__}/new"), name


def test_a_folder_that_may_not_be_written_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Oracle: `os.access` of a user who may not write there; root may write everywhere."""
    assert cannot_be_made(tmp_path / "a" / "b") == ""
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert cannot_be_made(tmp_path / "a" / "b") == f"{tmp_path} may not be written to"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["tip", "tip.csv"])
def test_a_simulation_does_not_replace_its_own_settings(tmp_path: Path, name: str) -> None:
    """Oracle: the settings file, unchanged."""
    settings = tmp_path / "tip.toml"
    settings.write_text("cycles = 2\n", encoding="utf-8")
    said = refused("simulate", MACHINE, *LASER, "--settings", settings, "-o", tmp_path / name)
    assert "is read by this simulation" in said
    assert settings.read_text(encoding="utf-8") == "cycles = 2\n"
    assert list(tmp_path.iterdir()) == [settings]
