"""Laws over every effect of the registry; an effect without an instance in effect_examples.py is a failure."""

import inspect
import math
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec import jit
from rtec.effects import EFFECTS, State, derived, effect_class
from rtec.errors import ModelError
from rtec.model import FittedEffect, Model, load_model, save_model
from rtec.model.kernel import build as elementary
from tests.support.compiled_model import CompiledModel, compile_model
from tests.support.effect_example import MACHINE, Example, states
from tests.support.effect_examples import EXAMPLES, everything
from tests.support.laws import law_for

Floats = NDArray[np.float64]
UNIT = re.compile(r"(um|urad)(_per_(m|mm|degc|m_degc|krpm_to_p|krpm2|krpm|h|100kg|kn)|_s_per_mm|_s2_per_m)?")
each = law_for(EXAMPLES)


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Iterator[CompiledModel]:
    """All examples in one kernel: one compilation for all laws."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield compile_model(everything())


def test_every_effect_has_an_example() -> None:
    assert {e.arguments["effect"] for e in EXAMPLES} == set(EFFECTS)


def test_the_registry_and_the_classes_agree() -> None:
    """A model file names an effect by its key here, and its class by the literal inside; they must be one."""
    for name, kind in EFFECTS.items():
        assert kind.model_fields["effect"].default == name
        assert kind.about.title
        assert kind.about.equation
        assert not inspect.isabstract(kind)
    with pytest.raises(ModelError, match="here: no effect 'backlsh'; did you mean 'backlash'"):
        effect_class("backlsh", "here")


@each
def test_units_are_those_of_the_component(example: Example) -> None:
    parameters = example.effect.coefficients(MACHINE)
    assert {p.name: p.unit for p in parameters} == dict(example.units)
    assert len({p.name for p in parameters}) == len(parameters) > 0
    for p in parameters:
        found = UNIT.fullmatch(p.unit)
        assert found, p.unit
        assert found[1] == ("urad" if example.arguments["component"][1] in "ABC" else "um") == example.effect.unit


@each
def test_nonlinear_parameters_have_units_and_bounds(example: Example) -> None:
    parameters = example.effect.nonlinear(MACHINE)
    assert {p.name for p in parameters} == set(example.theta)
    for p in parameters:
        assert p.unit in ("s", "mm", "mm_per_s", "degC", "1")
        assert math.isfinite(p.low)
        assert p.low < p.start < p.high
        assert p.low < example.theta[p.name] < p.high


@each
def test_usual_sizes_and_what_a_search_tries(example: Example) -> None:
    """Usual sizes are sizes; the search begins inside the bounds, and its values rise within them."""
    for p in example.effect.coefficients(MACHINE):
        assert math.isfinite(p.typical)
        assert p.typical > 0.0
    for p in example.effect.nonlinear(MACHINE):
        assert list(p.grid) == sorted(set(p.grid))
        assert all(p.low <= value <= p.high for value in p.grid)
        if p.unit == "s" and p.name == "tau" and example.arguments["effect"] != "expression":
            assert len(p.grid) >= 5
            np.testing.assert_allclose(np.diff(np.log2(p.grid)), 1.0)


@each
def test_basis_is_the_equation(example: Example) -> None:
    """Oracle: the equation in effect_examples.py, by other means (numpy's Legendre, interp, scipy's lsim)."""
    s = states()
    got = example.effect.basis(MACHINE, s, example.theta)
    wanted = example.basis(s, example.theta)
    assert len(got) == len(wanted) == len(example.units)
    for one, other in zip(got, wanted, strict=True):
        assert np.all(np.isfinite(one))
        np.testing.assert_allclose(np.broadcast_to(one, 60), np.broadcast_to(other, 60), rtol=1e-9, atol=1e-9)


@each
def test_basis_is_finite_at_the_ends_of_everything(example: Example) -> None:
    """Ends of travel, axis not yet moved, spindle at rest and reversed, far too hot and cold; bounds of every θ."""
    n = 6
    channels = {name: np.array([15.0, 20.0, 20.0, 120.0, -20.0, 20.0]) for name in MACHINE.sensor_names}
    channels |= {"x": np.array([0.0, 200.0, 100.0, 0.0, 0.0, 200.0]), "z": np.array([0.0, 400.0, 200.0, 0.0, 0.0, 1.0])}
    channels |= {"d_x": np.array([0.0, 0.0, 1.0, -1.0, 1.0, 1.0]), "d_z": np.array([0.0, 1.0, 1.0, -1.0, 1.0, 1.0])}
    channels |= {"spindle_rpm": np.array([0.0, 0.0, -3000.0, 6000.0, 0.0, 0.0])}
    for axis in "xz":
        channels |= {f"v_{axis}": np.array([0.0, 0.0, 500.0, -500.0, 1e-9, 0.0])}
        channels |= {f"a_{axis}": np.array([0.0, 0.0, 2e4, -2e4, 0.0, 0.0])}
        channels |= {f"s_{axis}": np.array([derived.FAR_MM, derived.FAR_MM, 0.0, 1e-6, 400.0, 0.0])}
    channels |= {
        "load_kg": np.array([0.0, 0.0, 5e4, 1.0, 0.0, 0.0]),
        "force_n": np.array([0.0, 0.0, 1e5, -1e5, 0.0, 0.0]),
    }
    s = State(MACHINE, np.array([0.0, 0.0, 1.0, 1.0, 1e6, 1e6]), channels)
    bounds = example.effect.nonlinear(MACHINE)
    for theta in ({p.name: p.low for p in bounds}, {p.name: p.high for p in bounds}):
        for value in example.effect.basis(MACHINE, s, theta):
            assert np.all(np.isfinite(np.broadcast_to(value, n)))


@each
def test_zero_coefficients_are_zero_error(example: Example) -> None:
    zero = Model(MACHINE, (FittedEffect(example.effect, dict.fromkeys(example.units, 0.0), dict(example.theta)),))
    assert np.all(zero.predict(states()) == 0.0)
    assert np.all(Model(MACHINE).predict(states()) == 0.0)


@each
def test_linear_in_the_coefficients(example: Example) -> None:
    """Oracle: f(2a - 3b) = 2 f(a) - 3 f(b)."""
    s = states()
    rng = np.random.default_rng(4)
    a, b = rng.normal(0, 5, (2, len(example.units)))

    def error(values: Floats) -> Floats:
        numbers = dict(zip(example.units, map(float, values), strict=True))
        model = Model(MACHINE, (FittedEffect(example.effect, numbers, dict(example.theta)),), reference_degc=20.0)
        return model.predict(s)

    np.testing.assert_allclose(error(2 * a - 3 * b), 2 * error(a) - 3 * error(b), rtol=1e-9, atol=1e-9)


def uses_lag(example: Example) -> bool:
    return "tau" in example.theta


@each
def test_a_batch_is_its_rows(example: Example) -> None:
    """Oracle: the rows one at a time, bit for bit; what has memory is compared with the batch of the first k rows."""
    s, model = states(), example.model
    whole = model.predict(s)
    for k in (1, 7, 59):
        np.testing.assert_array_equal(model.predict(s.rows(slice(0, k))), whole[:k])
    if not uses_lag(example):
        singles = [model.predict(s.rows(slice(i, i + 1)))[0] for i in range(len(s))]
        np.testing.assert_array_equal(singles, whole)


@each
def test_explain_sums_to_predict_and_feeds_its_component_alone(example: Example) -> None:
    s, model = states(), example.model
    np.testing.assert_allclose(model.explain(s).sum(axis=0), model.predict(s), rtol=1e-12, atol=1e-12)
    components = model.components(s)
    others = [i for i, c in enumerate(MACHINE.components) if c != example.arguments["component"]]
    assert np.all(components[:, others] == 0.0)
    np.testing.assert_array_equal(components.sum(axis=1), model.effect_components(s)[0])


def test_explain_of_a_whole_model_sums_to_predict() -> None:
    """Effects of one component add up; oracle: the sum, and the sum of the models of each effect alone."""
    s, model = states(), everything()
    np.testing.assert_allclose(model.explain(s).sum(axis=0), model.predict(s), rtol=1e-10, atol=1e-9)
    np.testing.assert_allclose(sum(e.model.predict(s) for e in EXAMPLES), model.predict(s), rtol=1e-10, atol=1e-9)
    assert Model(MACHINE).explain(s).shape == (0, 60, 3)


@each
def test_saving_and_loading_is_the_identity(example: Example, tmp_path: Path) -> None:
    model = example.model
    model.check()
    save_model(model, tmp_path / "m.toml")
    loaded = load_model(tmp_path / "m.toml", MACHINE)
    assert loaded == model
    assert loaded.hash == model.hash
    np.testing.assert_array_equal(loaded.predict(states()), model.predict(states()))


@each
def test_channels_are_those_that_the_basis_reads(example: Example) -> None:
    """Oracle: a state that has these channels and no other is enough; without any one of them it is not."""
    s, effect = states(), example.effect
    names = effect.channels(MACHINE)
    needed = {n: s.value(n) for n in names}
    effect.basis(MACHINE, State(MACHINE, s.time_s, needed), example.theta)
    for name in set(names) - {"time_s"}:  # no state is without its time
        # A direction that is not given follows from its position, so both go.
        gone = {name, name.removeprefix("d_")}
        fewer = {n: v for n, v in needed.items() if n not in gone}
        with pytest.raises(ModelError, match="is not in this data"):
            effect.basis(MACHINE, State(MACHINE, s.time_s, fewer), example.theta)


@each
def test_derivative_by_each_nonlinear_parameter(example: Example) -> None:
    """Finite and continuous, for variable projection. Oracle: central differences of two step sizes agree."""
    s = states()
    for name, at in example.theta.items():

        def slope(step: float, name: str = name, at: float = at) -> Floats:
            plus, minus = (example.effect.basis(MACHINE, s, {**example.theta, name: at + d}) for d in (step, -step))
            return np.array([(p - m) / (2 * step) for p, m in zip(plus, minus, strict=True)])

        fine, coarse = slope(at * 1e-6), slope(at * 1e-5)
        assert np.all(np.isfinite(fine))
        assert np.abs(fine).max() > 0.0
        np.testing.assert_allclose(fine, coarse, rtol=1e-4, atol=1e-4 * np.abs(fine).max())


def test_compiled_kernel_equals_numpy(compiled: CompiledModel) -> None:
    """Oracle: `Model.predict` and `Model.components`, to 1e-9, every component that any effect feeds."""
    s, model = states(500, seed=8), everything()
    tip, components = compiled.predict(s)
    wanted = model.components(s)
    for i, name in enumerate(compiled.source.components):
        column = wanted[:, MACHINE.components.index(name)]
        np.testing.assert_allclose(components[:, i], column, rtol=1e-9, atol=1e-9 * np.abs(column).max(), err_msg=name)
    assert set(compiled.source.components) == {e.arguments["component"] for e in EXAMPLES}
    np.testing.assert_allclose(tip, model.predict(s), rtol=1e-9, atol=1e-9 * np.abs(tip).max())


def test_compiled_batch_is_its_prefix(compiled: CompiledModel) -> None:
    """Oracle: the first k rows of a batch and a batch of k rows, bit for bit."""
    s = states(200, seed=9)
    tip, components = compiled.predict(s)
    for k in (1, 2, 77, 199):
        head_tip, head_components = compiled.predict(s.rows(slice(0, k)))
        np.testing.assert_array_equal(head_tip, tip[:k])
        np.testing.assert_array_equal(head_components, components[:k])


def test_new_numbers_need_no_new_kernel(compiled: CompiledModel) -> None:
    """A refit changes numbers only; oracle: the same source, and numpy's value with the new numbers."""
    effects = tuple(
        FittedEffect(f.effect, {k: 3.0 - v for k, v in f.values.items()}, {k: 1.001 * v for k, v in f.theta.items()})
        for f in everything().effects
    )
    refit = Model(MACHINE, effects, reference_degc=20.0)
    again = compile_model(refit)
    assert again.source.text == compiled.source.text
    assert again.module is compiled.module
    wanted = refit.predict(states())
    np.testing.assert_allclose(again.predict(states())[0], wanted, rtol=1e-9, atol=1e-9 * np.abs(wanted).max())


def plain_module(text: str, depends_on: Any) -> ModuleType:
    """What `build_module` gives where numba is not installed: the same text, run as Python."""
    del depends_on
    module = ModuleType("plain")
    whole = "import math\nfrom rtec.jit import njit\n" + text
    exec(compile(whole, "plain", "exec"), module.__dict__)  # noqa: S102 - the source under test
    for kernel in (derived.lag_update, elementary.sin_cos):
        module.__dict__[kernel.__name__] = jit.as_written(kernel)
    return module


@pytest.fixture
def without_numba(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jit, "HAVE_NUMBA", False)
    monkeypatch.setattr("tests.support.compiled_model.build_module", plain_module)


@each
@pytest.mark.usefixtures("without_numba")
def test_the_kernels_source_as_plain_python_equals_numpy(example: Example) -> None:
    """Each effect alone; oracle: `Model.predict`. And prefix for prefix, bit for bit."""
    s, model = states(), example.model
    kernel = compile_model(model)
    assert not hasattr(kernel.module.evaluate, "py_func"), "numba is out of the way"
    tip, components = kernel.predict(s)
    wanted = model.predict(s)
    np.testing.assert_allclose(tip, wanted, rtol=1e-9, atol=1e-9 * np.abs(wanted).max())
    np.testing.assert_allclose(components[:, 0], model.effect_components(s)[0], rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(kernel.predict(s.rows(slice(0, 13)))[0], tip[:13])


@pytest.mark.usefixtures("without_numba")
def test_an_empty_model_is_a_kernel_of_zeros() -> None:
    kernel = compile_model(Model(MACHINE))
    tip, components = kernel.predict(states())
    assert np.all(tip == 0.0)
    assert components.shape == (60, 0)


SENSORS = ("sensor", "front", "back")


@each
def test_check_refuses_what_the_machine_has_not(example: Example) -> None:
    """Unknown component, axis or sensor: the message has the place and the nearest name that there is."""
    example.effect.check(MACHINE, "model")
    component = str(example.arguments["component"])
    wrong = {"component": component + "q"}
    wrong |= {k: str(example.arguments[k]) + "q" for k in ("axis", *SENSORS) if k in example.arguments}
    for argument, name in wrong.items():
        kind = "sensor" if argument in SENSORS else argument
        with pytest.raises(ModelError) as caught:
            example.effect.model_copy(update={argument: name}).check(MACHINE, "model")
        message = str(caught.value)
        assert message.startswith(f"model: {kind} {name!r} is none of machine 'turning-centre'; ")
        nearest = re.search(r"did you mean '(\w+)'", message)
        assert nearest
        assert nearest[1] in (*MACHINE.components, *MACHINE.sensor_names, *MACHINE.axis_names)


@each
def test_check_refuses_missing_and_unknown_numbers(example: Example) -> None:
    fitted = example.fitted
    for values, theta, said in (
        ({}, fitted.theta, f"coefficient '{next(iter(example.units))}' is missing; it has: {', '.join(example.units)}"),
        ({**fitted.values, "qq": 1.0}, fitted.theta, "unknown coefficient 'qq'"),
        (fitted.values, {**fitted.theta, "qq": 1.0}, "unknown non-linear parameter 'qq'"),
        (dict.fromkeys(fitted.values, math.nan), fitted.theta, "a coefficient is not a finite number"),
    ):
        with pytest.raises(ModelError) as caught:
            Model(MACHINE, (FittedEffect(fitted.effect, values, theta),)).check("m.toml")
        assert f"m.toml: [effect 1, {fitted.effect.effect}]: {said}" in str(caught.value)


def test_arguments_of_single_effects() -> None:
    """Rules that one effect has for itself."""

    def read(effect: str, **arguments: Any) -> Any:
        return effect_class(effect, "t").model_validate({"effect": effect, "component": "EXX", **arguments})

    for arguments, said in (
        ({"effect": "polynomial_position", "axis": "X", "degrees": [1, 1]}, "a degree is given twice"),
        ({"effect": "polynomial_position", "axis": "X", "degrees": []}, "at least 1 item"),
        ({"effect": "polynomial_position", "axis": "X", "degrees": [13]}, "less than or equal to 12"),
        ({"effect": "piecewise_position", "axis": "X", "knots_mm": [1.0, 1.0]}, "knots must rise"),
        ({"effect": "piecewise_position", "axis": "X", "knots_mm": [1.0]}, "at least 2 items"),
        ({"effect": "cyclic_screw", "axis": "X", "harmonics": 0}, "greater than or equal to 1"),
        ({"effect": "scale", "axis": "X", "component": "QXX"}, "a component is E, then"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=said):
            read(**arguments)
    with pytest.raises(ModelError, match="lag is for the form with a sensor"):
        read("spindle_growth", lag=True).check(MACHINE, "m")
    no_pitch = replace(MACHINE, axes=tuple(replace(a, pitch_mm=None) for a in MACHINE.axes))
    with pytest.raises(ModelError, match="axis 'X' has no pitch_mm in the machine file, cyclic_screw needs it"):
        read("cyclic_screw", axis="X").check(no_pitch, "m")
