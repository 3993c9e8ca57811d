"""An effect of the user's own, written as an expression over channels (`arithmetic` lists what is allowed).

On the command line: `--expr "A*sin(2*pi*y/p + phi)" --param p=37:3..200`. Names that are neither channels nor
declared are fitted: those in which the expression is linear as coefficients. An amplitude with a phase, `A*sin(w +
phi)`, becomes `A_sin*sin(w) + A_cos*cos(w)`. That is linear, so that the phase needs no search: `A = hypot(A_sin,
A_cos)`, `phi = atan2(A_cos, A_sin)` (for a cosine, `phi = atan2(-A_sin, A_cos)`).
"""

import ast
import difflib
import math
import re
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from rtec.effects.arithmetic import (
    CONSTANTS,
    FUNCTIONS,
    MAX_LENGTH,
    as_sine_and_cosine,
    degree,
    evaluate,
    is_phase,
    names_in,
    parameter_units,
    parse,
    power_of,
)
from rtec.effects.base import About, Effect, Parameter
from rtec.effects.state import Channels, Value
from rtec.errors import ModelError
from rtec.machine import Machine
from rtec.machine.chain import component_unit
from rtec.quantities import Coefficient
from rtec.tomlfile import Strict, nearest, validated


class Free(Strict):
    """A non-linear parameter of an expression: where the search begins and its bounds."""

    start: Coefficient
    low: Coefficient
    high: Coefficient
    unit: str = "1"

    @model_validator(mode="after")
    def _ordered(self) -> "Free":
        if not self.low <= self.start <= self.high or self.low >= self.high:
            raise ValueError("need low <= start <= high and low < high")
        return self


class Expression(Effect):
    """`e = expression`, linear in `linear`, with the names in `free` as non-linear parameters.

    Names in the expression are channels of the machine and the parameters. Channels: position `x` mm, direction
    `d_x`, velocity `v_x` mm/s, acceleration `a_x` mm/s², distance since the last reversal `s_x` mm, temperatures
    above the reference K, `spindle_rpm`, `load_kg`, `force_n`, `time_s`. `lag(value, tau)` is the first-order lag.
    """

    about: ClassVar[About] = About(
        title="An expression of your own",
        equation="e = the expression",
        typical="-",
        seen_by=(),
        source="the user",
    )
    effect: Literal["expression"] = "expression"
    expression: Annotated[str, Field(min_length=1, max_length=MAX_LENGTH)]
    linear: Annotated[dict[str, str], Field(min_length=1)]
    free: dict[str, Free] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _parses(self) -> "Expression":
        names = names_in(self.expression)
        both = sorted(set(self.linear) & set(self.free))
        if both:
            raise ValueError(f"parameter {both[0]!r} is under both linear and free")
        unused = [n for n in (*self.linear, *self.free) if n not in names]
        if unused:
            raise ValueError(f"parameter {unused[0]!r} is not in the expression")
        return self

    def check(self, machine: Machine, where: str) -> None:
        """Check that every name is known and that the expression is linear in its coefficients."""
        super().check(machine, where)
        known = machine.channel_names
        for name in names_in(self.expression) - set(self.linear) - set(self.free) - set(CONSTANTS):
            if name not in known:
                raise ModelError(f"{where}: {name!r} is neither a channel nor a parameter{nearest(name, known)}")
        clash = next((n for n in (*self.linear, *self.free) if n in known or n in CONSTANTS), None)
        if clash:
            raise ModelError(f"{where}: parameter {clash!r} has the name of a channel; choose another")
        self._check_linear(where)
        with np.errstate(all="ignore"):
            self.basis(machine, _Probe(machine), {name: free.start for name, free in self.free.items()})

    def _check_linear(self, where: str) -> None:
        names = ", ".join(self.linear)
        try:
            total = degree(parse(self.expression), set(self.linear))
        except ValueError as e:
            raise ModelError(f"{where}: not linear in {names}: {e}; declare what is not linear under `free`") from e
        if total != 1:
            raise ModelError(f"{where}: with all of {names} zero the expression is not zero")

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """One for each name under `linear`."""
        del machine
        return tuple(Parameter(name, unit) for name, unit in self.linear.items())

    def nonlinear(self, machine: Machine) -> tuple[Parameter, ...]:
        """One for each name under `free`."""
        del machine
        return tuple(Parameter(n, f.unit, f.start, f.low, f.high) for n, f in self.free.items())

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """Every channel that the expression names."""
        return tuple(sorted(names_in(self.expression) & set(machine.channel_names)))

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """The expression with one coefficient at one and the others at zero, for each coefficient in turn."""
        return [
            self._evaluate(machine, channels, theta, {n: float(n == name) for n in self.linear}) for name in self.linear
        ]

    def _evaluate(
        self, machine: Machine, channels: Channels, theta: Mapping[str, Value], coefficients: Mapping[str, float]
    ) -> Value:
        names: dict[str, Value] = {**CONSTANTS, **theta, **coefficients}
        for name in self.channels(machine):
            names[name] = channels.rise(name) if name in machine.sensor_names else channels.value(name)
        try:
            return evaluate(parse(self.expression), names, channels)
        except (OverflowError, ZeroDivisionError, ValueError) as e:
            raise ModelError(f"expression {self.expression!r}: {e}") from e


class _Probe:
    """Three arbitrary instants, to try an expression on."""

    def __init__(self, machine: Machine) -> None:
        self._values = {n: np.array([0.37, 0.61, 0.83]) + 0.1 * i for i, n in enumerate(sorted(machine.channel_names))}

    def value(self, name: str) -> Value:
        return self._values[name]

    def rise(self, sensor: str) -> Value:
        return self._values[sensor]

    def lagged(self, value: Value, tau_s: Value) -> Value:
        if np.ndim(tau_s):
            raise ModelError("the time constant of lag() is a number or a parameter, not a channel")
        return value


NUMBER = r"[-+]?(?:\d+(?:\.\d+)?|\.\d+)(?:[eE][-+]?\d+)?"
PARAM = re.compile(rf"\s*([A-Za-z_]\w*)\s*=\s*({NUMBER})\s*:\s*({NUMBER})\s*\.\.\s*({NUMBER})\s*", re.ASCII)
PARAM_FORM = "name=start:low..high, for example p=37:3..200"
PHASE = {"start": 0.5, "low": -math.pi, "high": math.pi}
"""Start and bounds of a phase. It does not start at 0, because all slopes vanish a quarter turn away from there."""


def expression_from_text(expr: str, params: Sequence[str], component: str, machine: Machine) -> Expression:
    """Make an effect from the texts of `--expr`, `--param` and `--component`.

    Args:
        expr: the expression, over channels and parameters.
        params: `name=start:low..high` each: parameters that the expression is not linear in.
        component: which component error it feeds, for example "EYY".
        machine: whose channels it may read.

    Returns:
        The effect, checked against the machine; the units of its parameters follow from the channels.

    Raises:
        ModelError: one of the texts is wrong; the message names it and what to write instead.
    """
    tree = _tree(expr)
    names = names_in(expr)
    free: dict[str, dict[str, Any]] = {}
    for text in params:
        name, bounds = _declared(text, names, machine)
        if name in free:
            raise ModelError(f"--param {name!r} is given twice")
        free[name] = bounds
    fitted = sorted(names - set(free) - set(CONSTANTS) - set(machine.channel_names), key=expr.index)
    for name in fitted:
        _refuse_look_alike(name, machine)
    tree, linear, phases = _linearised(tree, fitted, machine)
    free |= {name: dict(PHASE) for name in phases}
    if not linear:
        raise ModelError(f"--expr {expr!r} has no coefficient to fit; multiply it by a name of your own: A*({expr})")
    _check_linear(tree, linear, expr, machine)
    return _effect(tree, linear, free, component, machine)


def _tree(expr: str) -> ast.expr:
    try:
        return parse(expr)
    except ValueError as e:
        raise ModelError(f"--expr: {e}") from e


def _declared(text: str, names: frozenset[str], machine: Machine) -> tuple[str, dict[str, Any]]:
    found = PARAM.fullmatch(text)
    if found is None:
        raise ModelError(f"--param {text!r}: write {PARAM_FORM}")
    name, (start, low, high) = found[1], map(float, found.groups()[1:])
    if not low < high or not low <= start <= high:
        raise ModelError(f"--param {text!r}: need low <= start <= high and low < high")
    if name in machine.channel_names or name in CONSTANTS:
        raise ModelError(f"--param {text!r}: {name!r} is a channel or a constant; choose another name")
    if name not in names:
        raise ModelError(f"--param {text!r}: {name!r} is not in the expression{nearest(name, names)}")
    return name, {"start": start, "low": low, "high": high}


def _refuse_look_alike(name: str, machine: Machine) -> None:
    """Refuse a name that is probably a misspelt channel or function: a slip must not become a parameter."""
    if name in FUNCTIONS or name == "lag":
        raise ModelError(f"--expr: {name} is a function; write {name}(…)")
    close = difflib.get_close_matches(name, machine.channel_names, n=1, cutoff=0.8)
    if close or re.fullmatch(r"[xyz]|[dvas]_\w+|T_\w+", name):
        known = nearest(name, machine.channel_names)
        raise ModelError(
            f"--expr: machine {machine.name!r} has no channel {name!r}{known}\n"
            "if it is a parameter, give it another name"
        )


def _linearised(tree: ast.expr, fitted: Sequence[str], machine: Machine) -> tuple[ast.expr, list[str], list[str]]:
    """The expression with sines and cosines for phases, its coefficients, and the phases that stay non-linear."""
    linear = [name for name in fitted if power_of(tree, name) <= 1]
    phases = [name for name in fitted if name not in linear]
    for name in phases:
        if not is_phase(tree, name):
            _refuse_capital(name, machine)
            raise ModelError(
                f"--expr: {name!r} is no channel of machine {machine.name!r}, and the expression is not linear in it; "
                f"if it is a parameter, declare --param {name}=start:low..high"
            )
    nonlinear = []
    for phase in phases:
        rewritten = as_sine_and_cosine(tree, linear, phase, {*fitted, *machine.channel_names})
        if rewritten is None:
            nonlinear.append(phase)
        else:
            tree, linear = rewritten
    return tree, linear, nonlinear


def _refuse_capital(name: str, machine: Machine) -> None:
    """Refuse a name that differs from a channel only by capitals, where the expression is not linear in it."""
    channel = next((c for c in machine.channel_names if c.lower() == name.lower() and c != name), None)
    if channel is not None:
        raise ModelError(f"--expr: machine {machine.name!r} has no channel {name!r}; did you mean {channel!r}?")


def _check_linear(tree: ast.expr, linear: Sequence[str], expr: str, machine: Machine) -> None:
    """Refuse an expression that is linear in each coefficient alone, but not in all together."""
    try:
        degree(tree, set(linear))
    except ValueError as e:
        for name in linear:
            _refuse_capital(name, machine)
        names = ", ".join(linear)
        way = (
            "multiply every part by a name of your own"
            if "added" in str(e)
            else f"declare all but one of {names}: --param NAME=start:low..high"
        )
        raise ModelError(f"--expr {expr!r} is not linear in {names}: {e}; {way}") from e


def _effect(
    tree: ast.expr, linear: Sequence[str], free: Mapping[str, dict[str, Any]], component: str, machine: Machine
) -> Expression:
    unit = component_unit(component) if len(component) > 1 else "um"
    units = parameter_units(tree, linear, tuple(free), machine, unit)
    table = {
        "effect": "expression",
        "component": component,
        "expression": ast.unparse(tree),
        "linear": {name: units[name] for name in linear},
        "free": {n: {**bounds, "unit": "rad" if bounds == PHASE else units[n]} for n, bounds in free.items()},
    }
    effect = validated(Expression, table, "--expr", ModelError)
    effect.check(machine, "--expr")
    return effect
