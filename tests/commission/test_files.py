"""Several files written together: all or none. Oracle: the folder before and after, file by file."""

from collections.abc import Callable
from pathlib import Path

import pytest

from rtec.cli.main import status
from rtec.commission.example import SHIPPED, write_example, write_together
from rtec.errors import ConfigError

TEXTS = {Path("a/one.toml"): "one", Path("a/two.toml"): "two", Path("three.toml"): "three"}


def content(folder: Path) -> dict[str, str]:
    return {str(p.relative_to(folder)): p.read_text() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_all_are_written_and_again_changes_nothing(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "folder"
    for _ in range(2):
        assert write_together(folder, TEXTS) == [folder / name for name in TEXTS]
        assert content(folder) == {str(name): text for name, text in TEXTS.items()}


def test_other_content_stays_unless_it_is_asked_for(tmp_path: Path) -> None:
    (tmp_path / "three.toml").write_text("mine")
    with pytest.raises(ConfigError, match=r"three\.toml: already there.*--force"):
        write_together(tmp_path, TEXTS)
    assert content(tmp_path) == {"three.toml": "mine"}
    assert not (tmp_path / "a").exists()
    write_together(tmp_path, TEXTS, overwrite=True)
    assert content(tmp_path)["three.toml"] == "three"


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError(28, "No space left on device")], ids=["ctrl-c", "full"])
@pytest.mark.parametrize("at", range(5))
def test_an_interruption_anywhere_leaves_the_folder_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at: int, error: BaseException | type[BaseException]
) -> None:
    """The n-th move of a file fails; four of them are needed here, since one file is replaced."""
    (tmp_path / "three.toml").write_text("mine")
    moves, true_replace = iter(range(100)), Path.replace

    def replace(self: Path, target: Path) -> Path:
        if next(moves) == at:
            raise error
        return true_replace(self, target)

    monkeypatch.setattr(Path, "replace", replace)
    attempt: Callable[[], object] = lambda: write_together(tmp_path, TEXTS, overwrite=True)  # noqa: E731
    if at == 4:
        attempt()
        assert content(tmp_path)["three.toml"] == "three"
        return
    with pytest.raises((KeyboardInterrupt, ConfigError)):
        attempt()
    assert content(tmp_path) == {"three.toml": "mine"}
    assert [p.name for p in tmp_path.iterdir()] == ["three.toml"]


def test_a_folder_that_is_a_file_is_one_message(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("a file")
    with pytest.raises(ConfigError, match="nothing was written"):
        write_together(tmp_path, TEXTS)


def test_the_example_is_what_is_shipped(tmp_path: Path) -> None:
    written = write_example(tmp_path)
    assert content(tmp_path / "configs") == {k: v for k, v in content(SHIPPED).items() if k.endswith(".toml")}
    assert len(written) >= 10


def test_init_example_says_what_to_type_next(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    blank = tmp_path / "my machine"
    blank.mkdir()
    assert status(["init", "--example", str(blank)]) == 0
    assert f"Next: cd '{blank}' && rtec run configs/turning-centre-sim.toml" in capsys.readouterr().out
    assert status(["init", "--example", str(tmp_path)]) == 0
    assert f"Next: cd {tmp_path} && rtec run configs/turning-centre-sim.toml" in capsys.readouterr().out
    (tmp_path / "configs" / "hil.toml").write_text("mine")
    assert status(["init", "--example", str(tmp_path)]) == 2
    assert "--force" in capsys.readouterr().err
    assert (tmp_path / "configs" / "hil.toml").read_text() == "mine"
    assert status(["init", "--example", str(tmp_path), "--force"]) == 0
