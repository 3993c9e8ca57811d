"""The files that come with rtec: machines, models, simulated devices, the tutorial's data, maps for imports.

Several files are written together: all of them or none, and none over an existing one.
"""

import os
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Final

from rtec.errors import ConfigError


def write_together(folder: Path, texts: Mapping[Path, str], *, overwrite: bool = False) -> list[Path]:
    """Write files below a folder; afterwards either all of them exist, or the folder is as before.

    A file that exists with the same content is not written.

    Args:
        folder: created where it is missing.
        texts: content by path, relative to the folder.
        overwrite: replace files with another content.

    Returns:
        the files, in the order of `texts`.

    Raises:
        ConfigError: files that exist with another content and may not be replaced, or cannot be written; all of them.
    """
    files = {folder / name: text for name, text in texts.items()}
    there = [file for file, text in files.items() if file.exists() and _content(file) != text]
    if there and not overwrite:
        names = ", ".join(str(file) for file in there)
        raise ConfigError(f"{names}: already there, with other content; nothing was written. --force replaces")
    todo = {file: text for file, text in files.items() if not file.exists() or file in there}
    made: list[Path] = []
    try:
        for place in dict.fromkeys([folder, *(file.parent for file in todo)]):
            _make_folder(place, made)
        with tempfile.TemporaryDirectory(prefix=".rtec-", dir=folder) as stage:
            _exchange(Path(stage), todo)
        made.clear()
    except OSError as e:
        raise ConfigError(f"{e.filename or folder}: cannot be written: {e.strerror}; nothing was written") from e
    finally:
        for place in reversed(made):
            with suppress(OSError):
                place.rmdir()
    return list(files)


def _content(file: Path) -> str | None:
    try:
        return file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return None


def _make_folder(folder: Path, made: list[Path]) -> None:
    missing = [p for p in (folder, *folder.parents) if not p.exists()]
    for place in reversed(missing):
        place.mkdir()
        made.append(place)


def _exchange(stage: Path, texts: Mapping[Path, str]) -> None:
    """Replace old files by new ones; an error or Ctrl-C on the way restores the old ones."""
    for k, text in enumerate(texts.values()):
        with (stage / f"new-{k}").open("w", encoding="utf-8") as out:
            out.write(text)
            out.flush()
            os.fsync(out.fileno())
    done: list[tuple[int, Path]] = []
    try:
        for k, file in enumerate(texts):
            done.append((k, file))
            if file.exists():
                file.replace(stage / f"old-{k}")
            (stage / f"new-{k}").replace(file)
    except BaseException:
        for k, file in reversed(done):
            _put_back(stage, k, file)
        raise


def _put_back(stage: Path, k: int, file: Path) -> None:
    if (stage / f"old-{k}").exists():
        (stage / f"old-{k}").replace(file)
    elif not (stage / f"new-{k}").exists():
        file.unlink(missing_ok=True)


SHIPPED: Final = Path(__file__).parents[1] / "configs"
"""Their folder, in a clone and in an installed package alike."""
FOLDER: Final = "configs"
"""Name of the folder for the copies, as in the commands of the documentation."""


def write_example(folder: Path, *, overwrite: bool = False) -> list[Path]:
    """Copy the shipped files into `configs` of a folder; all files or none.

    Raises:
        ConfigError: a file exists with another content and may not be replaced, or cannot be written.
    """
    files = sorted(file for file in SHIPPED.rglob("*.toml"))
    texts = {Path(FOLDER) / file.relative_to(SHIPPED): file.read_text(encoding="utf-8") for file in files}
    return write_together(folder, texts, overwrite=overwrite)
