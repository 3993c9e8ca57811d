"""Effects as text; oracle: the effect itself, written and read again."""

import tomllib
from typing import Any, Literal

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from pydantic import Field, ValidationError

from rtec.diagnosis.extend.add import asked_effect, settings_of
from rtec.effects import EFFECTS, Effect, effect_class
from rtec.effects.base import About, Parameter
from rtec.effects.effect_list import _given, _split, as_options, as_text, read_wanted
from rtec.effects.registry import check_effect
from rtec.errors import ModelError
from rtec.model import Model
from tests.support.effect_example import MACHINE
from tests.support.effect_examples import EXAMPLES

FLOATS = st.floats(-1e4, 1e4, allow_nan=False).map(lambda v: v + 0.0)
SENSOR, AXIS = st.sampled_from(MACHINE.sensor_names), st.sampled_from(MACHINE.axis_names)
DEGREES = st.lists(st.integers(1, 9), min_size=1, max_size=4, unique=True)
FIELDS: dict[str, st.SearchStrategy[Any]] = {
    "axis": AXIS, "other": AXIS, "across": AXIS, "sensor": SENSOR, "front": SENSOR, "back": SENSOR,
    "grows_with": st.none() | SENSOR, "lag": st.booleans(), "stretched": st.booleans(), "builds_up": st.booleans(),
    "degree": st.integers(0, 6), "harmonics": st.integers(1, 16), "degrees": DEGREES,
    "knots_mm": st.lists(FLOATS, min_size=2, max_size=9, unique=True).map(sorted),
    "lambda_mm": st.floats(1e-6, 5.0), "fixed_mm": FLOATS,
    "expression": st.just("A*sin(2*pi*x/p) + B*lag(T_bed, q)"), "linear": st.just({"A": "um", "B": "um_per_degc"}),
    "free": st.just({"p": {"start": 37.5, "low": 3.0, "high": 2e2, "unit": "mm"},
                     "q": {"start": 1, "low": 0, "high": 9}}),
}  # fmt: skip
"""Values of each argument, by its name; an effect with another argument is a failure of the test."""


@st.composite
def made(draw: st.DrawFn, kind: type[Effect]) -> Effect:
    """An effect of a class that this machine can have, any of its arguments chosen or left out."""
    table: dict[str, Any] = {"effect": kind.model_fields["effect"].default}
    table["component"] = draw(st.sampled_from(sorted(MACHINE.components)))
    for key, one in kind.model_fields.items():
        if key not in table and (one.is_required() or draw(st.booleans())):
            table[key] = draw(TERMS[kind.__name__] if key == "terms" else FIELDS[key])
    try:
        effect = kind.model_validate(table)
        check_effect(effect, MACHINE, "made")
    except (ValidationError, ModelError):
        assume(False)
        raise
    return effect


TERMS: dict[str, st.SearchStrategy[Any]] = {
    "LoadDeformation": st.lists(st.sampled_from("abc"), min_size=1, unique=True).map(sorted),
    "CrossTalk": st.lists(st.tuples(st.integers(1, 4), st.integers(1, 4)), min_size=1, max_size=4, unique=True),
}


@pytest.mark.parametrize("name", EFFECTS)
@given(data=st.data())
def test_a_written_effect_is_read_as_itself(name: str, data: st.DataObject) -> None:
    effect = data.draw(made(EFFECTS[name]))
    assert read_wanted(as_text(effect), MACHINE).exact == (effect,)


@pytest.mark.parametrize("name", EFFECTS)
@given(data=st.data())
def test_the_options_of_rtec_add_give_the_effect(name: str, data: st.DataObject) -> None:
    effect = data.draw(made(EFFECTS[name]))
    kind, _, component, *settings = as_options(effect)
    assert settings[::2] == ["--set"] * (len(settings) // 2)
    given_back = settings_of(settings[1::2], "here")
    assert asked_effect(kind, component, given_back, Model(MACHINE, ())).effect == effect


def test_a_list_of_all_effects_is_read_as_itself() -> None:
    """Oracle: one of each kind, with its numbers to six digits."""
    effects = [e.effect for e in EXAMPLES]
    numbers = [
        {p.name: 1.5 for p in e.effect.coefficients(MACHINE)} | {k: float(f"{v:.6g}") for k, v in e.theta.items()}
        for e in EXAMPLES
    ]
    text = ", ".join(as_text(e, n) for e, n in zip(effects, numbers, strict=True))
    found = read_wanted(text, MACHINE, with_numbers=True)
    assert list(found.exact) == effects
    assert list(found.numbers) == numbers
    assert found.names == ()


class Odd(Effect):
    """An effect of a plug-in, with arguments that need quotes."""

    about = About("odd", "e = 0", "-", (), "test")
    effect: Literal["odd"] = "odd"
    text: str
    texts: tuple[str, ...] = ()
    table: dict[str, str | float | bool] = Field(default_factory=dict)

    def coefficients(self, machine: Any) -> tuple[Parameter, ...]:
        del machine
        return ()

    def channels(self, machine: Any) -> tuple[str, ...]:
        del machine
        return ()

    def basis(self, machine: Any, channels: Any, theta: Any) -> tuple[Any, ...]:
        del machine, channels, theta
        return ()


WORDS = st.text(st.characters(exclude_categories=["Cs"]), max_size=12)


@given(WORDS, st.lists(WORDS, max_size=3), st.dictionaries(WORDS, WORDS | FLOATS | st.booleans(), max_size=3))
def test_no_text_of_an_argument_is_taken_for_a_mark(text: str, texts: list[str], table: dict[str, Any]) -> None:
    """Oracle: the arguments that were written; split at the marks, and read by JSON and by TOML."""
    odd = Odd(component="EXX", text=text, texts=tuple(texts), table=table)
    both = f"{as_text(odd)},scale:EXX"
    assert [_split(item, ":")[:2] for item in _split(both, ",")] == [["odd", "EXX"], ["scale", "EXX"]]
    from rtec.effects.effect_list import _arguments

    assert _arguments(_split(as_text(odd), ":")[2:], "here") == _given(odd)
    assert settings_of(as_options(odd)[4::2], "here") == _given(odd)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("scal:EXX", r"--rivals scal:EXX: no effect 'scal'"),
        ("mount_expansion:EX0work", r"--rivals mount_expansion:EX0work: component 'EX0work'"),
        ("mount_expansion:EXX", r"--rivals mount_expansion:EXX: key 'sensor' is missing"),
        ("cyclic_pole:EXX:periods=40", r"--rivals .*'periods' is neither an argument nor a number.*'period'"),
        ("cyclic_pole:EXX:period=far", r"--rivals .*period is 'far', which is no number"),
        ("cyclic_pole:EXX:period=-3", r"--rivals .*period = -3 is outside"),
    ],
)
def test_a_fault_names_the_option_that_was_typed(text: str, said: str) -> None:
    with pytest.raises(ModelError, match=said):
        read_wanted(text, MACHINE, "--rivals", with_numbers=True)


def test_a_fit_takes_no_numbers() -> None:
    """Oracle: `rtec fit` determines them."""
    with pytest.raises(ModelError, match=r"--effects .*unknown key 'period'"):
        read_wanted("cyclic_pole:EXX:period=40", MACHINE)


def test_a_word_stays_a_word() -> None:
    """Oracle: JSON and TOML read `true` and `1e5` as no text; such names get quotes."""
    for name in ("true", "NaN", "1e5", "inf", "12", "null"):
        odd = Odd(component="EXX", text=name)
        assert as_text(odd).endswith(f'text="{name}"') or name == "inf"
        pair = as_options(odd)[-1]
        assert settings_of([pair], "here") == {"text": name}
        assert tomllib.loads(f'text = "{name}"') == {"text": name}
    table = {"effect": "mount_expansion", "component": "EXX", "sensor": "T_bed"}
    assert as_text(effect_class("mount_expansion", "t").model_validate(table)) == "mount_expansion:EXX:sensor=T_bed"
