"""Model files: what is written is read again, what is broken is refused with a message, nothing in it is run."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rtec.effects import EFFECTS, effect_class
from rtec.errors import ModelError, RtecError
from rtec.model import FittedEffect, Model, load_model, save_model
from rtec.model.file import model_from, tables
from rtec.model.model import ErrorCorrelation, number_names
from tests.support.machines import bridge, turning_centre

MACHINE = turning_centre()
Table = dict[str, Any]


def model() -> Model:
    scale = effect_class("scale", "t").model_validate({"effect": "scale", "component": "EXX", "axis": "X"})
    drift = effect_class("ambient_drift", "t").model_validate(
        {"effect": "ambient_drift", "component": "EZ0spindle", "sensor": "T_air"}
    )
    return Model(
        MACHINE,
        (
            FittedEffect(scale, {"k": 11.5}, errors={"k": 0.3}),
            FittedEffect(drift, {"k": -2.0}, {"tau": 3600.0}, {"k": 0.1, "tau": 25.0}),
        ),
        name="day 1",
        reference_degc=20.5,
        valid_range={"x": (0.0, 200.0), "T_air": (17.0, 26.0)},
        noise_um=0.4,
        measurements={"laser-x": "ab12"},
        history=({"change": "fitted", "rms_before_um": 9.0, "rms_after_um": 0.5, "runs": [1, 2]},),
    )


def good() -> Table:
    return deepcopy(tables(model()))


def test_saving_and_loading_is_the_identity(tmp_path: Path) -> None:
    path = tmp_path / "m.toml"
    save_model(model(), path)
    loaded = load_model(path, MACHINE)
    assert loaded == model()
    assert loaded.hash == model().hash
    assert list(tmp_path.iterdir()) == [path], "no temporary file is left"
    save_model(loaded, tmp_path / "again.toml")
    assert (tmp_path / "again.toml").read_bytes() == path.read_bytes()


def test_a_file_that_ends_between_two_effects_is_refused(tmp_path: Path) -> None:
    """It is good TOML, and half a model. Oracle: the file cut behind every line before its last effect."""
    path = tmp_path / "m.toml"
    save_model(model(), path)
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    first, second = (i for i, line in enumerate(lines) if line == "[[effect]]\n")
    for n in range(second):
        path.write_text("".join(lines[:n]), encoding="utf-8")
        with pytest.raises(ModelError):
            load_model(path, MACHINE)
    for n, count in ((second, 1), (first, 0)):
        path.write_text("".join(lines[:n]), encoding="utf-8")
        with pytest.raises(ModelError, match=f"effects = 2, and {count} are in the file: it was cut off"):
            load_model(path, MACHINE)


def test_a_standard_error_that_is_not_known_is_left_out(tmp_path: Path) -> None:
    """A fit that cannot tell two parameters apart gives inf or nan; the file stays one that loads."""
    first = model().effects[0]
    path = tmp_path / "m.toml"
    save_model(Model(MACHINE, (FittedEffect(first.effect, first.values, errors={"k": float("inf")}),)), path)
    assert load_model(path, MACHINE).effects[0].errors == {}


def put(*path: Any) -> Callable[[Table], None]:
    def change(data: Table) -> None:
        place: Any = data
        for key in path[:-2]:
            place = place[key]
        place[path[-2]] = path[-1]

    return change


def drop(*path: Any) -> Callable[[Table], None]:
    def change(data: Table) -> None:
        place: Any = data
        for key in path[:-1]:
            place = place[key]
        del place[path[-1]]

    return change


NUMBER = {"value": 1.0, "unit": "um"}
HASH = "0" * 64
FAULTS: list[tuple[Callable[[Table], None], str]] = [
    (put("model", "machine_hash", HASH), "[model] machine_hash: made for machine 'turning-centre' as it was then"),
    (put("model", "format", 2), "[model] format: Input should be 1, found 2"),
    (put("model", "nam", "x"), "[model] unknown key 'nam'; did you mean 'name'?"),
    (drop("model", "reference_degc"), "[model] key 'reference_degc' is missing"),
    (drop("model"), "key 'model' is missing"),
    (put("model", "noise_um", -1.0), "[model] noise_um: must be from 0 to 1e+06, found -1.0"),
    (
        put("model", "reference_degc", float("nan")),
        "[model] reference_degc: Input should be a finite number, found nan",
    ),
    (put("efect", []), "unknown key 'efect'; did you mean 'effect'?"),
    (put("effect", {}), "effect: Input should be a valid array"),
    (put("effect", 0, 7), "effect[0]: Input should be an object, found 7"),
    (drop("effect", 0, "effect"), "[effect 1]: key 'effect' is missing; it names the effect"),
    (put("effect", 0, "effect", 3), "[effect 1]: key 'effect' is missing; it names the effect"),
    (put("effect", 0, "effect", "scael"), "[effect 1, scael]: no effect 'scael'; did you mean 'scale'?"),
    (put("effect", 0, "axes", "X"), "[effect 1, scale]: unknown key 'axes'; did you mean 'axis'?"),
    (drop("effect", 0, "axis"), "[effect 1, scale]: key 'axis' is missing"),
    (put("effect", 0, "axis", "Y"), "[effect 1, scale]: axis 'Y' is none of machine 'turning-centre'; allowed: X, Z"),
    (
        put("effect", 0, "component", "EXZZ"),
        "[effect 1, scale]: component 'EXZZ' is none of machine 'turning-centre'; did you mean",
    ),
    (
        put("effect", 0, "component", "no"),
        "[effect 1, scale]: component: a component is E, then X Y Z A B or C, then the axis",
    ),
    (
        put("effect", 1, "sensor", "T_aur"),
        "[effect 2, ambient_drift]: sensor 'T_aur' is none of machine 'turning-centre'; did you mean 'T_air'?",
    ),
    (put("effect", 1, "lag", False), "[effect 2, ambient_drift]: lag: Input should be True, found False"),
    (drop("effect", 0, "coefficient"), "[effect 1, scale]: key 'coefficient' is missing"),
    (put("effect", 0, "coefficient", {}), "[effect 1, scale]: coefficient 'k' is missing; it has: k"),
    (put("effect", 0, "coefficient", "q", NUMBER), "[effect 1, scale]: unknown coefficient 'q'; it has: k"),
    (drop("effect", 1, "nonlinear"), "[effect 2, ambient_drift]: non-linear parameter 'tau' is missing; it has: tau"),
    (
        put("effect", 0, "nonlinear", {"tau": NUMBER}),
        "[effect 1, scale]: unknown non-linear parameter 'tau'; it has: none",
    ),
    (
        put("effect", 0, "coefficient", "k", "value", float("nan")),
        "[effect 1, scale]: [coefficient.k] value: Input should be a finite number, found nan",
    ),
    (
        put("effect", 1, "nonlinear", "tau", "value", float("inf")),
        "[effect 2, ambient_drift]: [nonlinear.tau] value: Input should be a finite number, found inf",
    ),
    (
        put("effect", 0, "coefficient", "k", "valeu", 1.0),
        "[effect 1, scale]: [coefficient.k] unknown key 'valeu'; did you mean 'value'?",
    ),
    (drop("effect", 0, "coefficient", "k", "unit"), "[effect 1, scale]: [coefficient.k] key 'unit' is missing"),
    (
        put("effect", 0, "coefficient", "k", "unit", "nm"),
        "[effect 1, scale] coefficient.k: unit 'nm'; it is 'um_per_m'",
    ),
    (
        put("effect", 1, "nonlinear", "tau", "unit", "min"),
        "[effect 2, ambient_drift] nonlinear.tau: unit 'min'; it is 's'",
    ),
    (
        put("effect", 0, "coefficient", "k", "se", -1.0),
        "[effect 1, scale]: [coefficient.k] se: must be from 0 to 1e+12, found -1.0",
    ),
    (put("valid_range", "T_ari", [0.0, 1.0]), "[valid_range] 'T_ari' is no channel; did you mean 'T_air'?"),
    (put("valid_range", "x", [1.0, 0.0]), "[valid_range] x: [1.0, 0.0]: need lowest <= highest"),
    (put("valid_range", "x", [1.0]), "[valid_range] x: has 1 value, and 2 are needed"),
]


@pytest.mark.parametrize(("change", "message"), FAULTS, ids=[f[1][:60] for f in FAULTS])
def test_each_fault_has_its_message(change: Callable[[Table], None], message: str) -> None:
    data = good()
    change(data)
    with pytest.raises(ModelError) as caught:
        model_from(data, MACHINE, "f.toml")
    assert any(line.startswith(f"f.toml: {message}") for line in str(caught.value).splitlines()), str(caught.value)


def test_faults_of_several_effects_come_together() -> None:
    data = good()
    data["effect"][0]["axis"] = "Y"
    data["effect"][1]["sensor"] = "none"
    with pytest.raises(ModelError) as caught:
        model_from(data, MACHINE, "f.toml")
    assert len(str(caught.value).splitlines()) == 2


def test_a_model_of_another_machine() -> None:
    with pytest.raises(ModelError, match="made for machine 'turning-centre' as it was then, not for 'bridge'"):
        model_from(good(), bridge(), "f.toml")


def test_broken_files(tmp_path: Path) -> None:
    path = tmp_path / "m.toml"
    path.write_text("[model", encoding="utf-8")
    with pytest.raises(ModelError, match=r"m.toml: not valid TOML"):
        load_model(path, MACHINE)
    with pytest.raises(ModelError, match=r"gone.toml: no such file"):
        load_model(tmp_path / "gone.toml", MACHINE)


def test_a_failing_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Oracle: the bytes that stood there before; nothing else is in the folder."""
    path = tmp_path / "m.toml"
    save_model(model(), path)
    before = path.read_bytes()

    def full(_descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("rtec.model.file.os.fsync", full)
    with pytest.raises(ModelError, match=r"m.toml: cannot be written: No space left on device"):
        save_model(Model(MACHINE, name="new"), path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_the_file_stands_whole_before_it_takes_the_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At the instant when the new file is made safe on disk the old one is untouched and the new one complete."""
    path = tmp_path / "m.toml"
    path.write_text("old", encoding="utf-8")
    seen: list[tuple[str, str]] = []

    def look(_descriptor: int) -> None:
        (other,) = (p for p in tmp_path.iterdir() if p != path)
        seen.append((path.read_text(encoding="utf-8"), other.read_text(encoding="utf-8")))

    monkeypatch.setattr("rtec.model.file.os.fsync", look)
    save_model(model(), path)
    assert seen == [("old", path.read_text(encoding="utf-8"))]


def test_a_delay_of_which_nothing_is_known_is_read_again(tmp_path: Path) -> None:
    """A fit gave it a standard error of fifty thousand years. Oracle: the file is read, and its numbers are those."""
    scale, drift = model().effects
    vague = replace(drift, errors={"k": 0.1, "tau": 1.6e12})
    path = tmp_path / "m.toml"
    save_model(replace(model(), effects=(scale, vague)), path)
    read = load_model(path, MACHINE).effects[1]
    assert (read.values, read.theta) == (drift.values, drift.theta)
    assert read.errors["tau"] > 1e6 * read.theta["tau"]


def test_a_place_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    for place in (tmp_path / "no" / "m.toml", tmp_path / "file" / "m.toml"):
        with pytest.raises(ModelError, match=r"m.toml: cannot be written: "):
            save_model(model(), place)
    (tmp_path / "folder.toml").mkdir()
    with pytest.raises(ModelError, match="cannot be written"):
        save_model(model(), tmp_path / "folder.toml")
    assert {p.name for p in tmp_path.iterdir()} == {"file", "folder.toml"}


def test_loading_never_runs_text(tmp_path: Path) -> None:
    """Every text in the file is Python code that would make a file; oracle: the folder stays empty of it."""
    mark = tmp_path / "ran"
    code = f"__import__('pathlib').Path({str(mark)!r}).touch()"
    data = good()
    data["model"]["name"] = code
    data["measurement"] = {code: code}
    data["history"] = [{code: code, "deep": [[{"a": code}]]}]
    path = tmp_path / "m.toml"
    path.write_text(tomli_w.dumps(data), encoding="utf-8")
    loaded = load_model(path, MACHINE)
    assert loaded.name == code
    save_model(loaded, path)
    assert load_model(path, MACHINE) == loaded
    for key in ("effect", "component", "axis"):
        bad = good()
        bad["effect"][0][key] = code
        with pytest.raises(ModelError):
            model_from(bad, MACHINE, "f.toml")
    bad = good()
    bad["effect"].append(
        {"effect": "expression", "component": "EXX", "expression": code, "linear": {"k": code}, "coefficient": {}}
    )
    with pytest.raises(ModelError, match="is not allowed"):
        model_from(bad, MACHINE, "f.toml")
    assert not mark.exists()


# Random tables, most of them near enough to a model to get past the first check.
SCALARS = st.one_of(
    st.integers(), st.integers(10**300, 10**320), st.floats(), st.booleans(), st.text(max_size=8), st.dates()
)
WORDS = st.sampled_from([
    "X", "Z", "EXX", "EZ0spindle", "T_air", "k", "tau", "value", "unit", "um", "um_per_m", "k*x", "x",
    "lag(T_air, tau)",
    *EFFECTS, "effect", "component", "axis", "sensor", "coefficient", "nonlinear", "linear", "free", "start", "low",
])  # fmt: skip
ANYTHING = st.recursive(
    SCALARS | WORDS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(WORDS | st.text(max_size=4), inner, max_size=3),
    max_leaves=8,
)
NUMBERS = st.dictionaries(
    st.sampled_from(["k", "tau", "p", "alpha", "B", "pitch", "s1", "c1", "c2", "at0", "at1", "b0", "b1", "b2"]),
    st.fixed_dictionaries({"value": SCALARS, "unit": WORDS}) | ANYTHING,
    max_size=3,
)
EFFECT = st.fixed_dictionaries(
    {"effect": st.sampled_from(sorted(EFFECTS)), "component": WORDS | SCALARS, "coefficient": NUMBERS},
    optional={
        "axis": WORDS, "sensor": WORDS | ANYTHING, "front": WORDS, "back": WORDS, "lag": st.booleans() | ANYTHING,
        "degrees": ANYTHING, "degree": SCALARS, "harmonics": SCALARS, "knots_mm": ANYTHING, "fixed_mm": SCALARS,
        "expression": WORDS | st.text(max_size=20), "linear": ANYTHING, "free": ANYTHING, "nonlinear": NUMBERS,
    },
)  # fmt: skip
HEAD = st.fixed_dictionaries(
    {"format": st.just(1), "name": st.text(max_size=5), "machine": st.just("m"), "machine_hash": st.just(MACHINE.hash)},
    optional={"reference_degc": SCALARS | st.just(20.0), "noise_um": SCALARS},
)
FILE = st.fixed_dictionaries(
    {"model": HEAD | ANYTHING},
    optional={
        "effect": st.lists(EFFECT | ANYTHING, max_size=3),
        "valid_range": ANYTHING,
        "measurement": ANYTHING,
        "history": ANYTHING,
        "other": ANYTHING,
    },
)


def model_or_error(data: Any) -> None:
    made: Model | None = None
    message = ""
    with np.errstate(all="ignore"):
        try:
            made = model_from(data, MACHINE, "f.toml")
        except RtecError as e:
            message = str(e)
    assert made is not None or message.startswith("f.toml")


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(FILE | ANYTHING)
def test_random_tables_give_a_model_or_an_error_of_ours(data: object) -> None:
    """Oracle: no exception but RtecError, and its text begins with the source."""
    model_or_error(data)


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.data())
def test_a_good_model_with_one_thing_replaced(data: st.DataObject) -> None:
    """As above, starting from a model that is right and putting anything at a random place."""
    tree = good()
    place: Any = tree
    for _ in range(data.draw(st.integers(0, 5))):
        inner = place[data.draw(st.sampled_from(sorted(place)))] if isinstance(place, dict) and place else None
        if isinstance(inner, list) and inner and isinstance(inner[0], dict):
            inner = data.draw(st.sampled_from(inner))
        if not isinstance(inner, dict):
            break
        place = inner
    key = data.draw(st.sampled_from(sorted(place)) if place else WORDS)
    place[key] = data.draw(ANYTHING)
    model_or_error(tree)


TOGETHER = ErrorCorrelation(("1 scale(EXX, X) k", "2 ambient_drift(EZ0spindle, T_air) k"), ((), (-0.25,)))


def test_the_correlation_of_the_errors_is_kept(tmp_path: Path) -> None:
    """Oracle: the matrix that was given; what a model no longer has is left out."""
    path, whole = tmp_path / "m.toml", replace(model(), correlation=TOGETHER)
    save_model(whole, path)
    assert load_model(path, MACHINE) == whole
    names = number_names(whole.effects)
    assert np.array_equal(TOGETHER.matrix(names[:2]), [[1.0, -0.25], [-0.25, 1.0]])
    assert np.array_equal(TOGETHER.matrix(names[2:]), [[1.0]]), "of the delay none is known"
    save_model(replace(whole, effects=whole.effects[:1]), path)
    assert load_model(path, MACHINE).correlation == ErrorCorrelation(TOGETHER.numbers[:1], ((),))


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        (["", "-0.25 0.5"], "each longer by one"),
        ([""], "each longer by one"),
        (["", "2"], "from -1 to 1"),
        (["", "nan"], "finite"),
        (["", "much"], "much"),
    ],
)
def test_a_broken_correlation_is_refused(rows: list[str], said: str) -> None:
    table = good() | {"correlation": {"numbers": list(TOGETHER.numbers), "rows": rows}}
    with pytest.raises(ModelError, match=said):
        model_from(table, MACHINE, "m.toml")


def test_correlations_that_contradict_each_other_are_refused() -> None:
    """Two numbers that go with a third go with each other. Oracle: the determinant is negative."""
    numbers = [*TOGETHER.numbers, "2 ambient_drift(EZ0spindle, T_air) tau"]
    table = good() | {"correlation": {"numbers": numbers, "rows": ["", "0.9", "0.9 -0.9"]}}
    with pytest.raises(ModelError, match="contradict each other"):
        model_from(table, MACHINE, "m.toml")


def test_a_correlation_of_effects_that_were_removed_by_hand_is_refused() -> None:
    """Their places are no longer the ones that it names."""
    table = deepcopy(tables(replace(model(), correlation=TOGETHER)))
    del table["effect"][0]
    with pytest.raises(ModelError, match="remove this table"):
        model_from(table, MACHINE, "m.toml")
