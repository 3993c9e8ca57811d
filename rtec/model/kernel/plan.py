"""What the kernel has to compute, and when: sorts a model's arithmetic into slow and fast.

Slow is what depends on temperatures, spindle speed, load, force and parameters only: worked out anew when a sensor
has a new reading. Fast is what depends on the motion of an axis: worked out every cycle. Each term `coefficient ·
basis` is split into a slow and a fast factor, and all terms of a component with the same fast factor become one:

    component = Σ_F (Σ coefficient · slow) · F        F: product of fast nodes, 1 for none

so 200 fitted terms cost a few dozen multiplications a cycle.
"""

from dataclasses import dataclass, field

from rtec.errors import ModelError
from rtec.machine import Machine
from rtec.model.kernel.trace import Graph, Node, Symbol, SymbolicChannels
from rtec.model.model import FittedEffect, Model, names_of
from rtec.tomlfile import nearest

Product = tuple[int, ...]


@dataclass
class Plan:
    """The sorted arithmetic of one model.

    Attributes:
        graph: all nodes.
        fast: whether a node depends on the motion of an axis.
        terms: (component, fast factors) to the slow terms that multiply them: (parameter, slow factors).
        lags: nodes that are first-order lags, each after those that it needs.
        used: nodes that are needed, sorted.
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
        seen: set[int] = set()
        stack = list(self.roots)
        while stack:
            n = stack.pop()
            if n not in seen:
                seen.add(n)
                stack += self.graph.nodes[n].args
        return sorted(seen)

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


def plan_model(model: Model) -> Plan:
    """Trace every effect of a model and sort its terms.

    Raises:
        ModelError: an effect uses arithmetic that the kernel does not know, a channel that the machine has not got,
            or one that it does not list among its channels.
    """
    graph = Graph()
    plan = Plan(model.machine, graph)
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
    """Refuse an effect that reads what the machine has not, or what it does not tell: it would read zeros there."""
    where = f"{fitted.effect.effect}({fitted.effect.component})"
    for name in sorted(read):
        if name not in machine.channel_names:
            raise ModelError(
                f"{where}: channel {name!r} is none of machine {machine.name!r}{nearest(name, machine.channel_names)}"
            )
        if name not in fitted.effect.channels(machine):
            raise ModelError(f"{where}: its basis reads channel {name!r}, which its channels() does not list")


def _factors(plan: Plan, number: int) -> list[int]:
    """Factors whose product is the node; constants of one are left out."""
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


def _classify(plan: Plan) -> None:
    """Say for every node not yet looked at whether it is fast."""
    moving = set(plan.machine.moving_channels)
    for node in plan.graph.nodes[len(plan.fast) :]:
        fast = node.key in moving if node.op == "input" else any(plan.fast[a] for a in node.args)
        if node.op == "lag" and fast:
            raise ModelError(
                "a lag of a position or direction: the loop keeps lags of temperatures and spindle speed only, of "
                "nothing that an axis' motion changes"
            )
        plan.fast.append(fast)
