"""The noise floor of files that visit the same places. Oracle: the noise that was added."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.estimation.floor import repeats_floor
from rtec.estimation.gls import without_nuisance
from rtec.estimation.judge import Judgement
from rtec.estimation.outliers import clean
from rtec.estimation.readings import read
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.support.characterise_examples import Probe, ProbeSetup, measurement, runs
from tests.support.diagnosis_examples import effects, small_machine

Floats = NDArray[np.float64]
NOISE_UM = 0.3
TARGETS = 31
MODEL = Model(small_machine(), effects("scale,component=EXX,axis=X,k=0"), name="scale")


def passed_once(name: str, rough_um: Floats, seed: int, degc: float = 20.0) -> Measurement:
    """One way there and back over the same targets; an error of each target that is smooth in nothing."""
    machine, rng = small_machine(), np.random.default_rng(seed)
    low, high = machine.axis("X").travel_mm
    places = np.linspace(low + 3.0, high - 3.0, TARGETS)
    x = np.concatenate([places, places[::-1]])
    n = len(x)
    channels = {"x": x, "d_x": np.repeat([1.0, -1.0], TARGETS)} | {s: np.full(n, degc) for s in machine.sensor_names}
    error = np.concatenate([rough_um, rough_um[::-1]])
    readings = {"reading_um": error + rng.normal(0.0, 5.0) + NOISE_UM * rng.standard_normal(n)}
    made = make_instrument("laser_linear", {}, "X", None, machine, "test")
    return Measurement(
        name, made, machine, np.ones(n, dtype=np.int64), np.linspace(0.0, 20.0 * n, n), channels, readings
    )


ROUGH = 4.0 * np.random.default_rng(5).standard_normal(TARGETS)


def floors(*measured: Measurement) -> list[tuple[float, str]]:
    return [(f.value, f.source) for f in Judgement(MODEL, clean(measured)).floors]


def test_repeats_in_other_files_are_the_floor() -> None:
    """A rough error that comes again in every file is no noise, whatever neighbouring readings differ by."""
    files = [passed_once(name, ROUGH, i) for i, name in enumerate(("Monday", "Tuesday", "Friday"))]
    ((alone, source),) = floors(files[0])
    assert source == "short-time differences"
    assert alone > 4.0 * NOISE_UM
    for value, source in floors(*files):
        assert source == "repeats"
        assert value == pytest.approx(NOISE_UM, rel=0.15)


def test_files_that_contradict_each_other_or_are_of_other_temperatures_are_no_repeats() -> None:
    """Neither may raise the floor of a file: what changed between two days is no noise of a reading."""
    smooth = 8.0 * np.sin(np.linspace(0.0, 3.0, TARGETS))
    (one,) = floors(passed_once("one", smooth, 1))
    for other in (passed_once("turned", -smooth, 2), passed_once("warm", smooth + 5.0, 2, degc=27.0)):
        both = floors(passed_once("one", smooth, 1), other)
        assert both[0] == one
        assert both[0][0] == pytest.approx(NOISE_UM, rel=0.4)


def test_another_set_up_is_no_repeat() -> None:
    """A beam at another height reads other angles: the same places are not the same readings."""
    machine = small_machine()
    one, other = (passed_once(name, ROUGH, i) for i, name in enumerate(("low", "high")))
    beside = make_instrument("laser_linear", {"beam_offset_mm": [0.0, 0.0, 150.0]}, "X", None, machine, "test")
    assert {source for _, source in floors(one, replace(other, instrument=beside))} == {"short-time differences"}


def test_what_drifts_between_repeats_is_no_noise() -> None:
    """Twelve passes over the same targets within six hours, of a machine that goes 2 µm to and fro in every one."""
    rng = np.random.default_rng(3)
    probe = Probe(ProbeSetup.model_validate({"zero": "run"}), component="EXX")
    m = measurement(runs([TARGETS] * 12), instrument=probe, seed=1, noise_um=0.0, hours=6.0)
    still = {k: np.full_like(v, v[0]) for k, v in m.channels.items()}
    drift = 2.0 * np.sin(2.0 * np.pi * m.time_s / 2300.0)
    m = replace(
        m,
        channels=still | {"x": np.tile(np.linspace(5.0, 95.0, TARGETS), 12)},
        readings={"reading_um": drift + NOISE_UM * rng.standard_normal(len(m))},
    )
    (floor,) = Judgement(MODEL, clean([m])).floors
    assert floor.source == "short-time differences"
    assert floor.value == pytest.approx(NOISE_UM, rel=0.35)
    assert floor.drift > 2.0 * floor.value


@pytest.mark.parametrize("slope", ["none", "run"])
def test_what_a_run_spends_on_its_zero_is_no_lack_of_noise(slope: str) -> None:
    """Twelve runs over three places, each with a zero (and a slope) of its own, which take a third (or two) of it."""
    rng = np.random.default_rng(8)
    probe = Probe(ProbeSetup.model_validate({"zero": "run", "slope": slope}), component="EXX")
    found = []
    for seed in range(20):
        m = measurement(runs([3] * 12), instrument=probe, seed=seed, noise_um=0.0)
        still = {k: np.full_like(v, v[0]) for k, v in m.channels.items()}
        x = np.tile([10.0, 50.0, 90.0], 12)
        m = replace(m, channels=still | {"x": x}, readings={"reading_um": 0.5 * rng.standard_normal(36)})
        readings = read([m], smooth=False)
        value = repeats_floor(readings, readings.series, without_nuisance(readings, readings.values))
        assert value is not None
        found.append(value)
    assert np.sqrt(np.mean(np.square(found))) == pytest.approx(0.5, rel=0.12)
