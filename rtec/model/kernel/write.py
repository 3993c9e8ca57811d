"""Writes the kernel's source: two straight-line functions, `slow_part` and `fast_part`, for one model's structure.

The numbers (coefficients, time constants) are passed as an array, so that a refit needs no compilation. The text
consists of node numbers, literals and channel indices only; no text of a model file reaches it.
"""

from collections.abc import Callable
from dataclasses import dataclass

from rtec.machine import Axis, Machine
from rtec.machine.machine import CONSTANT_CHANNELS
from rtec.model.kernel.trace import KernelPlan, Product, plan_model
from rtec.model.model import Model

# Division by zero gives inf, as in numpy, and the guard holds on it; an exception would end the loop.
DECORATOR = '@njit(error_model="numpy")'
LAG_SLOTS = 2  # memory of a lag: its value, and its input at the last update
EXTRA_ARRAYS: dict[str, Callable[[Axis], str]] = {
    "vel": lambda axis: axis.velocity_channel,
    "acc": lambda axis: axis.acceleration_channel,
    "since": lambda axis: axis.since_reversal_channel,
}
"""Arrays over the axes beside position and direction: name of the array, and attribute that names an axis' channel."""


@dataclass(frozen=True)
class KernelSource:
    """Source of one model's kernel.

    Attributes:
        text: the functions
            `slow_part(m, p, u, dt_s, first)` updates memory `m` from slow inputs `u` (the machine's slow channels
            in order: temperatures °C, 1/min, kg, N; then seconds);
            `fast_part(m, q, d, …)` gives the tip error (ex, ey, ez) in µm and then the components in order.
        memory: length of `m`.
        components: names of the components that `fast_part` gives.
        sensors: indices of the sensors that the model reads.
        uses_spindle: whether it reads the spindle speed.
        constants: those of the machine's constant channels that it reads (load, force).
        arrays: what `fast_part` takes behind `m`, one array over the axes each: always `q` (positions) and `d`
            (directions), then those of `vel`, `acc` and `since` that the model reads.
        moving: indices of the axes whose velocity or acceleration it reads.
        lags: number of lags; if there are any, the slow part changes with time alone.
    """

    text: str
    memory: int
    components: tuple[str, ...]
    sensors: tuple[int, ...]
    uses_spindle: bool
    constants: tuple[str, ...]
    arrays: tuple[str, ...]
    moving: tuple[int, ...]
    lags: int


def slow_inputs(machine: Machine) -> tuple[str, ...]:
    """Names of the channels in the slow inputs `u`, in order."""
    return (*machine.slow_channels, "time_s")


def write_kernel(model: Model) -> KernelSource:
    """Write the kernel for a model."""
    plan = plan_model(model)
    writer = _Writer(plan)
    inputs = {str(n.key) for n in (plan.graph.nodes[i] for i in plan.used) if n.op == "input"}
    axes = model.machine.axes
    return KernelSource(
        text="\n".join([*writer.slow_lines(), "", "", *writer.fast_lines(), ""]),
        memory=max(1, writer.memory),
        components=tuple(plan.components),
        sensors=tuple(i for i, s in enumerate(model.machine.sensor_names) if s in inputs),
        uses_spindle="spindle_rpm" in inputs,
        constants=tuple(c for c in CONSTANT_CHANNELS if c in inputs),
        arrays=writer.arrays,
        moving=tuple(i for i, a in enumerate(axes) if inputs & {a.velocity_channel, a.acceleration_channel}),
        lags=len(plan.lags),
    )


class _Writer:
    def __init__(self, plan: KernelPlan) -> None:
        self.plan = plan
        self.nodes = plan.graph.nodes
        self.keys = sorted(plan.terms, key=lambda k: (plan.components.index(k[0]), k[1]))
        lag_slots = {n: LAG_SLOTS * i for i, n in enumerate(plan.lags)}
        start = LAG_SLOTS * len(lag_slots)
        self.lag_slot = lag_slots
        self.sum_slot = {key: start + i for i, key in enumerate(self.keys)}
        start += len(self.keys)
        self.kept_slot = {n: start + i for i, n in enumerate(plan.kept)}
        self.memory = start + len(plan.kept)
        read = {str(self.nodes[n].key) for n in plan.used if self.nodes[n].op == "input"}
        extra = [name for name, of in EXTRA_ARRAYS.items() if any(of(a) in read for a in plan.machine.axes)]
        self.arrays = ("q", "d", *extra)

    def slow_lines(self) -> list[str]:
        """Lines of `slow_part`."""
        body: list[str] = []
        for n in self.plan.used:
            if not self.plan.fast[n] and self.nodes[n].op != "const":
                body += self._lag(n) if n in self.lag_slot else self._assign(n, body)
        body += [f"m[{slot}] = v{n}" for n, slot in self.kept_slot.items()]
        for key in self.keys:
            terms = [self._product(f"p[{parameter}]", slow) for parameter, slow in self.plan.terms[key]]
            body.append(f"m[{self.sum_slot[key]}] = {' + '.join(terms)}")
        return [DECORATOR, "def slow_part(m, p, u, dt_s, first):", *_indent(body or ["pass"])]

    def fast_lines(self) -> list[str]:
        """Lines of `fast_part`."""
        body = [f"v{n} = m[{slot}]" for n, slot in self.kept_slot.items()]
        for n in self.plan.used:
            if self.plan.fast[n]:
                body += self._assign(n, body)
        products: dict[Product, str] = {}
        for i, component in enumerate(self.plan.components):
            terms = []
            for key in (k for k in self.keys if k[0] == component):
                lines, name = self._shared(key[1], products)
                body += lines
                terms.append(f"m[{self.sum_slot[key]}]" + (f" * {name}" if name else ""))
            body.append(f"c{i} = {' + '.join(terms)}")
        body += [f"e{k} = {text}" for k, text in zip("xyz", _tip(self.plan.machine, self.plan.components), strict=True)]
        gives = ["ex", "ey", "ez", *(f"c{i}" for i in range(len(self.plan.components)))]
        return [
            DECORATOR,
            f"def fast_part(m, {', '.join(self.arrays)}):",
            *_indent([*body, f"return {', '.join(gives)}"]),
        ]

    def _shared(self, factors: Product, products: dict[Product, str]) -> tuple[list[str], str]:
        """Name of a product of fast nodes, and the lines that compute it, each partial product once."""
        if len(factors) < 2:
            return [], f"v{factors[0]}" if factors else ""
        if factors in products:
            return [], products[factors]
        lines, before = self._shared(factors[:-1], products)
        name = f"f{len(products)}"
        products[factors] = name
        return [*lines, f"{name} = {before} * v{factors[-1]}"], name

    def _lag(self, n: int) -> list[str]:
        value, tau = (self._name(a) for a in self.nodes[n].args)
        slot = self.lag_slot[n]
        return [
            f"v{n} = {value} if first else lag_update(m[{slot}], m[{slot + 1}], {value}, dt_s, {tau})",
            f"m[{slot}] = v{n}",
            f"m[{slot + 1}] = {value}",
        ]

    def _assign(self, n: int, before: list[str]) -> list[str]:
        """Lines that assign a node's value; sine and cosine of one angle come from one call."""
        node = self.nodes[n]
        if node.op not in ("sin", "cos"):
            return [f"v{n} = {self._formula(n)}"]
        angle = node.args[0]
        both = f"sin{angle}, cos{angle} = sin_cos({self._name(angle)})"
        return [*([] if both in before else [both]), f"v{n} = {node.op}{angle}"]

    def _product(self, start: str, factors: Product) -> str:
        return " * ".join([start, *(self._name(n) for n in factors)])

    def _name(self, n: int) -> str:
        node = self.nodes[n]
        return f"({float(node.key or 0.0)!r})" if node.op == "const" else f"v{n}"

    def _formula(self, n: int) -> str:
        node = self.nodes[n]
        args = [self._name(a) for a in node.args]
        match node.op:
            case "input":
                return self._input(str(node.key))
            case "param":
                return f"p[{int(node.key or 0)}]"
            case "add" | "sub" | "mul" | "div" | "pow":
                sign = {"add": "+", "sub": "-", "mul": "*", "div": "/", "pow": "**"}[node.op]
                return f"{args[0]} {sign} {args[1]}"
            case "neg":
                return f"-{args[0]}"
            case "abs" | "min" | "max":
                return f"{node.op}({', '.join(args)})"
            case _:
                return f"math.{node.op}({', '.join(args)})"

    def _input(self, channel: str) -> str:
        machine = self.plan.machine
        for i, axis in enumerate(machine.axes):
            if channel == axis.channel:
                return f"q[{i}]"
            if channel == axis.direction_channel:
                return f"d[{i}]"
            for name, of in EXTRA_ARRAYS.items():
                if channel == of(axis):
                    return f"{name}[{i}]"
        return f"u[{slow_inputs(machine).index(channel)}]"


def _tip(machine: Machine, components: list[str]) -> list[str]:
    """The three components of the tip error as text: the chain with its numbers as literals."""
    out = []
    for row in machine.chain.terms:
        terms = []
        for i, component in enumerate(components):
            numbers = row[machine.components.index(component)]
            arm = [repr(float(numbers[0]))] if numbers[0] else []
            arm += [f"{float(k)!r} * q[{a}]" for a, k in enumerate(numbers[1:]) if k]
            if arm:
                terms.append(f"c{i}" if arm == ["1.0"] else f"({' + '.join(arm)}) * c{i}")
        out.append(" + ".join(terms) or "0.0")
    return out


def _indent(lines: list[str]) -> list[str]:
    return [f"    {line}" for line in lines]
