"""An error that jumps at places, as at the joints of a rack. Oracle: the jumps that were put in."""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.diagnosis.result import Diagnosis
from rtec.diagnosis.search.diagnose import diagnose
from rtec.diagnosis.search.refit import same_but_finer
from rtec.diagnosis.search.shapes import LocalPlace
from rtec.effects import effect_class
from rtec.effects.expression import expression_from_text
from rtec.estimation.readings import read
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect, Model
from tests.support import proof
from tests.support.diagnosis_examples import effects, laser, small_machine

Floats = NDArray[np.float64]
RUNS, TARGETS, NOISE_UM = 4, 49, 0.3
STEP_MM = 190.0 / (TARGETS - 1)


def line(error: Callable[[Floats], Floats], seed: int, count: int = TARGETS) -> Measurement:
    """A laser along X, four times there and back over 49 targets, or another count, at unequal steps; nothing warms."""
    machine, rng = small_machine(), np.random.default_rng(seed)
    at = np.linspace(5.0, 195.0, count)
    at[1:-1] += rng.uniform(-0.3, 0.3, count - 2) * 190.0 / (count - 1)
    x = np.tile(np.concatenate([at, at[::-1]]), RUNS)
    ways = np.tile(np.repeat([1.0, -1.0], count), RUNS)
    channels = {
        "x": x,
        "d_x": ways,
        "T_bed": 20.0 + 0.02 * rng.standard_normal(len(x)),
        "T_air": 20.0 + 0.02 * rng.standard_normal(len(x)),
    }
    values = error(x) + 0.02 * x + 1.5 * ways + NOISE_UM * rng.standard_normal(len(x))
    made = make_instrument("laser_linear", {}, "X", None, machine, "test")
    run, time_s = np.repeat(np.arange(1, RUNS + 1), 2 * count), np.linspace(0.0, 5.0 * len(x), len(x))
    return Measurement("rack", made, machine, run, time_s, channels, {"reading_um": values})


def found(m: Measurement) -> Diagnosis:
    known = effects("scale,component=EXX,axis=X,k=0", "backlash,component=EXX,axis=X,B=0")
    return diagnose(Model(small_machine(), known, name="known"), [m], draws=50, explain=True)


def steps(jumps: dict[float, float]) -> Callable[[Floats], Floats]:
    return lambda x: np.asarray(sum(by * (x > at) for at, by in jumps.items()))


@pytest.mark.parametrize("seed", proof.few(range(2), 1))
@pytest.mark.parametrize(
    "jumps",
    [{65.0: 4.2, 132.0: -6.6}, {62.0: 2.4, 128.0: 2.4}, {50.0: 3.6, 100.0: -2.7, 150.0: 3.0}],
    ids=["up and down", "both up", "three"],
)
def test_steps_are_named_with_their_places(jumps: dict[float, float], seed: int) -> None:
    m = line(steps(jumps), seed)
    d = found(m)
    assert d.verdict == "unknown_effect", d.sentence
    assert d.unknown is not None
    assert (d.unknown.shape, d.unknown.channels, d.unknown.period) == ("steps", ("x",), None)
    assert "depends on X, with steps at X ≈ " in d.sentence
    where = [float(w) for w in re.findall(r"[\d.]+(?= and| mm|, )", d.unknown.where)]
    assert where == pytest.approx(list(jumps), abs=1.6 * STEP_MM)
    # Oracle: least squares with what is proposed leaves the noise.
    machine = small_machine()
    effect = expression_from_text(d.unknown.expression, d.unknown.parameters, d.unknown.feeds, machine)
    columns = read([m]).columns(effect, {p.name: p.start for p in effect.nonlinear(machine)})
    x, ways, values = m.channels["x"], m.channels["d_x"], m.readings["reading_um"]
    whole = np.stack([np.ones(len(x)), x, ways, *columns.T], axis=1)
    left = values - whole @ np.linalg.lstsq(whole, values, rcond=None)[0]
    assert float(np.std(left)) < 1.1 * NOISE_UM


@pytest.mark.parametrize(
    "error",
    [
        lambda x: 3.0 * np.sin(2.0 * np.pi * x / 47.0),
        lambda x: 4.0 * (x / 100.0 - 1.0) ** 3,
        lambda x: np.interp(x, [0.0, 60.0, 110.0, 150.0, 200.0], [0.0, 5.0, -3.0, 4.0, 0.0]),
        lambda x: 0.0 * x,
    ],
    ids=["wave", "bow", "bends", "nothing"],
)
def test_what_is_no_step_is_not_called_one(error: Callable[[Floats], Floats]) -> None:
    """Oracle: what was put in."""
    d = found(line(error, 5))
    assert d.unknown is None or d.unknown.shape != "steps", d.sentence


KNOTS: Sequence[Sequence[float]] = ([0.0, 100.0, 200.0], [0.0, 50.0, 100.0, 200.0])


def test_one_effect_with_more_knots_is_the_same_effect() -> None:
    """Oracle: what the effects are written as."""

    def made(name: str, **arguments: object):  # type: ignore[no-untyped-def]
        return effect_class(name, "test").model_validate({"effect": name, "component": "EXX", **arguments})

    few, many = (made("piecewise_position", axis="X", knots_mm=list(k)) for k in KNOTS)
    assert same_but_finer(few, many)
    assert not same_but_finer(few, few)
    early, late = (made("axis_expansion", axis="X", sensor="T_bed", lag=lag) for lag in (False, True))
    assert not same_but_finer(early, late)


@pytest.mark.parametrize("seed", proof.few(range(3), 2))
def test_no_effect_is_named_twice_with_other_knots(seed: int) -> None:
    """Oracle: the names. Steps that a few knots describe badly."""
    heights = 4.0 * np.random.default_rng(seed).standard_normal(6)
    d = found(line(lambda x: heights[np.searchsorted([30.0, 62.0, 95.0, 128.0, 163.0], x)], seed))
    first = d.findings[0]
    named = [m.fitted.effect for m in d.together]
    named += [f.effect for f in (first, first.partner) if f is not None and first.accepted and not d.together]
    kinds = [(e.effect, e.component) for e in named if e.effect == "piecewise_position"]
    assert len(kinds) == len(set(kinds)), d.sentence


CURVE_MM = tuple(5.0 + 23.75 * i for i in range(9))


def beside_curve(m: Measurement) -> Diagnosis:
    """Diagnosis with a model that has a free curve along X, of nine knots."""
    curve = effect_class("piecewise_position", "test").model_validate(
        {"effect": "piecewise_position", "component": "EXX", "axis": "X", "knots_mm": CURVE_MM}
    )
    known = effects("scale,component=EXX,axis=X,k=0", "backlash,component=EXX,axis=X,B=0")
    bent = FittedEffect(curve, {f"at{i}": 0.0 for i in range(len(CURVE_MM))}, {})
    return diagnose(Model(small_machine(), (*known, bent), name="known"), [m], draws=50, explain=True)


@pytest.mark.parametrize("seed", proof.few(range(6), 2))
def test_one_step_is_found_beside_a_curve_that_has_taken_up_a_part_of_it(seed: int) -> None:
    """Oracle: the place that was put in, anywhere between two knots; it had been a dip or a hump somewhere near."""
    rng = np.random.default_rng([seed, 24])
    at, by = rng.uniform(40.0, 160.0), rng.choice([-1.0, 1.0]) * rng.uniform(1.8, 2.6)
    heights = rng.normal(0.0, 2.0, len(CURVE_MM))
    d = beside_curve(line(lambda x: np.interp(x, CURVE_MM, heights) + by * (x > at), seed))
    where = re.search(r"depends on X, with a step between X = ([\d.]+) and ([\d.]+) mm", d.sentence)
    assert d.verdict == "unknown_effect"
    assert where, d.sentence
    assert 0.5 * (float(where[1]) + float(where[2])) == pytest.approx(at, abs=1.6 * STEP_MM)


@pytest.mark.parametrize("seed", proof.few([0, 1, 3], 1))
@pytest.mark.parametrize("count", [13, 30, 49])
def test_a_step_is_said_to_be_between_the_targets_beside_it(count: int, seed: int) -> None:
    """Oracle: the targets; nothing shows where between two of them it is. One of its number had been printed."""
    at = float(np.random.default_rng([seed, 26]).uniform(50.0, 150.0))
    m = line(steps({at: 4.0}), seed, count)
    d = found(m)
    targets = np.unique(m.channels["x"])
    low, high = targets[targets < at].max(), targets[targets > at].min()
    where = re.search(r"depends on X, with a step between X = ([\d.]+) and ([\d.]+) mm", d.sentence)
    assert where, d.sentence
    assert [float(where[1]), float(where[2])] == [float(f"{v:.3g}") for v in (low, high)]
    assert d.unknown is not None
    centre = re.match(r"centre=([\d.]+):([\d.]+)\.\.([\d.]+)", d.unknown.parameters[0])
    assert centre, d.unknown.parameters
    assert [float(centre[i]) for i in (1, 2, 3)] == pytest.approx([0.5 * (low + high), low, high], abs=0.06)


@pytest.mark.parametrize("seed", proof.few(range(3), 1))
@pytest.mark.parametrize(
    "error",
    [lambda x: 0.0 * x, lambda x: 2.5 * np.exp(-(((x - 111.0) / 14.0) ** 2)), lambda x: 1.5 * np.sin(x / 5.0)],
    ids=["nothing", "bump", "wave"],
)
def test_beside_a_curve_nothing_else_is_called_a_step(error: Callable[[Floats], Floats], seed: int) -> None:
    """Oracle: what was put in."""
    heights = np.random.default_rng([seed, 25]).normal(0.0, 2.0, len(CURVE_MM))
    d = beside_curve(line(lambda x: np.interp(x, CURVE_MM, heights) + error(x), seed))
    assert " step" not in d.sentence, d.sentence


def test_a_step_whose_gap_nothing_shows_breaks_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Oracle: where a step was made; the one in its gap moves no reading, as among the close places of two plates."""
    nowhere = LocalPlace("step", 1e6, 1.0)
    monkeypatch.setattr("rtec.diagnosis.search.shapes._in_gap", lambda shape, _: replace(shape, place=nowhere))
    m = laser(["scale,component=EXX,axis=X,k=12"], 3)
    stepped = replace(m, readings={"reading_um": m.readings["reading_um"] + 4.0 * (m.channels["x"] > 101.0)})
    d = diagnose(Model(small_machine(), effects("scale,component=EXX,axis=X,k=12"), name="m"), [stepped], draws=50)
    assert d.unknown is not None
    assert d.unknown.channels == ("x",)
