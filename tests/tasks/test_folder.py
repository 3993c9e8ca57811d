"""The opened folder. Oracle: the files on disk, and the rule that nothing outside can be named."""

from dataclasses import replace
from pathlib import Path

import pytest

import rtec
from rtec.cli.main import status
from rtec.errors import RtecError
from rtec.model import Model
from rtec.tasks.folder import Folder
from rtec.tomlfile import read_toml
from tests.studio.studio_rig import MACHINE


def test_a_machine_in_a_folder_below_is_listed_and_copied(tmp_path: Path) -> None:
    """As `rtec init mill` leaves it. Oracle: the bytes; a link that leads out of the opened folder is not followed."""
    outside, root = tmp_path / "outside", tmp_path / "root"
    (root / "mill").mkdir(parents=True)
    outside.mkdir()
    content = b"[machine]\n[axis.X]\n"
    for place in (root / "mill", outside):
        (place / "machine.toml").write_bytes(content)
    (root / "far").symlink_to(outside)
    (root / "near").mkdir()
    (root / "near" / "machine.toml").symlink_to(outside / "machine.toml")
    folder = Folder(root)
    assert folder.machines_below() == ("mill/machine.toml",)
    assert folder.take("mill/machine.toml") == "mill.toml"
    assert (root / "mill.toml").read_bytes() == content
    assert folder.listing().machines == ("mill.toml",)


def test_a_file_that_cannot_be_read_is_listed_with_its_reason(tmp_path: Path) -> None:
    """Oracle: the sentence of `read_toml`, with the name of the file in the folder."""
    for name, text in (
        ("mill.toml", "counts_per_mm = 2000,0\n"),
        ("open.toml", "[machine\n"),
        ("other.toml", "a = 1\n"),
    ):
        (tmp_path / name).write_text(text, encoding="utf-8")
    unread = dict(Folder(tmp_path).listing().unread)
    assert set(unread) == {"mill.toml", "open.toml"}
    for name, why in unread.items():
        with pytest.raises(RtecError) as raised:
            read_toml(tmp_path / name)
        assert why == str(raised.value).replace(f"{tmp_path}/", "")
    assert "2000.0" in unread["mill.toml"]


@pytest.mark.parametrize(
    "name",
    [
        "../x.toml",
        "a/b.toml",
        "a\\b.toml",
        "/etc/passwd",
        ".hidden",
        "",
        " ",
        "x" * 200,
        "a\nb.toml",
        "a\x1b[2J.toml",
        "<b>",
    ],
)
def test_a_name_that_leads_out_or_cannot_be_shown_is_refused(name: str, tmp_path: Path) -> None:
    """And nothing is written."""
    with pytest.raises(RtecError):
        Folder(tmp_path).write(name, b"x")
    assert list(tmp_path.iterdir()) == []


def test_a_link_that_leads_out_is_not_listed(tmp_path: Path) -> None:
    """Neither as a machine nor as a table, and it cannot be opened."""
    inside, outside = tmp_path / "in", tmp_path / "out"
    inside.mkdir()
    outside.mkdir()
    (outside / "secret.csv").write_text("1,2\n")
    (inside / "secret.csv").symlink_to(outside / "secret.csv")
    (inside / "machine.toml").symlink_to(MACHINE)
    folder = Folder(inside)
    assert folder.listing().foreign == folder.listing().machines == ()
    with pytest.raises(RtecError, match="leads out"):
        folder.existing("secret.csv")
    with pytest.raises(RtecError):
        folder.write("secret.csv", b"3,4\n")
    assert (outside / "secret.csv").read_text() == "1,2\n"


def test_a_file_takes_no_other_files_place(tmp_path: Path) -> None:
    """The same content again is no fault; nothing half-written stays."""
    folder = Folder(tmp_path)
    (tmp_path / "one").write_bytes(b"1")
    (tmp_path / "two").write_bytes(b"2")
    folder.write("a.csv", b"1")
    folder.write("b.csv", tmp_path / "one")
    for name, same, other in (("a.csv", tmp_path / "one", b"2"), ("b.csv", b"1", tmp_path / "two")):
        folder.write(name, same)
        with pytest.raises(RtecError, match="another file of that name"):
            folder.write(name, other)
        assert (tmp_path / name).read_bytes() == b"1"
    assert {p.name for p in tmp_path.iterdir()} == {"a.csv", "b.csv", "one", "two"}


def test_files_are_listed_by_kind(tmp_path: Path) -> None:
    """Of the shipped machine file, and of tables with and without a description."""
    (tmp_path / "m.toml").write_bytes(MACHINE.read_bytes())
    (tmp_path / "one.csv").write_text("run,time_s\n")
    (tmp_path / "one.toml").write_text('[measurement]\ninstrument = "laser_linear"\n')
    (tmp_path / "two.csv").write_text("a;b\n")
    (tmp_path / "broken.toml").write_text("[[[")
    found = Folder(tmp_path).listing()
    assert (found.machines, found.measurements, found.foreign) == (("m.toml",), ("one.csv",), ("two.csv",))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--host", "192.0.2.1"], "--tls-cert"),
        (["--host", "192.0.2.1", "--token", "short"], "at least 16"),
        (["--tls-cert", "a.pem"], "belong together"),
        (["--tls-cert", "a.pem", "--tls-key", "b.pem"], "is no file"),
    ],
)
def test_another_address_needs_a_key_or_tls(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nothing is served, exit status 2, and the message says the way out."""
    assert status(["studio", str(tmp_path), "--no-browser", *words]) == 2
    assert said in capsys.readouterr().err


def test_without_nicegui_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Oracle: the extra's name in pyproject.toml."""
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    assert status(["studio", str(tmp_path), "--no-browser"]) == 2
    assert "rtec[studio]" in capsys.readouterr().err


def test_two_tabs_never_replace_each_other_s_model(tmp_path: Path) -> None:
    """Each saves, saves again, and once more after the other tab did. Oracle: the file, of whoever wrote it last."""
    model = Model(rtec.load_machine(MACHINE), ())
    one, two = Folder(tmp_path), Folder(tmp_path)
    first = one.save_model(model, "better.toml")
    with pytest.raises(RtecError, match=r"better\.toml: another file of that name"):
        two.save_model(model, "better.toml")
    second = one.save_model(replace(model, name="second"), "better.toml", first)
    assert (tmp_path / "better.toml").read_bytes() == second != first
    (tmp_path / "better.toml").write_bytes(b"of another program")
    with pytest.raises(RtecError, match=r"better\.toml: was changed by another tab or program"):
        one.save_model(model, "better.toml", second)
    assert (tmp_path / "better.toml").read_bytes() == b"of another program"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["better.toml"]
