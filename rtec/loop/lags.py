"""What the lags of a model remember, by what they lag: so that another model can go on from it."""

import math
from collections.abc import Sequence
from typing import Final

from rtec.model import Model
from rtec.model.kernel.trace import Plan, plan_model
from rtec.model.kernel.write import LAG_SLOTS

MOST_APART: Final = math.log(2.0)
"""Time constants within a factor of two remember much the same."""

Lag = tuple[str, float]


def lags_of(model: Model) -> list[Lag]:
    """What each lag of a model lags, as text, and its time constant, s; in the order of the kernel's memory."""
    plan = plan_model(model)
    values = [float(v) for v in model.parameter_values()]
    out = []
    for n in plan.lags:
        value, tau = plan.graph.nodes[n].args
        node = plan.graph.nodes[tau]
        at = values[int(node.key or 0)] if node.op == "param" else float(node.key or 0.0) if node.op == "const" else 0.0
        out.append((_text(plan, value, values), at))
    return out


def slots_to_carry(old: Sequence[Lag], new: Sequence[Lag]) -> list[tuple[int, int]]:
    """Pairs (from, to) of places in the kernels' memories: of each new lag the old one of the same, nearest in time."""
    out = []
    for k, (what, tau_s) in enumerate(new):
        near = [(_apart(tau_s, other_s), i) for i, (other, other_s) in enumerate(old) if other == what]
        if near and min(near)[0] <= MOST_APART:
            source = LAG_SLOTS * min(near)[1]
            out += [(source + j, LAG_SLOTS * k + j) for j in range(LAG_SLOTS)]
    return out


def _apart(a_s: float, b_s: float) -> float:
    if a_s == b_s:
        return 0.0
    return abs(math.log(a_s / b_s)) if min(a_s, b_s) > 0.0 else math.inf


def _text(plan: Plan, n: int, values: Sequence[float]) -> str:
    node = plan.graph.nodes[n]
    if node.op == "param":
        return repr(values[int(node.key or 0)])
    if node.op in ("input", "const"):
        return str(node.key)
    return f"{node.op}({', '.join(_text(plan, a, values) for a in node.args)})"
