"""The step: one source for loop, replay and pure function; guard, ledger and flags behind the model.

Oracles: `Model.predict` in numpy for what is requested; the sample's own ages and ranges for the flags; bitwise
equality between n = 1 and n = many.
"""

import tracemalloc

import numpy as np
import pytest

from rtec.correction.flags import MODE_HOLD, MODE_OFF, MODE_ON, Flag, GuardSettings, Limits
from rtec.correction.sinks import FollowingErrorSink, PhaseSink, PulseSink
from rtec.effects import EFFECTS
from rtec.errors import ConfigError
from rtec.loop.records import NEVER_NS, Commands, Samples
from rtec.loop.step import Step, StepSettings
from rtec.machine import machine_from
from rtec.model import FittedEffect, Model
from rtec.model.model import names_of
from tests.support.plain_step import plain_module

FAST = Limits(warning_um=500, stop_um=1000, slew_um_s=1e6, acceleration_um_s2=1e10)
SLOW = Limits(warning_um=50, stop_um=100, slew_um_s=20, acceleration_um_s2=400)
NS = 10**9

MACHINE = machine_from(
    {
        "machine": {"name": "lathe", "tool_chain": ["Z", "X", "tool"], "work_chain": ["spindle"]},
        "axis": {
            "X": {"direction": "X", "travel_mm": [0, 200], "counts_per_mm": 1000, "pitch_mm": 5.0},
            "Z": {"direction": "Z", "travel_mm": [0, 400], "counts_per_mm": 2000, "pitch_mm": 10.0},
        },
        "link": {"tool": {"offset_mm": [120, 0, 80]}},
        "temperature": {"Ta": {"range_degc": [0, 90]}, "Tb": {"range_degc": [0, 90]}, "unused": {}},
    },
    "test",
)


def fitted(name: str, values: list[float], theta: list[float] | None = None, **arguments: object) -> FittedEffect:
    effect = EFFECTS[name].model_validate({"effect": name, **arguments})
    linear, free = names_of(effect, MACHINE)
    return FittedEffect(effect, dict(zip(linear, values, strict=True)), dict(zip(free, theta or [], strict=True)))


MODEL = Model(
    MACHINE,
    (
        fitted("scale", [30.0], component="EXX", axis="X"),
        fitted("backlash", [6.0], component="EXX", axis="X"),
        fitted("cyclic_screw", [1.0, 0.5], [10.0], component="EZZ", axis="Z"),
        fitted("axis_expansion", [11.0], component="EZZ", axis="Z", sensor="Ta"),
        fitted("mount_expansion", [2.0], [600.0], component="EX0spindle", sensor="Tb", lag=True),
        fitted("polynomial_position", [3.0, -2.0], component="EBZ", axis="Z"),
    ),
    valid_range={"Ta": (10.0, 60.0), "x": (-1.0, 201.0)},
)


def settings(limits: Limits = FAST, model: Model = MODEL, **more: object) -> StepSettings:
    return StepSettings(model, {"X": limits, "Z": limits}, longest_cycle_s=0.5, **more)  # type: ignore[arg-type]


def samples(n: int, step: Step, seed: int = 3) -> Samples:
    """A wandering machine at 1 kHz with temperatures every 100 ms."""
    rng = np.random.default_rng(seed)
    out = Samples.empty(step.layout, n)
    out.time_ns[:] = 5 * NS + np.arange(n) * 1_000_000
    out.mode[:] = MODE_ON
    out.counts_time_ns[:] = out.time_ns
    out.counts[:, 0] = 100_000 + 50_000 * np.sin(np.arange(n) / 70.0)
    out.counts[:, 1] = 300_000 + 200_000 * np.sin(np.arange(n) / 110.0)
    tick = np.arange(n) // 100
    warm = 20.0 + np.cumsum(rng.normal(0.1, 0.1, (tick.max() + 1, 3)), axis=0)
    out.degc[:] = warm[tick]
    out.degc_time_ns[:] = (5 * NS + tick * 100_000_000)[:, None]
    return out


def same(a: Commands, b: Commands) -> bool:
    return all(
        np.array_equal(
            x.view(np.int64) if x.dtype == np.float64 else x, y.view(np.int64) if y.dtype == np.float64 else y
        )
        for x, y in zip(a.arrays().values(), b.arrays().values(), strict=True)
    )


def test_requested_is_minus_the_models_prediction() -> None:
    step = Step(settings())
    data = samples(2000, step)
    commands = step.run(data)
    # The loop's lag moves on when a sensor has something new; so does the reference, on those rows only.
    fresh = np.flatnonzero(np.diff(data.degc_time_ns[:, 0], prepend=0))
    held = np.searchsorted(fresh, np.arange(2000), side="right") - 1
    x, z = data.counts[:, 0] / 1000.0, data.counts[:, 1] / 2000.0
    whole = MODEL.state(data.time_ns / NS, {"x": x, "z": z})
    at_fresh = MODEL.state(data.time_ns[fresh] / NS, {"Tb": data.degc[fresh, 1]})
    lagged = at_fresh.lagged(at_fresh.rise("Tb"), 600.0)[held]
    channels = {"x": x, "z": z, "d_x": whole.value("d_x"), "Ta": data.degc[:, 0], "Tb": data.degc[:, 1]}
    others = Model(MACHINE, tuple(f for f in MODEL.effects if not f.theta or "tau" not in f.theta))
    tip = others.predict(others.state(data.time_ns / NS, channels))
    tip[:, 0] -= 2.0 * lagged  # a work-side link's own displacement: e = -δ
    np.testing.assert_allclose(commands.requested_um, -tip[:, [0, 2]], atol=1e-9)
    assert np.ptp(commands.requested_um[:, 0]) > 5.0


def test_singles_equal_a_batch_bit_for_bit() -> None:
    one, many = Step(settings(SLOW)), Step(settings(SLOW))
    data = samples(700, one)
    batch = many.run(data)
    for i, single in enumerate(data.singles()):
        assert same(one.run(single), batch.rows(i, i + 1)), f"row {i}"


def test_counts_that_were_never_read_are_no_position() -> None:
    """A device gives its first counts after 40 cycles. Oracle: a step that begins with them: the same requests, so no
    direction from the way between 0 and the first counts."""
    late, whole = Step(settings(SLOW)), Step(settings(SLOW))
    data = samples(300, late)
    data.counts[:], data.degc[:] = data.counts[0], data.degc[0]  # at rest
    wanted = whole.run(data.rows(40, 300))
    data.counts[:40], data.counts_time_ns[:40] = 0, NEVER_NS
    found = late.run(data).rows(40, 300)
    np.testing.assert_allclose(found.requested_um, wanted.requested_um, atol=1e-9)
    assert np.abs(late.state.floats[late.source.floats.at["d"]]).max() == 0.0


def test_advance_is_pure() -> None:
    step = Step(settings(SLOW))
    data = samples(300, step)
    start = step.fresh_state()
    kept = start.copy()
    middle, first = step.advance(start, data.rows(0, 150))
    _, second = step.advance(middle, data.rows(150, 300))
    _, again = step.advance(start, data)
    np.testing.assert_array_equal(start.floats, kept.floats)
    np.testing.assert_array_equal(start.ints, kept.ints)
    assert same(first, again.rows(0, 150))
    assert same(second, again.rows(150, 300))


def test_without_numba_the_same_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same source as plain Python. Oracle: the compiled step."""
    compiled = Step(settings(SLOW))
    data = samples(250, compiled)
    wanted = compiled.run(data)
    plain = Step(settings(SLOW))
    monkeypatch.setattr(plain, "_step", plain_module(plain.source.text).step)
    found = plain.run(data)
    np.testing.assert_allclose(found.applied_um, wanted.applied_um, atol=1e-12)
    np.testing.assert_array_equal(found.output, wanted.output)
    np.testing.assert_array_equal(found.flags, wanted.flags)


def test_nothing_is_allocated_per_cycle() -> None:
    step = Step(settings())
    data, commands = samples(1, step), Commands.empty(step.layout, 1)
    cycle = step.bind(data, commands)
    cycle()
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    for _ in range(100_000):
        cycle()
    grown = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    assert grown < 2_000  # the list of the traced range itself, nothing that grows with the cycles


def flags_of(step: Step, data: Samples) -> list[Flag]:
    return [Flag(int(f)) for f in step.run(data).flags]


def settled(step: Step) -> tuple[Samples, Commands]:
    """A machine at rest with its correction arrived."""
    data = samples(400, step)
    data.counts[:] = data.counts[0]
    data.degc[:] = 30.0
    return data, step.run(data)


@pytest.mark.parametrize(
    ("what", "flag"),
    [
        ("counts", Flag.STALE_COUNTS),
        ("temperature", Flag.STALE_TEMPERATURE),
        ("nan", Flag.STALE_TEMPERATURE),
        ("wire", Flag.SENSOR_FAULT),
        ("range", Flag.OUT_OF_RANGE),
        ("travel", Flag.OUT_OF_RANGE),
    ],
)
def test_bad_input_holds_and_says_why(what: str, flag: Flag) -> None:
    step = Step(settings(guard=GuardSettings(counts_max_age_s=0.005, temperature_max_age_s=2.0)))
    data, before = settled(step)
    late = data.copy()
    late.time_ns[:] += 400_000_000
    late.counts_time_ns[:] = late.time_ns
    late.degc_time_ns[:] = late.time_ns[:, None]
    match what:
        case "counts":
            late.counts_time_ns[:] -= 6_000_000
        case "temperature":
            late.degc_time_ns[:] = int(late.time_ns[0]) - 2_100_000_000
        case "nan":
            late.degc[:, 0] = np.nan
        case "wire":
            late.degc[:, 0] = 1372.0
        case "range":
            late.degc[:, 0] = 70.0
        case "travel":
            late.counts[:, 0] = -2000
    after = step.run(late)
    assert all(Flag(int(f)) & flag and Flag(int(f)) & Flag.HELD for f in after.flags)
    np.testing.assert_array_equal(after.applied_um, np.broadcast_to(before.applied_um[-1], after.applied_um.shape))
    np.testing.assert_array_equal(after.output, np.broadcast_to(before.output[-1], after.output.shape))


def test_a_sensor_that_the_model_does_not_read_stops_nothing() -> None:
    step = Step(settings())
    data, _ = settled(step)
    data.degc[:, 2] = np.nan
    assert step.sensors == ("Ta", "Tb")
    assert not any(f & Flag.HELD for f in flags_of(Step(settings()), data))


def test_a_model_that_reads_no_temperature_has_none_that_could_be_stale() -> None:
    step = Step(settings(model=Model(MACHINE, (fitted("scale", [30.0], component="EXX", axis="X"),))))
    data = samples(400, step)
    data.degc[:] = np.nan
    data.degc_time_ns[:] = 0
    data.time_ns[200:] += 40 * NS  # longer than any temperature may be old
    data.counts_time_ns[:] = data.time_ns
    assert step.sensors == ()
    assert not any(f & (Flag.HELD | Flag.STALE_TEMPERATURE) for f in flags_of(step, data))


@pytest.mark.parametrize(("counts", "held"), [(201_000, False), (201_001, True), (-1_000, False), (-1_001, True)])
def test_both_ends_of_the_models_range_hold(counts: int, held: bool) -> None:
    """Oracle: the model's `valid_range` of x, -1 to 201 mm, at 1000 counts/mm."""
    step = Step(settings())
    data = samples(3, step)
    data.counts[:, 0] = counts
    assert all(bool(f & Flag.OUT_OF_RANGE) == held for f in flags_of(step, data))


def test_a_spindle_speed_outside_the_models_range_holds() -> None:
    """Oracle: the model's `valid_range` of spindle_rpm."""
    growth = fitted("spindle_growth", [5.0], [600.0, 1.0], component="EZ0spindle")
    step = Step(settings(model=Model(MACHINE, (growth,), valid_range={"spindle_rpm": (0.0, 3000.0)})))
    for rpm, flag in ((3000.0, Flag(0)), (3001.0, Flag.OUT_OF_RANGE), (np.nan, Flag.STALE_TEMPERATURE)):
        data = samples(2, step)
        data.spindle_rpm[:] = rpm
        wrong = Flag.OUT_OF_RANGE | Flag.STALE_TEMPERATURE
        assert [f & wrong for f in flags_of(step, data)] == [flag, flag]


def test_after_a_pause_nothing_jumps() -> None:
    """Oracle: slew limit times the longest time that a cycle counts for, half a second here."""
    step = Step(settings(SLOW))
    data = samples(40, step)
    data.counts[:] = data.counts[0]
    data.degc[:] = 45.0
    data.time_ns[20:] += 60 * NS
    data.counts_time_ns[:] = data.time_ns
    data.degc_time_ns[:] = data.time_ns[:, None]
    commands = step.run(data)
    assert np.abs(commands.requested_um).max() > 40.0
    moved_um = np.abs(np.diff(commands.applied_um, axis=0))
    assert 0.0 < moved_um[19].max() <= 20.0 * 0.5 * (1 + 1e-9)


def test_over_the_stop_limit_is_not_followed() -> None:
    tight = Limits(warning_um=2, stop_um=4, slew_um_s=1e6, acceleration_um_s2=1e10)
    step = Step(settings(tight))
    data = samples(200, step)
    data.counts[:] = data.counts[0]
    data.degc[:] = 20.0 + np.linspace(0, 5, 200)[:, None]
    data.degc_time_ns[:] = data.time_ns[:, None]
    commands = step.run(data)
    over = np.abs(commands.requested_um).max(axis=1) > 4.0
    assert 0 < np.count_nonzero(over) < 200
    np.testing.assert_array_equal((commands.flags & int(Flag.OVER_STOP_LIMIT)) != 0, over)
    warned = np.abs(commands.requested_um).max(axis=1) > 2.0
    np.testing.assert_array_equal((commands.flags & int(Flag.OVER_WARNING_LIMIT)) != 0, warned)
    assert np.abs(commands.applied_um).max() <= 4.0
    held = commands.applied_um[over]
    np.testing.assert_array_equal(held, np.broadcast_to(held[0], held.shape))


def test_off_fades_at_the_slew_limit_and_hold_stays() -> None:
    step = Step(settings(SLOW))
    data = samples(12_000, step)
    data.counts[:] = data.counts[0]
    data.degc[:] = 24.0
    data.degc_time_ns[:] = data.time_ns[:, None]
    data.mode[4000:6000] = MODE_HOLD
    data.mode[6000:] = MODE_OFF
    commands = step.run(data)
    reached = commands.applied_um[3999]
    assert np.abs(reached).max() > 3.0
    np.testing.assert_array_equal(commands.applied_um[4000:6000], np.broadcast_to(reached, (2000, 2)))
    steps = np.abs(np.diff(commands.applied_um, axis=0)).max()
    assert steps <= 20.0 * 0.001 * (1 + 1e-9)
    np.testing.assert_array_equal(commands.applied_um[-1], [0.0, 0.0])
    np.testing.assert_array_equal(commands.output[-1], [0, 0])


def test_a_long_hold_fades_where_so_configured() -> None:
    step = Step(settings(SLOW, guard=GuardSettings(temperature_max_age_s=1.0, fade_after_s=2.0)))
    data = samples(12_000, step)
    data.counts[:] = data.counts[0]
    data.degc[:] = 24.0
    data.degc_time_ns[:] = np.minimum(data.time_ns, 5 * NS + 3 * NS)[:, None]
    commands = step.run(data)
    fading = (commands.flags & int(Flag.FADING)) != 0
    assert np.flatnonzero(fading)[0] == pytest.approx(6002, abs=2)  # 3 s, stale after 1 s more, fading after 2 s more
    assert np.abs(commands.applied_um[5999]).max() > 3.0
    np.testing.assert_array_equal(commands.applied_um[-1], [0.0, 0.0])


def test_a_hold_that_ended_does_not_count_towards_the_next() -> None:
    """Two holds of 1.5 s with a second between them, where 2 s of hold would fade: nothing fades."""
    step = Step(settings(SLOW, guard=GuardSettings(fade_after_s=2.0)))
    data = samples(6000, step)
    data.counts[:] = data.counts[0]
    data.degc[:] = 24.0
    data.mode[1000:2500] = MODE_HOLD
    data.mode[3500:5000] = MODE_HOLD
    flags = step.run(data).flags
    assert np.count_nonzero(flags & int(Flag.HELD)) == 3000
    assert not np.any(flags & int(Flag.FADING))


def test_outputs_are_the_applied_correction_in_the_sinks_units() -> None:
    scales = {
        "X": PulseSink(quantum_counts=4).scale(MACHINE.axis("X")),
        "Z": FollowingErrorSink(resolution_um=0.5).scale(MACHINE.axis("Z")),
    }
    step = Step(settings(sinks=scales))
    data, commands = settled(step)
    x, z = commands.applied_um[-1]
    assert commands.output[-1, 0] % 4 == 0
    assert commands.output[-1, 0] == pytest.approx(-x, abs=3)
    assert commands.output[-1, 1] == pytest.approx(z / 0.5, abs=0.75)
    # A new value to the following-error register every 20 ms, not every cycle.
    moving = Step(settings(sinks=scales))
    run = moving.run(samples(400, moving))
    changes = np.flatnonzero(np.diff(run.output[:, 1]))
    assert len(changes) > 5
    assert np.all((changes + 1) % 20 == 0)
    del data


def test_a_full_converter_says_so() -> None:
    step = Step(settings(sinks={"X": PhaseSink(bits=4, range_mm=0.002).scale(MACHINE.axis("X"))}))
    commands = step.run(samples(400, step))
    full = (commands.flags & int(Flag.OUTPUT_SATURATED)) != 0
    assert np.count_nonzero(full) > 0
    assert set(commands.output[full, 0].tolist()) <= {7, -8}


def test_a_ledger_taken_over_is_no_jump() -> None:
    step = Step(settings(SLOW))
    step.resume(np.array([-30, 44]))
    data = samples(1, step)
    data.mode[:] = MODE_HOLD
    commands = step.run(data)
    np.testing.assert_array_equal(commands.output[0], [-30, 44])
    np.testing.assert_allclose(commands.applied_um[0], [30.0, -22.0])


def test_no_limits_no_run() -> None:
    with pytest.raises(ConfigError, match=r"\[limits.Z\] is missing.*nothing runs without limits"):
        Step(StepSettings(MODEL, {"X": FAST}))


def test_before_any_temperature_nothing_is_requested() -> None:
    step = Step(settings())
    data = samples(50, step)
    data.degc[:20] = np.nan
    data.degc_time_ns[:20] = 0
    commands = step.run(data)
    np.testing.assert_array_equal(commands.requested_um[:20], np.zeros((20, 2)))
    assert all(Flag(int(f)) & Flag.STALE_TEMPERATURE for f in commands.flags[:20])
    assert np.all(np.abs(commands.requested_um[20:, 1]) > 0)
