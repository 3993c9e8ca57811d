"""Plans what the kernel computes, and when: runs the effects' numpy arithmetic on symbols and sorts the result.

The symbols record the arithmetic done on them. Nodes are interned: the same arithmetic on the same inputs is one
node, which is how effects that share `u²` share its computation. Constants fold, `0·x`, `1·x` and `0+x` vanish.

Slow nodes depend only on temperatures, spindle speed, load, force and parameters: they are computed when a sensor has a
new reading. Fast nodes depend on the motion of an axis: they are computed every cycle. Each term `coefficient · basis`
is split into a slow and a fast factor, and all terms of a component with the same fast factor become one:

    component = Σ_F (Σ coefficient · slow) · F        F: product of fast nodes, 1 for none

so 200 fitted terms cost a few dozen multiplications a cycle.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from rtec.effects.state import Value
from rtec.errors import ModelError
from rtec.machine import Machine
from rtec.model.model import FittedEffect, Model, names_of
from rtec.tomlfile import nearest

Op = Literal[
    "const", "input", "param", "lag", "add", "sub", "mul", "div", "pow", "neg",
    "abs", "sin", "cos", "exp", "log", "sqrt", "tanh", "min", "max",
]  # fmt: skip

UFUNCS: dict[str, Op] = {
    "add": "add", "subtract": "sub", "multiply": "mul", "divide": "div", "power": "pow", "negative": "neg",
    "absolute": "abs", "sin": "sin", "cos": "cos", "exp": "exp", "log": "log", "sqrt": "sqrt", "tanh": "tanh",
    "minimum": "min", "maximum": "max",
}  # fmt: skip

FOLD: dict[Op, Callable[..., float]] = {
    "add": lambda a, b: a + b, "sub": lambda a, b: a - b, "mul": lambda a, b: a * b, "div": lambda a, b: a / b,
    "pow": lambda a, b: a**b, "neg": lambda a: -a, "abs": abs, "sin": math.sin, "cos": math.cos, "exp": math.exp,
    "log": math.log, "sqrt": math.sqrt, "tanh": math.tanh, "min": min, "max": max,
}  # fmt: skip


SHORT: dict[str, Callable[["Symbol"], "Symbol"]] = {
    "square": lambda x: x * x, "reciprocal": lambda x: 1.0 / x, "positive": lambda x: x,
}  # fmt: skip
"""Functions that numpy takes for a power of an array, too: `x**2` is `np.square(x)`."""


@dataclass(frozen=True)
class Node:
    """One step of arithmetic: `args` are node numbers, `key` the constant, or the name of input or parameter."""

    op: Op
    args: tuple[int, ...] = ()
    key: float | str | int | None = None


@dataclass
class Graph:
    """All nodes; each comes after its arguments."""

    nodes: list[Node] = field(default_factory=list)
    index: dict[Node, int] = field(default_factory=dict)

    def add(self, node: Node) -> "Symbol":
        """The symbol of a node; equal nodes have one symbol."""
        if node not in self.index:
            self.index[node] = len(self.nodes)
            self.nodes.append(node)
        return Symbol(self, self.index[node])

    def constant(self, value: float) -> "Symbol":
        """The symbol of a constant; ModelError where it is not finite, as the kernel's text cannot write that."""
        if not math.isfinite(value):
            raise ModelError(f"the arithmetic of an effect gives {value}, not a finite number")
        return self.add(Node("const", (), float(value)))

    def symbol(self, value: Value) -> "Symbol":
        """The symbol of a number; a symbol is returned as it is."""
        return value if isinstance(value, Symbol) else self.constant(value)

    def apply(self, op: Op, *values: Value) -> "Symbol":
        """The symbol of an operation, simplified where that does not change the value."""
        symbols = [self.symbol(v) for v in values]
        constants = [s.constant for s in symbols]
        if all(c is not None for c in constants):
            try:
                return self.constant(float(FOLD[op](*constants)))
            except (ValueError, OverflowError, ZeroDivisionError, TypeError) as e:
                raise ModelError(f"{op} of {constants}: {e}") from e
        simple = self._simple(op, symbols, constants)
        return self.add(Node(op, tuple(s.number for s in symbols))) if simple is None else simple

    def _simple(self, op: Op, symbols: list["Symbol"], constants: list[float | None]) -> "Symbol | None":
        match op, constants:
            case ("add", [0.0, None]) | ("mul", [1.0, None]):
                return symbols[1]
            case ("add" | "sub", [None, 0.0]) | ("mul" | "div" | "pow", [None, 1.0]):
                return symbols[0]
            case ("mul", [0.0, None] | [None, 0.0]) | ("div", [0.0, None]):
                return self.constant(0.0)
            case ("pow", [None, float() as power]) if power == int(power) and 2 <= power <= 8:
                out = symbols[0]
                for _ in range(int(power) - 1):
                    out = out * symbols[0]
                return out
            case ("add" | "mul", _):  # in one order, so that a·b and b·a are one node (the sum is the same to the bit)
                low, high = sorted(s.number for s in symbols)
                return self.add(Node(op, (low, high)))
        return None


class Symbol:
    """A value that is not known yet; records the numpy arithmetic that is done on it."""

    __array_priority__ = 1000

    def __init__(self, graph: Graph, number: int) -> None:
        self.graph = graph
        self.number = number

    @property
    def constant(self) -> float | None:
        """Its number, where it is a constant; else None."""
        node = self.graph.nodes[self.number]
        return float(node.key) if node.op == "const" and node.key is not None else None

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **kwargs: Any) -> "Symbol":
        if method == "__call__" and not kwargs and ufunc.__name__ in SHORT:
            return SHORT[ufunc.__name__](self)
        if method != "__call__" or kwargs or ufunc.__name__ not in UFUNCS:
            allowed = ", ".join(f"np.{name}" for name in (*UFUNCS, *SHORT))
            raise ModelError(f"an effect used np.{ufunc.__name__}; the compiled kernel knows {allowed}")
        return self.graph.apply(UFUNCS[ufunc.__name__], *inputs)

    def __add__(self, other: Value) -> "Symbol":
        return self.graph.apply("add", self, other)

    def __radd__(self, other: Value) -> "Symbol":
        return self.graph.apply("add", other, self)

    def __sub__(self, other: Value) -> "Symbol":
        return self.graph.apply("sub", self, other)

    def __rsub__(self, other: Value) -> "Symbol":
        return self.graph.apply("sub", other, self)

    def __mul__(self, other: Value) -> "Symbol":
        return self.graph.apply("mul", self, other)

    def __rmul__(self, other: Value) -> "Symbol":
        return self.graph.apply("mul", other, self)

    def __truediv__(self, other: Value) -> "Symbol":
        return self.graph.apply("div", self, other)

    def __rtruediv__(self, other: Value) -> "Symbol":
        return self.graph.apply("div", other, self)

    def __pow__(self, other: Value) -> "Symbol":
        return self.graph.apply("pow", self, other)

    def __rpow__(self, other: Value) -> "Symbol":
        return self.graph.apply("pow", other, self)

    def __neg__(self) -> "Symbol":
        return self.graph.apply("neg", self)

    def __pos__(self) -> "Symbol":
        return self

    def __abs__(self) -> "Symbol":
        return self.graph.apply("abs", self)

    def __bool__(self) -> bool:
        raise ModelError(
            "an effect asked whether a channel is true; write it without `if`, with np.minimum and np.maximum"
        )

    def __float__(self) -> float:
        raise ModelError("an effect asked for a channel's number; the compiled kernel needs plain arithmetic")


class SymbolicChannels:
    """Channels as symbols, for effects that are traced; records which channels they read."""

    def __init__(self, graph: Graph, reference_degc: float) -> None:
        self.graph = graph
        self.reference_degc = reference_degc
        self.read: set[str] = set()

    def value(self, name: str) -> Value:
        """The symbol of a channel."""
        self.read.add(name)
        return self.graph.add(Node("input", (), name))

    def rise(self, sensor: str) -> Value:
        """Temperature above the reference, K."""
        return self.value(sensor) - self.reference_degc

    def lagged(self, value: Value, tau_s: Value) -> Value:
        """The symbol of a first-order lag; the kernel keeps its memory."""
        args = (self.graph.symbol(value).number, self.graph.symbol(tau_s).number)
        return self.graph.add(Node("lag", args))


Product = tuple[int, ...]


@dataclass
class KernelPlan:
    """The sorted arithmetic of one model.

    Attributes:
        graph: all nodes.
        fast: whether a node depends on the motion of an axis.
        terms: (component, fast factors) to the slow terms that multiply them: (parameter, slow factors).
        lags: nodes that are first-order lags; each comes after its arguments.
        used: nodes that the terms need, sorted.
    """

    machine: Machine
    graph: Graph
    fast: list[bool] = field(default_factory=list)
    terms: dict[tuple[str, Product], list[tuple[int, Product]]] = field(default_factory=dict)

    @property
    def roots(self) -> set[int]:
        """Nodes that the terms name."""
        slow = {n for terms in self.terms.values() for _, factors in terms for n in factors}
        return slow | {n for _, factors in self.terms for n in factors}

    @property
    def used(self) -> list[int]:
        """All nodes that the roots need, in order."""
        needed: set[int] = set()
        stack = list(self.roots)
        while stack:
            n = stack.pop()
            if n not in needed:
                needed.add(n)
                stack += self.graph.nodes[n].args
        return sorted(needed)

    @property
    def lags(self) -> list[int]:
        """Used nodes that are lags."""
        return [n for n in self.used if self.graph.nodes[n].op == "lag"]

    @property
    def kept(self) -> list[int]:
        """Slow nodes, other than constants, that fast nodes need: kept in memory between slow updates."""
        needed = {a for n in self.used if self.fast[n] for a in self.graph.nodes[n].args if not self.fast[a]}
        return sorted(n for n in needed if self.graph.nodes[n].op != "const")

    @property
    def components(self) -> list[str]:
        """Components that any term feeds, in the chain's order."""
        fed = {component for component, _ in self.terms}
        return [c for c in self.machine.components if c in fed]


def plan_model(model: Model) -> KernelPlan:
    """Trace every effect of a model and sort its terms.

    Raises:
        ModelError: an effect uses arithmetic that the kernel does not know, a channel that the machine does not have,
            or one that the effect does not list among its channels.
    """
    graph = Graph()
    plan = KernelPlan(model.machine, graph)
    traced: list[tuple[str, int, Symbol]] = []
    first = 0
    for fitted in model.effects:
        linear, free = names_of(fitted.effect, model.machine)
        theta = {n: graph.add(Node("param", (), first + len(linear) + i)) for i, n in enumerate(free)}
        channels = SymbolicChannels(graph, model.reference_degc)
        basis = fitted.effect.basis(model.machine, channels, theta)
        _check_read(fitted, channels.read, model.machine)
        traced += [(fitted.effect.component, first + i, graph.symbol(value)) for i, value in enumerate(basis)]
        first += len(linear) + len(free)
    for component, parameter, symbol in traced:
        factors = _factors(plan, symbol.number)
        slow = tuple(n for n in factors if not plan.fast[n])
        quick = tuple(sorted(n for n in factors if plan.fast[n]))
        plan.terms.setdefault((component, quick), []).append((parameter, slow))
    return plan


def _check_read(fitted: FittedEffect, read: set[str], machine: Machine) -> None:
    """Refuse an effect that reads a channel which the machine lacks or the effect does not list: it would be zero."""
    where = f"{fitted.effect.effect}({fitted.effect.component})"
    for name in sorted(read):
        if name not in machine.channel_names:
            raise ModelError(
                f"{where}: channel {name!r} is none of machine {machine.name!r}{nearest(name, machine.channel_names)}"
            )
        if name not in fitted.effect.channels(machine):
            raise ModelError(f"{where}: its basis reads channel {name!r}, which its channels() does not list")


def _factors(plan: KernelPlan, number: int) -> list[int]:
    """Factors whose product is the node, without constants of one."""
    _classify(plan)
    node = plan.graph.nodes[number]
    if node.op == "mul":
        return _factors(plan, node.args[0]) + _factors(plan, node.args[1])
    if node.op == "neg":
        return [plan.graph.constant(-1.0).number, *_factors(plan, node.args[0])]
    if node.op == "const" and node.key == 1.0:
        return []
    _classify(plan)
    return [number]


def _classify(plan: KernelPlan) -> None:
    """Note for every new node whether it is fast."""
    moving = set(plan.machine.moving_channels)
    for node in plan.graph.nodes[len(plan.fast) :]:
        fast = node.key in moving if node.op == "input" else any(plan.fast[a] for a in node.args)
        if node.op == "lag" and fast:
            raise ModelError(
                "a lag of a position or direction: the loop keeps lags of temperatures and spindle speed only, of "
                "nothing that an axis' motion changes"
            )
        plan.fast.append(fast)
