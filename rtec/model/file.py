"""Saves and loads a model: TOML, data only. Loading never runs its text."""

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tomli_w
from pydantic import BeforeValidator, Field

from rtec.effects import effect_class
from rtec.errors import ModelError
from rtec.files import whole
from rtec.machine import Machine
from rtec.model.model import ErrorCorrelation, FittedEffect, Model, number_names
from rtec.quantities import (
    LARGEST,
    Coefficient,
    CoefficientNotNegative,
    Counts,
    DegreesCelsius,
    MicrometresNotNegative,
)
from rtec.tomlfile import Strict, read_kind, validated

FORMAT = 1
ROUNDED = 0.015
"""Least eigenvalue of a correlation matrix, below zero: its numbers are rounded."""


class _Number(Strict):
    value: Coefficient
    se: CoefficientNotNegative | None = None
    unit: str


class _ModelTable(Strict):
    """`[model]`: what the model as a whole is.

    Attributes:
        format: of this file.
        name: for people.
        machine: name of the machine that it was made for.
        machine_hash: SHA-256 of that machine; a model for another machine is refused. "" stands for the machine that
            the model is used with, whichever it is; rtec writes it out when it saves the model.
        machine_file: where the machine's file is; a relative path starts at the model's folder. Commands that are
            given a model alone look there first.
        reference_degc: temperature at which a temperature effect is zero.
        noise_um: noise of the measurements behind the fit.
        effects: how many follow, so that a file that was cut off is refused; may be left out.
    """

    format: Literal[1]
    name: str
    machine: str
    machine_hash: str
    machine_file: Path | None = None
    reference_degc: DegreesCelsius
    noise_um: MicrometresNotNegative | None = None
    effects: Counts | None = None


def _numbers_of(row: object) -> object:
    """The numbers of a row; a line a row keeps the table readable."""
    return tuple(map(float, row.split())) if isinstance(row, str) else row


_Share = Annotated[float, Field(ge=-1, le=1)]


class _CorrelationTable(Strict):
    """`[correlation]`: how the errors of the numbers hang together; a later fit needs it to keep what is known.

    Attributes:
        numbers: place and label of the effect, from 1, and name of the number.
        rows: correlation of each number with those before it, -1 to 1, separated by spaces; the first row is empty.
    """

    numbers: list[str]
    rows: list[Annotated[tuple[_Share, ...], BeforeValidator(_numbers_of)]]


class ModelFile(Strict):
    """The whole model file.

    Attributes:
        model: the model as a whole.
        effect: the effects, each with its arguments and numbers; `rtec effects NAME` explains one.
        valid_range: lowest and highest value of a channel that the fit has seen; the guard holds outside.
        measurement: SHA-256 of the measurements behind the fit, by name.
        history: one entry a change, for `rtec history`.
        correlation: of the errors of the numbers; may be left out.
    """

    model: _ModelTable
    effect: list[dict[str, Any]] = Field(default_factory=list)
    valid_range: dict[str, tuple[Coefficient, Coefficient]] = Field(default_factory=dict)
    measurement: dict[str, str] = Field(default_factory=dict)
    history: list[dict[str, Any]] = Field(default_factory=list)
    correlation: _CorrelationTable | None = None


class _Numbers(Strict):
    coefficient: dict[str, _Number]
    nonlinear: dict[str, _Number] = Field(default_factory=dict)


def load_model(path: Path, machine: Machine) -> Model:
    """Read a model for a machine.

    Raises:
        ModelError: the file is broken, made for another machine, or names an unknown effect, argument or parameter; the
            message has the place and what is allowed.
    """
    return model_from(read_kind(path, "a model file", ModelError), machine, str(path))


def model_from(data: Mapping[str, Any], machine: Machine, source: str) -> Model:
    """Build a model from the tables of its file."""
    file = validated(ModelFile, data, source, ModelError)
    if file.model.machine_hash not in ("", machine.hash):
        raise ModelError(
            f"{source}: [model] machine_hash: made for machine {file.model.machine!r} as it was then, not for "
            f"{machine.name!r} as its file is now; refit, or check which machine file belongs to it"
        )
    count = file.model.effects
    if count is not None and count != len(file.effect):
        raise ModelError(
            f"{source}: [model] effects = {count}, and {len(file.effect)} are in the file: it was cut off while it was "
            "copied or written; copy it again. After adding or removing one by hand, change the number, too"
        )
    model = Model(
        machine=machine,
        effects=tuple(_read_effect(table, f"{source}: [effect {i + 1}]") for i, table in enumerate(file.effect)),
        name=file.model.name,
        reference_degc=file.model.reference_degc,
        valid_range=file.valid_range,
        noise_um=file.model.noise_um,
        measurements=file.measurement,
        history=tuple(file.history),
        correlation=_read_correlation(file.correlation, source),
    )
    model.check(source)
    _check_correlation(model, source)
    _check_units(file, model, source)
    return model


def save_model(model: Model, path: Path, *, replace: bool = True) -> None:
    """Write a model; the file appears whole or not at all.

    Args:
        model: the model.
        path: of its file.
        replace: replace an older file of that name.

    Raises:
        ModelError: the file cannot be written.
        FileExistsError: the file exists, and `replace` is false.
    """
    content = tables(model)
    # A file that is cut off between two effects is valid TOML; the count comes first, so that a cut never removes it.
    content["model"] = {"effects": len(model.effects), **content["model"]}
    if model.machine.file is not None:
        content["model"]["machine_file"] = _way(path.parent, model.machine.file)
    with whole(path, ModelError, replace) as out:
        out.write(tomli_w.dumps(content).encode())


def _way(folder: Path, file: Path) -> str:
    """Path of a file relative to a folder, so that both may be moved together."""
    return os.path.relpath(file.resolve(), folder.resolve())


def tables(model: Model) -> dict[str, Any]:
    """Give the tables of a model's file."""
    head: dict[str, Any] = {
        "format": FORMAT,
        "name": model.name,
        "machine": model.machine.name,
        "machine_hash": model.machine.hash,
        "reference_degc": model.reference_degc,
    }
    if model.noise_um is not None:
        head["noise_um"] = model.noise_um
    out: dict[str, Any] = {
        "model": head,
        "valid_range": {k: list(v) for k, v in model.valid_range.items()},
        "measurement": dict(model.measurements),
        "effect": [_effect_table(f, model.machine) for f in model.effects],
        "history": [dict(entry) for entry in model.history],
    }
    if model.correlation is not None:
        known = model.correlation.among(model.effects)
        out["correlation"] = {"numbers": list(known.numbers), "rows": [" ".join(map(str, row)) for row in known.rows]}
    return out


def _read_correlation(table: _CorrelationTable | None, source: str) -> ErrorCorrelation | None:
    if table is None:
        return None
    if [len(row) for row in table.rows] != list(range(len(table.numbers))):
        raise ModelError(
            f"{source}: [correlation] rows: need one for each of the {len(table.numbers)} numbers, the first empty and "
            "each longer by one"
        )
    found = ErrorCorrelation(tuple(table.numbers), tuple(table.rows))
    if table.numbers and np.linalg.eigvalsh(found.matrix(found.numbers))[0] < -ROUNDED:
        raise ModelError(f"{source}: [correlation] rows: these correlations contradict each other; remove this table")
    return found


def _check_correlation(model: Model, source: str) -> None:
    """Refuse a correlation of numbers that the model does not have."""
    there = set(number_names(model.effects))
    strange = [n for n in (model.correlation.numbers if model.correlation else ()) if n not in there]
    if strange:
        raise ModelError(
            f"{source}: [correlation] numbers: {strange[0]!r} is no number of these effects; after adding or removing "
            "effects by hand, remove this table"
        )


def _read_effect(table: Mapping[str, Any], source: str) -> FittedEffect:
    name = table.get("effect")
    if not isinstance(name, str):
        raise ModelError(f"{source}: key 'effect' is missing; it names the effect")
    source = f"{source[:-1]}, {name}]"
    numbers = validated(_Numbers, {k: table[k] for k in ("coefficient", "nonlinear") if k in table}, source, ModelError)
    arguments = {k: v for k, v in table.items() if k not in ("coefficient", "nonlinear")}
    effect = validated(effect_class(name, source), arguments, source, ModelError)
    both = {**numbers.coefficient, **numbers.nonlinear}
    return FittedEffect(
        effect=effect,
        values={k: v.value for k, v in numbers.coefficient.items()},
        theta={k: v.value for k, v in numbers.nonlinear.items()},
        errors={k: v.se for k, v in both.items() if v.se is not None},
    )


def _check_units(file: ModelFile, model: Model, source: str) -> None:
    """Refuse numbers in a unit other than the one of their parameter."""
    faults = []
    for i, (table, fitted) in enumerate(zip(file.effect, model.effects, strict=True)):
        effect = fitted.effect
        for kind, parameters in (
            ("coefficient", effect.coefficients(model.machine)),
            ("nonlinear", effect.nonlinear(model.machine)),
        ):
            where = f"{source}: [effect {i + 1}, {effect.effect}] {kind}"
            faults += [
                f"{where}.{p.name}: unit {table[kind][p.name]['unit']!r}; it is {p.unit!r}"
                for p in parameters
                if table[kind][p.name]["unit"] != p.unit
            ]
    if faults:
        raise ModelError("\n".join(faults))


def _effect_table(fitted: FittedEffect, machine: Machine) -> dict[str, Any]:
    def numbers(parameters: Any, values: Mapping[str, float]) -> dict[str, Any]:
        out = {}
        for p in parameters:
            error = fitted.errors.get(p.name, math.nan)
            se = {"se": min(error, LARGEST)} if math.isfinite(error) else {}  # larger: nothing is known of it
            out[p.name] = {"value": float(values[p.name]), **se, "unit": p.unit}
        return out

    effect = fitted.effect
    table = effect.model_dump(mode="json", exclude_none=True)
    table["coefficient"] = numbers(effect.coefficients(machine), fitted.values)
    if fitted.theta:
        table["nonlinear"] = numbers(effect.nonlinear(machine), fitted.theta)
    return table
