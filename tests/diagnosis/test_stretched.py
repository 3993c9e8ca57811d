"""A screw that was stretched at assembly, held at both ends. Oracle: bars and springs, worked out here.

Below the temperature at which it is slack, its expansion only lowers its tension; above it grows from its fixed end.
"""

import re
from dataclasses import replace

import numpy as np
import pytest

from rtec.diagnosis.extend.improve import improve
from rtec.diagnosis.search.diagnose import diagnose
from rtec.effects import effect_class
from rtec.estimation.judge import Judgement
from rtec.estimation.outliers import clean
from rtec.machine import machine_from
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.support.machines import axis

MACHINE = machine_from(
    {
        "machine": {"name": "mill", "tool_chain": ["head"], "work_chain": ["X", "table"]},
        "axis": {"X": axis("X", travel_mm=[0.0, 600.0], pitch_mm=10.0)},
        "link": {"head": {}, "table": {}},
        "temperature": {"T_x_nut": {}, "T_bed": {}},
    },
    "mill",
)
PER_K, NOISE_UM, COLD_DEGC = 11.5e-6, 0.3, 20.0


def screw_um(place_mm: np.ndarray, degc: np.ndarray, strain: float) -> np.ndarray:
    """Shift of a place on a screw of uniform strain, held at both ends by bearings that can only pull, µm.

    Held: the length is that at assembly, and the strain is thermal plus elastic. The bearings let go where the elastic
    strain would turn negative.
    """
    elastic = np.maximum(strain - PER_K * (degc - COLD_DEGC), 0.0)
    return np.asarray(1e3 * place_mm * (PER_K * (degc - COLD_DEGC) + elastic - strain))


def day(seed: int, strain: float, slack: bool = True) -> Measurement:
    """Ten runs there and back over a warm-up of the screw by 9 K; the bed follows the room. 46e-6 are 4 K."""
    rng = np.random.default_rng(seed)
    places = np.linspace(15.0, 585.0, 14)
    x = np.tile(np.concatenate([places, places[::-1]]), 10)
    way = np.tile(np.repeat([1.0, -1.0], 14), 10)
    run = np.repeat(np.arange(1, 11), 28)
    time_s = 20.0 * np.arange(len(x)) + 300.0 * run
    nut = COLD_DEGC + 0.3 + 9.0 * (1.0 - np.exp(-time_s / 3000.0))
    bed = COLD_DEGC + 2.0 * (1.0 - np.exp(-time_s / 9000.0)) + np.sin(time_s / 700.0)
    shift = screw_um(x, nut, strain) if slack else 1e3 * x * PER_K * (nut - COLD_DEGC)
    reading = shift + 0.8 * way + NOISE_UM * rng.normal(size=len(x))
    read = {k: np.round(v + 0.03 * rng.normal(size=len(x)), 1) for k, v in (("T_x_nut", nut), ("T_bed", bed))}
    return Measurement(
        name=f"laser-{seed}", machine=MACHINE, run=run,
        instrument=make_instrument("laser_linear", {}, "X", None, MACHINE, "test"), time_s=time_s,
        channels={"x": x, "d_x": way, **read}, readings={"reading_um": reading},
    )  # fmt: skip


def empty() -> Model:
    return Model(MACHINE, ())


@pytest.mark.parametrize("kelvin", [3.0, 5.0])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_screw_that_gets_slack_is_named_with_its_temperature(seed: int, kelvin: float) -> None:
    done = improve(empty(), [day(seed, kelvin * PER_K)], draws=50)
    grown = [f for f in done.model.effects if f.effect.effect == "axis_expansion"]
    assert [f.effect.model_dump().get("stretched") for f in grown] == [True]
    assert grown[0].theta["T0"] == pytest.approx(COLD_DEGC + kelvin, abs=0.3)
    assert grown[0].values["k"] == pytest.approx(1e6 * PER_K, rel=0.05)
    other = clean([day(100 + seed, kelvin * PER_K)], done.model.reference_degc)
    assert Judgement(done.model, other).residual < 1.3 * NOISE_UM


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_screw_that_only_grows_is_not_stretched(seed: int) -> None:
    found = diagnose(empty(), [day(seed, 0.0, slack=False)], draws=50)
    first = found.findings[0]
    assert (first.effect.effect, first.effect.model_dump().get("stretched")) == ("axis_expansion", None)
    assert found.verdict == "missing_effect"
    assert "stretched" not in found.sentence


def test_the_answer_says_from_which_temperature_on() -> None:
    found = diagnose(empty(), [day(1, 4.0 * PER_K)], draws=50)
    said = re.match(
        r"axis_expansion\(EXX, X, T_x_nut\) of a stretched screw that is slack from (\S+) °C on is missing",
        found.sentence,
    )
    assert said
    assert float(said[1]) == pytest.approx(COLD_DEGC + 4.0, abs=0.3)


def test_a_model_from_before_keeps_its_text() -> None:
    kind = effect_class("axis_expansion", "test")
    plain = {"effect": "axis_expansion", "component": "EXX", "axis": "X", "sensor": "T_x_nut"}
    assert "stretched" not in kind.model_validate(plain).model_dump()
    assert kind.model_validate({**plain, "stretched": True}).model_dump()["stretched"] is True


def test_beside_another_effect_the_answer_says_so_as_well() -> None:
    """A scale error is missing, too."""
    day_ = day(1, 4.0 * PER_K)
    more = {k: v - 0.02 * day_.channels["x"] for k, v in day_.readings.items()}
    found = diagnose(empty(), [replace(day_, readings=more)], draws=50)
    assert {"axis_expansion", "scale"} <= {m.fitted.effect.effect for m in found.together}
    assert "axis_expansion(EXX, X, T_x_nut) of a stretched screw that is slack from 24.0 °C on" in found.sentence


def test_it_may_grow_from_the_bearing_at_the_far_end() -> None:
    """As it was, "an effect is missing that is not in the catalogue", and `improve` added nothing."""
    day_, far_mm, kelvin = day(3, 4.0 * PER_K), 600.0, 4.0
    x, nut = day_.channels["x"], day_.channels["T_x_nut"]
    held = day_.readings["reading_um"] - screw_um(x, nut, kelvin * PER_K) - screw_um(far_mm - x, nut, kelvin * PER_K)
    found = diagnose(empty(), [replace(day_, readings={"reading_um": held})], draws=50)
    first = found.findings[0]
    assert found.verdict == "missing_effect"
    assert first.effect.model_dump()["fixed_mm"] == far_mm
    assert first.parameters["k"].value == pytest.approx(1e6 * PER_K, rel=0.05)
    assert first.theta["T0"] == pytest.approx(COLD_DEGC + kelvin, abs=0.3)
