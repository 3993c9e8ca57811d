"""Which parameters of an expression are coefficients, which are phases; and `A sin(w + φ)` as sine and cosine."""

import ast
import copy
from collections.abc import Sequence

NOT_LINEAR = 2
"""What `power_of` gives for a name that the expression is not linear in."""


def power_of(node: ast.expr, name: str) -> int:
    """0: the name is not there; 1: straight in the name, with or without a part that has it not; 2: neither."""
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
    """Whether a name stands only as something added to the angle of sines and cosines."""
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
        The new expression and its coefficients; None where A or φ stands more than once or A is no factor of it.
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
    """What is left of an angle without the phase added to it; None where it is not added, or nothing is left."""
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


def _factor_of(tree: ast.expr, wanted: ast.AST) -> ast.expr | None:
    """The largest product that a node is a factor of, through signs and divisions of the whole."""
    parents = {child: node for node in ast.walk(tree) for child in ast.iter_child_nodes(node)}
    node, found = wanted, None
    while node in parents:
        above = parents[node]
        product = isinstance(above, ast.BinOp) and isinstance(above.op, ast.Mult)
        divided = isinstance(above, ast.BinOp) and isinstance(above.op, ast.Div) and above.left is node
        if not (product or divided or isinstance(above, ast.UnaryOp)):
            break
        node = above
        found = node
    return found if isinstance(found, ast.expr) else None


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
