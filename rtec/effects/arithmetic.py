"""Arithmetic written as text: parsed, walked, and let through only where it is on the list.

Numbers, names, `+ - * / **` and a few functions; nothing in the text is ever run as code.
"""

import ast
import math
import warnings
from collections.abc import Callable, Mapping

import numpy as np

from rtec.effects.state import Channels, Value
from rtec.tomlfile import nearest

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
    if isinstance(out, complex):  # Python's own numbers do that where numpy gives nan
        raise ValueError(f"{a:g} ** {b:g} is no real number")
    return out


OPERATORS: dict[type[ast.operator], Callable[[Value, Value], Value]] = {
    ast.Add: lambda a, b: a + b,
    ast.Sub: lambda a, b: a - b,
    ast.Mult: lambda a, b: a * b,
    ast.Div: lambda a, b: a / b,
    ast.Pow: _power,
}


def names_in(expression: str) -> set[str]:
    """Names that stand in an expression, functions left out.

    Raises:
        ValueError: the text is no expression of the allowed kind.
    """
    tree = parse(expression)
    calls = {id(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}
    return {node.id for node in ast.walk(tree) if isinstance(node, ast.Name) and id(node) not in calls}


def parse(expression: str) -> ast.expr:
    """Give the tree of an expression of the allowed kind.

    Raises:
        ValueError: it is not.
    """
    if len(expression) > MAX_LENGTH:
        raise ValueError(f"expression longer than {MAX_LENGTH} characters")
    if not expression.isascii():  # Python takes look-alike letters for others; here a name is what it looks like
        raise ValueError(f"{expression!r}: letters without accents, digits and signs only")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", SyntaxWarning)  # odd literals are refused below, in words of our own
            tree = ast.parse(expression.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as e:
        raise ValueError(f"{expression!r} is no expression: {getattr(e, 'msg', e)}") from e
    _check(tree, 0)
    return tree


def _check(node: ast.expr, depth: int) -> None:
    """Let through what is on the list, and nothing else."""
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
        case _:
            raise ValueError(f"{type(node).__name__} is not allowed; use numbers, names, + - * / ** and functions")


def _check_call(name: str, call: ast.Call) -> None:
    if name not in FUNCTIONS and name != "lag":
        raise ValueError(f"function {name!r} is not allowed{nearest(name, [*FUNCTIONS, 'lag'])}")
    if call.keywords:
        raise ValueError(f"{name} takes arguments without names")
    wanted = 2 if name == "lag" else FUNCTIONS[name][0]
    if len(call.args) != wanted:
        raise ValueError(f"{name} takes {wanted} argument{'s' if wanted > 1 else ''}, not {len(call.args)}")


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
    """0 for a part without coefficients, 1 for one that is linear in them with nothing left over.

    Read off the text, not tried out: a kink that no trial met would let a fit believe in a straight line.

    Raises:
        ValueError: neither.
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
