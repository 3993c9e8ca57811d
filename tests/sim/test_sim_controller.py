"""The position loop, the play and what insertion and offsets do to the slide."""

import math

import numpy as np
import pytest

from rtec.sim.machine import SimulatedMachine
from tests.support.sim_example import MS, S, plain, plain_machine, plain_truth, run_out


@pytest.mark.parametrize("encoder", ["screw", "scale"])
@pytest.mark.parametrize("play_um", [0.0, 8.0])
def test_settles_on_commanded_corrected_counts(encoder: str, play_um: float) -> None:
    """Oracle: the command in counts, to the count, with anything inserted."""
    sim = plain(encoder=encoder, backlash_um=play_um, screw={"cyclic_um": 1.5})
    for target, inserted in ((120.0, 0), (40.0, 17), (40.017, -250)):
        sim.apply(np.array([inserted, -inserted]))
        run_out(sim, f"G1 X{target} Z{target} F6000")
        want = round(target * 1000)
        np.testing.assert_array_equal(sim.raw_counts + sim.inserted_counts, [want, want])


@pytest.mark.parametrize("k", [25, -40, 1])
def test_inserted_counts_stop_the_slide_sooner(k: int) -> None:
    """Oracle: [G 4.2]: +k counts inserted in positive motion, the slide stands k counts short of where it would."""
    without, with_k = plain(), plain()
    with_k.apply(np.array([k, 0]))
    for sim in (without, with_k):
        run_out(sim, "G1 X100 F3000")
    assert with_k.raw_counts[0] == without.raw_counts[0] - k
    assert abs((without.actual_mm[0] - with_k.actual_mm[0]) * 1000 - k) < 0.2
    assert abs(with_k.tip_error_um()[0] - without.tip_error_um()[0] + k) < 0.2


def test_insertion_at_standstill_moves_the_slide() -> None:
    """Oracle: the same k counts, without a program."""
    sim = plain()
    run_out(sim, "G0 X100")
    sim.apply(np.array([30, 0]))
    sim.advance_to(sim.time_ns + S)
    assert sim.raw_counts[0] == 100_000 - 30


@pytest.mark.parametrize("kind", ["following_error", "origin"])
def test_offsets_move_the_slide_their_own_way(kind: str) -> None:
    """Oracle: +12 µm goes 12 µm further, in µm and machine coordinates."""
    sim = plain()
    run_out(sim, "G0 X100")
    before = sim.actual_mm[0]
    sim.set_offset_um([12.0, 0.0], kind)
    sim.advance_to(sim.time_ns + S)
    assert abs((sim.actual_mm[0] - before) * 1e3 - 12.0) < 0.3


def test_an_origin_offset_waits_for_the_next_block() -> None:
    """Oracle: nothing moves within the block under way."""
    sim, twin = plain(), plain()
    for s in (sim, twin):
        s.load_program("G1 X100 F6000\nG1 X120")
        s.advance_to(300 * MS)
    sim.set_offset_um([15.0, 0.0], "origin")
    for s in (sim, twin):
        s.advance_to(900 * MS)
    assert sim.raw_counts[0] == twin.raw_counts[0]
    for s in (sim, twin):
        s.advance_to(3 * S)
    assert sim.raw_counts[0] == twin.raw_counts[0] + 15


def test_play_between_motor_and_slide() -> None:
    """Oracle: the slide stands half the play behind the last direction; a move within the play leaves it still."""
    sim = plain(backlash_um=6.0)
    run_out(sim, "G1 X100 F600")
    reading = sim.raw_counts[0] * 1e-3
    assert abs((sim.actual_mm[0] - reading) * 1e3 + 3.0) < 0.6
    stood = sim.actual_mm[0]
    run_out(sim, "G1 X99.996 F600")
    assert sim.raw_counts[0] == 99_996
    assert abs(sim.actual_mm[0] - stood) < 1e-9
    run_out(sim, "G1 X99.9 F600")
    assert abs((sim.actual_mm[0] - 99.9) * 1e3 - 3.0) < 0.6


def test_play_inside_the_loop_of_a_scale() -> None:
    """Oracle: with a linear scale the slide itself reaches the count, from either side."""
    sim = plain(encoder="scale", backlash_um=6.0)
    for start in ("G1 X90 F600\nG1 X100", "G1 X110 F600\nG1 X100"):
        run_out(sim, start)
        assert abs(sim.actual_mm[0] - 100.0) < 0.6e-3


def test_drive_follows_a_ramp_as_the_first_order_formula_says() -> None:
    """Oracle: following error v·(1 - feed forward)/Kv at steady speed [classical type 1 loop]."""
    for feed_forward in (0.0, 0.5):
        sim = plain(drive={"feed_forward": feed_forward, "kv_per_s": 50.0})
        sim.load_program("G1 X200 F6000")
        sim.advance_to(1 * S)
        lag = sim.commanded_mm[0] - sim.actual_mm[0]
        assert abs(lag - 100.0 * (1 - feed_forward) / 50.0) < 3e-3


def test_feed_forward_keeps_arcs_round() -> None:
    """Oracle: the commanded radius, within counts and the drive's roll-off, over a whole circle, both senses."""
    for word in ("G2", "G3"):
        sim = plain()
        run_out(sim, "G0 X130 Z100")
        sim.load_program(f"{word} X130 Z100 I-30 F2000")
        got = sim.record_to(sim.time_ns + round(sim.program_s * S), 5 * MS)
        ideal = np.hypot(*(got.commanded_mm - 100).T)
        real = np.hypot(*(got.actual_mm - 100).T)
        assert np.abs(ideal - 30).max() < 1e-9
        assert np.abs(real - 30).max() < 2e-3
        angle = np.unwrap(np.arctan2(got.actual_mm[:, 0] - 100, got.actual_mm[:, 1] - 100))
        assert abs(abs(angle[-1] - angle[0]) - 2 * math.pi) < 0.02


def test_encoder_error_on_the_screw_reaches_the_slide_the_other_way() -> None:
    """Oracle: where the encoder shows 2 µm too much, the controller stops the slide 2 µm short."""
    sim = plain(screw={"encoder_um": 2.0})
    run_out(sim, "G1 X101.25 F600")  # a quarter of the pitch: the sine is at its top
    assert abs((sim.actual_mm[0] - 101.25) * 1e3 + 2.0) < 0.6


def test_encoder_in_the_loop_is_the_encoder_of_the_truth() -> None:
    """Oracle: reading = slide - error of the scale there; the error by hand: wave, once and twice per pitch, heat."""
    screw = {"cyclic_um": 2.0, "cyclic_phase_rad": 0.4, "cyclic2_um": 1.0, "cyclic2_phase_rad": 1.1}
    heat = {"bodies": ["head"], "um_per_m_degc": 12.0, "fixed_at_mm": 20.0}
    wave = {"EXX": {"waves": [[5.0, 300.0, 0.0]]}}
    sim = plain(encoder="scale", screw={**screw, **heat}, motion_um=wave)
    sim.work(3600, 2000)
    rise = sim.thermal.body_degc[0] - 20.0
    assert rise > 10
    for target in (41.0, 63.3, 152.6):
        run_out(sim, f"G1 X{target} F3000")
        reading = (sim.record_to(sim.time_ns + MS, MS).reading_counts[0, 0] - 0.5) / 1000
        rise = sim.thermal.body_degc[0] - 20.0
        s = sim.actual_mm[0]
        turn = 2 * math.pi * s / 5.0
        error = 5 * math.sin(2 * math.pi * s / 300) + 2 * math.sin(turn + 0.4) + math.sin(2 * turn + 1.1)
        error += 12e-3 * rise * (s - 20.0)
        assert abs((s - reading) * 1e3 - error) < 0.01
        assert abs(error) > 1


def test_spindle_runs_up_and_heats() -> None:
    """Oracle: the ramp of the truth, 2000 1/min per s; heat 100 W · 1.5^1.5 into 1000 J/K for 60 s at most."""
    sim = plain()
    sim.load_program("S1500 M3")
    sim.advance_to(500 * MS)
    assert abs(sim.spindle_rpm - 1000.0) < 2.0
    sim.advance_to(60 * S)
    assert sim.spindle_rpm == 1500.0
    heat_w, loss_per_s = 100 * 1.5**1.5, 2.0 / 1000.0
    rise = heat_w / 2.0 * (1 - math.exp(-loss_per_s * 59.6))
    assert abs(sim.thermal.body_degc[0] - 20.0 - rise) < 0.15


def test_axis_motion_heats_by_its_path() -> None:
    """Oracle: 2 J/mm over 300 mm of path into 1000 J/K, losses small."""
    sim = plain(drive={"heat_j_per_mm": 2.0, "shares": {"head": 1.0}})
    run_out(sim, "G0 X150\nG0 X0")
    sim.advance_to(sim.time_ns // S * S + S)
    assert 0.55 < sim.thermal.body_degc[0] - 20.0 <= 0.6


def test_three_axes() -> None:
    """Oracle: every axis of a milling machine settles on its own command."""
    from rtec.sim.truth import Truth
    from rtec.tomlfile import validated
    from tests.sim.test_sim_chain import milling_machine

    body = {"b": {"capacity_j_per_k": 10.0, "to_air_w_per_k": 1.0}}
    spindle = {"w_at_1000_rpm": 0.0, "exponent": 1.0, "shares": {"b": 1.0}}
    truth = validated(Truth, {"body": body, "spindle": spindle, "axis": {"X": {}, "Y": {}, "Z": {}}}, "t")
    sim = SimulatedMachine(milling_machine(), truth)
    run_out(sim, "G17 G0 X100 Y100\nG3 X100 Y100 Z20 I-20 F3000\nG0 Z33")
    np.testing.assert_array_equal(sim.raw_counts, [100_000, 100_000, 33_000])
    assert np.max(np.abs(sim.tip_error_um())) < 0.6


def test_plain_truth_is_the_default_servo() -> None:
    """Oracle: a machine without errors or insertion has a tip error below one count at rest."""
    sim = SimulatedMachine(plain_machine(), plain_truth(), start_mm=[10.0, 20.0])
    assert np.max(np.abs(sim.tip_error_um())) < 1e-9
    run_out(sim, "G1 X80 Z90 F3000")
    assert np.max(np.abs(sim.tip_error_um())) <= 0.51
