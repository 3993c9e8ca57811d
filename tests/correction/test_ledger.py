"""The ledger's laws. Oracle: integer arithmetic; what is put out, plus what is left, is what was wanted."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtec.correction.guard import ledger_update
from rtec.correction.sinks import DEAD_BAND, FollowingErrorSink, PhaseSink, PulseSink
from rtec.machine import Axis

DT = 0.001


@given(
    st.lists(st.floats(-1e5, 1e5), min_size=1, max_size=200),
    st.sampled_from([1, 4]),
    st.floats(1.0, 1e6),
)
def test_whole_quanta_within_the_rate(wanted: list[float], quantum: int, rate: float) -> None:
    output, allowance, put_out = 0, 0.0, 0
    for cycle, units in enumerate(wanted, 1):
        before = output
        output, allowance = ledger_update(units, output, allowance, DT, quantum, rate)
        assert (output - before) % quantum == 0
        assert abs(units - output) <= abs(units - before) + 1e-9  # never further off than before
        put_out += abs(output - before)
        assert put_out <= rate * DT * cycle + quantum * (1 + 1e-9)
        assert allowance >= 0.0


@given(st.floats(-1e4, 1e4), st.sampled_from([1, 4]))
def test_nothing_is_lost_the_remainder_stays_below_the_dead_band(units: float, quantum: int) -> None:
    output, allowance = 0, 0.0
    for _ in range(3):
        output, allowance = ledger_update(units, output, allowance, DT, quantum, 1e9)
    assert abs(units - output) <= DEAD_BAND * quantum


def test_small_steps_add_up() -> None:
    """A thousand steps of 0.01 count are ten counts, not none (rounding each step would lose them all)."""
    output, allowance = 0, 0.0
    for k in range(1001):
        output, allowance = ledger_update(0.01 * k, output, allowance, DT, 1, 1e6)
    assert output in (9, 10)


def test_noise_within_the_dead_band_does_not_chatter() -> None:
    output, allowance, moves = 0, 0.0, 0
    for k in range(1000):
        after, allowance = ledger_update(0.5 + 0.2 * (-1) ** k, output, allowance, DT, 1, 1e6)
        moves += after != output
        output = after
    assert moves == 0


def test_signs_of_the_sinks() -> None:
    """Pulses make the axis stop sooner [G 4.2.1], so they have the correction's opposite sign; offsets have its own."""
    axis = Axis("X", "X", (0.0, 100.0), counts_per_mm=2000.0)
    assert PulseSink().scale(axis).units_per_um == -2.0
    assert FollowingErrorSink(resolution_um=0.5).scale(axis).units_per_um == 2.0


def test_phase_mode_has_the_resolution_of_the_paper() -> None:
    """[G 4.1]: 8 bits over ±0.1 mm, quoted as 0.7 µm; 200 µm / 256 = 0.78 µm."""
    scale = PhaseSink().scale(Axis("X", "X", (0.0, 100.0), counts_per_mm=1000.0))
    assert 1.0 / scale.units_per_um == pytest.approx(0.78125)
    assert (scale.low, scale.high) == (-128.0, 127.0)
