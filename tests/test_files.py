"""A file appears whole or not at all. Oracle: the folder."""

import os
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
