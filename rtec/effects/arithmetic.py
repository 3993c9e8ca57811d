"""Arithmetic written as text: what is allowed, which of its parameters are coefficients, and their units.

Numbers, names, `+ - * / **` and a few functions are allowed; the text is never run as code. A parameter in which the
text is linear is a coefficient. `A sin(w + φ)` is rewritten as a sine and a cosine: then the phase is linear, too.

Units follow from those of the channels. Terms of a sum, and arguments of `min` and `max`, have the same unit. The
argument of `sin`, `exp` and the like has none. The time constant of `lag` is in seconds. The whole expression is in the
unit of the component. These equations are solved one unknown at a time; where each has several unknowns, as in
`A*(x/p)**2`, the coefficient is taken to be in the component's unit. A number has the unit of the other term in a sum,
and none in a product.
"""

import ast
import copy
import functools
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction

import numpy as np

from rtec.effects.state import Channels, Value
from rtec.machine import Machine
from rtec.tomlfile import nearest
from rtec.wording import counted

MAX_LENGTH = 2000
MAX_DEPTH = 60
MAX_NUMBER = 1e300
CONSTANTS = {"pi": math.pi}
FUNCTIONS: dict[str, tuple[int, Callable[..., Value]]] = {
    "sin": (1, np.sin),
    "cos": (1, np.cos),
    "exp": (1, np.exp),
    "log": (1, np.log),
    "sqrt": (1, np.sqrt),
    "tanh": (1, np.tanh),
    "abs": (1, np.abs),
    "min": (2, np.minimum),
    "max": (2, np.maximum),
}


def _power(a: Value, b: Value) -> Value:
    out = a**b
    if isinstance(out, complex):  # a negative number to a fraction: Python gives a complex number, numpy nan
        raise ValueError(f"{a:g} ** {b:g} is no real number")
    return out


OPERATORS: dict[type[ast.operator], Callable[[Value, Value], Value]] = {
    ast.Add: lambda a, b: a + b,
    ast.Sub: lambda a, b: a - b,
    ast.Mult: lambda a, b: a * b,
    ast.Div: lambda a, b: a / b,
    ast.Pow: _power,
}


@functools.lru_cache(maxsize=256)
def names_in(expression: str) -> frozenset[str]:
    """Names of channels and parameters in an expression; not those of functions.

    Raises:
        ValueError: the text is not an allowed expression.
    """
    tree = parse(expression)
    calls = {id(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}
    return frozenset(node.id for node in ast.walk(tree) if isinstance(node, ast.Name) and id(node) not in calls)


@functools.lru_cache(maxsize=256)
def parse(expression: str) -> ast.expr:
    """Give the tree of an allowed expression; it is shared, so nobody may change it.

    Raises:
        ValueError: the expression is not allowed.
    """
    if len(expression) > MAX_LENGTH:
        raise ValueError(f"expression longer than {MAX_LENGTH} characters")
    if not expression.isascii():  # Python replaces look-alike letters; here a name is what it looks like
        raise ValueError(f"{expression!r}: letters without accents, digits and signs only")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", SyntaxWarning)  # odd literals are refused below, with our own message
            tree = ast.parse(expression.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as e:
        raise ValueError(f"{expression!r} is no expression: {getattr(e, 'msg', e)}") from e
    _check(tree, 0)
    return tree


def _check(node: ast.expr, depth: int) -> None:
    """Refuse every node that is not on the list of allowed ones."""
    if depth > MAX_DEPTH:
        raise ValueError(f"expression nested deeper than {MAX_DEPTH}")
    match node:
        case ast.Constant(value=bool()):
            raise ValueError("True and False are no numbers here")
        case ast.Constant(value=int() | float() as value):
            if not abs(value) <= MAX_NUMBER:
                raise ValueError(f"a number above {MAX_NUMBER:g}")
        case ast.Name():
            return
        case ast.UnaryOp(op=ast.USub() | ast.UAdd(), operand=operand):
            _check(operand, depth + 1)
        case ast.BinOp(left=left, op=op, right=right) if type(op) in OPERATORS:
            _check(left, depth + 1)
            _check(right, depth + 1)
        case ast.Call(func=ast.Name(id=name)):
            _check_call(name, node)
            for arg in node.args:
                _check(arg, depth + 1)
        case ast.BinOp(op=ast.BitXor()):
            raise ValueError("^ is no power here; write ** for it: x**2")
        case _:
            raise ValueError(f"{type(node).__name__} is not allowed; use numbers, names, + - * / ** and functions")


def _check_call(name: str, call: ast.Call) -> None:
    if name not in FUNCTIONS and name != "lag":
        raise ValueError(f"function {name!r} is not allowed{nearest(name, [*FUNCTIONS, 'lag'])}")
    if call.keywords:
        raise ValueError(f"{name} takes arguments without names")
    count = 2 if name == "lag" else FUNCTIONS[name][0]
    if len(call.args) != count:
        raise ValueError(f"{name} takes {counted(count, 'argument')}, not {len(call.args)}")


def evaluate(node: ast.expr, names: Mapping[str, Value], channels: Channels) -> Value:
    """Give the value of a tree from `parse`; `channels` does the lags."""
    match node:
        case ast.Constant(value=value):
            return float(value)  # type: ignore[arg-type]
        case ast.Name(id=name):
            return names[name]
        case ast.UnaryOp(op=op, operand=operand):
            inner = evaluate(operand, names, channels)
            return -inner if isinstance(op, ast.USub) else inner
        case ast.BinOp(left=left, op=operator, right=right):
            return OPERATORS[type(operator)](evaluate(left, names, channels), evaluate(right, names, channels))
        case ast.Call(func=ast.Name(id="lag"), args=[value, tau]):
            return channels.lagged(evaluate(value, names, channels), evaluate(tau, names, channels))
        case ast.Call(func=ast.Name(id=name), args=args):
            return FUNCTIONS[name][1](*(evaluate(arg, names, channels) for arg in args))
        case _:
            raise ValueError(f"{type(node).__name__} is not allowed")


def degree(node: ast.expr, linear: set[str]) -> int:
    """0 for a part without coefficients, 1 for one that is linear in them without a constant term.

    The tree decides, not trial values: these could miss a kink, and a fit would then assume a straight line.

    Raises:
        ValueError: neither holds.
    """
    match node:
        case ast.Constant():
            return 0
        case ast.Name(id=name):
            return int(name in linear)
        case ast.UnaryOp(operand=operand):
            return degree(operand, linear)
        case ast.BinOp(left=left, op=op, right=right):
            return _degree_of_two(op, degree(left, linear), degree(right, linear))
        case ast.Call(func=ast.Name(id="lag"), args=[value, tau]) if degree(tau, linear) == 0:
            return degree(value, linear)
        case ast.Call(func=ast.Name(id=name), args=args):
            if any(degree(arg, linear) for arg in args):
                raise ValueError(f"a coefficient stands inside {name}()")
            return 0
        case _:
            raise ValueError(f"{type(node).__name__} is not allowed")


def _degree_of_two(op: ast.operator, left: int, right: int) -> int:
    match op:
        case ast.Add() | ast.Sub():
            if left != right:
                raise ValueError("a part without a coefficient is added to one with a coefficient")
            return left
        case ast.Mult() if left + right <= 1:
            return left + right
        case ast.Div() if right == 0:
            return left
        case ast.Pow() if left + right == 0:
            return 0
        case _:
            raise ValueError("coefficients are multiplied, divided by, or raised to a power")


NOT_LINEAR = 2
"""What `power_of` gives for a name that the expression is not linear in."""


def power_of(node: ast.expr, name: str) -> int:
    """0: the name is absent; 1: the expression is linear in it, with or without other terms; 2: it is not linear."""
    match node:
        case ast.Name(id=found):
            return int(found == name)
        case ast.UnaryOp(operand=operand):
            return power_of(operand, name)
        case ast.BinOp(left=left, op=op, right=right):
            return _of_two(op, power_of(left, name), power_of(right, name))
        case ast.Call(func=ast.Name(id="lag"), args=[value, tau]) if power_of(tau, name) == 0:
            return power_of(value, name)
        case ast.Call(args=args):
            return NOT_LINEAR if any(power_of(arg, name) for arg in args) else 0
    return 0


def _of_two(op: ast.operator, left: int, right: int) -> int:
    match op:
        case ast.Add() | ast.Sub():
            return max(left, right)
        case ast.Mult():
            return min(left + right, NOT_LINEAR)
        case ast.Div() if right == 0:
            return left
    return NOT_LINEAR if left + right else 0


def is_phase(tree: ast.expr, name: str) -> bool:
    """Whether a name occurs only as a term of the angle of sines and cosines."""
    return _count(tree, name) == sum(_split(angle, name) is not None for angle in _angles(tree))


def as_sine_and_cosine(
    tree: ast.expr, linear: Sequence[str], phase: str, taken: set[str]
) -> tuple[ast.expr, list[str]] | None:
    """Write `A · … · sin(w ± φ)` as `… · (A_sin sin(w) + A_cos cos(w))`.

    Args:
        tree: the expression; not changed.
        linear: its coefficients.
        phase: φ, which `is_phase`.
        taken: names that the two new coefficients must not have.

    Returns:
        The new expression and its coefficients; None where A or φ occurs more than once or A is no factor of it.
    """
    if _count(tree, phase) != 1:
        return None
    tree = copy.deepcopy(tree)
    parents = {child: node for node in ast.walk(tree) for child in ast.iter_child_nodes(node)}
    call = next(c for c in _calls(tree) if _split(c.args[0], phase) is not None)
    for name in (n for n in linear if _count(tree, n) == 1):
        amplitude = next(n for n in ast.walk(tree) if isinstance(n, ast.Name) and n.id == name)
        new = [f"{name}_sin", f"{name}_cos"]
        angle = _split(call.args[0], phase)
        if angle is not None and not set(new) & taken and _factor_of(tree, amplitude) is _factor_of(tree, call):
            root = _replaced(tree, parents, call, _pair(new, angle))
            parents = {child: node for node in ast.walk(root) for child in ast.iter_child_nodes(node)}
            at = linear.index(name)
            return _without(root, parents, amplitude), [*linear[:at], *new, *linear[at + 1 :]]
    return None


def _calls(tree: ast.expr) -> list[ast.Call]:
    return [
        n
        for n in ast.walk(tree)
        if isinstance(n, ast.Call) and isinstance(n.func, ast.Name) and n.func.id in ("sin", "cos")
    ]


def _angles(tree: ast.expr) -> list[ast.expr]:
    return [call.args[0] for call in _calls(tree)]


def _count(tree: ast.expr, name: str) -> int:
    return sum(isinstance(n, ast.Name) and n.id == name for n in ast.walk(tree))


def _split(angle: ast.expr, name: str) -> ast.expr | None:
    """The angle without the phase that is added to it; None where the phase is not a term, or is the whole angle."""
    match angle:
        case ast.BinOp(left=left, op=ast.Add(), right=ast.Name(id=found)) if found == name:
            return None if _count(left, name) else left
        case ast.BinOp(left=left, op=ast.Sub(), right=ast.Name(id=found)) if found == name:
            return None if _count(left, name) else left
        case ast.BinOp(left=ast.Name(id=found), op=ast.Add(), right=right) if found == name:
            return None if _count(right, name) else right
        case ast.BinOp(left=left, op=ast.Add() | ast.Sub() as op, right=right) if not _count(right, name):
            rest = _split(left, name)
            return None if rest is None else ast.BinOp(rest, op, right)
    return None


def _factor_of(tree: ast.expr, factor: ast.AST) -> ast.expr | None:
    """The largest product that has a node as a factor; signs, and divisions of the product, are part of it."""
    parents = {child: node for node in ast.walk(tree) for child in ast.iter_child_nodes(node)}
    node, product_of = factor, None
    while node in parents:
        above = parents[node]
        product = isinstance(above, ast.BinOp) and isinstance(above.op, ast.Mult)
        divided = isinstance(above, ast.BinOp) and isinstance(above.op, ast.Div) and above.left is node
        if not (product or divided or isinstance(above, ast.UnaryOp)):
            break
        node = above
        product_of = node
    return product_of if isinstance(product_of, ast.expr) else None


def _pair(names: Sequence[str], angle: ast.expr) -> ast.expr:
    """`A_sin * sin(angle) + A_cos * cos(angle)`."""
    sine, cosine = (
        ast.BinOp(ast.Name(name), ast.Mult(), ast.Call(ast.Name(function), [copy.deepcopy(angle)], []))
        for name, function in zip(names, ("sin", "cos"), strict=True)
    )
    return ast.BinOp(sine, ast.Add(), cosine)


def _without(tree: ast.expr, parents: dict[ast.AST, ast.AST], factor: ast.AST) -> ast.expr:
    """The expression without one factor: a product becomes its other side, else the factor becomes 1."""
    above = parents.get(factor)
    if isinstance(above, ast.BinOp) and isinstance(above.op, ast.Mult):
        return _replaced(tree, parents, above, above.right if above.left is factor else above.left)
    return _replaced(tree, parents, factor, ast.Constant(1.0))


def _replaced(tree: ast.expr, parents: dict[ast.AST, ast.AST], old: ast.AST, new: ast.expr) -> ast.expr:
    above = parents.get(old)
    if above is None:
        return new
    for field, value in ast.iter_fields(above):
        if value is old:
            setattr(above, field, new)
        elif isinstance(value, list) and old in value:
            value[value.index(old)] = new
    return tree


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
    """Walks an expression once and notes which units are equal."""

    def __init__(self, names: Mapping[str, Dimension]) -> None:
        self.names = names
        self.noted: list[Dimension] = []

    def equal(self, left: Dimension | None, right: Dimension | None) -> None:
        """Note that two units are equal; a bare number (None) sets no condition."""
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
        """Add the units that follow from the known ones; equations that contradict each other add none."""
        progress = True
        while progress:
            progress = False
            for equation in self.noted:
                rest = _inserted(equation, known)
                unknown = [key for key in rest if key.startswith("?")]
                if len(unknown) == 1:
                    power = rest.pop(unknown[0])
                    known[unknown[0]] = {base: -p / power for base, p in rest.items()}
                    progress = True

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
