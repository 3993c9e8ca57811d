"""`--expr … --param …`: which effect a text becomes, its units, and what each misuse is answered with."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtec.effects import State
from rtec.effects.expression import expression_from_text
from rtec.errors import ModelError
from rtec.model import FittedEffect, Model
from rtec.tomlfile import nearest
from tests.support.machines import turning_centre, vertical_mill
from tests.support.tip_fit import fit_model

MACHINE = turning_centre()


def made(expr: str, *params: str, component: str = "EXX") -> Any:
    return expression_from_text(expr, params, component, MACHINE)


def state(n: int = 300) -> State:
    rng = np.random.default_rng(2)
    channels = {"x": rng.uniform(0, 200, n), "z": rng.uniform(0, 400, n), "d_x": rng.choice([-1.0, 1.0], n)}
    channels |= {"s_x": rng.uniform(0, 30, n), "v_x": rng.uniform(-99, 99, n), "T_bed": rng.uniform(20, 30, n)}
    return State(MACHINE, np.arange(float(n)), channels)


def test_the_example_of_the_help() -> None:
    effect = expression_from_text("A*sin(2*pi*y/p + phi)", ["p=37:3..200"], "EYY", vertical_mill())
    assert effect.expression == "A_sin * sin(2 * pi * y / p) + A_cos * cos(2 * pi * y / p)"
    assert effect.linear == {"A_sin": "um", "A_cos": "um"}
    (p,) = effect.nonlinear(vertical_mill())
    assert (p.name, p.unit, p.start, p.low, p.high) == ("p", "mm", 37.0, 3.0, 200.0)


PHASED = [
    ("A*sin(x/p + phi)", lambda c, a, f: a * np.sin(c["x"] / 20 + f)),
    ("A*sin(phi + x/p)", lambda c, a, f: a * np.sin(c["x"] / 20 + f)),
    ("A*d_x*sin(x/p + phi)/2 + B*x", lambda c, a, f: a * c["d_x"] * np.sin(c["x"] / 20 + f) / 2),
    ("-(A*exp(-s_x/9)*sin(x/p + phi + z/5))",
     lambda c, a, f: -a * np.exp(-c["s_x"] / 9) * np.sin(c["x"] / 20 + f + c["z"] / 5)),
    ("sin(x/p + phi)*(-A)*d_x", lambda c, a, f: -a * c["d_x"] * np.sin(c["x"] / 20 + f)),
]  # fmt: skip


@pytest.mark.parametrize(("text", "wanted"), PHASED, ids=[t for t, _ in PHASED])
def test_amplitude_and_phase_become_sine_and_cosine(text: str, wanted: Any) -> None:
    """Oracle: numpy's own sine with the phase, with A_sin = A cos φ and A_cos = A sin φ."""
    effect = made(text, "p=20:5..50")
    assert [n for n in effect.linear if n != "B"] == ["A_sin", "A_cos"]
    amplitude, phase, s = 2.5, 1.1, state()
    values = {"A_sin": amplitude * math.cos(phase), "A_cos": amplitude * math.sin(phase), "B": 0.0}
    fitted = FittedEffect(effect, {n: values[n] for n in effect.linear}, {"p": 20.0})
    found = Model(MACHINE, (fitted,)).effect_components(s)[0]
    np.testing.assert_allclose(found, wanted(s.channels, amplitude, phase), atol=1e-9)


def test_a_cosines_phase_as_told() -> None:
    """Oracle: A cos(x/p + φ) in numpy; `phi = atan2(-A_sin, A_cos)` of the module's text."""
    effect = made("A*cos(x/p + phi)", "p=20:5..50")
    values = {"A_sin": -2.5 * math.sin(1.1), "A_cos": 2.5 * math.cos(1.1)}
    assert math.atan2(-values["A_sin"], values["A_cos"]) == pytest.approx(1.1)
    found = Model(MACHINE, (FittedEffect(effect, values, {"p": 20.0}),)).effect_components(state())[0]
    np.testing.assert_allclose(found, 2.5 * np.cos(state().channels["x"] / 20 + 1.1), atol=1e-9)


def test_a_phase_minus_turns_the_other_way() -> None:
    """Oracle: sin(w - φ) is sin(w + φ) with the other φ; the two coefficients cover both."""
    assert made("A*sin(x/p - phi)", "p=20:5..50").expression == made("A*sin(x/p + phi)", "p=20:5..50").expression


@pytest.mark.parametrize("text", ["(A + B*T_bed)*sin(x/p + phi)", "A*sin(x/p + phi)*cos(z/p + phi)", "A*x*sin(x/p + phi) + A*z"])  # fmt: skip  # noqa: E501
def test_a_phase_that_is_no_simple_one_is_searched_for(text: str) -> None:
    effect = made(text, "p=20:5..50")
    phi = {p.name: p for p in effect.nonlinear(MACHINE)}["phi"]
    assert (phi.low, phi.high, phi.unit) == (-math.pi, math.pi, "rad")
    assert 0.0 < phi.start < math.pi


def test_a_declared_phase_stays() -> None:
    effect = made("A*sin(x/p + phi)", "p=20:5..50", "phi=0:-1..1")
    assert effect.expression == "A * sin(x / p + phi)"
    assert [p.name for p in effect.nonlinear(MACHINE)] == ["p", "phi"]


def test_the_made_effect_is_found_by_the_fit() -> None:
    """Oracle: the amplitude, phase and period that the readings were made with."""
    s = state()
    tip = np.full((300, 3), np.nan)
    noise = 0.05 * np.random.default_rng(1).standard_normal(300)
    tip[:, 0] = 1.8 * np.sin(2 * np.pi * s.channels["x"] / 37.3 + 2.9) + noise
    model = fit_model([made("A*sin(2*pi*x/p + phi)", "p=36:30..45")], s, tip)
    values, theta = model.effects[0].values, model.effects[0].theta
    assert theta["p"] == pytest.approx(37.3, abs=0.05)
    assert math.hypot(values["A_sin"], values["A_cos"]) == pytest.approx(1.8, abs=0.03)
    assert math.atan2(values["A_cos"], values["A_sin"]) == pytest.approx(2.9, abs=0.05)


UNITS = [
    ("A*x", "EXX", (), {"A": "um_per_mm"}),
    ("A*x", "EBX", (), {"A": "urad_per_mm"}),
    ("A + B*x + C*x**2", "EXX", (), {"A": "um", "B": "um_per_mm", "C": "um_per_mm2"}),
    ("A*(x - 100)*T_bed", "EXX", (), {"A": "um_per_degc_mm"}),
    ("A*v_x + B*a_x*load_kg", "EXX", (), {"A": "um_s_per_mm", "B": "um_s2_per_kg_mm"}),
    ("A*force_n/2", "EXX", (), {"A": "um_per_n"}),
    ("A*time_s*d_x", "EXX", (), {"A": "um_per_s"}),
    ("A*d_x*exp(-s_x/s0)", "EXX", ("s0=1:0.1..9",), {"A": "um", "s0": "mm"}),
    ("A*lag(T_bed, tau)*(x - x0)", "EXX", ("tau=9:1..99", "x0=0:-9..9"),
     {"A": "um_per_degc_mm", "tau": "s", "x0": "mm"}),
    ("A*(abs(v_x)/v0)**q", "EXX", ("v0=9:1..99", "q=1:0..2"), {"A": "um", "v0": "mm_per_s", "q": "1"}),
    ("A*(x/p)**2", "EXX", ("p=9:1..99",), {"A": "um", "p": "mm"}),
    ("A*sqrt(abs(spindle_rpm))", "EXX", (), {"A": "um_per_rpm0.5"}),
    ("A/x + B*x**-2", "EXX", (), {"A": "um_mm", "B": "um_mm2"}),
    ("A*max(x, x0) + B*min(1, z/w)", "EXX", ("x0=9:1..99", "w=9:1..99"),
     {"A": "um_per_mm", "x0": "mm", "B": "um", "w": "mm"}),
    ("A*tanh(T_bed/w)*log(2)", "EXX", ("w=9:1..99",), {"A": "um", "w": "degc"}),
]  # fmt: skip


@pytest.mark.parametrize(("text", "component", "params", "units"), UNITS, ids=[u[0] for u in UNITS])
def test_units_follow_from_the_channels(text: str, component: str, params: Any, units: dict[str, str]) -> None:
    """Oracle: by hand; the sum of each term's units must be that of the component."""
    effect = made(text, *params, component=component)
    parameters = (*effect.coefficients(MACHINE), *effect.nonlinear(MACHINE))
    assert {p.name: p.unit for p in parameters} == units


MISUSE = [
    ("A*x+", (), "EXX", "--expr: 'A*x+' is no expression: invalid syntax"),
    ("A*sim(x)", (), "EXX", "--expr: function 'sim' is not allowed; did you mean 'sin'?"),
    ("A*x.real", (), "EXX", "--expr: Attribute is not allowed"),
    ("A*sin", (), "EXX", "--expr: sin is a function; write sin(…)"),
    ("A*y", (), "EXX", "--expr: machine 'turning-centre' has no channel 'y'; allowed: T_air"),
    ("A*T_spindel", (), "EXX", "has no channel 'T_spindel'; did you mean 'T_spindle'?\nif it is a parameter"),
    ("A*d_y", (), "EXX", "has no channel 'd_y'; did you mean 'd_"),
    ("A*time", (), "EXX", "has no channel 'time'; did you mean 'time_s'?"),
    ("A*exp(-s_x/s0)", (), "EXX", "not linear in it; if it is a parameter, declare --param s0=start:low..high"),
    ("A*x**n", (), "EXX", "--expr: 'n' is no channel of machine 'turning-centre', and the expression is not linear"),
    ("A*sin(phi)", (), "EXX", "declare --param phi=start:low..high"),
    ("A*sin(2*(x + phi))", (), "EXX", "declare --param phi=start:low..high"),
    ("A*B*x", (), "EXX", "is not linear in A, B: coefficients are multiplied"),
    ("A*B*x", (), "EXX", "declare all but one of A, B: --param NAME=start:low..high"),
    ("A*x + sin(x)", (), "EXX", "not linear in A: a part without a coefficient is added"),
    ("A*x + sin(x)", (), "EXX", "; multiply every part by a name of your own"),
    ("sin(x)", (), "EXX", "--expr 'sin(x)' has no coefficient to fit; multiply it by a name of your own: A*(sin(x))"),
    ("p*x", ("p=1:0..2",), "EXX", "has no coefficient to fit"),
    ("A*x/p", ("p=37",), "EXX", "--param 'p=37': write name=start:low..high, for example p=37:3..200"),
    ("A*x/p", ("p=37:3-200",), "EXX", "--param 'p=37:3-200': write name=start:low..high"),
    ("A*x/p", ("p=nan:3..200",), "EXX", "write name=start:low..high"),
    ("A*x/p", ("p=2:3..200",), "EXX", "--param 'p=2:3..200': need low <= start <= high and low < high"),
    ("A*x/p", ("p=3:3..3",), "EXX", "need low <= start <= high and low < high"),
    ("A*x/p", ("p=9:3..20", "p=9:3..20"), "EXX", "--param 'p' is given twice"),
    ("A*x/p", ("p=9:3..20", "q=9:3..20"), "EXX", "--param 'q=9:3..20': 'q' is not in the expression"),
    ("A*x", ("x=9:3..20",), "EXX", "'x' is a channel or a constant; choose another name"),
    ("A*x", (), "EQX", "--expr: component: a component is E, then X Y Z A B or C"),
    ("A*x", (), "", "--expr: component: a component is E"),
    ("A*x", (), "EXY", "--expr: component 'EXY' is none of machine 'turning-centre'"),
    ("A*x^2", (), "EXX", "^ is no power here; write ** for it: x**2"),
    ("A*lag(T_bed, x)", (), "EXX", "the time constant of lag() is a number or a parameter, not a channel"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "params", "component", "said"), MISUSE)
def test_misuse_is_answered_precisely(text: str, params: tuple[str, ...], component: str, said: str) -> None:
    with pytest.raises(ModelError) as caught:
        expression_from_text(text, params, component, MACHINE)
    assert said in str(caught.value)


def test_a_mistyped_sensor_lists_all_that_are_near() -> None:
    """Oracle: the names by eye; the farther one is not proposed."""
    sensors = ["T_x_nut", "T_z_nut", "T_bed"]
    assert nearest("T_nut", sensors) == "; did you mean 'T_x_nut' or 'T_z_nut'?"
    assert nearest("T_x_nit", sensors) == "; did you mean 'T_x_nut'?"
    assert nearest("spindle", sensors) == "; allowed: T_bed, T_x_nut, T_z_nut"


def test_numbers_of_a_parameter_as_people_write_them() -> None:
    for text, numbers in (
        ("p=37:3..200", (37.0, 3.0, 200.0)),
        (" p = 1e2 : -3.5 .. 2.5E3 ", (100.0, -3.5, 2500.0)),
        ("p=.5:0...7", (0.5, 0.0, 0.7)),
    ):
        (p,) = made("A*x/p", text).nonlinear(MACHINE)
        assert (p.start, p.low, p.high) == numbers


@settings(max_examples=300, deadline=None)
@given(st.text(alphabet="AxzT_bedph0123.+-*/() ,=sincola", max_size=30), st.text(max_size=12))
def test_any_text_is_read_or_refused(text: str, param: str) -> None:
    """No text gives any other exception than the one that is told."""
    for params in ((), (param,)):
        try:
            with np.errstate(all="ignore"):
                expression_from_text(text, params, "EXX", MACHINE)
        except ModelError as e:
            assert str(e).startswith("--")  # noqa: PT017 - either outcome is right


def test_an_expression_over_every_channel() -> None:
    text = "+".join(f"k{i}*{name}" for i, name in enumerate(MACHINE.channel_names))
    effect = made(text)
    assert effect.channels(MACHINE) == tuple(sorted(MACHINE.channel_names))
