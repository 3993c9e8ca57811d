"""Expressions: the whitelist against hostile texts, and the value against Python's own arithmetic."""

import contextlib
import itertools
import math
import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from rtec.effects.expression import Expression
from rtec.effects.state import State
from rtec.errors import ModelError
from rtec.model import FittedEffect, Model
from rtec.model.kernel.write import write_kernel
from tests.support.machines import turning_centre

MACHINE = turning_centre()


def expression(text: str, linear: dict[str, str] | None = None, **more: Any) -> Expression:
    data = {"effect": "expression", "component": "EXX", "expression": text, "linear": linear or {"k": "um"}}
    return Expression.model_validate({**data, **more})


def refused(text: str) -> str:
    """Message with which a text is refused, when read or when checked against a machine."""
    with pytest.raises((ModelError, ValidationError)) as caught:
        expression(text).check(MACHINE, "model")
    return str(caught.value)


HOSTILE = [
    "__import__('os').system('true')",
    "k*__import__('os')",
    "k*eval('1')",
    "k*exec('1')",
    "k*open('/etc/passwd')",
    "k*().__class__.__bases__[0].__subclasses__()",
    "k*x.real",
    "k*x.__class__",
    "(k*x).tofile('f')",
    "(lambda: k*x)()",
    "lambda k: k",
    "[k for k in x]",
    "{k for k in x}",
    "{k: x for k in x}",
    "(k for k in x)",
    "k*x[0]",
    "k*[1.0]",
    "(k, x)",
    "{k: x}",
    "{k}",
    "f'{k}'",
    "k*f'{x!r}'",
    "'k'*9999999999",
    "k*b'a'",
    "k*1j",
    "k*True",
    "k*None",
    "k*...",
    "k if x else k",
    "k and x",
    "not k",
    "k < x",
    "k == x",
    "k is x",
    "k in x",
    "k % x",
    "k // x",
    "k @ x",
    "k << 9999999999",
    "k | 1",
    "~k",
    "(k := x)",
    "k := x",
    "k = x",
    "k; x",
    "k\nimport os",
    "import os",
    "await k",
    "yield k",
    "*k",
    "sin(*k)",
    "sin(**k)",
    "k*sin(x, x)",
    "k*sin()",
    "k*sin(x=1)",
    "k*sin(x, out=x)",
    "k*max(x, x, **k)",
    "k*min(x, x, where=x)",
    "k*lag(x)",
    "k*max(x)",
    "k*sin(x)(x)",
    "k*(sin)(x)(x)",
    "k*math.sin(x)",
    "k*np.sin(x)",
    "k*print(x)",
    "k*getattr(x, 'real')",
    "k*lag.__globals__",
    "k*9**9**9",
    "k*9**9**9**9**9",
    "k*2.0**99999",
    "k*10**400",
    "k*1e999",
    "k*-1e999",
    "k*1e999/1e999",
    "k*(-8)**0.5",
    "k*abs((-8)**0.5)",
    "k*0**-1",
    "k/0",
    "k*" + "9" * 1500,
    "(" * 900 + "k" + ")" * 900,
    "-" * 1900 + "k",
    "k" + "+k" * 900,
    "k*" + "sin(" * 100 + "x" + ")" * 100,
    "k*" + "x**" * 100 + "2",
    "k" * 1_000_000,
    "(" * 1_000_000,
    "k+" * 500_000 + "k",
    "",
    "   ",
    "k*",
    "k x",
    "k\x00",
    "k*x\x00.real",
    "k # x\n+1",
    "k*\N{FULLWIDTH LATIN SMALL LETTER X}",
    "k*\N{MATHEMATICAL BOLD SMALL X}",
    "k*s\N{CYRILLIC SMALL LETTER BYELORUSSIAN-UKRAINIAN I}n(x)",
    "k*_\N{FULLWIDTH LOW LINE}import__('os')",
    "k\N{RIGHT-TO-LEFT OVERRIDE}*x",
    "k*\N{ARABIC-INDIC DIGIT NINE}",
    "k*\ud800",
    "k*unknown",
    "k*__name__",
    "k*T_spindel",
    "k*lag(x, x)",
    "k*lag(T_bed, T_air)",
]


@pytest.mark.parametrize("text", HOSTILE, ids=lambda text: ascii(text[:40]))
def test_hostile_texts_are_refused_and_never_run(text: str) -> None:
    """Oracle: an audit hook sees no import, no open file, no compiled code object, no process while it is refused."""
    with watched() as seen:
        message = refused(text)
    assert not seen
    assert len(message) < 10_000


class watched:  # noqa: N801 - reads as a word
    """Notes what the interpreter is asked to do to the outside world; one hook for all, it cannot be taken off."""

    noted: list[str] | None = None
    hooked = False

    def __enter__(self) -> list[str]:
        if not watched.hooked:
            sys.addaudithook(watched._note)
            watched.hooked = True
        watched.noted = []
        return watched.noted

    def __exit__(self, *_: object) -> None:
        watched.noted = None

    @staticmethod
    def _note(event: str, args: tuple[Any, ...]) -> None:
        # Parsing is itself announced as "compile"; running what was parsed would be "exec".
        if watched.noted is not None and event in ("import", "open", "exec", "os.system", "subprocess.Popen"):
            watched.noted.append(f"{event} {args!r}"[:100])


def test_the_watch_sees_what_it_should() -> None:
    """The oracle above is alive: running code and opening a file are noted."""
    with watched() as seen:
        eval(compile("1", "x", "eval"))  # noqa: S307
        with open(sys.executable, "rb"):  # noqa: PTH123
            pass
    assert {event.split()[0] for event in seen} == {"exec", "open"}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("k*sim(x)", "function 'sim' is not allowed; did you mean 'sin'?"),
        ("k*sin(x, x)", "sin takes 1 argument, not 2"),
        ("k*sin(x, out=x)", "sin takes arguments without names"),
        ("k*lag(x)", "lag takes 2 arguments, not 1"),
        ("k*T_spindel", "model: 'T_spindel' is neither a channel nor a parameter; did you mean 'T_spindle'?"),
        ("k*x.real", "Attribute is not allowed; use numbers, names, + - * / ** and functions"),
        ("k*(x % 2)", "BinOp is not allowed; use numbers, names"),
        ("k*1e999", "a number above 1e+300"),
        ("k*lag(T_bed, T_air)", "the time constant of lag() is a number or a parameter, not a channel"),
        ("2*x", "parameter 'k' is not in the expression"),
        ("k*x + 1", "model: not linear in k: a part without a coefficient is added to one with a coefficient"),
        ("k*k*x", "model: not linear in k: coefficients are multiplied, divided by, or raised to a power"),
        ("x*k**0", "coefficients are multiplied, divided by, or raised to a power"),
        ("x/k", "coefficients are multiplied, divided by, or raised to a power"),
        ("sin(k*x)", "a coefficient stands inside sin()"),
        ("k*x + max(k - 5, 0)", "a part without a coefficient is added to one with a coefficient"),
        ("k*x + 0*abs(k)", "a coefficient stands inside abs()"),
        ("k*sqrt(x - 1000) + k*k", "coefficients are multiplied"),
        ("lag(T_bed, k)", "a coefficient stands inside lag()"),
    ],
)
def test_messages_say_what_is_wrong(text: str, said: str) -> None:
    assert said in refused(text)


def test_names_clash() -> None:
    with pytest.raises(ValidationError, match="parameter 'k' is under both linear and free"):
        expression("k*x", free={"k": {"start": 1.0, "low": 0.0, "high": 2.0}})
    for name in ("x", "d_z", "T_bed", "spindle_rpm", "pi"):
        with pytest.raises(ModelError, match=f"model: parameter '{name}' has the name of a channel; choose another"):
            expression(f"{name}*2", {name: "um"}).check(MACHINE, "model")
    with pytest.raises(ModelError, match="'EQX' is none of machine"):
        expression("k*x", component="EXX").model_copy(update={"component": "EQX"}).check(MACHINE, "model")


@pytest.mark.parametrize(
    "free",
    [(1.0, 1.0, 1.0), (0.0, 1.0, 2.0), (3.0, 1.0, 2.0), (1.0, 2.0, 0.0)],
    ids=["no room", "below", "above", "turned"],
)
def test_bounds_of_free_parameters(free: tuple[float, float, float]) -> None:
    start, low, high = free
    with pytest.raises(ValidationError, match="need low <= start <= high and low < high"):
        expression("k*x**p", free={"p": {"start": start, "low": low, "high": high}})


def state(n: int = 7) -> State:
    rng = np.random.default_rng(1)
    channels = {name: rng.uniform(0.5, 3.0, n) for name in ("x", "z", "spindle_rpm", "T_bed", "T_air")}
    return State(
        MACHINE, np.arange(0.0, 30.0 * n, 30.0), {**channels, "d_x": np.where(rng.random(n) < 0.5, -1.0, 1.0)}, 0.25
    )


def names_at(s: State, i: int) -> dict[str, float]:
    """What Python's own arithmetic sees: temperatures above the reference, everything else as it is."""
    out = {n: float(v[i]) - (0.25 if n.startswith("T_") else 0.0) for n, v in s.channels.items()}
    functions = {"sin": math.sin, "cos": math.cos, "exp": math.exp, "log": math.log, "sqrt": math.sqrt}
    return {**out, **functions, "tanh": math.tanh, "min": min, "max": max, "abs": abs, "pi": math.pi}  # type: ignore[dict-item]


VALUES = [
    "k*x",
    "k*(x - 2.5)**2/4",
    "-k*x + +k*z",
    "k*sin(2*pi*x/3)*cos(z)",
    "k*exp(-x)*log(z)/sqrt(T_bed)",
    "k*tanh(x)*abs(d_x)*d_x",
    "k*min(x, z) - k*max(T_bed, T_air)",
    "k*x**z**0.5",
    "k*2**-x",
    "k*(T_bed - T_air)*x",
    "k/(1 + spindle_rpm)",
    "(k*x - k)*(1 + z)",
    "k*1e-3*x*1_000",
    "k",
]


@pytest.mark.parametrize("text", VALUES)
def test_value_is_pythons_own(text: str) -> None:
    """Oracle: Python evaluating the same (trusted) text, once per instant."""
    e, s = expression(text), state()
    e.check(MACHINE, "model")
    wanted = [eval(text, {"__builtins__": {}, **names_at(s, i), "k": 1.7}) for i in range(len(s))]  # noqa: S307
    model = Model(MACHINE, (FittedEffect(e, {"k": 1.7}),))
    got = Model(MACHINE, model.effects, reference_degc=0.25).effect_components(s)[0]
    np.testing.assert_allclose(got, wanted, rtol=1e-12)


LEAVES = st.one_of(st.sampled_from(["x", "z", "T_bed", "d_x", "pi"]), st.floats(0.01, 9.0).map(repr))
TREES = st.recursive(
    LEAVES,
    lambda inner: st.one_of(
        st.tuples(inner, st.sampled_from("+-*/"), inner).map(lambda t: f"({t[0]} {t[1]} {t[2]})"),
        st.tuples(st.sampled_from(["sin", "cos", "tanh", "abs", "-", "+"]), inner).map(lambda t: f"{t[0]}({t[1]})"),
        st.tuples(st.sampled_from(["min", "max"]), inner, inner).map(lambda t: f"{t[0]}({t[1]}, {t[2]})"),
    ),
    max_leaves=12,
)


def text_divides_numbers_by_zero(text: str) -> bool:
    """Whether Python stops at a division of plain numbers, whatever the channels are."""
    arrays = {n: np.full(3, 0.5) for n in ("x", "z", "T_bed", "d_x")}
    functions = {"sin": np.sin, "cos": np.cos, "tanh": np.tanh, "abs": np.abs, "min": np.minimum, "max": np.maximum}
    with np.errstate(all="ignore"):
        try:
            eval(text, {"__builtins__": {}, **arrays, **functions, "pi": math.pi})  # noqa: S307
        except ZeroDivisionError:
            return True
    return False


@settings(max_examples=150, deadline=None)
@given(TREES)
def test_value_of_any_tree_is_pythons_own(text: str) -> None:
    """Oracle: as above, on random trees; a division by zero is refused or gives no finite number."""
    s = state(3)
    e = expression(f"k*({text})")
    if text_divides_numbers_by_zero(text):
        with pytest.raises(ModelError, match="division by zero"):
            e.check(MACHINE, "model")
        return
    e.check(MACHINE, "model")
    with np.errstate(all="ignore"):
        got = np.broadcast_to(e.basis(MACHINE, s, {})[0], 3)
    for i in range(3):
        try:
            wanted = eval(text, {"__builtins__": {}, **names_at(s, i)})  # noqa: S307
        except ZeroDivisionError:
            assert not np.isfinite(got[i])
        else:
            assert got[i] == pytest.approx(wanted, rel=1e-9, abs=1e-9)


@settings(max_examples=300, deadline=None)
@given(st.text(alphabet="kxzT_bed0123456789.+-*/() ,[]{}'\"\\:=<>!@lagsin\n", max_size=40) | st.text(max_size=60))
def test_any_text_is_read_or_refused(text: str) -> None:
    """No text gives any other exception, and none runs anything (audit hook)."""
    with watched() as seen, np.errstate(all="ignore"), contextlib.suppress(ModelError, ValidationError):
        expression(text).check(MACHINE, "model")
    assert not seen


def test_lag_is_the_first_order_lag() -> None:
    """Oracle: the recurrence of derived.py, tested in test_derived.py, applied by hand here."""
    e = expression("k*x*lag(T_bed, tau)", free={"tau": {"start": 60.0, "low": 1.0, "high": 1e4, "unit": "s"}})
    e.check(MACHINE, "model")
    s = state()
    lagged, rise = [s.rise("T_bed")[0]], s.rise("T_bed")
    h, decay = 30.0 / 90.0, math.exp(-30.0 / 90.0)
    mean = (1 - decay) / h
    for before, now in itertools.pairwise(rise):
        lagged.append(lagged[-1] * decay + before * (mean - decay) + now * (1 - mean))
    np.testing.assert_allclose(e.basis(MACHINE, s, {"tau": 90.0})[0], s.value("x") * lagged, rtol=1e-12)
    assert [p.name for p in e.nonlinear(MACHINE)] == ["tau"]
    assert e.channels(MACHINE) == ("T_bed", "x")


def test_several_coefficients_each_have_their_own_basis() -> None:
    e = expression("a*x + b*z*(T_bed - T_air) - c", {"a": "um_per_mm", "b": "um", "c": "um"})
    e.check(MACHINE, "model")
    s = state()
    a, b, c = (np.broadcast_to(v, len(s)) for v in e.basis(MACHINE, s, {}))
    np.testing.assert_allclose(a, s.value("x"))
    np.testing.assert_allclose(b, s.value("z") * (s.value("T_bed") - s.value("T_air")))
    np.testing.assert_allclose(c, -1.0)
    assert [(p.name, p.unit) for p in e.coefficients(MACHINE)] == [("a", "um_per_mm"), ("b", "um"), ("c", "um")]


@pytest.mark.parametrize(
    "text", ["k*exp(1000)", "k*x*(1e200*1e200)", "k*log(-1)", "k*x**(1e200*1e200)", "k*sqrt(-1)*x"]
)
def test_a_constant_that_is_no_finite_number_never_reaches_the_kernel(text: str) -> None:
    """`inf` and `nan` have no spelling in the kernel's source."""
    model = Model(MACHINE, (FittedEffect(expression(text), {"k": 1.0}),))
    with np.errstate(all="ignore"), pytest.raises(ModelError, match=r"finite number|math|nonnegative|positive"):
        write_kernel(model)


def test_division_by_zero_is_no_finite_number() -> None:
    """Numpy's rule, for the guard to hold on: no exception."""
    model = Model(MACHINE, (FittedEffect(expression("k*x/(T_bed - T_bed)"), {"k": 1.0}),))
    with np.errstate(all="ignore"):
        assert np.all(np.isinf(model.effect_components(state())[0]))
