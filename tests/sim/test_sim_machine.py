"""The simulated machine as a whole: determinism, saving, the shipped files, the sizes of its errors."""

import numpy as np
import pytest

from rtec.errors import ConfigError
from rtec.sim.machine import SimulatedMachine
from rtec.sim.truth import Truth, check_truth
from rtec.tomlfile import read_toml, validated
from tests.support.sim_example import MS, TRUTH_FILE, S, per_mm, plain, plain_machine, plain_truth, run_out, shipped

PROGRAM = "S1200 M3\nG0 X50 Z100\nG1 X100 F1200\nG3 X100 Z100 I-20 K0\nG4 P0.2\nG0 X0 Z0"


def loaded(seed: int) -> SimulatedMachine:
    sim = SimulatedMachine(*shipped(), seed=seed)
    sim.load_program(PROGRAM, repeat=True)
    return sim


def everything(sim: SimulatedMachine) -> list[float]:
    degc, time_ns = sim.temperatures()
    return [*sim.raw_counts, *degc, time_ns, *sim.tip_error_um(), *sim.geometric_error_um(), sim.spindle_rpm]


def test_same_seed_same_day() -> None:
    """Oracle: bit-for-bit equality; another seed differs."""
    one, two, other = loaded(7), loaded(7), loaded(8)
    for sim in (one, two, other):
        sim.advance_to(2500 * MS)
        sim.work(1800, 1500, 0.2)
        sim.advance_to(sim.time_ns + 1700 * MS)
    assert everything(one) == everything(two)
    assert everything(one) != everything(other)


def test_how_often_the_machine_is_asked_does_not_matter() -> None:
    """Oracle: one call, 1 ms calls, odd calls and a recording: the same bits."""
    runs = [loaded(3) for _ in range(4)]
    runs[0].advance_to(2300 * MS)
    for k in range(2300):
        runs[1].advance_to((k + 1) * MS)
    for k in range(0, 2_300_000_000, 77_777_777):
        runs[2].advance_to(k)
    runs[2].advance_to(2300 * MS)
    got = runs[3].record_to(2300 * MS, 7 * MS)
    assert all(everything(runs[0]) == everything(run) for run in runs[1:])
    np.testing.assert_array_equal(got.time_ns, np.arange(7 * MS, 2300 * MS + 1, 7 * MS))


def test_a_recording_is_what_single_questions_give() -> None:
    """Oracle: the properties of the machine, asked at the same instants."""
    recorded, asked = loaded(3), loaded(3)
    recorded.advance_to(1250 * MS)
    got = recorded.record_to(2200 * MS, 50 * MS)
    for k, t in enumerate(got.time_ns):
        asked.advance_to(int(t))
        np.testing.assert_array_equal(got.raw_counts[k], asked.raw_counts)
        np.testing.assert_array_equal(got.commanded_mm[k], asked.commanded_mm)
        np.testing.assert_allclose(got.actual_mm[k], asked.actual_mm, atol=1e-12 if t % S else 2e-5)
        # The row of a whole second still has the temperatures of the second before it.
        np.testing.assert_allclose(got.tip_error_um[k], asked.tip_error_um(), atol=1e-9 if t % S else 0.03)
        np.testing.assert_allclose(got.geometric_error_um[k], asked.geometric_error_um(), atol=1e-9 if t % S else 0.03)


def test_save_and_restore_is_the_identity() -> None:
    """Oracle: a machine that was never stopped."""
    straight, first, second = loaded(5), loaded(5), loaded(5)
    first.work(600, 1000)
    straight.work(600, 1000)
    for sim in (straight, first):
        sim.apply(np.array([5, -7]))
        sim.set_offset_um([2.0, 0.0])
        sim.advance_to(sim.time_ns + 1234 * MS)
    kept = first.save()
    first.advance_to(first.time_ns + 900 * MS)
    for sim in (first, second):
        sim.restore(kept)
        sim.advance_to(sim.time_ns + 3 * S)
    straight.advance_to(straight.time_ns + 3 * S)
    assert everything(straight) == everything(first) == everything(second)
    assert all(isinstance(array, np.ndarray) for array in kept.values())


def test_total_error_is_geometric_error_plus_where_the_encoders_stand() -> None:
    """Oracle: tip error against command = tip error against encoders + (encoders - command), exactly."""
    sim = loaded(2)
    sim.apply(np.array([40, -25]))
    got = sim.record_to(1500 * MS, 10 * MS)
    apart = (got.reading_counts - 0.5) / per_mm(sim) - got.commanded_mm
    wanted = got.geometric_error_um + 1e3 * np.stack([apart[:, 0], 0 * apart[:, 0], apart[:, 1]], axis=1)
    np.testing.assert_allclose(got.tip_error_um, wanted, atol=1e-6)
    np.testing.assert_array_equal(got.raw_counts, np.floor(got.reading_counts))


def test_perfect_insertion_takes_the_error_away() -> None:
    """Oracle: inserting the true error as counts leaves a count and a half in X and Z of 15 µm and more."""
    sim = SimulatedMachine(*shipped(), seed=1)
    sim.work(4 * 3600, 2500, 0.3)
    run_out(sim, "G1 X100 Z200 F3000")
    before = sim.tip_error_um()
    sim.apply(np.rint(sim.geometric_error_um()[[0, 2]] * per_mm(sim) / 1e3).astype(np.int64))
    run_out(sim, "G0 X90 Z190\nG1 X100 Z200 F3000")  # back and here again: the play has its side
    after = sim.tip_error_um()
    assert np.all(np.abs(before[[0, 2]]) > 15)
    assert np.all(np.abs(after[[0, 2]]) < 1.5)


def test_geometric_error_asked_for_a_place_is_that_of_going_there() -> None:
    """Oracle: driving to the place from below and from above; within the slope of the error over a count."""
    sim = SimulatedMachine(*shipped(), seed=1)
    sim.work(3600, 2500, 0.3)
    for start, direction in (("G0 X80 Z150", 1.0), ("G0 X120 Z260", -1.0)):
        run_out(sim, f"{start}\nG1 X101.3 Z203.7 F1000")
        there = (sim.record_to(sim.time_ns + MS, MS).reading_counts - 0.5) / per_mm(sim)
        np.testing.assert_allclose(sim.geometric_error_um(), sim.geometric_error_at_um(there, direction)[0], atol=0.02)


def test_sizes_over_a_day_are_those_of_a_turning_centre() -> None:
    """Oracle: [G]'s machine: 30-40 µm of growth in X and Z over 8 h, most of it gone by morning; straightness."""
    sim = SimulatedMachine(*shipped(), seed=1)
    q = [[100.0, z] for z in np.linspace(0.0, 400.0, 81)]
    cold = sim.geometric_error_at_um(q, 1.0)
    sim.work(8 * 3600, 2500, 0.3)
    grown = np.abs(sim.geometric_error_at_um(q, 1.0) - cold).max(axis=0)
    sim.work(16 * 3600)
    left = np.abs(sim.geometric_error_at_um(q, 1.0) - cold).max(axis=0)
    assert np.all((grown[[0, 2]] > 25) & (grown[[0, 2]] < 50))
    assert np.all(left < 0.4 * grown.max())
    x_of_z = cold[:, 0] - np.polyval(np.polyfit(np.arange(81), cold[:, 0], 1), np.arange(81))
    assert 2 < np.ptp(x_of_z) < 12


def test_no_low_polynomial_is_the_truth() -> None:
    """Oracle: a cubic fitted to the cold positioning error leaves more than its cyclic part explains."""
    sim = SimulatedMachine(*shipped(), seed=1)
    x = np.linspace(5.0, 195.0, 39)  # steps of one pitch, so the cyclic part stands still
    error = sim.geometric_error_at_um(np.stack([x, 0 * x + 100], axis=1), 1.0)[:, 0]
    left = error - np.polyval(np.polyfit(x - 100, error, 3), x - 100)
    assert np.std(left) > 0.15


def test_shipped_truth_fits_and_names_are_checked() -> None:
    """Oracle: the messages, with the nearest allowed name; all faults at once."""
    machine, truth = shipped()
    check_truth(truth, machine)
    bad = read_toml(TRUTH_FILE)
    bad["sensor"]["T_spindel_front"] = bad["sensor"].pop("T_spindle_front")
    bad["growth_um"][0]["body"] = "spindle_frnt"
    bad["axis"]["X"]["motion_um"]["EXZ"] = bad["axis"]["X"]["motion_um"].pop("EZX")
    bad["drift_um"][0]["link"] = "workpice"
    with pytest.raises(ConfigError) as caught:
        SimulatedMachine(machine, validated(Truth, bad, "t"))
    text = str(caught.value)
    for said in (
        "[sensor.T_spindel_front] is not in the machine; did you mean 'T_spindle_front'?",
        "[sensor.T_spindle_front] is missing",
        "no body 'spindle_frnt'; did you mean 'spindle_front'?",
        "no motion 'EXZ'",
        "no link 'workpice'; did you mean 'workpiece'?",
    ):
        assert said in text


def test_unknown_key_names_section_and_nearest() -> None:
    """Oracle: the message's words."""
    bad = read_toml(TRUTH_FILE)
    bad["axis"]["Z"]["backlash_mu"] = 3.0
    with pytest.raises(
        ConfigError, match=r"truth\.toml: \[axis\.Z\] unknown key 'backlash_mu'; did you mean 'backlash_um'"
    ):
        validated(Truth, bad, "truth.toml")


def test_time_does_not_go_back() -> None:
    """Oracle: an instant that has passed changes nothing."""
    sim = plain()
    sim.load_program("G0 X50")
    sim.advance_to(100 * MS)
    before = sim.save()
    sim.advance_to(50 * MS)
    for name, array in sim.save().items():
        np.testing.assert_array_equal(array, before[name])


def test_start_is_kept_within_the_travel() -> None:
    """Oracle: the nearest end."""
    sim = SimulatedMachine(plain_machine(), plain_truth(), start_mm=[-5.0, 900.0])
    np.testing.assert_array_equal(sim.raw_counts, [0, 200_000])
