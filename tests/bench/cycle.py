"""One cycle called from Python, and the same model over a log."""

import tempfile
import tracemalloc
from pathlib import Path
from timeit import default_timer

import numpy as np

from rtec.effects import State
from rtec.log.reader import LogReader
from rtec.log.writer import LogWriter
from rtec.loop.records import Commands, Samples
from rtec.loop.step import Step
from tests.bench import models
from tests.bench.table import Row

CALLS = 100_000
LOG_ROWS = 3_000_000
NUMPY_ROWS = 200_000


def rows() -> list[Row]:
    """All figures of this file."""
    step = Step(models.settings())
    step.warm_up()
    n = models.terms(step.settings.model)
    return [*_single(n), *_replay(n)]


def _single(n: int) -> list[Row]:
    step = Step(models.settings())
    data, commands = models.samples(step, CALLS), Commands.empty(step.layout, 1)
    one = data.rows(0, 1).copy()
    cycle = step.bind(one, commands)
    pairs = list(zip(one.arrays().values(), data.arrays().values(), strict=True))
    times = np.empty(CALLS)
    for i in range(CALLS):
        for target, source in pairs:
            target[0] = source[i]
        start = default_timer()
        cycle()
        times[i] = default_timer() - start
    p50, p999 = np.percentile(times * 1e6, [50, 99.9])
    grown = _growth(cycle)
    numpy_us = _numpy_single(step, data)
    what = f"one cycle from Python, 21 components, {n} terms"
    return [
        Row(
            f"{what}: median",
            f"{p50:.2f} µs",
            numpy_us / p50,
            f"numpy, one instant: {numpy_us:.0f} µs",
            "≤ 5 µs",
            p50 <= 5,
        ),
        Row(f"{what}: p99.9", f"{p999:.2f} µs", None, "", "≤ 20 µs", p999 <= 20),
        Row("memory after 10^5 cycles (tracemalloc)", f"{grown} bytes", None, "", "flat", grown < 2000),
    ]


def _growth(cycle: object) -> int:
    assert callable(cycle)
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    for _ in range(CALLS):
        cycle()
    grown = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    return grown


def _state(step: Step, data: Samples, stop: int) -> State:
    machine = step.settings.model.machine
    channels = {a.channel: data.counts[:stop, i] / a.counts_per_mm for i, a in enumerate(machine.axes)}
    channels |= {name: data.degc[:stop, i] for i, name in enumerate(machine.sensor_names)}
    time_s = np.asarray(data.time_ns[:stop] * 1e-9, dtype=np.float64)
    return step.settings.model.state(time_s, channels)


def _numpy_single(step: Step, data: Samples) -> float:
    state = _state(step, data, 1)
    step.settings.model.predict(state)
    start = default_timer()
    for _ in range(20):
        step.settings.model.predict(state)
    return (default_timer() - start) / 20 * 1e6


def _replay(n: int) -> list[Row]:
    step = Step(models.settings())
    data = models.samples(step, LOG_ROWS)
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "bench.arrows"
        with LogWriter(log, step.layout, {"bench": "1"}, batch_rows=1000) as writer:
            writer.write(data, step.run(data))
        speed = max(_read_and_step(log) for _ in range(3))
    start = default_timer()
    step.settings.model.predict(_state(step, data, NUMPY_ROWS))
    plain = NUMPY_ROWS / (default_timer() - start)
    ratio = speed / plain
    return [
        Row(
            f"replay of a log of {LOG_ROWS / 1e6:g} M samples, {n} terms, guard and ledger",
            f"{speed / 1e6:.2f} M samples/s",
            ratio,
            f"numpy, the model alone: {plain / 1e6:.3f} M/s",
            "≥ 5 M/s, ratio ≥ 10",
            speed >= 5e6 and ratio >= 10,
        )
    ]


def _read_and_step(log: Path) -> float:
    """Samples a second, from the file (in the page cache) to the commands."""
    step = Step(models.settings())
    memory = Commands.empty(step.layout, 65_536)
    start, done = default_timer(), 0
    with LogReader(log) as reader:
        for samples, _ in reader.blocks():
            step.run(samples, memory)
            done += len(samples)
    return done / (default_timer() - start)
