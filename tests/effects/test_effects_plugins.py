"""Effects of other packages: good ones join the registry, broken ones are told and take nothing with them.

Oracle: what was written into the packages' own files; they are installed as `pip` leaves them, a module and a
dist-info folder.
"""

import importlib
import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from rtec.cli.main import status
from rtec.effects import EFFECTS, all_effects, effect_class
from rtec.effects.registry import ARITHMETIC, PlugInWarning, plug_in_faults
from rtec.errors import ModelError
from rtec.estimation.candidates import library
from rtec.estimation.readings import read
from rtec.model import Model
from rtec.model.kernel.trace import SHORT, UFUNCS
from rtec.report.effects import OTHERS, catalogue_page, families
from tests.support.command import here
from tests.support.diagnosis_examples import effects, laser, small_machine

GOOD = """
from typing import Literal
from rtec.effects import Parameter
from rtec.effects.base import About, AxisEffect

class {name}(AxisEffect):
    about = About(title="A step", equation="e = h", typical="1 µm", seen_by=("laser_linear",), source="a test")
    effect: Literal["{effect}"] = "{effect}"

    def coefficients(self, machine):
        return (Parameter("h", self.unit, typical=1.0),)

    def basis(self, machine, channels, theta):
        return [channels.value(self.the_axis(machine).channel) * 0.0 + 1.0]
"""
ABSTRACT = """
from rtec.effects.base import About, AxisEffect

class Half(AxisEffect):
    about = About(title="", equation="", typical="", seen_by=(), source="")
    effect: str = "half"
"""
UNTOLD = "\n".join(line for line in GOOD.splitlines() if "about = " not in line)
Install = Callable[[str, dict[str, str], str], None]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Install a package: its name, entry points, and the text of its one module."""
    before = set(sys.modules)

    def write(package: str, points: dict[str, str], text: str) -> None:
        info = tmp_path / f"{package}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n", encoding="utf-8")
        lines = "".join(f"{k} = {v}\n" for k, v in points.items())
        (info / "entry_points.txt").write_text(f"[rtec.effects]\n{lines}", encoding="utf-8")
        (tmp_path / f"{package}.py").write_text(text, encoding="utf-8")
        monkeypatch.syspath_prepend(str(tmp_path))
        importlib.invalidate_caches()
        # What is installed is looked up once for a search path; each installation here is a new one.
        monkeypatch.syspath_prepend(str(tmp_path / package))

    yield write
    for name in set(sys.modules) - before:
        if name.startswith("pkg_"):
            del sys.modules[name]


def test_a_good_one_stands_beside_the_built_in(install: Install) -> None:
    install("pkg_good", {"one_step": "pkg_good:One"}, GOOD.format(name="One", effect="one_step"))
    assert set(all_effects()) == {*EFFECTS, "one_step"}
    assert "one_step" not in EFFECTS
    kind = effect_class("one_step", "t")
    assert kind.model_validate({"effect": "one_step", "component": "EXX", "axis": "X"}).effect == "one_step"
    assert list(families()[OTHERS]) == ["one_step"]
    assert not plug_in_faults()
    with pytest.raises(ModelError, match="did you mean 'one_step'"):
        effect_class("one_stepp", "t")


FAULTS = (
    ("scale", "pkg_bad:One", GOOD.format(name="One", effect="scale"), "'scale' is a name of rtec's own"),
    ("outliers", "pkg_bad:One", GOOD.format(name="One", effect="outliers"), "'outliers' is a name of rtec's own"),
    ("gone", "pkg_nowhere:One", "", "cannot be loaded: ModuleNotFoundError: No module named 'pkg_nowhere'"),
    ("gone", "pkg_bad:Two", GOOD.format(name="One", effect="gone"), "cannot be loaded: AttributeError"),
    ("torn", "pkg_bad:One", "def (", "cannot be loaded: SyntaxError"),
    ("torn", "pkg_bad:One", "raise RuntimeError('no licence')", "cannot be loaded: RuntimeError: no licence"),
    ("torn", "pkg_bad:One", "raise SystemExit(5)", "cannot be loaded: SystemExit: 5"),
    ("number", "pkg_bad:One", "One = 1", "1 is not a class derived from rtec.effects.Effect"),
    ("half", "pkg_bad:Half", ABSTRACT, "Half lacks basis, coefficients"),
    ("untold", "pkg_bad:One", UNTOLD.format(name="One", effect="untold"), "One has no `about = About"),
    ("other", "pkg_bad:One", GOOD.format(name="One", effect="one_step"), "`effect` of One is 'one_step'"),
)


@pytest.mark.parametrize(("name", "value", "text", "said"), FAULTS, ids=[f"{f[0]}-{f[3][:25]}" for f in FAULTS])
def test_a_broken_one_is_told_and_the_rest_stays(
    name: str, value: str, text: str, said: str, install: Install, capsys: pytest.CaptureFixture[str]
) -> None:
    install("pkg_bad", {name: value}, text)
    install("pkg_good", {"one_step": "pkg_good:One"}, GOOD.format(name="One", effect="one_step"))
    assert set(all_effects()) == {*EFFECTS, "one_step"}
    fault = plug_in_faults()[name]
    assert fault.startswith(f"package pkg_bad, entry point rtec.effects: {name} = {value}: ")
    assert said in fault
    (section,) = [s for s in catalogue_page().sections if s.heading == "Plug-ins that cannot be used"]
    assert section.text == [f"{name}: {fault}"]
    if name in EFFECTS:
        assert effect_class(name, "t") is EFFECTS[name]
    elif name != "outliers":
        with pytest.raises(ModelError) as caught:
            effect_class(name, "m.toml")
        assert f"m.toml: effect {name!r} of a plug-in: package pkg_bad" in str(caught.value)
        assert status(["effects", name]) == 2
        assert said in capsys.readouterr().err.replace("\n", " ")


FED = 'feeds, driven_by = ("positioning",), ("position",)\n    effect: Literal'
WORKS = GOOD.replace("effect: Literal", FED, 1)
BASIS = "return [channels.value(self.the_axis(machine).channel) * 0.0 + 1.0]"
FAILS = (
    ("raises", WORKS.replace(BASIS, "raise KeyError('T_bed')"), "basis() raises KeyError: 'T_bed'"),
    (
        "decides",
        WORKS.replace(BASIS, "return [1.0 if channels.value('x') > 0 else 0.0]"),
        "np.greater is none of the loop's",
    ),
    (
        "where",
        WORKS.replace(BASIS, "import numpy as np; return [np.where(1 > 0, channels.value('x'), 0.0)]"),
        "np.where",
    ),
    ("no numbers", WORKS.replace(BASIS, "return [channels.value('x') / 0.0]"), "that are no finite numbers"),
    ("not listed", WORKS.replace(BASIS, "return [channels.value('T_bed')]"), "channel 'T_bed', which channels() does"),
    ("too few", WORKS.replace(BASIS, "return []"), "basis() gives 0 values for 1 coefficients"),
    (
        "too short",
        WORKS.replace(BASIS, "return [channels.value('x')[:2]]"),
        "basis() raises ValueError: shape",
    ),
    ("signature", WORKS.replace("(self, machine):", "(self):"), "coefficients() raises TypeError"),
    ("no number", WORKS.replace("(Parameter(", "(str("), "coefficients() raises TypeError"),
    (
        "own argument",
        WORKS.replace(FED, "reach_mm: float\n    " + FED),
        "its argument 'reach_mm' has no",
    ),
    ("driver", WORKS.replace('("position",)', '("warmth",)'), "suggest() raises KeyError: 'warmth'"),
    ("yields", WORKS + "\n    @classmethod\n    def suggest(cls, around):\n        yield 1\n", "suggest() gives 1"),
)


@pytest.mark.parametrize(("text", "said"), [f[1:] for f in FAILS], ids=[f[0] for f in FAILS])
def test_one_that_fails_is_skipped_and_the_rest_is_as_before(text: str, said: str, install: Install) -> None:
    """Oracle: the candidates without any plug-in; and one line that names the plug-in."""
    readings = read([laser(["scale,component=EXX,axis=X,k=40"], 3, cycles=1)], smooth=False)
    before, _ = library(readings)
    assert "effect: Literal" in text
    install("pkg_fails", {"one_step": "pkg_fails:One"}, text.format(name="One", effect="one_step"))
    with pytest.warns(PlugInWarning, match=r"plug-in effect 'one_step' is skipped: pkg_fails\.One: ") as warned:
        found, untried = library(readings)
    assert said in str(warned[0].message)
    assert len(warned) == 1
    assert "\n" not in str(warned[0].message)
    assert [c.effect for c in found] == [c.effect for c in before]
    assert [u.why for u in untried if u.effect == "one_step"] == [
        f"the plug-in is skipped: {plug_in_faults()['one_step']}"
    ]
    assert library(readings)[0] == found
    assert set(all_effects()) == set(EFFECTS)
    with pytest.raises(ModelError, match=r"effect 'one_step' of a plug-in: pkg_fails\.One: "):
        effect_class("one_step", "m.toml")


def test_a_working_one_is_a_candidate(install: Install) -> None:
    """Oracle: the class that was installed; without it the test above would skip whatever was installed."""
    readings = read([laser(["scale,component=EXX,axis=X,k=40"], 3, cycles=1)], smooth=False)
    install("pkg_works", {"one_step": "pkg_works:One"}, WORKS.format(name="One", effect="one_step"))
    assert "one_step" in {c.effect.effect for c in library(readings)[0]}


def test_a_model_that_has_a_failing_one_is_refused(install: Install) -> None:
    """Oracle: the message names the effect and what its code did."""
    text = WORKS.replace(BASIS, "raise RuntimeError('no table')").format(name="One", effect="one_step")
    install("pkg_fails", {"one_step": "pkg_fails:One"}, text)
    with pytest.raises(ModelError, match=r"effect 'one_step' of a plug-in, pkg_fails: basis\(\) raises RuntimeError"):
        Model(small_machine(), effects("one_step,component=EXX,axis=X,h=1")).check()


def test_of_two_with_one_name_the_first_package_is_used(install: Install) -> None:
    """In alphabetical order of the packages, so that it is the same on every machine."""
    install("pkg_b", {"one_step": "pkg_b:Second"}, GOOD.format(name="Second", effect="one_step"))
    install("pkg_a", {"one_step": "pkg_a:First"}, GOOD.format(name="First", effect="one_step"))
    assert effect_class("one_step", "t").__name__ == "First"
    assert "package pkg_b" in plug_in_faults()["one_step"]
    assert "another package has an effect 'one_step'" in plug_in_faults()["one_step"]


def test_built_in_names_look_for_no_package(monkeypatch: pytest.MonkeyPatch) -> None:
    """The loop and the reading of models ask for built-in names only; that costs no search of the disk."""

    def searched(**_: object) -> None:
        raise AssertionError("searched")

    monkeypatch.setattr("rtec.effects.registry.entry_points", searched)
    monkeypatch.syspath_prepend("somewhere new")
    for name in EFFECTS:
        assert effect_class(name, "t") is EFFECTS[name]


def test_what_is_no_effect_is_refused_with_a_reason() -> None:
    with pytest.raises(ModelError, match="'centre_offset' is no error of the machine, a model cannot hold it"):
        effect_class("centre_offset", "t")


def test_a_plug_in_is_told_like_the_others(install: Install, capsys: pytest.CaptureFixture[str]) -> None:
    install("pkg_good", {"one_step": "pkg_good:One"}, GOOD.format(name="One", effect="one_step"))
    assert status(["effects", "one_step"]) == 0
    shown = capsys.readouterr().out
    assert "one_step: A step." in shown
    assert "drawn with h = 1 µm" in shown
    assert status(["effects", "one_step", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)["one_step"]
    assert facts["family"] == OTHERS
    assert facts["parameters"] == [{"name": "h", "unit": "um", "typical": 1.0}]


def test_the_arithmetic_of_a_trial_is_that_of_the_kernel() -> None:
    """Oracle: the kernel's own list; an effect that passes the trial can be compiled."""
    assert set(ARITHMETIC) == {*UFUNCS, *SHORT}


KNEE = """
from typing import Literal
import numpy as np
from rtec.effects import Parameter
from rtec.effects.base import About, AxisEffect

class Knee(AxisEffect):
    about = About(title="Above a knee", equation="", typical="1 µm", seen_by=("laser_linear",), source="a test")
    feeds, driven_by = ("positioning",), ("position", "temperature")
    effect: Literal["knee"] = "knee"
    sensor: str

    def coefficients(self, machine):
        return (Parameter("k", "um_per_m_degc", typical=10.0),)

    def nonlinear(self, machine):
        return (Parameter("T0", "degc", 3.0, 0.5, 15.0),)

    def channels(self, machine):
        return (*super().channels(machine), self.sensor)

    def basis(self, machine, channels, theta):
        q = channels.value(self.the_axis(machine).channel)
        return [np.maximum(channels.rise(self.sensor) - theta["T0"], 0.0) * np.abs(q) / 1000.0]
"""
MILL = """
[machine]
name = "mill"
tool_chain = ["X", "tool"]

[axis.X]
direction = "X"
travel_mm = [-250.0, 350.0]
counts_per_mm = 500

[temperature.T_screw]
[temperature.T_column]
[temperature.T_quill]
"""


def test_each_sensor_of_one_is_tried_at_its_own_number(install: Install, tmp_path: Path) -> None:
    """Two sensors whose effects have one shape at a value of the grid, and not where each fits best.

    Oracle: what was hidden; with its own number the other leaves half as much again, so "confounded" would be wrong.
    """
    install("pkg_knee", {"knee": "pkg_knee:Knee"}, KNEE)
    machine, data, model = (tmp_path / name for name in ("mill.toml", "lx", "known.toml"))
    machine.write_text(MILL, encoding="utf-8")
    known = ("scale,component=EXX,axis=X,k=15", "axis_expansion,component=EXX,axis=X,sensor=T_screw,k=8")
    hidden = "knee,component=EXX,axis=X,sensor=T_screw,k=30,T0=2.5"
    words = [word for effect in (*known, hidden) for word in ("--effect", effect)]
    done = here(
        "simulate", machine, "--instrument", "laser_linear", "--axis", "X", "--protocol", "warm_up", *words,
        "--noise", 0.3, "-o", data, "--seed", 5,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    names = "scale:EXX,axis_expansion:EXX:sensor=T_screw"
    done = here("fit", machine, f"{data}.csv", "-o", model, "--effects", names)
    assert done.returncode == 0, done.stderr
    found = json.loads(here("diagnose", model, f"{data}.csv", "--json").stdout)
    assert found["verdict"] == "missing_effect"
    (first, second) = found["candidates"][:2]
    assert (first["effect"], first["arguments"]["sensor"]) == ("knee", "T_screw")
    assert first["parameters"]["T0"]["value"] == pytest.approx(2.5, abs=0.2)
    assert second["log_evidence"] < first["log_evidence"] - 50.0
