"""Reload of limits, model and run file: without a jump, or not at all.

Oracles: the slew limit; a step that had the new numbers from the start; a lag that was never interrupted.
"""

import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

from rtec.correction.flags import MODE_HOLD, MODE_ON, Flag, Limits
from rtec.daemon.reload import MOST_BYTES, Now, ReloadReader, read_again
from rtec.effects import EFFECTS
from rtec.errors import RtecError
from rtec.loop.orders import OrderRefused
from rtec.loop.records import Commands, Samples
from rtec.loop.run_file import Setup, load_setup
from rtec.loop.state import IMAGE_BYTES, StateWriter, newest
from rtec.loop.step import Step, StepSettings, lags_of, slots_to_carry
from rtec.model import FittedEffect, Model, save_model
from tests.support import plain_step, setups
from tests.support.parts import part

MS = 1_000_000
SLEW_UM_S = 50.0


def samples(step: Step, first_ms: int, n: int, degc: Callable[[float], float] = lambda _: 27.0) -> Samples:
    """X and Z stand still after a little way; temperatures once a second, by `degc` of the time in s."""
    out = Samples.empty(step.layout, n)
    time_ms = first_ms + np.arange(n)
    out.time_ns[:] = out.counts_time_ns[:] = time_ms * MS
    out.mode[:] = MODE_ON
    out.counts[:] = np.clip(time_ms[:, None], 0, 400) * [10, 10] + [50_000, 100_000]
    seconds = time_ms // 1000
    out.degc[:] = np.array([degc(float(s)) for s in seconds])[:, None]
    out.degc_time_ns[:] = (seconds * 1000 * MS)[:, None]
    out.spindle_rpm[:] = 900.0
    return out


@pytest.fixture(autouse=True)
def plain(monkeypatch: pytest.MonkeyPatch) -> None:
    plain_step.use(monkeypatch)


@pytest.fixture
def setup(tmp_path: Path) -> Setup:
    return setups.setup(tmp_path)


def limited(settings: StepSettings, **x: float) -> StepSettings:
    """Other limits for X."""
    limits = dict(settings.limits)
    limits["X"] = Limits(**{**limits["X"].model_dump(), **x})
    return replace(settings, limits=limits)


def other_model(settings: StepSettings, keep: Callable[[str], bool]) -> StepSettings:
    """The model without some of its effects."""
    model = settings.model
    return replace(settings, model=Model(model.machine, tuple(e for e in model.effects if keep(e.effect.effect))))


def in_steps(before: Commands, after: Commands) -> float:
    """Largest change of the applied correction in one cycle, over both and the seam between them, µm."""
    applied = np.concatenate([before.applied_um[-1:], after.applied_um])
    return float(np.abs(np.diff(applied, axis=0)).max())


def test_other_limits_go_on_from_the_same_correction(setup: Setup) -> None:
    step = Step(setup.step_settings())
    before = step.run(samples(step, 0, 1500))
    step.take_numbers(*Step(limited(setup.step_settings(), slew_um_s=5.0)).all_numbers())
    after = step.run(samples(step, 1500, 500))
    assert after.applied_um[0].tolist() == pytest.approx(before.applied_um[-1].tolist(), abs=0.05)
    fresh = Step(limited(setup.step_settings(), slew_um_s=5.0))
    assert step.all_numbers()[0].tobytes() == fresh.all_numbers()[0].tobytes()
    assert in_steps(before, after) <= SLEW_UM_S * 1e-3 * (1 + 1e-9)


def test_other_coefficients_count_at_once(setup: Setup) -> None:
    """Not only when the next temperature comes. Oracle: a step that had them from the start."""
    settings = setup.step_settings()
    model = settings.model
    scale = replace(model.effects[0], values={"k": 60.0})
    other = replace(settings, model=replace(model, effects=(scale, *model.effects[1:])))
    step, alone = Step(settings), Step(other)
    assert step.source.text == alone.source.text
    first, later = samples(step, 0, 1200), samples(step, 1200, 10)
    step.run(first)
    alone.run(first)
    step.take_numbers(*alone.all_numbers())
    requested = step.run(later).requested_um
    np.testing.assert_allclose(requested, alone.run(later).requested_um, atol=1e-9)
    assert abs(requested[0, 0] - Step(settings).run(later).requested_um[0, 0]) > 1.0


@pytest.mark.parametrize("stop_um", [3.0, 8.0])
@pytest.mark.parametrize("mode", [MODE_ON, MODE_HOLD])
def test_a_lower_stop_limit_is_approached_at_the_slew_limit(setup: Setup, stop_um: float, mode: int) -> None:
    """The correction stands at more than the new limit: it moves there, never jumps, and never goes further away."""
    step = Step(setup.step_settings())
    before = step.run(samples(step, 0, 1500))
    assert abs(before.applied_um[-1, 0]) > 10.0
    step.take_numbers(*Step(limited(setup.step_settings(), stop_um=stop_um, warning_um=2.0)).all_numbers())
    held = samples(step, 1500, 2000)
    held.mode[:] = mode
    after = step.run(held)
    size = np.abs(after.applied_um[:, 0])
    assert in_steps(before, after) <= SLEW_UM_S * 1e-3 * (1 + 1e-9)
    assert (np.diff(size[5:]) <= 1e-12).all()
    assert size[-1] == pytest.approx(stop_um, abs=0.1)
    assert size[-1] <= stop_um
    assert after.flags[-1] & Flag.OVER_STOP_LIMIT


def test_another_model_is_reached_at_the_slew_limit(setup: Setup) -> None:
    """Oracle: a step that had the other model from the start, over the same samples: where both must end."""
    settings = setup.step_settings()
    without = other_model(settings, lambda name: name != "backlash")
    step, new, alone = Step(settings), Step(without), Step(without)
    first, later = samples(step, 0, 1500), samples(step, 1500, 3000)
    before = step.run(first)
    alone.run(first)
    new.adopt(step, first.rows(1499, 1500))
    after = new.run(later)
    expected = alone.run(later)
    assert np.abs(after.applied_um[0] - before.applied_um[-1]).max() <= SLEW_UM_S * 1e-3
    assert in_steps(before, after) <= SLEW_UM_S * 1e-3 * (1 + 1e-9)
    np.testing.assert_allclose(after.requested_um[-1], expected.requested_um[-1], atol=1e-9)
    assert np.abs(after.output[-1] - expected.output[-1]).max() <= 1  # each side of the ledger's dead band
    # It started from rest and from the same ledger.
    assert np.abs(after.output[0] - before.output[-1]).max() <= 1


def test_what_a_lag_remembers_goes_over_to_the_other_model(setup: Setup) -> None:
    """The bed warms up; a lag of 15 min must not begin again. Oracle: the lag of a step that was never interrupted."""
    settings = setup.step_settings()
    without = other_model(settings, lambda name: name != "scale")
    step, new, alone = Step(settings), Step(without), Step(without)

    def warming(s: float) -> float:
        return 20.0 + 0.5 * s

    first, later = samples(step, 0, 20_000, warming), samples(step, 20_000, 2000, warming)
    step.run(first)
    alone.run(first)
    new.adopt(step, first.rows(19_999, 20_000))
    slots = slots_to_carry(step.lags, new.lags)
    assert len(slots) == 2
    np.testing.assert_allclose(new._memory[:2], alone._memory[:2], rtol=1e-12)
    requested, expected = new.run(later).requested_um, alone.run(later).requested_um
    np.testing.assert_allclose(requested, expected, atol=1e-9)
    # It matters: begun again the lag would be at the temperature itself, 0.4 µm/K off by degrees.
    cold = Step(without)
    cold.run(first.rows(19_999, 20_000))
    assert np.abs(cold.run(later).requested_um[-1] - expected[-1]).max() > 1.0


def test_which_lag_goes_on_as_which(setup: Setup) -> None:
    lags = lags_of(setup.model)
    assert lags == [(lags[0][0], 900.0)]
    assert "T_bed" in lags[0][0].lower() or "t_bed" in lags[0][0].lower()
    old = [("a", 100.0), ("a", 900.0), ("b", 900.0)]
    assert slots_to_carry(old, [("b", 800.0), ("a", 800.0), ("a", 10.0), ("c", 900.0)]) == [
        (4, 0),
        (5, 1),
        (2, 2),
        (3, 3),
    ]
    assert slots_to_carry([], [("a", 1.0)]) == []
    assert slots_to_carry([("a", 0.0)], [("a", 0.0)]) == [(0, 0), (1, 1)]


def test_a_reload_before_any_temperature_was_read(setup: Setup) -> None:
    """Nothing is known yet, before and after: it holds, and begins as at a start when the first temperature comes."""
    settings = setup.step_settings()
    step, new = Step(settings), Step(other_model(settings, lambda name: name != "backlash"))
    first = samples(step, 0, 100)
    first.degc[:] = np.nan
    step.run(first)
    new.adopt(step, first.rows(99, 100))
    after = new.run(samples(step, 100, 2000))
    assert not after.flags[-1] & Flag.HELD
    alone = Step(new.settings)
    expected = alone.run(samples(alone, 100, 2000))
    np.testing.assert_allclose(after.requested_um[-1], expected.requested_um[-1])


def rewrite(setup: Setup, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the run file."""
    content = setups.tables(setup.base)
    change(content)
    setup.path.write_text(tomli_w.dumps(content), encoding="utf-8")


def test_what_changed_is_said(setup: Setup) -> None:
    assert read_again(setup).changed == []
    rewrite(setup, lambda t: t["limits"]["X"].update(slew_um_s=20.0))
    found = read_again(setup)
    assert found.changed == ["limits of X"]
    assert len(found.message) < MOST_BYTES
    model = setup.model
    save_model(Model(model.machine, model.effects[:-1]), setup.base / "model.toml")
    assert read_again(setup).changed == ["model", "limits of X"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t["run"].update(rate_hz=500.0), "[run] rate_hz changed; it is taken up at a start only"),
        (lambda t: t["device"]["box"].update(seed=4), "[device] changed; it is taken up at a start only"),
        (lambda t: t["role"].pop("spindle"), "[role] changed"),
        (lambda t: t["limits"].pop("Z"), "[limits.Z] is missing"),
        (lambda t: t["limits"]["X"].update(warning_um=500.0), "warning_um 500 is above stop_um 100"),
        (lambda t: t["run"].update(model="absent.toml"), "absent.toml: no such file"),
    ],
)
def test_what_cannot_be_reloaded_is_refused_with_the_reason(setup: Setup, change: Any, message: str) -> None:
    rewrite(setup, change)
    with pytest.raises(RtecError) as e:
        read_again(setup)
    assert message in str(e.value)


@pytest.mark.parametrize("cut", [0, 1, 40, 200])
def test_a_file_that_was_cut_off_changes_nothing(setup: Setup, cut: int) -> None:
    for path in (setup.path, setup.base / "model.toml"):
        whole = path.read_bytes()
        path.write_bytes(whole[:cut])
        with pytest.raises(RtecError):
            read_again(setup)
        path.write_bytes(whole)
    assert read_again(setup).changed == []


def test_an_older_model_file_is_refused_and_the_reader_tells(setup: Setup) -> None:
    """Through the thread that the supervisor uses: a text that says that the old one stays."""
    path = setup.base / "model.toml"
    path.write_text(path.read_text(encoding="utf-8").replace("[model]", "[model]\nformat = 0"), encoding="utf-8")
    reader = ReloadReader(setup, part())
    reader.begin(setup)
    with pytest.raises(OrderRefused, match="an earlier order"):
        reader.begin(setup)
    found = reader._results.get(timeout=60)
    assert isinstance(found, str)
    assert found.startswith("not reloaded, the old one stays in force: ")
    assert "model.toml" in found
    reader.done()
    assert load_setup.__name__ == "load_setup"
    reader.begin(setup)
    reader._results.get(timeout=60)


def test_several_faults_are_one_line_of_an_event(setup: Setup) -> None:
    """Two wrong keys. Oracle: the message names both, without a line break, which an event would show as its escape."""
    rewrite(setup, lambda t: t.update(one={}, two={}))
    reader = ReloadReader(setup, part())
    reader.begin(setup)
    found = reader._results.get(timeout=60)
    assert isinstance(found, str)
    assert "'one'" in found
    assert "; " in found
    assert "'two'" in found
    assert found.isprintable()


@pytest.mark.parametrize("error", [OverflowError("cannot convert float infinity"), ZeroDivisionError(), MemoryError()])
def test_a_fault_that_nobody_foresaw_is_an_answer_too(
    setup: Setup, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    """The order is answered with it, it is counted, and the next order is read."""
    told: list[str] = []
    reads = part(told.append)
    reader = ReloadReader(setup, reads)

    def wrong(_: Path) -> Setup:
        raise error

    with monkeypatch.context() as patch:
        patch.setattr("rtec.daemon.reload.load_setup", wrong)
        reader.begin(setup)
        found = reader._results.get(timeout=60)
    assert isinstance(found, str)
    assert found.startswith("not reloaded, the old one stays in force: fault in the program")
    assert type(error).__name__ in found
    assert type(error).__name__ in told[0]
    assert reads.faults == 1
    reader.done()
    reader.begin(setup)
    assert not isinstance(reader._results.get(timeout=60), str)


def rewrite_model(setup: Setup, change: Callable[[Model], Model]) -> None:
    """Change the model file."""
    save_model(change(setup.model), setup.base / "model.toml")


def times(factor: float, *names: str) -> Callable[[Model], Model]:
    """These effects' coefficients, so many times as large."""

    def change(model: Model) -> Model:
        return replace(
            model,
            effects=tuple(
                replace(e, values={k: factor * v for k, v in e.values.items()}) if e.effect.effect in names else e
                for e in model.effects
            ),
        )

    return change


def now(setup: Setup, degc: float = 27.0) -> Now:
    """The loop, 1.5 s after its start."""
    step = Step(setup.step_settings())
    rows = samples(step, 0, 1500, lambda _: degc)
    step.run(rows)
    image = np.zeros(IMAGE_BYTES, np.uint8)
    writer = StateWriter(image, step, MODE_ON)
    writer.keep(rows.rows(1499, 1500), step.output_of(step.state), 1499)
    return Now(rows.rows(1499, 1500), newest(image.tobytes()))


@pytest.mark.parametrize(
    ("names", "axis"),
    [
        (("scale", "backlash"), "X"),
        (("spindle_growth",), "X"),  # it acts along X on this machine, and scale is the larger: said by the step
        (("ambient_drift", "cyclic_screw"), "Z"),
        (("scale", "backlash", "cyclic_screw", "spindle_growth", "ambient_drift"), "X"),
    ],
)
def test_a_turned_sign_is_asked_about_with_its_numbers(setup: Setup, names: tuple[str, ...], axis: str) -> None:
    """Every effect of the axis times -1. Oracle: the correlation of a correction with its negative is -1."""
    small = [e for e in setup.model.effects if e.effect.effect in names]
    alone = load_setup(setups.write(setup.base, setups.tables(setup.base)))
    rewrite_model(alone, lambda model: replace(model, effects=tuple(small)))
    alone = load_setup(alone.path)
    rewrite_model(alone, times(-1.0, *names))
    with pytest.raises(OrderRefused, match=rf"axis {axis}: .*\(correlation -1\.00; .*rtec ctl reload --yes"):
        read_again(alone, now(alone))
    assert read_again(alone, now(alone), accepts_doubts=True).changed == ["model"]
    rewrite_model(alone, times(1.05, *names))
    assert read_again(alone, now(alone)).changed == ["model"]


def test_a_large_step_is_asked_about_and_a_small_one_is_not(setup: Setup) -> None:
    """X is at 27 mm: 30 µm/m make 0.8 µm there; 19 times as much on top is more than a fifth of warning_um = 60."""
    rewrite_model(setup, times(20.0, "scale"))
    old, new = Step(setup.step_settings()), Step(load_setup(setup.path).step_settings())
    from_um, to_um = (float(step.run(samples(step, 0, 1500)).requested_um[-1, 0]) for step in (old, new))
    assert abs(to_um - from_um) > 12.0
    told = f"axis X: the correction would go from {from_um:+.1f} µm to {to_um:+.1f} µm, more than a fifth of warning_um"
    with pytest.raises(OrderRefused, match=re.escape(told)):
        read_again(setup, now(setup))
    rewrite_model(setup, times(10.0, "scale"))
    assert read_again(setup, now(setup)).changed == ["model"]


def test_an_average_that_turns_round_is_asked_about(setup: Setup) -> None:
    """A correction that is the same all over the machine has no correlation with anything."""
    table = {"effect": "expression", "component": "EXX", "expression": "k * cos(0 * x)", "linear": {"k": "um"}}
    offset = FittedEffect(EFFECTS["expression"].model_validate(table), {"k": 5.0})
    rewrite_model(setup, lambda model: replace(model, effects=(offset,)))
    constant = load_setup(setup.path)
    rewrite_model(constant, times(-1.0, "expression"))
    with pytest.raises(OrderRefused, match="on average, the running one"):
        read_again(constant, now(constant))


def test_before_the_first_row_and_before_the_first_temperature(setup: Setup) -> None:
    """There is no moment to compare; the machine can be compared all the same."""
    rewrite_model(setup, times(-1.0, "scale", "backlash"))
    unknown = now(setup, math.nan)
    for moment in (None, unknown):
        with pytest.raises(OrderRefused, match="correlation -"):
            read_again(setup, moment)


def test_a_model_that_the_kept_state_has_no_room_for_is_refused(setup: Setup) -> None:
    """Each lag needs memory; the loop would die of what it cannot keep."""
    drift = setup.model.effects[-1]
    many = tuple(replace(drift, theta={"tau": 900.0 + k}) for k in range(2200))
    rewrite_model(setup, lambda model: replace(model, effects=many))
    with pytest.raises(RtecError, match=r"words of memory; at most \d+ can be kept"):
        read_again(setup)
