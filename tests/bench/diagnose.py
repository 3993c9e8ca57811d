"""How long a diagnosis takes, for a thousand readings and for a hundred thousand, and how it grows."""

import resource
from dataclasses import replace
from pathlib import Path
from timeit import default_timer

import numpy as np

from rtec.diagnosis.search.diagnose import diagnose
from rtec.estimation.candidates import library
from rtec.estimation.readings import read
from rtec.machine import Machine, load_machine
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect, Model
from rtec.sim.campaign.truth import effect_from_text
from tests.bench.table import Row

EACH = 50
SIZES = (1_000, 10_000, 100_000)
MORE_SENSORS = 37
MACHINE = Path(__file__).parents[2] / "configs" / "machines" / "turning-centre.toml"
KNOWN = (
    "scale,component=EXX,axis=X,k=12",
    "backlash,component=EXX,axis=X,B=0.1",
    "polynomial_position,component=EXX,axis=X,degrees=[2,3],c2=4,c3=1",
)


def rows() -> list[Row]:
    """Times, growth and memory; the memory is that of this whole process so far."""
    machine = load_machine(MACHINE)
    known: tuple[FittedEffect, ...] = tuple(effect_from_text(text, machine) for text in KNOWN)
    model = Model(machine, known)
    diagnose(model, [readings(machine, SIZES[0])])  # compiles
    times = []
    for n in SIZES:
        measurement = readings(machine, n)
        start = default_timer()
        diagnose(model, [measurement])
        times.append(default_timer() - start)
    slope = float(np.log(times[-1] / times[0]) / np.log(SIZES[-1] / SIZES[0]))
    what = f"readings against the catalogue, {_variants(model, readings(machine, SIZES[0]))} columns"
    many, candidates, columns = _many(machine, known)
    most = f"100 000 readings against {candidates} candidates, {columns} columns"
    memory_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    return [
        Row(f"1000 {what}", f"{times[0]:.2f} s", None, "", "at most 3 s", times[0] <= 3.0),
        Row(f"100 000 {what}", f"{times[-1]:.1f} s", None, "", "at most 15 s", times[-1] <= 15.0),
        Row(most, f"{many:.1f} s", None, "", "at most 15 s", many <= 15.0),
        Row("growth from 1000 to 100 000", f"n^{slope:.2f}", None, "n^1 is linear", "about linear", slope <= 1.15),
        Row("memory at most", f"{memory_mb:.0f} MB", None, "", "at most 2000 MB", memory_mb <= 2000.0),
    ]


def _many(machine: Machine, known: tuple[FittedEffect, ...]) -> tuple[float, int, int]:
    """Seconds, candidates and columns on a machine with so many temperatures that there are a thousand candidates."""
    sensors = [f"T_more_{i}" for i in range(MORE_SENSORS)]
    larger = replace(machine, sensors=(*machine.sensors, *(replace(machine.sensors[0], name=n) for n in sensors)))
    measurement = readings(larger, SIZES[-1], instrument=("straightness", "EYX"))
    model = Model(larger, known)
    candidates, _ = library(read([measurement], model.reference_degc))
    start = default_timer()
    diagnose(model, [measurement])
    return default_timer() - start, len(candidates), sum(len(c.thetas) for c in candidates)


def _variants(model: Model, measurement: Measurement) -> int:
    candidates, _ = library(read([measurement], model.reference_degc))
    return sum(len(c.thetas) for c in candidates)


def readings(
    machine: Machine, n: int, seed: int = 1, instrument: tuple[str, str] = ("laser_linear", "EXX")
) -> Measurement:
    """An instrument along X through a warm-up with an expansion that the model has not."""
    rng = np.random.default_rng(seed)
    runs = n // EACH
    time_s = np.arange(n, dtype=np.float64) * (9 * 3600.0 / n if n < 5000 else 5.0)
    hours = time_s / 3600.0
    there = np.linspace(3.0, 197.0, EACH // 2)
    x = np.tile(np.concatenate([there, there[::-1]]), runs)
    channels = {"x": x, "z": np.full(n, 200.0)}
    for i, sensor in enumerate(machine.sensor_names):
        warm = (3 + i) * (1.0 - np.exp(-hours / (1.0 + 0.3 * i))) + 0.5 * np.sin(hours * (1.0 + 0.2 * i))
        channels[sensor] = 20.0 + warm + 0.02 * rng.standard_normal(n)
    error = 12e-3 * x + 1e-3 * (channels["T_x_nut"] - 20.0) * x
    laser = make_instrument(instrument[0], {}, "X", instrument[1], machine, "bench")
    run = np.repeat(np.arange(runs), EACH)
    read_um = np.asarray(error + 0.4 * rng.standard_normal(n), dtype=np.float64)
    return Measurement("laser", laser, machine, run, time_s, channels, {"reading_um": read_um})
