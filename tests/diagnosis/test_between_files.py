"""Two days between which the machine changed. Oracle: what was put in, which no temperature drives."""

from collections.abc import Collection, Sequence
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from rtec.diagnosis.doubts.doubt import Doubt
from rtec.diagnosis.result import Diagnosis
from rtec.diagnosis.search.diagnose import Search, diagnose, instead_of_files
from rtec.estimation.outliers import clean
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.support import proof
from tests.support.diagnosis_examples import effects, laser, small_machine

KNOWN = ("backlash,component=EXX,axis=X,B=2", "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=11")


def model() -> Model:
    return Model(small_machine(), effects(*KNOWN), name="known")


def days(seed: int, changed: Sequence[str], air_degc: Sequence[float], swing: float = 0.3) -> list[Measurement]:
    """Two days of a machine that changed between them; the air swings about another temperature on each."""
    out = []
    for n, (more, degc) in enumerate(zip(((), changed), air_degc, strict=True)):
        m, rng = laser([*KNOWN, *more], seed + n), np.random.default_rng(seed + n)
        air = degc + swing * np.sin(4.0 * m.time_s / m.time_s[-1] + n) + 0.05 * rng.standard_normal(len(m))
        out.append(replace(m, channels={**m.channels, "T_air": air}))
    return out


@pytest.mark.parametrize(("k", "seed"), proof.few([(18, 103), (18, 105), (18, 101), (45, 101), (45, 105)], 1))
def test_a_scale_that_changed_between_two_days_is_no_heat(k: int, seed: int) -> None:
    """It had been called a scale and an expansion by the air together, or an error without a name over both."""
    d = diagnose(model(), days(seed, [f"scale,component=EXX,axis=X,k={k}"], (22.6, 20.2)), draws=50)
    assert d.verdict == "undecided"
    assert [(x.kind, x.fatal) for x in d.doubts] == [("between_files", True)]
    assert not d.findings[0].accepted
    assert not d.together
    assert d.unknown is None
    assert "within each of them the readings do not follow T_air" in d.sentence
    assert d.sentence.endswith("If the machine changed between them, diagnose the newer file alone.")


@pytest.mark.parametrize("seed", proof.few([101, 103], 1))
def test_of_the_new_day_alone_the_scale_is_named(seed: int) -> None:
    """What the answer to both asks for."""
    new = days(seed, ["scale,component=EXX,axis=X,k=18"], (22.6, 20.2))[1:]
    assert diagnose(model(), new, draws=50).findings[0].label == "scale(EXX, X)"


def grown(m: Measurement, um_per_mm_degc: float) -> Measurement:
    """The same of an axis that grows by the air, and is longer throughout."""
    x, air = m.channels["x"], m.channels["T_air"]
    more = (um_per_mm_degc * (air - 20.0) - 0.02) * x
    return replace(m, readings={k: v + more for k, v in m.readings.items()})


@pytest.mark.parametrize("seed", proof.few([101, 103], 1))
def test_what_follows_the_air_within_each_day_is_named(seed: int) -> None:
    """A scale and an expansion together, both on both days. Oracle: these two."""
    both = [grown(m, 0.009) for m in days(seed, (), (22.6, 20.2), swing=2.0)]
    d = diagnose(model(), both, draws=50)
    assert {"scale(EXX, X)", "axis_expansion(EXX, X, T_air)"} <= {m.label for m in d.together}
    assert "between_files" not in {x.kind for x in d.doubts}


@pytest.mark.parametrize("seed", proof.few([101, 103], 1))
def test_what_has_no_name_and_follows_the_air_within_each_day_is_no_change(seed: int) -> None:
    """An axis that bends with the air squared. Oracle: its variables."""
    both = []
    for m in days(seed, (), (22.6, 20.2), swing=2.0):
        bent = 4.0 * np.cos(m.channels["x"] / 25.0) * (m.channels["T_air"] - 20.0) ** 2 / 10.0
        both.append(replace(m, readings={k: v + bent for k, v in m.readings.items()}))
    d = diagnose(model(), both, draws=50)
    assert d.unknown is not None
    assert "T_air" in d.unknown.channels
    assert "between_files" not in {x.kind for x in d.doubts}


@pytest.mark.parametrize("seed", proof.few([101, 103], 1))
def test_a_wave_that_is_there_on_one_day_only_does_not_grow_with_the_air(seed: int) -> None:
    """Of one period, and of no screw: without a name it had grown with the air. Oracle: what was put in."""
    wave = "cyclic_pole,component=EXX,axis=X,s=3,c=-2,period=61.3"
    d = diagnose(model(), days(seed, [wave], (22.6, 20.2)), draws=50)
    assert "T_air" not in (d.unknown.channels if d.unknown is not None else ())
    assert not any("T_air" in m.label for m in d.together)


def test_days_alike_that_differ_contradict_each_other_though_both_warmed() -> None:
    """Play that changed; the bed warms by kelvins on both days. Oracle: what was put in, and the bed's readings."""
    both = days(103, ["backlash,component=EXX,axis=X,B=4"], (20.0, 20.0))
    assert min(float(np.ptp(m.channels["T_bed"])) for m in both) > 3.0
    d = diagnose(model(), both, draws=50)
    assert [x.kind for x in d.doubts] == ["contradiction"]
    assert "although every other recorded channel took much the same values in both" in d.sentence
    assert d.sentence.endswith("If the machine changed between them, diagnose the newer file alone.")
    assert "turned" not in d.sentence


class Between:
    """A search that found something that explains only differences between files, and another without it."""

    def __init__(self, drop: float, other: Diagnosis) -> None:
        self.model, self.other = Model(small_machine(), (), name="m"), other
        self.between, self.refits = [(drop, frozenset({"x", "T_bed"}))], SimpleNamespace(given={"T_bed", "T_air"})
        self.left_out: set[str] = set()

    def without(self, channels: Collection[str]) -> "Between":
        self.left_out = set(channels)
        return self

    def diagnosis(self) -> Diagnosis:
        return self.other


def test_what_explains_more_without_the_temperatures_is_named_instead() -> None:
    """Oracle: the shares that were written here; an angle removes 43 %, two beams at two offsets show it."""
    tilt = "angular_motion,component=EBX,axis=X,c2=0,c3=30"
    beams = [laser([tilt], 3), laser([tilt], 4, setup={"beam_offset_mm": [0.0, 0.0, 100.0]})]
    angle = diagnose(Model(small_machine(), (), name="m"), beams, draws=50)
    assert angle.group
    doubt = Doubt("between_files", "It explains only what differs.", "", fatal=True)
    doubted = replace(angle, doubts=(doubt,), sentence="in doubt")
    drop = angle.findings[0].heldout_drop
    less, more = Between(drop - 0.01, angle), Between(drop + 0.01, angle)
    assert instead_of_files(less, doubted) is angle  # type: ignore[arg-type]
    assert less.left_out == {"T_bed", "T_air"}
    assert instead_of_files(more, doubted) is doubted  # type: ignore[arg-type]
    nothing = replace(angle, findings=())
    assert instead_of_files(Between(0.0, nothing), doubted) is doubted  # type: ignore[arg-type]
    assert instead_of_files(less, nothing) is nothing  # type: ignore[arg-type]


def test_the_second_search_has_nothing_that_reads_them() -> None:
    search = Search(
        Model(small_machine(), (), name="m"), clean([laser([], 3)]), 1, 0.05, 50, None, False, lambda *_: None
    )
    other = search.without({"T_bed", "T_air"})
    read = {c for e in other.candidates for c in e.effect.channels(small_machine())}
    assert read
    assert not read & {"T_bed", "T_air"}
    assert len(other.candidates) < len(search.candidates)


AIR_DEGC = (18.5, 24.5, 21.6, 25.5, 19.4)


def weeks(seed: int, longer_um_per_m: Sequence[float]) -> list[Measurement]:
    """Five tests of one run there and back in five weeks, each at the temperature that was written down that day."""
    machine, rng, x = small_machine(), np.random.default_rng(seed), np.linspace(10.0, 190.0, 15)
    place, way = np.concatenate([x, x[::-1]]), np.repeat([1.0, -1.0], 15)
    made = make_instrument("laser_linear", {}, "X", "EXX", machine, "test")
    out = []
    for i, (degc, k) in enumerate(zip(AIR_DEGC, longer_um_per_m, strict=True)):
        channels = {"x": place, "d_x": way, "T_air": np.full(30, degc)}
        read_um = {"reading_um": 1e-3 * k * place + way + 0.3 * rng.standard_normal(30)}
        out.append(
            Measurement(f"w{i}", made, machine, np.repeat([1, 2], 15), 10.0 * np.arange(30.0), channels, read_um)
        )
    return out


@pytest.mark.parametrize("seed", proof.few([1, 2, 3], 2))
def test_five_days_on_one_line_over_the_air_are_an_expansion(seed: int) -> None:
    """Oracle: 12 µm/(m·K) were put in; two of the days, at both sides of 20 °C, had contradicted each other."""
    known = Model(small_machine(), effects(KNOWN[0]), name="known")
    d = diagnose(known, weeks(seed, [12.0 * (degc - 20.0) for degc in AIR_DEGC]), draws=50)
    first = d.findings[0]
    assert first.accepted, d.sentence
    assert first.label == "axis_expansion(EXX, X, T_air)"
    assert first.parameters["k"].value == pytest.approx(12.0, rel=0.1)
    assert not any(x.fatal for x in d.doubts)


@pytest.mark.parametrize("seed", proof.few([1, 2, 3], 2))
def test_five_days_that_differ_by_something_else_are_none(seed: int) -> None:
    """The same sizes in another order. Oracle: no line over the air meets them."""
    known = Model(small_machine(), effects(KNOWN[0]), name="known")
    d = diagnose(known, weeks(seed, [54.0, -18.0, 66.0, -7.0, 19.0]), draws=50)
    assert not any(f.accepted and "T_air" in f.label for f in d.findings), d.sentence
