"""The benchmark's machine and its heat against what is known of them by hand, and the program's own lever arms."""

import numpy as np
import pytest

from rtec.bench.rig import campaign, machine
from rtec.bench.rig.campaign import line
from rtec.bench.rig.machine import displaced, rotation
from rtec.bench.sets import machine_of, measurements_of
from rtec.bench.trials import GROUPS, build


def test_a_turn_keeps_lengths() -> None:
    """Oracle: a rotation matrix is orthonormal with determinant one."""
    for axis in range(3):
        (r,) = rotation(axis, np.array([0.7]))
        assert r @ r.T == pytest.approx(np.eye(3), abs=1e-14)
        assert np.linalg.det(r) == pytest.approx(1.0)


@pytest.mark.parametrize("component", ["EXX", "EBX", "ECX", "EAY", "EBZ", "EC0Y", "EB0Z", "EB0spindle", "EA0column"])
def test_arms_are_those_of_the_program(component: str) -> None:
    """Oracle: the program's chain of the same machine file; two ways to the same geometry."""
    trial = build("plates", "two_on_plate", 1)
    (m,), plan = measurements_of(trial), trial.records[0].plan
    ones = np.ones(len(plan))
    mine = displaced({component: ones}, plan.pose_mm).T
    theirs = m.instrument.arms_of(machine_of(trial), m.state().positions_mm(), component)
    assert mine == pytest.approx(theirs, abs=1e-5)


def test_heat_is_conserved_where_none_flows() -> None:
    """Oracle: bodies that are as warm as the air stay so."""
    time = np.arange(0.0, 3600.0, machine.STEP_S)
    power = {name: np.zeros_like(time) for name in machine.BODIES}
    body, screw = machine._integrate(time, np.full_like(time, 2.0), power, np.zeros_like(time))
    assert all(v == pytest.approx(2.0) for v in (*body.values(), screw))


def test_an_even_screw_grows_as_steel_does() -> None:
    """Oracle: 11.5 µm per metre and kelvin."""
    time = np.arange(0.0, 600.0, machine.STEP_S)
    day = machine.Day(time, time * 0.0, {}, np.full((len(time), machine.ELEMENTS), 3.0))
    place = np.array([0.0, 200.0, 600.0])
    assert day.growth(place, np.zeros(3)) == pytest.approx(11.5 * 3.0 * place * 1e-3)


@pytest.mark.parametrize("form", campaign.FORMS)
def test_noise_has_a_white_part_of_its_size(form: str) -> None:
    """Oracle: 0.3 to 0.8 µm between neighbouring readings; a coarse display adds up to 1/√12 of its step."""
    plan = line(np.random.default_rng(3))
    drawn = [campaign.draw_noise(np.random.default_rng(s), form, plan.time_s, plan.run).values for s in range(12)]
    rough = [1.4826 * float(np.median(np.abs(np.diff(d)))) / np.sqrt(2.0) for d in drawn]
    assert min(rough) > 0.2
    assert max(rough) < 1.1


def test_an_axis_turns_beyond_all_that_it_passed() -> None:
    """Oracle: no target of either way lies beyond the place where the axis turned round."""
    plan = line(np.random.default_rng(5))
    way = plan.direction["X"]
    turned = np.flatnonzero(np.diff(way) != 0) + 1
    place = (plan.q - way * plan.since_mm)[turned]
    for here, at in zip(turned, place, strict=True):
        assert (way[here] * (plan.q[here - 1 : here + 1] - at)).min() == pytest.approx(1.0)


def test_the_same_words_give_the_same_bits() -> None:
    """Oracle: the first time; another seed differs."""
    one, two, other = (build("run_level", "load_shift", s).records[0].readings["reading_um"] for s in (5, 5, 6))
    assert one.tobytes() == two.tobytes()
    assert one.tobytes() != other.tobytes()


@pytest.mark.parametrize("group", GROUPS)
def test_every_trial_can_be_measured(group: str) -> None:
    """Oracle: the program's own checks of machines, models and measurements."""
    for what in GROUPS[group]:
        trial = build(group, what, 2)
        for m in measurements_of(trial):
            assert group == "improve" or np.isfinite(m.matrix()).all()
