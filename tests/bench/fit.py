"""Fitting: a million readings and 200 terms; how the time grows; beside numpy's least squares where that can."""

import json
import subprocess
import sys
from timeit import default_timer

import numpy as np
from numpy.typing import NDArray

from rtec.effects import Effect, effect_class
from rtec.estimation.gram.fit import estimate
from rtec.estimation.gram.source import Source
from rtec.estimation.gram.stream import Term
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.parallel import one_blas_thread
from tests.bench import models
from tests.bench.table import Row

Floats = NDArray[np.float64]
SIZES = (10_000, 100_000, 1_000_000)
LSTSQ_READINGS = 100_000
RUN = 400


def rows() -> list[Row]:
    """All figures of this file; each size in a process of its own, whose peak memory is its own."""
    found = [_apart(n) for n in SIZES]
    lstsq_s = _lstsq_s(LSTSQ_READINGS)
    seconds = [f["seconds"] for f in found]
    slope = float(np.polyfit(np.log([f["readings"] for f in found]), np.log(seconds), 1)[0])
    last = np.log(seconds[2] / seconds[1]) / np.log(found[2]["readings"] / found[1]["readings"])
    big = found[-1]
    what = f"{big['readings'] / 1e6:.2f} M readings, {big['columns']:.0f} terms, zero of every run"
    return [
        Row(
            f"fit of {what}: time",
            f"{big['seconds']:.2f} s",
            lstsq_s * big["readings"] / LSTSQ_READINGS / big["seconds"],
            f"numpy lstsq without the runs' zeros, {LSTSQ_READINGS / 1e6:g} M: {lstsq_s:.2f} s, taken as linear",
            "< 5 s",
            big["seconds"] < 5,
        ),
        Row(
            "the same: peak memory of the process",
            f"{big['peak_gb']:.2f} GB",
            None,
            f"its dense design would be {big['readings'] * big['columns'] * 8e-9:.1f} GB",
            "< 4 GB",
            big["peak_gb"] < 4,
        ),
        Row(
            "slope, time against readings: all, and the last decade",
            f"{slope:.2f}, {last:.2f}",
            None,
            ", ".join(f"{f['readings']:.0f}: {f['seconds']:.2f} s" for f in found),
            "linear: ≤ 1.1",
            last <= 1.1,
        ),
    ]


def effects() -> list[Effect]:
    """About 200 coefficients that a tracker can tell apart on a bridge machine."""
    out = []

    def add(name: str, component: str, axis: str, **more: object) -> None:
        table = {"effect": name, "component": component, "axis": axis, **more}
        out.append(effect_class(name, "bench").model_validate(table))

    for k, axis in enumerate("XYZ"):
        for i, letter in enumerate("XYZABC"):
            component = f"E{letter}{axis}"
            add("polynomial_position", component, axis, degrees=(2, 3, 4, 5, 6))
            for j in range(4):
                sensor = models.SENSORS[(5 * i + 4 * k + j) % 16]
                add("axis_expansion", component, axis, sensor=sensor)
            if letter in "XYZ":
                add("backlash", component, axis)
                for j in range(3):
                    add("axis_expansion_nonuniform", component, axis, sensor=models.SENSORS[(7 * i + 3 * k + j) % 16])
    return out


def measurements(readings: int) -> list[Measurement]:
    """Three coordinates at each instant, by a tracker, with three lengths of tool: one alone cannot see the turns."""
    offsets = ([120.0, 80.0, -60.0], [-70.0, 150.0, 40.0], [10.0, -90.0, -180.0])
    return [_measurement(readings // 9, i, offset) for i, offset in enumerate(offsets)]


def _measurement(n: int, seed: int, offset_mm: list[float]) -> Measurement:
    machine, rng = models.machine(), np.random.default_rng(seed)
    time = np.linspace(0.0, 8 * 3600.0, n)
    channels: dict[str, Floats] = {
        a.channel: 250.0 + 240.0 * np.sin(np.arange(n) / (19.0 + 7.3 * j) + j) for j, a in enumerate(machine.axes)
    }
    for i, sensor in enumerate(models.SENSORS):
        wave = np.sin(time / 3600.0 * (0.4 + 0.17 * i) + i)
        channels[sensor] = 22.0 + 4.0 * wave + 0.02 * rng.standard_normal(n)
    instrument = make_instrument("tool_tip", {"zero": "run", "offset_mm": offset_mm}, None, None, machine, "bench")
    run = np.arange(n) // max(RUN, n // 1000) + 1
    names, noise = instrument.columns(), rng.standard_normal((3, n))
    return Measurement(f"{seed}", instrument, machine, run, time, channels, dict(zip(names, noise, strict=True)))


def timed(readings: int) -> dict[str, float]:
    """Time of one whole fit, and this process' peak memory."""
    import resource

    terms = [Term(e) for e in effects()]
    _ = estimate([Source.of(m) for m in measurements(9000)], terms[:8]).errors  # imports, and what is compiled
    taken = measurements(readings)
    start = default_timer()
    with one_blas_thread():
        fit = estimate([Source.of(m) for m in taken], terms)
        _ = fit.errors, fit.held_out
    seconds = default_timer() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return {
        "seconds": seconds,
        "readings": float(sum(m.matrix().size for m in taken)),
        "columns": float(fit.linear.width),
        "peak_gb": peak,
        "condition": fit.linear.condition(),
    }


def _apart(readings: int) -> dict[str, float]:
    command = [sys.executable, "-m", "tests.bench.fit", str(readings)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    found: dict[str, float] = json.loads(done.stdout)
    return found


def _lstsq_s(readings: int) -> float:
    """numpy's least squares on a dense design of that size."""
    rng = np.random.default_rng(0)
    design = rng.standard_normal((readings, 201))
    y = rng.standard_normal(readings)
    start = default_timer()
    np.linalg.lstsq(design, y, rcond=None)
    return default_timer() - start


if __name__ == "__main__":
    sys.stdout.write(json.dumps(timed(int(sys.argv[1]))))
