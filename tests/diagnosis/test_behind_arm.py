"""An angle that one beam reads at one lever arm is not named together with others: it reads as a shift.

Oracle: the lever arm of each beam, which is its height above the axis.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import rtec
from rtec.diagnosis.compare.compare import compare
from rtec.diagnosis.extend.improve import improve
from rtec.diagnosis.search.diagnose import Search, diagnose
from rtec.diagnosis.search.refit import Refitted
from rtec.effects.reversal import AngularReversal, Backlash
from rtec.effects.thermal import AxisExpansion
from rtec.estimation.candidates import library
from rtec.estimation.outliers import clean
from rtec.machine import load_machine
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from rtec.sim.campaign.truth import effect_from_text
from tests.support.diagnosis_examples import laser, small_machine
from tests.support.sim_example import CONFIGS

TRUE = ("scale,component=EXX,axis=X,k=8",)


@pytest.mark.parametrize(("heights_mm", "behind"), [((100.0,), True), ((100.0, 100.0), True), ((0.0, 100.0), False)])
def test_beams_at_one_height_show_no_angle(heights_mm: tuple[float, ...], behind: bool) -> None:
    beams = [laser(TRUE, 1 + i, setup={"beam_offset_mm": [0.0, 0.0, h]}, cycles=1) for i, h in enumerate(heights_mm)]
    model = Model(small_machine(), (), name="empty")
    search = Search(model, clean(beams).without_ends(), 1, 0.05, 50, None, False, lambda *_: None)
    turns = AngularReversal(component="EBX", axis="X")
    plays = Backlash(component="EXX", axis="X")
    assert search._behind_arm(turns) is behind
    assert not search._behind_arm(plays)


MILL = CONFIGS / "machines" / "vertical-mill.toml"
KNOWN = ("scale,component=EXX,axis=X,k=8",)
WARM = "axis_expansion,component=EBX,axis=X,sensor={sensor},k={k}"


def beam_of_mill(height_mm: float, seed: int, *more: str) -> Measurement:
    changes = {"cycles": 1, "targets": {"step_mm": 23.7}, "noise": {"white_um": 0.3}}
    setup, effects = {"beam_offset_mm": [0.0, 0.0, height_mm]}, (*KNOWN, *more)
    made = rtec.simulate(MILL, "laser_linear", axis="X", setup=setup, effects=effects, changes=changes, seed=seed)
    return replace(made.measurement, name=f"beam-{height_mm:g}-{seed}")


@pytest.mark.parametrize(("heights_mm", "k"), [((-60.0, 140.0), 20.0), ((0.0, 100.0), -35.0)])
def test_a_guideway_that_bends_as_it_warms_up_is_named(heights_mm: tuple[float, ...], k: float) -> None:
    """Two beams, each at a height of its own. Oracle: the number that was simulated, µrad/(m·K)."""
    beams = [beam_of_mill(h, 5 + i, WARM.format(sensor="T_x_nut", k=k)) for i, h in enumerate(heights_mm)]
    machine = load_machine(MILL)
    known = Model(machine, tuple(effect_from_text(t, machine) for t in KNOWN), name="known")
    found = diagnose(known, beams, draws=50, explain=True)
    assert found.verdict == "missing_effect"
    assert (found.findings[0].effect.effect, found.findings[0].effect.component) == ("axis_expansion", "EBX")
    number = found.findings[0].parameters["k"]
    assert number.value == pytest.approx(k, abs=4.0 * (number.se or 0.0))


@pytest.mark.parametrize(
    ("heights_mm", "sensors"), [((100.0,), set()), ((100.0, 100.0), set()), ((100.0, 0.0), {"T_x_nut"})]
)
def test_a_screw_whose_temperature_nobody_recorded_is_no_guideway(
    heights_mm: tuple[float, ...], sensors: set[str]
) -> None:
    """At one height both are one column; at two a bend by another body's temperature would stand for the screw."""
    beams = [beam_of_mill(h, 1 + i) for i, h in enumerate(heights_mm)]
    offered = [c.effect for c in library(clean(beams).readings)[0] if c.effect.component == "EBX"]
    assert {e.sensor for e in offered if isinstance(e, AxisExpansion)} == sensors


@pytest.mark.parametrize(("less", "first"), [(1.0, "mount_expansion"), (4.0, "column_tilt")])
def test_a_shift_by_one_temperature_is_before_an_angle_by_two(less: float, first: str) -> None:
    """One beam reads both alike; of any two temperatures the difference makes many a curve. Oracle: odds of 20 to 1."""
    beam = laser(TRUE, 1, setup={"beam_offset_mm": [0.0, 0.0, 100.0]}, cycles=1)
    model = Model(small_machine(), (), name="empty")
    search = Search(model, clean([beam]).without_ends(), 1, 0.05, 50, None, False, lambda *_: None)

    def fitted(name: str, component: str, log_evidence: float) -> Refitted:
        number = next(
            i
            for i, c in enumerate(search.candidates)
            if (c.effect.effect, c.effect.component) == (name, component) and c.thetas == ({},)
        )
        columns = search.readings.columns(search.candidates[number].effect, {})
        fit = search.refits.fit(np.concatenate([search.prepared.base, columns], axis=1))
        return Refitted(number, {}, columns, fit, log_evidence, 0.9, 0.9)

    tilt, shift = fitted("column_tilt", "EBX", 9.0), fitted("mount_expansion", "EXX", 9.0 - less)
    assert search.candidates[search._direct_first([tilt, shift])[0].number].effect.effect == first


BRIDGE = """[machine]
name = "bridge"
tool_chain = ["X", "probe"]
work_chain = ["Y", "table"]
[axis]
X = { direction = "X", travel_mm = [0, 700], counts_per_mm = 1000 }
Y = { direction = "Y", travel_mm = [0, 1000], counts_per_mm = 1000 }
[link]
probe = {}
table = {}
[temperature]
T_beam = {}
T_air = {}
"""


def test_a_beam_that_bows_between_its_ends_is_a_shift_and_no_tilt_at_the_place_of_the_carriage(tmp_path: Path) -> None:
    """Straightness of Y while X stands: the beam bows by 1.2 µm/K of the difference of two temperatures.

    Oracle: the curve that was added, which is the same wherever X stands. As it was, a tilt of the table was named,
    "no other" in its place: with X elsewhere the improved model was worse than none.
    """
    (tmp_path / "m.toml").write_text(BRIDGE)
    machine, rng = load_machine(tmp_path / "m.toml"), np.random.default_rng(4)
    y, run = np.tile(np.linspace(10.0, 990.0, 15), 24), np.repeat(np.arange(24), 15)
    time_s = 25.0 * np.arange(360.0) + 900.0 * run
    beam, air = 20.0 + 3.0 * np.sin(time_s / 7000.0), 20.3 + 1.2 * np.sin(time_s / 11000.0 + 1.0)
    bow = -1.2 * (beam - air) * (1.0 - ((y - 500.0) / 500.0) ** 2)

    def line(x_mm: float, noise_um: float) -> Measurement:
        channels = {"x": np.full(360, x_mm), "y": y, "T_beam": np.round(beam, 1), "T_air": np.round(air, 1)}
        instrument = make_instrument("straightness", {"direction": "Z"}, "Y", None, machine, "line")
        read_um = {"reading_um": bow + noise_um * rng.standard_normal(360)}
        return Measurement(f"line{x_mm:g}", instrument, machine, run, time_s, channels, read_um)

    better = improve(Model(machine, (), name="empty"), [line(300.0, 0.2)], draws=50).model
    assert {(f.effect.effect, f.effect.component[:2]) for f in better.effects} == {
        ("column_tilt", "EZ"),
        ("bed_bending", "EZ"),
    }
    assert compare(better, [line(650.0, 0.0)]).judged.residual < 0.15
