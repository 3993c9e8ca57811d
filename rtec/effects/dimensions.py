"""Units of the parameters of an expression, worked out from the units of its channels as far as they follow.

Each part of the expression has a unit, a product of powers; a parameter's is unknown at first. What is added up, or
compared by `min` and `max`, has one unit; what stands in `sin`, `exp` and their like has none; the time constant of
`lag` is in seconds; the whole is in the unit of the component. These equations are solved one unknown at a time;
where all have several unknowns, as in `A*(x/p)**2`, the coefficient is taken to be in the component's unit.
Numbers have no unit of their own: in a sum they take the other's, in a product they have none.
"""

import ast
from collections.abc import Mapping, Sequence
from fractions import Fraction

from rtec.effects.arithmetic import CONSTANTS
from rtec.machine import Machine

Dimension = dict[str, Fraction]
"""Powers by base unit, and by "?name" for a parameter whose unit is not known yet."""

PLAIN = {"spindle_rpm": {"rpm": 1}, "load_kg": {"kg": 1}, "force_n": {"n": 1}, "time_s": {"s": 1}}


def parameter_units(
    tree: ast.expr, linear: Sequence[str], free: Sequence[str], machine: Machine, component_unit: str
) -> dict[str, str]:
    """Units of coefficients and other parameters as text, `um_per_mm_degc`; "1" where none follows."""
    parameters = (*linear, *free)
    equations = _Equations({**_channels(machine), **{p: {f"?{p}": Fraction(1)} for p in parameters}})
    whole = equations.of(tree)
    equations.equal(whole, {component_unit: Fraction(1)})
    known: dict[str, Dimension] = {}
    equations.solve(known)
    for name in linear:
        if f"?{name}" not in known:
            known[f"?{name}"] = {component_unit: Fraction(1)}
            equations.solve(known)
    return {p: _text(known.get(f"?{p}", {})) for p in parameters}


def _channels(machine: Machine) -> dict[str, Dimension]:
    out = {name: _fractions(powers) for name, powers in PLAIN.items()}
    out |= {name: _fractions({"degc": 1}) for name in machine.sensor_names}
    for axis in machine.axes:
        out |= {axis.channel: _fractions({"mm": 1}), axis.since_reversal_channel: _fractions({"mm": 1})}
        out |= {axis.direction_channel: {}, axis.velocity_channel: _fractions({"mm": 1, "s": -1})}
        out |= {axis.acceleration_channel: _fractions({"mm": 1, "s": -2})}
    return out | {name: {} for name in CONSTANTS}


def _fractions(powers: Mapping[str, int]) -> Dimension:
    return {base: Fraction(power) for base, power in powers.items()}


class _Equations:
    """Walks an expression once and notes which units must be equal."""

    def __init__(self, names: Mapping[str, Dimension]) -> None:
        self.names = names
        self.noted: list[Dimension] = []

    def equal(self, left: Dimension | None, right: Dimension | None) -> None:
        """Note that two units are one; a bare number (None) says nothing."""
        if left is not None and right is not None:
            self.noted.append(_product(left, right, -1))

    def of(self, node: ast.expr) -> Dimension | None:
        """Unit of a part; None for a bare number."""
        match node:
            case ast.Name(id=name):
                return self.names[name]
            case ast.UnaryOp(operand=operand):
                return self.of(operand)
            case ast.BinOp(left=left, op=ast.Add() | ast.Sub(), right=right):
                return self._same(left, right)
            case ast.BinOp(left=left, op=ast.Mult() | ast.Div() as op, right=right):
                one, other = self.of(left), self.of(right)
                both_bare = one is None and other is None
                return None if both_bare else _product(one or {}, other or {}, 1 if isinstance(op, ast.Mult) else -1)
            case ast.BinOp(left=base, right=exponent):
                return self._power(base, exponent)
            case ast.Call(func=ast.Name(id=name), args=args):
                return self._call(name, args)
        return None

    def solve(self, known: dict[str, Dimension]) -> None:
        """Add the units that follow from those known; what contradicts itself is left out."""
        found = True
        while found:
            found = False
            for equation in self.noted:
                rest = _inserted(equation, known)
                unknown = [key for key in rest if key.startswith("?")]
                if len(unknown) == 1:
                    power = rest.pop(unknown[0])
                    known[unknown[0]] = {base: -p / power for base, p in rest.items()}
                    found = True

    def _same(self, left: ast.expr, right: ast.expr) -> Dimension | None:
        one, other = self.of(left), self.of(right)
        self.equal(one, other)
        return other if one is None else one

    def _power(self, base: ast.expr, exponent: ast.expr) -> Dimension | None:
        inner = self.of(base)
        match exponent:
            case ast.Constant(value=int() | float() as power):
                return None if inner is None else {b: p * Fraction(power) for b, p in inner.items()}
            case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int() | float() as power)):
                return None if inner is None else {b: -p * Fraction(power) for b, p in inner.items()}
        self.equal(self.of(exponent), {})
        self.equal(inner, {})
        return {}

    def _call(self, name: str, args: list[ast.expr]) -> Dimension | None:
        match name:
            case "abs":
                return self.of(args[0])
            case "sqrt":
                inner = self.of(args[0])
                return None if inner is None else {b: p / 2 for b, p in inner.items()}
            case "min" | "max":
                return self._same(args[0], args[1])
            case "lag":
                self.equal(self.of(args[1]), {"s": Fraction(1)})
                return self.of(args[0])
        self.equal(self.of(args[0]), {})
        return {}


def _product(left: Dimension, right: Dimension, power: int) -> Dimension:
    keys = {*left, *right}
    out = {k: left.get(k, Fraction(0)) + power * right.get(k, Fraction(0)) for k in keys}
    return {k: p for k, p in out.items() if p}


def _inserted(equation: Dimension, known: Mapping[str, Dimension]) -> Dimension:
    out: Dimension = {}
    for key, power in equation.items():
        out = _product(out, {b: p * power for b, p in known.get(key, {key: Fraction(1)}).items()}, 1)
    return out


def _text(dimension: Dimension) -> str:
    first = sorted(dimension, key=lambda base: (base not in ("um", "urad"), base))
    above = [_with_power(b, dimension[b]) for b in first if dimension[b] > 0]
    below = [_with_power(b, -dimension[b]) for b in first if dimension[b] < 0]
    return "_".join(above or ["1"]) + ("_per_" + "_".join(below) if below else "")


def _with_power(base: str, power: Fraction) -> str:
    return base if power == 1 else f"{base}{float(power):g}"
