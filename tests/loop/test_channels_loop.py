"""Velocity, acceleration, distance since reversal, load and force in the loop.

Oracles: `Model.predict` in numpy on channels made by the batch forms (tested in test_channels.py) from the same
counts and time stamps; bitwise equality between n = 1 and n = many; the sample's own numbers for the flags.
"""

import re
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import tomli_w

from rtec.correction.flags import MODE_ON, Flag, Limits
from rtec.daemon.dry_run import input_rows
from rtec.effects.expression import Expression
from rtec.errors import ConfigError, ModelError
from rtec.log.reader import LogReader
from rtec.log.writer import LogWriter
from rtec.loop.records import Commands, Layout, Samples
from rtec.loop.run_file import load_setup
from rtec.loop.step import Inputs, Step, StepSettings
from rtec.machine import load_machine
from rtec.model import FittedEffect, Model, save_model
from rtec.playback.replay import replay_log
from tests.loop.test_step import FAST, MACHINE, NS, SLOW, same
from tests.support import setups
from tests.support.motion import motion_track
from tests.support.plain_step import plain_module


def expression(text: str, component: str = "EXX", k: float = 1.7) -> FittedEffect:
    effect = Expression.model_validate(
        {"effect": "expression", "component": component, "expression": text, "linear": {"k": "um"}}
    )
    return FittedEffect(effect, {"k": k})


def model(*texts: str, **valid_range: tuple[float, float]) -> Model:
    return Model(MACHINE, tuple(expression(text) for text in texts), valid_range=valid_range)


MODEL = Model(
    MACHINE,
    (
        expression("k*exp(-s_x/0.4)*d_x"),
        expression("k*v_x/100"),
        expression("k*a_x/1000*load_kg"),
        expression("k*force_n*z/1e6", "EZZ"),
        expression("k*sqrt(abs(v_z))*Ta", "EZZ"),
        expression("k*x*Tb/100"),
    ),
)
INPUTS = Inputs(load_kg=250.0, force_n=-800.0, motion_filter_s=0.015)


def settings(limits: Limits = FAST, model: Model = MODEL, inputs: Inputs = INPUTS) -> StepSettings:
    return StepSettings(model, {"X": limits, "Z": limits}, longest_cycle_s=0.5, inputs=inputs)


def samples(n: int, step: Step) -> Samples:
    """Both axes swing; counts come a little before the cycle, unevenly; now and then none, or new ones, old stamp."""
    rng = np.random.default_rng(12)
    out = Samples.empty(step.layout, n)
    out.time_ns[:] = 5 * NS + np.arange(n) * 1_000_000
    out.mode[:] = MODE_ON
    taken = out.time_ns - rng.integers(0, 300_000, n)
    x = 100_000 + 3_000 * np.sin(taken / NS * 14.0)
    z = 300_000 + 100_000 * np.sin(taken / NS * 9.0)
    for i in np.flatnonzero(rng.random(n) < 0.1):
        before = max(int(i) - 1, 0)
        taken[i], x[i] = taken[before], x[before]  # Z has moved already
    out.counts_time_ns[:] = taken
    out.counts[:, 0], out.counts[:, 1] = x, z
    out.degc[:] = 25.0 + (np.arange(n) // 100)[:, None] * 0.1
    out.degc_time_ns[:] = (5 * NS + np.arange(n) // 100 * 100_000_000)[:, None]
    return out


def test_requested_is_minus_the_prediction_on_channels_made_in_a_batch() -> None:
    step = Step(settings())
    data = samples(3000, step)
    commands = step.run(data)
    x, z = data.counts[:, 0] / 1000.0, data.counts[:, 1] / 2000.0
    stamp_s = np.asarray((data.counts_time_ns - data.counts_time_ns[0]) * 1e-9, dtype=np.float64)
    (v_x, a_x), (v_z, _) = (motion_track(q, stamp_s, 0.015) for q in (x, z))
    still = {"load_kg": np.full(3000, 250.0), "force_n": np.full(3000, -800.0)}
    degc = {"Ta": data.degc[:, 0], "Tb": data.degc[:, 1]}
    s = MODEL.state(stamp_s, {"x": x, "z": z, "v_x": v_x, "a_x": a_x, "v_z": v_z, **still, **degc})
    np.testing.assert_allclose(commands.requested_um, -MODEL.predict(s)[:, [0, 2]], rtol=1e-7, atol=1e-7)
    assert all(np.ptp(part) > 0.05 for part in MODEL.effect_components(s)), "every effect has its say"
    assert len(np.unique(s.value("s_x"))) > 100


def test_singles_equal_a_batch_bit_for_bit() -> None:
    one, many = Step(settings(SLOW)), Step(settings(SLOW))
    data = samples(900, one)
    batch = many.run(data)
    for i, single in enumerate(data.singles()):
        assert same(one.run(single), batch.rows(i, i + 1)), f"row {i}"


def test_a_cut_anywhere_changes_nothing() -> None:
    """The state carries velocity and reversal. Oracle: the uncut run."""
    step = Step(settings(SLOW))
    data = samples(400, step)
    middle, first = step.advance(step.fresh_state(), data.rows(0, 173))
    _, second = step.advance(middle, data.rows(173, 400))
    _, whole = step.advance(step.fresh_state(), data)
    assert same(first, whole.rows(0, 173))
    assert same(second, whole.rows(173, 400))


def test_without_numba_the_same_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same source as plain Python. Oracle: the compiled step."""
    compiled, plain = Step(settings(SLOW)), Step(settings(SLOW))
    data = samples(250, compiled)
    wanted = compiled.run(data)
    monkeypatch.setattr(plain, "_step", plain_module(plain.source.text).step)
    found = plain.run(data)
    np.testing.assert_allclose(found.applied_um, wanted.applied_um, atol=1e-9)
    np.testing.assert_array_equal(found.flags, wanted.flags)


def test_nothing_is_allocated_per_cycle() -> None:
    step = Step(settings())
    data, commands = samples(1, step), Commands.empty(step.layout, 1)
    cycle = step.bind(data, commands)
    cycle()
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    for _ in range(20_000):
        cycle()
    grown = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    assert grown < 2_000


def test_a_model_without_these_channels_carries_nothing_of_them() -> None:
    """Oracle: the names of the state's parts, and the text of the step."""
    plain, full = Step(settings(model=model("k*x*d_x"))).source, Step(settings()).source
    assert not {"vel", "acc", "since", "turn", "motion_q"} & set(plain.floats.at)
    assert {"vel", "acc", "since", "turn", "motion_q"} <= set(full.floats.at)
    body = plain.text.split("def step(")[1]
    assert not re.search(r"motion_update|reversal_update|since", body)


OF_Z = ("k*v_z/1000", "k*a_z/1000", "k*exp(-s_z)", "k*load_kg/1000", "k*force_n/1000")
"""Every channel that may have a range, none of X: one step for all ranges."""


@pytest.mark.parametrize(
    ("channel", "range_", "held"),
    [
        ("v_z", (-1000.0, 1000.0), False),
        ("v_z", (-1000.0, 100.0), True),
        ("v_z", (-100.0, 1000.0), True),
        ("v_x", (5.0, 9.0), False),  # the model does not read it
        ("a_z", (-100.0, 100.0), True),
        ("s_z", (0.0, 1e10), False),
        ("s_z", (0.0, 50.0), True),
        ("load_kg", (0.0, 250.0), False),
        ("load_kg", (0.0, 249.0), True),
        ("force_n", (-700.0, 0.0), True),
        ("force_n", (-900.0, 0.0), False),
    ],
)
def test_outside_the_models_range_it_holds(channel: str, range_: tuple[float, float], held: bool) -> None:
    """Oracle: Z swings at up to 450 mm/s over 100 mm; the loads are those of `INPUTS`."""
    step = Step(settings(model=model(*OF_Z, **{channel: range_})))
    flags = step.run(samples(2000, step)).flags
    out = np.count_nonzero(flags & int(Flag.OUT_OF_RANGE))
    assert (out > 100) == held
    assert held or out == 0


def test_time_is_refused_by_the_loop(tmp_path: Path) -> None:
    """One message, that names the effect and the way on; from the step and from the run file."""
    timed = Model(MACHINE, (expression("k*x"), expression("k*time_s", "EZZ")))
    said = r"effect 2, expression\(EZZ\), reads time_s\. Such an effect can be found and its cause removed, but not"
    with pytest.raises(ModelError, match=said):
        Step(settings(model=timed))
    path = setups.write(tmp_path, setups.tables(tmp_path))
    machine = load_machine(setups.CONFIGS / "machines" / "turning-centre.toml")
    save_model(Model(machine, (expression("k*time_s", "EZZ"),)), tmp_path / "model.toml")
    with pytest.raises(ConfigError, match=r"model.toml: model 'model': effect 1, .* delete its \[\[effect\]\]"):
        load_setup(path)


def test_inputs_of_the_run_file(tmp_path: Path) -> None:
    """They reach the step and the log's header. Oracle: the run file's numbers."""
    content = {**setups.tables(tmp_path), "inputs": {"load_kg": 120.0, "force_n": 40.0}}
    path = setups.write(tmp_path, content)
    machine = load_machine(setups.CONFIGS / "machines" / "turning-centre.toml")
    effects = (expression("k*load_kg"), expression("k*force_n", "EZZ"))
    save_model(Model(machine, effects), tmp_path / "model.toml")
    made = load_setup(path)
    header = made.log_header()
    assert (header["load_kg"], header["force_n"], header["motion_filter_s"]) == ("120.0", "40.0", "0.02")
    step = Step(made.step_settings())
    sample = Samples.empty(step.layout, 1)
    sample.mode[:] = MODE_ON
    np.testing.assert_allclose(step.run(sample).requested_um[0], [-1.7 * 120, -1.7 * 40])
    assert [i for i in input_rows(made, sample) if i[2] == "run file"] == [
        ("load", "120 kg", "run file"),
        ("force", "40 N", "run file"),
    ]
    for wrong, message in (
        ({"load_kg": -1.0}, r"\[inputs\] load_kg: must be from 0"),
        ({"load": 1.0}, r"\[inputs\] unknown key 'load'; did you mean 'load_kg'"),
        ({"motion_filter_s": 0.0}, r"\[inputs\] motion_filter_s"),
    ):
        path.write_text(tomli_w.dumps({**content, "inputs": wrong}), encoding="utf-8")
        with pytest.raises(ConfigError, match=message):
            load_setup(path)


def test_a_log_with_motion_replays_to_the_same_bits(tmp_path: Path) -> None:
    """Live one row at a time, replay in blocks. Oracle: the commands that were logged."""
    path = setups.write(tmp_path, {**setups.tables(tmp_path), "inputs": {"load_kg": 120.0}})
    machine = load_machine(setups.CONFIGS / "machines" / "turning-centre.toml")
    effects = (expression("k*exp(-s_x/0.4)*d_x + k*v_x/10"), expression("k*a_z*load_kg/1e4", "EZZ"))
    save_model(Model(machine, effects), tmp_path / "model.toml")
    made = load_setup(path)
    step = Step(made.step_settings())
    data = Samples.empty(step.layout, 1500)
    like = samples(1500, step)
    for name, array in data.arrays().items():
        array[:] = getattr(like, name)
    live = [step.run(one) for one in data.singles()]
    log = tmp_path / "run.arrows"
    layout = Layout(machine.axis_names, machine.sensor_names)
    with LogWriter(log, layout, {**made.log_header(), "initial_output": "[0, 0]"}) as writer:
        for sample, command in zip(data.singles(), live, strict=True):
            writer.write(sample, command)
    report = replay_log(made, log, check=True)
    assert (report.rows, report.different, report.notes) == (1500, 0, [])
    assert max(float(np.abs(c.requested_um).max()) for c in live) > 1.0
    with LogReader(log) as reader:
        assert reader.header["load_kg"] == "120.0"
