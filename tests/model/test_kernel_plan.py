"""The kernel's plan: what is slow never depends on position, equal fast factors are one, and the text is harmless."""

import io
import math
import re
import tokenize
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtec import jit
from rtec.effects import effect_class
from rtec.effects.derived import lag_update
from rtec.errors import ModelError
from rtec.machine import Machine, machine_from
from rtec.model import FittedEffect, Model
from rtec.model.kernel.build import LARGEST, sin_cos
from rtec.model.kernel.trace import Graph, KernelPlan, SymbolicChannels, plan_model
from rtec.model.kernel.write import write_kernel
from rtec.model.model import names_of
from tests.support.effect_examples import EXAMPLES, MACHINE, everything, states

MOVING = {prefix + axis for prefix in ("", "d_", "v_", "a_", "s_") for axis in "xz"}


def fitted(machine: Machine, effect: str, component: str, **arguments: Any) -> FittedEffect:
    e = effect_class(effect, "t").model_validate({"effect": effect, "component": component, **arguments})
    linear, free = names_of(e, machine)
    rng = np.random.default_rng(len(component) + len(arguments))
    theta = {p.name: p.start for p in e.nonlinear(machine)}
    assert set(free) == set(theta)
    return FittedEffect(e, {n: float(v) for n, v in zip(linear, rng.normal(0, 1, len(linear)), strict=True)}, theta)


def model_of_200_terms() -> Model:
    """Geometry that shares its polynomials, and every component drifting with every sensor, lagged and not."""
    effects = []
    for axis in "XZ":
        for letter in "XYZABC":
            component = f"E{letter}{axis}"
            effects.append(fitted(MACHINE, "polynomial_position", component, axis=axis, degrees=[1, 2]))
            for sensor in MACHINE.sensor_names:
                effects.append(fitted(MACHINE, "axis_expansion", component, axis=axis, sensor=sensor))
                effects.append(fitted(MACHINE, "axis_expansion", component, axis=axis, sensor=sensor, lag=True))
                effects.append(fitted(MACHINE, "axis_expansion_nonuniform", component, axis=axis, sensor=sensor))
                effects.append(fitted(MACHINE, "mount_expansion", component, sensor=sensor))
    return Model(MACHINE, tuple(effects))


def depends_on(plan: KernelPlan, number: int) -> set[str]:
    """Channels that a node needs, by walking the graph."""
    node = plan.graph.nodes[number]
    if node.op == "input":
        return {str(node.key)}
    return set().union(*(depends_on(plan, a) for a in node.args))


@pytest.mark.parametrize("model", [everything(), model_of_200_terms()], ids=["everything", "200 terms"])
def test_slow_never_depends_on_position(model: Model) -> None:
    """Oracle: the channels below each node, collected by a walk of its own."""
    plan = plan_model(model)
    assert len(plan.fast) >= len(plan.used)
    for number in plan.used:
        assert plan.fast[number] == bool(depends_on(plan, number) & MOVING)
    for (_, quick), terms in plan.terms.items():
        assert all(depends_on(plan, n) & MOVING for n in quick)
        assert all(not depends_on(plan, n) & MOVING for _, slow in terms for n in slow)
    assert all(not depends_on(plan, n) & MOVING for n in (*plan.lags, *plan.kept))
    for number, node in enumerate(plan.graph.nodes):
        assert all(a < number for a in node.args), "each node comes after what it needs"


def test_slow_text_reads_no_position_and_fast_text_no_temperature() -> None:
    slow, fast = write_kernel(everything()).text.split("\n\n\n")
    assert re.search(r"\bu\[", slow)
    assert not re.search(r"\b[qd]\[", slow)
    assert re.search(r"\bq\[", fast)
    assert not re.search(r"\b[up]\[", fast)


def test_terms_with_the_same_fast_factor_are_one() -> None:
    """k1 x T1 + k2 x T2 + k3 x on one component: one product with x. Oracle: counted by hand."""
    effects = [fitted(MACHINE, "axis_expansion", "EXX", axis="X", sensor=s, lag=True) for s in ("T_bed", "T_air")]
    effects.append(fitted(MACHINE, "scale", "EXX", axis="X"))
    effects.append(fitted(MACHINE, "mount_expansion", "EXX", sensor="T_bed"))
    effects.append(fitted(MACHINE, "scale", "EZZ", axis="X"))
    plan = plan_model(Model(MACHINE, tuple(effects)))
    counts = {key: len(terms) for key, terms in plan.terms.items()}
    assert sorted((c, len(quick), n) for (c, quick), n in counts.items()) == [
        ("EXX", 0, 1),
        ("EXX", 1, 3),
        ("EZZ", 1, 1),
    ]
    assert len(plan.lags) == 2
    parameters = [p for terms in plan.terms.values() for p, _ in terms]
    assert sorted(parameters) == [0, 2, 4, 5, 6], "coefficients, with the two time constants between them"


def test_a_product_is_the_same_in_any_order() -> None:
    """The second text meets sin(x) before its own product, the first after it; both are cos(z)·sin(x)."""
    effects = tuple(
        fitted(MACHINE, "expression", "EXX", expression=f"k*({sensor}*cos(z))*sin(x)", linear={"k": "um"})
        for sensor in ("T_bed", "T_air")
    )
    ((_, quick),) = plan_model(Model(MACHINE, effects)).terms
    assert len(quick) == 2


def multiplications(text: str) -> int:
    return len(re.findall(r"(?<!\*)\*(?!\*)", text))


def test_200_terms_cost_few_multiplications_a_cycle() -> None:
    """Oracle: counted in the source. Without the plan there would be one or more for each term, each cycle."""
    model = model_of_200_terms()
    terms = sum(len(f.values) for f in model.effects)
    assert terms >= 200
    fast = write_kernel(model).text.split("\n\n\n")[1]
    body, chain = fast.split("    ex = ")
    assert multiplications(body) <= terms // 3
    assert multiplications(chain) <= 2 * 3 * 12, "lever arms: 12 components, at most two axes each"
    # Terms that differ in temperature only make the slow part longer: 1, u, P2, q and u² are left for the fast part.
    assert len(plan_model(model).terms) == 12 * 5


def test_what_is_shared_is_computed_once() -> None:
    """The polynomials of six components of an axis are the same nodes."""
    one = plan_model(Model(MACHINE, (fitted(MACHINE, "polynomial_position", "EXX", axis="X", degrees=[1, 2, 3, 4]),)))
    six = plan_model(
        Model(MACHINE, tuple(fitted(MACHINE, "polynomial_position", f"E{k}X", axis="X", degrees=[1, 2, 3, 4]) for k in "XYZABC"))  # noqa: E501
    )  # fmt: skip
    assert [n for n in six.used if six.fast[n]] == [n for n in one.used if one.fast[n]]


def test_every_parameter_stands_at_the_place_where_the_array_has_it() -> None:
    """Oracle: `parameter_values`, read back through the plan: each coefficient once, each time constant somewhere."""
    model = everything()
    plan, values = plan_model(model), model.parameter_values()
    found = {p: values[p] for terms in plan.terms.values() for p, _ in terms}
    free = {int(n.key or 0): values[int(n.key or 0)] for n in plan.graph.nodes if n.op == "param"}
    assert not set(found) & set(free)
    assert sorted(found.values()) == sorted(v for f in model.effects for v in f.values.values())
    assert sorted(free.values()) == sorted(v for f in model.effects for v in f.theta.values())


# What the kernel's text may be made of: nothing that a file's text could bring in.
NAME = re.compile(
    r"def|return|if|else|njit|error_model|slow_part|fast_part|first|lag_update|dt_s|math|abs|min|max|sin|cos|exp|log|sqrt|"
    r"tanh|pass|sin_cos|[mpuqd]|vel|acc|since|e[xyz]|([vcf]|sin|cos)\d+"
)
SIGNS = set("()[]=+-*/,.:@") | {"**"}


def foreign_tokens(text: str) -> list[str]:
    """Tokens that are not on the list."""
    out = []
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.NAME:
            good = NAME.fullmatch(token.string) is not None
        elif token.type == tokenize.OP:
            good = token.string in SIGNS
        elif token.type == tokenize.NUMBER:
            good = math.isfinite(float(token.string))
        elif token.type == tokenize.STRING:
            good = token.string == '"numpy"'
        else:
            good = token.type in (tokenize.NEWLINE, tokenize.NL, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)
        if not good:
            out.append(token.string)
    return out


def hostile_machine() -> Machine:
    """Names that are Python's own words, or the kernel's."""
    return machine_from(
        {
            "machine": {"name": "'); import os #", "tool_chain": ["exec", "M", "eval"], "work_chain": ["class", "q"]},
            "axis": {
                "exec": {"direction": "X", "travel_mm": [0.0, 1e3], "counts_per_mm": 1000, "pitch_mm": 1e-6},
                "M": {"direction": "Z", "travel_mm": [-1e5, 1e5], "counts_per_mm": 1000},
            },
            "link": {"eval": {"offset_mm": [-1e-300, 1e5, -0.0]}},
            "temperature": {"import": {}, "os": {}, "njit": {}, "lambda_": {}},
        },
        "hostile",
    )  # fmt: skip


def hostile_model() -> Model:
    m = hostile_machine()
    linear = {"__import__": "um", "exec_": "'); import os"}
    free = {"eval": {"start": -1e-300, "low": -1.0, "high": 1.0, "unit": "__import__('os')"}}
    text = "__import__*exec*os - exec_*lag(njit, 1e300)*sin(-eval/1e-300*d_m)"
    return Model(
        m,
        (
            fitted(m, "expression", "EXM", expression=text, linear=linear, free=free),
            fitted(m, "column_tilt", "EB0eval", front="os", back="lambda_"),
            fitted(m, "mount_expansion", "EZ0class", sensor="os", lag=True),
            fitted(m, "backlash_position", "ECexec", axis="exec"),
            fitted(m, "spindle_growth", "EY0q"),
        ),
        name="'''); __import__('os')",
    )


@pytest.mark.parametrize("model", [everything(), model_of_200_terms(), hostile_model()], ids=["all", "200", "hostile"])
def test_the_text_is_made_of_listed_tokens_only(model: Model) -> None:
    """Oracle: Python's tokenizer; names by pattern, numbers finite."""
    model.check()
    assert foreign_tokens(write_kernel(model).text) == []


def test_the_list_of_tokens_is_no_sieve() -> None:
    for text in (
        "import os",
        "v1 = __import__",
        "v1 = 'a'",
        "v1 = inf",
        "x = 1",
        "v1 = q.real",
        "v1 = 1 ; pass",
        "# a",
    ):
        assert foreign_tokens(text), text


def test_axes_and_sensors_are_found_by_their_place() -> None:
    """Oracle: numpy's `Model.predict` on the hostile machine, and the same model's kernel run as Python."""
    model = hostile_model()
    n = 4
    channels = {"exec": np.linspace(0.0, 9.0, n), "m": np.linspace(5.0, 1.0, n), "spindle_rpm": np.full(n, 900.0)}
    channels |= {name: np.linspace(20.0, 20.0 + i, n) for i, name in enumerate(model.machine.sensor_names)}
    s = model.state(np.arange(0.0, 10.0 * n, 10.0), channels)
    memory, parameters, source = np.zeros(99), model.parameter_values(), write_kernel(model)
    module = run_plain(source.text)
    for i in range(n):
        slow = np.array([*(s.value(name)[i] for name in model.machine.sensor_names), 900.0])
        module.slow_part(memory, parameters, slow, 10.0, i == 0)
        q, d = s.positions_mm()[i], np.array([s.value("d_exec")[i], s.value("d_m")[i]])
        out = module.fast_part(memory, q, d)
        columns = [model.machine.components.index(c) for c in source.components]
        np.testing.assert_allclose(out[3:], model.components(s)[i, columns], rtol=1e-9)
        np.testing.assert_allclose(out[:3], model.predict(s)[i], rtol=1e-9)
    assert source.memory <= 99
    assert source.sensors == (1, 2, 3)
    assert source.uses_spindle


def run_plain(text: str) -> ModuleType:
    module = ModuleType("plain")
    plain = {f.__name__: jit.as_written(f) for f in (lag_update, sin_cos)}
    module.__dict__.update(plain, math=math, njit=lambda **_: lambda f: f)
    exec(compile(text, "plain", "exec"), module.__dict__)  # noqa: S102 - the source under test
    return module


def test_division_by_zero_in_the_compiled_kernel_is_inf() -> None:
    """As numpy has it; an exception would end the loop, an inf makes the guard hold. Oracle: IEEE 754."""
    if not jit.HAVE_NUMBA:
        pytest.skip("numba is not installed")
    model = Model(
        MACHINE,
        (
            fitted(MACHINE, "expression", "EXX", expression="k/x", linear={"k": "um"}),
            fitted(MACHINE, "expression", "EYX", expression="k*log(x)", linear={"k": "um"}),
        ),
    )
    module = ModuleType("kernel")
    text = write_kernel(model).text.replace("@njit(", "@njit(cache=False, ")
    module.__dict__.update(math=math, njit=jit.njit)
    exec(compile(text, "kernel", "exec"), module.__dict__)  # noqa: S102 - the source under test
    memory = np.zeros(9)
    module.slow_part(memory, np.array([-2.0, 1.0]), np.zeros(5), 0.0, True)
    assert module.fast_part(memory, np.zeros(2), np.zeros(2))[:2] == (-math.inf, -math.inf)
    negative = module.fast_part(memory, np.array([-1.0, 0.0]), np.zeros(2))
    assert negative[0] == 2.0
    assert math.isnan(negative[1])


def test_what_the_loop_cannot_give_is_refused() -> None:
    def model(expression: str) -> Model:
        return Model(MACHINE, (fitted(MACHINE, "expression", "EXX", expression=expression, linear={"k": "um"}),))

    with pytest.raises(ModelError, match="a lag of a position or direction: the loop keeps lags of temperatures"):
        plan_model(model("k*lag(x, 5)"))
    with pytest.raises(ModelError, match="a lag of a position or direction"):
        plan_model(model("k*lag(T_bed*d_z, 5)"))
    plan_model(model("k*lag(T_bed*lag(T_air, 3), 5)*x"))


class TestSymbols:
    """The tracer."""

    def symbols(self) -> tuple[Graph, Any, Any]:
        graph = Graph()
        channels = SymbolicChannels(graph, 20.0)
        return graph, channels.value("x"), channels.value("z")

    def test_equal_arithmetic_is_one_node(self) -> None:
        graph, x, z = self.symbols()
        assert (x * z).number == (z * x).number
        assert (x + z).number == (z + x).number
        assert (x - z).number != (z - x).number
        assert (x**2).number == (x * x).number
        before = len(graph.nodes)
        assert np.sin(x * z).number == np.sin(z * x).number
        assert len(graph.nodes) == before + 1

    def test_what_changes_nothing_vanishes(self) -> None:
        _, x, _ = self.symbols()
        for same in (x + 0, 0 + x, x - 0, 1 * x, x * 1.0, x / 1, x**1, +x, np.float64(1.0) * x):
            assert same.number == x.number
        assert (x * 0).constant == 0.0
        assert (0 * x).constant == 0.0
        assert (0 - x).constant is None
        assert (2 - x).number != (x - 2).number
        assert (2**x).number != (x**2).number

    def test_arithmetic_that_the_kernel_has_not_is_refused(self) -> None:
        _, x, _ = self.symbols()
        with pytest.raises(ModelError, match=r"an effect used np.arctan; the compiled kernel knows np.add"):
            np.arctan(x)
        with pytest.raises(ModelError, match="write it without `if`"):
            bool(x)
        with pytest.raises(ModelError, match="needs plain arithmetic"):
            float(x)
        with pytest.raises(ModelError, match="not a finite number"):
            x + math.inf
        with pytest.raises(ModelError, match=r"math domain error|positive"):
            np.log(x * 0)


OPERATIONS = st.lists(st.tuples(st.sampled_from("+-*/m^nasc"), st.integers(0, 30), st.integers(0, 30)), min_size=1, max_size=25)  # fmt: skip  # noqa: E501


@settings(max_examples=100, deadline=None)
@given(OPERATIONS, st.sampled_from([-1.0, 0.0, 0.5, 1.0, 2.0]))
def test_any_arithmetic_traced_and_planned_is_that_arithmetic(program: list[tuple[str, int, int]], number: float) -> None:  # fmt: skip  # noqa: E501
    """Random straight-line programs through the tracer, the plan and the writer. Oracle: numpy on the same program."""
    text = ["x", "z", "T_bed", "d_x", "spindle_rpm", repr(number)]
    for op, i, j in program:
        a, b = text[i % len(text)], text[j % len(text)]
        made = {"m": f"min({a}, {b})", "^": f"({a})**2", "n": f"-({a})", "a": f"abs({a})", "s": f"sin({a})", "c": f"cos({a})"}  # fmt: skip  # noqa: E501
        new = made.get(op, f"({a} {op} (2 + sin({b})))" if op == "/" else f"({a} {op} {b})")
        if len(new) < 400:
            text.append(new)
    expression = f"k*({text[-1]})"
    model = Model(MACHINE, (fitted(MACHINE, "expression", "EXX", expression=expression, linear={"k": "um"}),))
    s = states(5)
    kernel = run_plain(write_kernel(model).text)
    with np.errstate(all="ignore"):
        wanted = model.predict(s)[:, 0]
        memory = np.zeros(99)
        for i in range(5):
            slow = np.array([*(s.value(name)[i] for name in MACHINE.sensor_names), s.value("spindle_rpm")[i]])
            kernel.slow_part(memory, model.parameter_values(), slow, 45.0, i == 0)
            got = kernel.fast_part(memory, s.positions_mm()[i], np.array([s.value("d_x")[i], s.value("d_z")[i]]))
            if abs(wanted[i]) < 1e12:
                assert got[0] == pytest.approx(wanted[i], rel=1e-6, abs=1e-6)


@settings(max_examples=300, deadline=None)
@given(st.floats(-2 * LARGEST, 2 * LARGEST) | st.integers(-1_000_000, 1_000_000).map(lambda k: k * math.pi / 4))
def test_sine_and_cosine_of_the_kernel(angle: float) -> None:
    """Oracle: the C library's, to 2e-16 absolute (an ulp of 1); compiled and as written the same to the bit."""
    sine, cosine = sin_cos(angle)
    assert abs(sine - math.sin(angle)) <= 2.3e-16
    assert abs(cosine - math.cos(angle)) <= 2.3e-16
    assert jit.as_written(sin_cos)(angle) == (sine, cosine)


def test_examples_are_all_in_the_plan() -> None:
    plan = plan_model(everything())
    assert set(plan.components) == {e.arguments["component"] for e in EXAMPLES}
