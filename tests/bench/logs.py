"""What a day of logging takes on the disk: 1 kHz, three axes, sixteen temperatures, all axes moving all the time."""

import tempfile
from pathlib import Path
from timeit import default_timer

import numpy as np
from numpy.typing import NDArray

from rtec.log.packed import pack
from rtec.log.reader import open_log
from rtec.log.writer import LogWriter
from rtec.loop.records import Samples
from rtec.loop.step import Step, StepSettings
from tests.bench import models
from tests.bench.table import Row

SECONDS = 600
RATE_HZ = 1000
DAY_S = 86_400
READINGS_HZ = 10
"""Of each thermometer; most give one a second."""
GOAL_GB = 4.0


def rows() -> list[Row]:
    """All figures of this file."""
    return [_day("following", models.settings()), _day("never there", _slow())]


def _slow() -> StepSettings:
    """Limits so low that the correction never gets to where the model wants it: applied is never what is requested."""
    settings = models.settings()
    limits = models.LIMITS.model_copy(update={"slew_um_s": 20.0, "acceleration_um_s2": 200.0})
    return StepSettings(settings.model, dict.fromkeys("XYZ", limits))


def _day(how: str, settings: StepSettings) -> Row:
    step = Step(settings)
    data = _shift(step)
    commands = step.run(data)
    with tempfile.TemporaryDirectory() as folder:
        written, packed = Path(folder) / "a.arrows", Path(folder) / "a.parquet"
        with LogWriter(written, step.layout, {}, batch_rows=500) as writer:
            writer.write(data, commands)
        start = default_timer()
        with open_log(written) as log:
            pack(log, packed)
        took_s = default_timer() - start
        raw_gb, packed_gb = (p.stat().st_size * 1e-9 * DAY_S / SECONDS for p in (written, packed))
    share = 100.0 * took_s / SECONDS
    same = float(np.mean(commands.applied_um == commands.requested_um))
    name = f"log, packed; correction {how}: applied is requested in {100 * same:.0f} % of cells"
    value = f"{packed_gb:.2f} GB a day"
    against = f"as written: {raw_gb:.1f} GB a day; packing takes {share:.2f} % of one processor"
    return Row(name, value, raw_gb / packed_gb, against, f"≤ {GOAL_GB:g} GB a day", packed_gb <= GOAL_GB)


def _shift(step: Step) -> Samples:
    """Ten minutes: moves at four feeds, a count of noise, jitter of wake-ups and latches, noisy thermometers."""
    n, rng = SECONDS * RATE_HZ, np.random.default_rng(8)
    out = models.samples(step, n)
    out.time_ns[:] = 10**15 + np.arange(n) * 1_000_000 + rng.gamma(2.0, 6000.0, n).astype(np.int64)
    out.counts_time_ns[:] = out.time_ns + rng.integers(2000, 6000, n)
    for k in range(3):
        out.counts[:, k] = np.round(_moves(n, rng) * 1000.0 + rng.normal(0.0, 0.4, n))
    for k in range(16):
        reading = (np.arange(n) + int(rng.integers(0, 100))) * READINGS_HZ // RATE_HZ
        m = int(reading[-1]) + 1
        degc = 25.0 + 5.0 * rng.random() * (1.0 - np.exp(-np.arange(m) / READINGS_HZ / 3600.0)) + rng.normal(0, 0.02, m)
        out.degc[:, k] = (np.round(degc * 100.0) / 100.0)[reading]
        times = 10**15 + np.arange(m) * (10**9 // READINGS_HZ) + rng.integers(0, 300_000, m)
        out.degc_time_ns[:, k] = times[reading]
    out.spindle_rpm[:] = (3000.0 + np.round(rng.normal(0, 1, n)))[np.arange(n) // 100 * 100]
    return out


def _moves(n: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Positions, mm: one move after the other, with straight ramps of the speed, and short stops between them."""
    out, i, position = np.empty(n), 0, 250.0
    while i < n:
        target, speed_mm_s, ramp_s = rng.uniform(5.0, 495.0), float(rng.choice([10.0, 30.0, 100.0, 300.0])), 0.1
        way = abs(target - position)
        m = int((way / speed_mm_s + ramp_s) * RATE_HZ) + 2
        speed = np.minimum(np.minimum(np.arange(m), np.arange(m)[::-1]) / (ramp_s * RATE_HZ), 1.0)
        path = position + (target - position) * np.cumsum(speed) / max(speed.sum(), 1e-12)
        stop = np.full(int(rng.integers(0, 1500)), target)
        piece = np.concatenate([path, stop])[: n - i]
        out[i : i + len(piece)] = piece
        i, position = i + len(piece), target
    return out
