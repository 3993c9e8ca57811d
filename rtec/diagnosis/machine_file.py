"""Finds the machine file of a model where none is given. A machine file itself is the model without effects."""

from collections.abc import Iterator
from pathlib import Path

from rtec.errors import ModelError, RtecError
from rtec.machine import load_machine
from rtec.model import Model, load_model
from rtec.tomlfile import read_kind, read_toml

FOLDERS = (".", "..", "machines", "../machines", "configs/machines")
MOST_BYTES = 1_000_000
MACHINE = {"machine", "axis"}
"""Tables that every machine file has, and no model file."""


def load_with_machine(model: Path, machine: Path | None = None) -> Model:
    """Load a model with its machine.

    Args:
        model: file.
        machine: its machine's file; where None, `machine_file` finds it.

    Raises:
        ModelError: the model cannot be read, or no machine file belongs to it.
    """
    described = machine_file(model, machine)
    there = load_machine(described)
    return Model(there, name=there.name) if described == model else load_model(model, there)


def machine_file(model: Path, machine: Path | None = None) -> Path:
    """The machine file of a model.

    Args:
        model: file.
        machine: taken where given; where None it is the one that the model names (`machine_file`), or is searched
            by its content beside the model, in `machines` beside it or one folder up, and in `configs/machines` of
            the working directory. A machine file in place of the model is its own.

    Raises:
        ModelError: the model cannot be read, or no machine file belongs to it.
    """
    if model.suffix.lower() == ".csv":
        raise ModelError(f"{model}: is a table of readings; a model file is expected first, then the measurements")
    if set(read_toml(model, ModelError)) >= MACHINE:
        if machine is not None and load_machine(machine).hash != load_machine(model).hash:
            raise ModelError(f"{model}: is a machine file, not a model, and of another machine than {machine}")
        return model
    if machine is not None:
        return machine
    head = read_kind(model, "a model file", ModelError).get("model")
    wanted = head.get("machine_hash") if isinstance(head, dict) else None
    if not isinstance(head, dict) or not isinstance(wanted, str):
        raise ModelError(f"{model}: [model] machine_hash is missing; is this a model file?")
    named, name = head.get("machine_file"), head.get("machine", "")
    files = [_shown(model.resolve().parent / named)] if isinstance(named, str) else []
    for file in [*files, *_candidates(model)]:
        try:
            here = load_machine(file)
        except RtecError:
            continue  # not a machine file
        # A model without a hash fits any machine that it is used with: take the one that it names.
        if here.hash == wanted or (not wanted and (file in files or here.name == name)):
            return file
    at = f"at machine_file = {named!r}, " if files else ""
    raise ModelError(
        f"{model}: no file of machine {name!r} as it was at the fit was found {at}beside it or in configs/machines; "
        "name it with --machine FILE"
    )


def _shown(file: Path) -> Path:
    """The shortest form of a path: relative to the working directory where the file is below it."""
    file = file.resolve()
    return file.relative_to(Path.cwd()) if file.is_relative_to(Path.cwd()) else file


def _candidates(model: Path) -> Iterator[Path]:
    """Files that may be a machine's, nearest first."""
    places = [model.resolve().parent / f for f in FOLDERS[:4]] + [Path(FOLDERS[4])]
    for folder in dict.fromkeys(p.resolve() for p in places):
        for file in sorted(folder.glob("*.toml")) if folder.is_dir() else []:
            try:
                if file.stat().st_size < MOST_BYTES and set(read_toml(file)) >= MACHINE:
                    yield _shown(file)
            except (OSError, RtecError):
                continue
