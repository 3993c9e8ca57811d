"""An expression typed on the command line becomes an effect: `--expr "A*sin(2*pi*y/p + phi)" --param p=37:3..200`.

Names that are neither channels nor declared are fitted: those in which the expression is linear as coefficients. An
amplitude with a phase, `A*sin(w + phi)`, becomes `A_sin*sin(w) + A_cos*cos(w)`, which is linear and finds its phase
wherever it is: `A = hypot(A_sin, A_cos)`, `phi = atan2(A_cos, A_sin)` (for a cosine, `phi = atan2(-A_sin, A_cos)`).
"""

import ast
import difflib
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from rtec.effects.arithmetic import CONSTANTS, FUNCTIONS, degree, names_in, parse
from rtec.effects.dimensions import parameter_units
from rtec.effects.expression import Expression
from rtec.effects.phases import as_sine_and_cosine, is_phase, power_of
from rtec.errors import ModelError
from rtec.machine import Machine
from rtec.machine.chain import component_unit
from rtec.tomlfile import nearest, validated

NUMBER = r"[-+]?(?:\d+(?:\.\d+)?|\.\d+)(?:[eE][-+]?\d+)?"
PARAM = re.compile(rf"\s*([A-Za-z_]\w*)\s*=\s*({NUMBER})\s*:\s*({NUMBER})\s*\.\.\s*({NUMBER})\s*", re.ASCII)
PARAM_FORM = "name=start:low..high, for example p=37:3..200"
PHASE = {"start": 0.5, "low": -math.pi, "high": math.pi}
"""Bounds of a phase; it does not start at 0, where a quarter turn away all slopes vanish."""


def expression_from_text(expr: str, params: Sequence[str], component: str, machine: Machine) -> Expression:
    """Make an effect from the texts of `--expr`, `--param` and `--component`.

    Args:
        expr: the expression, over channels and parameters.
        params: `name=start:low..high` each: parameters that the expression is not linear in.
        component: which component error it feeds, for example "EYY".
        machine: whose channels it may read.

    Returns:
        The effect, checked against the machine; units of its parameters are worked out from the channels.

    Raises:
        ModelError: what is wrong with which of the texts, and what to write instead.
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
    tree, linear, phases = _sorted_out(tree, fitted, machine)
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


def _declared(text: str, names: set[str], machine: Machine) -> tuple[str, dict[str, Any]]:
    found = PARAM.fullmatch(text)
    if found is None:
        raise ModelError(f"--param {text!r}: write {PARAM_FORM}")
    name, (start, low, high) = found[1], map(float, found.groups()[1:])
    if not low < high or not low <= start <= high:
        raise ModelError(f"--param {text!r}: need low <= start <= high and low < high")
    if name in machine.channel_names or name in CONSTANTS:
        raise ModelError(f"--param {text!r}: {name!r} is a channel or a constant; choose another name")
    if name not in names:
        raise ModelError(f"--param {text!r}: {name!r} does not stand in the expression{nearest(name, names)}")
    return name, {"start": start, "low": low, "high": high}


def _refuse_look_alike(name: str, machine: Machine) -> None:
    """Refuse a name that somebody probably meant as a channel or function: a slip must not become a parameter."""
    if name in FUNCTIONS or name == "lag":
        raise ModelError(f"--expr: {name} is a function; write {name}(…)")
    close = difflib.get_close_matches(name, machine.channel_names, n=1, cutoff=0.8)
    if close or re.fullmatch(r"[xyz]|[dvas]_\w+|T_\w+", name):
        known = nearest(name, machine.channel_names)
        raise ModelError(
            f"--expr: machine {machine.name!r} has no channel {name!r}{known}\n"
            "if it is a parameter, give it another name"
        )


def _sorted_out(tree: ast.expr, fitted: Sequence[str], machine: Machine) -> tuple[ast.expr, list[str], list[str]]:
    """The expression (with sines and cosines for phases), its coefficients, and its phases that are left."""
    linear = [name for name in fitted if power_of(tree, name) <= 1]
    phases = [name for name in fitted if name not in linear]
    for name in phases:
        if not is_phase(tree, name):
            _refuse_capital(name, machine)
            raise ModelError(
                f"--expr: {name!r} is no channel of machine {machine.name!r}, and the expression is not linear in it; "
                f"if it is a parameter, declare --param {name}=start:low..high"
            )
    left = []
    for phase in phases:
        rewritten = as_sine_and_cosine(tree, linear, phase, {*fitted, *machine.channel_names})
        if rewritten is None:
            left.append(phase)
        else:
            tree, linear = rewritten
    return tree, linear, left


def _refuse_capital(name: str, machine: Machine) -> None:
    """Refuse a name that is a channel but for small and capital letters, where the expression is not linear in it."""
    channel = next((c for c in machine.channel_names if c.lower() == name.lower() and c != name), None)
    if channel is not None:
        raise ModelError(f"--expr: machine {machine.name!r} has no channel {name!r}; did you mean {channel!r}?")


def _check_linear(tree: ast.expr, linear: Sequence[str], expr: str, machine: Machine) -> None:
    """Refuse what is linear in each coefficient alone, but not in all together."""
    try:
        degree(tree, set(linear))
    except ValueError as e:
        for name in linear:
            _refuse_capital(name, machine)
        said = ", ".join(linear)
        way = (
            "multiply every part by a name of your own"
            if "added" in str(e)
            else f"declare all but one of {said}: --param NAME=start:low..high"
        )
        raise ModelError(f"--expr {expr!r} is not linear in {said}: {e}; {way}") from e


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
