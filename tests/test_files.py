"""A file appears whole or not at all. Oracle: the folder."""

import os
import socket
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, Literal

import pytest
from pydantic import Field

from rtec.errors import ConfigError, ModelError
from rtec.files import whole, write_text
from rtec.tomlfile import Strict, validated


def test_it_takes_the_place_of_the_old_one_and_leaves_nothing_beside(tmp_path: Path) -> None:
    file = tmp_path / "x.toml"
    write_text("old", file, ConfigError)
    write_text("new µm", file, ConfigError)
    assert file.read_text(encoding="utf-8") == "new µm"
    assert list(tmp_path.iterdir()) == [file]
    mask = os.umask(0o022)
    os.umask(mask)
    assert file.stat().st_mode & 0o777 == 0o666 & ~mask


def test_what_ends_badly_changes_nothing(tmp_path: Path) -> None:
    """An error of the writer comes through as it is; Ctrl-C too."""
    file = tmp_path / "x.toml"
    write_text("old", file, ConfigError)

    def begin(fault: BaseException) -> None:
        with whole(file, ConfigError) as out:
            out.write(b"ne")
            raise fault

    for fault in (ValueError("no number"), KeyboardInterrupt()):
        with pytest.raises(type(fault)):
            begin(fault)
    assert file.read_text() == "old"
    assert list(tmp_path.iterdir()) == [file]


def test_one_that_is_there_may_be_kept(tmp_path: Path) -> None:
    file = tmp_path / "x.toml"
    write_text("old", file, ConfigError)
    with pytest.raises(FileExistsError), whole(file, ConfigError, replace=False) as out:
        out.write(b"new")
    assert file.read_text() == "old"
    assert list(tmp_path.iterdir()) == [file]


def test_a_symbolic_link_stays_and_its_target_is_written(tmp_path: Path) -> None:
    """Also through two links, into another folder, and where the target is not there yet."""
    (tmp_path / "there").mkdir()
    target, link, further = tmp_path / "there" / "x.toml", tmp_path / "link", tmp_path / "further"
    link.symlink_to("there/x.toml")
    further.symlink_to(link)
    for text in ("new", "newer"):
        write_text(text, further, ConfigError)
        assert target.read_text() == text
        assert (link.readlink(), further.readlink()) == (Path("there/x.toml"), link)
        assert list((tmp_path / "there").iterdir()) == [target]
    assert sorted(tmp_path.iterdir()) == [further, link, tmp_path / "there"]
    with pytest.raises(FileExistsError), whole(further, ConfigError, replace=False) as out:
        out.write(b"newest")
    assert target.read_text() == "newer"


def test_what_is_no_regular_file_is_refused_and_stays_what_it_is(tmp_path: Path) -> None:
    """A FIFO, a socket, a folder, each also through a link; a link to itself. Oracle: the kind in `lstat`."""
    fifo, folder, place = tmp_path / "fifo", tmp_path / "folder", tmp_path / "socket"
    os.mkfifo(fifo)
    folder.mkdir()
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(place))
    (tmp_path / "loop").symlink_to("loop")
    whats = {"fifo": "a FIFO", "folder": "a folder; name a file", "socket": "a socket", "loop": "Too many levels"}
    for name, what in whats.items():
        link = tmp_path / f"to-{name}"
        link.symlink_to(name)
        for path in (tmp_path / name, link):
            before = path.lstat()
            with pytest.raises(ModelError, match=rf"{name}: cannot be written: .*{what}"):
                write_text("x", path, ModelError)
            assert (path.lstat().st_mode, path.lstat().st_ino) == (before.st_mode, before.st_ino)
    assert not list(folder.iterdir())


@pytest.mark.parametrize("place", [".", "..", "/", "folder/.."])
def test_a_path_without_a_name_is_one_clear_message(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "folder").mkdir()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ModelError, match="cannot be written: it is a folder; name a file"):
        write_text("x", Path(place), ModelError)
    assert list(tmp_path.iterdir()) == [tmp_path / "folder"]


@pytest.mark.parametrize(("place", "why"), [("none/x.toml", "No such file"), ("file/x.toml", "Not a directory")])
def test_a_folder_that_cannot_be_is_one_clear_message(tmp_path: Path, place: str, why: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ModelError, match=rf"x\.toml: cannot be written: {why}"):
        write_text("x", tmp_path / place, ModelError)


def test_many_may_write_one_name(tmp_path: Path) -> None:
    """Each text is whole at any time; the last one stays."""
    file = tmp_path / "x.toml"
    texts = [letter * 100_000 for letter in "abcdefgh"]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda text: write_text(text, file, ConfigError), texts * 4))
    assert file.read_text() in texts
    assert list(tmp_path.iterdir()) == [file]


class Round(Strict):
    kind: Literal["round"] = "round"
    radius_mm: float = 1.0


class Square(Strict):
    kind: Literal["square"] = "square"
    side_mm: float = 1.0


class Shapes(Strict):
    shape: dict[str, Annotated[Round | Square, Field(discriminator="kind")]]


@pytest.mark.parametrize(
    ("table", "says"),
    [
        ({"kind": "round", "side_mm": 1.0}, "[shape.a] unknown key 'side_mm'; allowed: kind, radius_mm"),
        ({"kind": "round", "Radius_mm": 1.0}, "[shape.a] unknown key 'Radius_mm'; did you mean 'radius_mm'?"),
        ({"kind": "round", "radius_mm": "x"}, "[shape.a] radius_mm: Input should be a valid number, found 'x'"),
        ({"kind": "oval"}, "[shape.a] kind: must be one of 'round', 'square', found 'oval'"),
        ({"side_mm": 1.0}, "[shape.a] key 'kind' is missing"),
    ],
)
def test_a_table_of_several_kinds_is_named_as_it_is_written(table: dict[str, object], says: str) -> None:
    """Oracle: the place in the file, and the keys of the kind that is named."""
    with pytest.raises(ConfigError) as error:
        validated(Shapes, {"shape": {"a": table}}, "x.toml")
    assert str(error.value) == f"x.toml: {says}"
