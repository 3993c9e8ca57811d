"""All checks of a run without commanding anything: files, devices, one reading of each, what the model asks for."""

from contextlib import ExitStack
from typing import Any

import numpy as np

from rtec.correction.guard import HOLD_REASONS, REASONS, Flag
from rtec.loop.clock import RealClock
from rtec.loop.devices import make_devices, open_ports
from rtec.loop.records import MODE_ON, Samples
from rtec.loop.run_file import Setup
from rtec.loop.step import Step

NS = 1e-9


def dry_run(setup: Setup) -> dict[str, Any]:
    """Open every device, read each, step once; the actuator is opened and told nothing.

    Returns:
        `inputs`: (name, value, age) as text; `requested_um` by axis; `reasons` why the guard would hold.

    Raises:
        RtecError: a file or device is not as it should be.
    """
    clock = RealClock()
    step = Step(setup.step_settings())
    step.warm_up()
    sample = Samples.empty(step.layout, 1)
    sample.degc[:] = np.nan
    sample.spindle_rpm[:] = np.nan
    with ExitStack() as stack:
        ports = open_ports(setup, make_devices(setup, clock), stack)
        ports.counts.read_counts(sample.counts[0])  # the first reading of anything may take its time: it is not judged
        for source in ports.temperatures:
            source.read_temperatures(sample.degc[0], sample.degc_time_ns[0])
        if ports.spindle is not None:
            sample.spindle_rpm[0] = ports.spindle.read_spindle()
        sample.counts_time_ns[0] = ports.counts.read_counts(sample.counts[0])
        sample.time_ns[0] = clock.now_ns()
    sample.mode[0] = MODE_ON
    commands = step.run(sample)
    flags = int(commands.flags[0]) & HOLD_REASONS
    return {
        "inputs": input_rows(setup, sample),
        "requested_um": dict(zip(step.layout.axes, commands.requested_um[0].tolist(), strict=True)),
        "reasons": [text for flag, text in REASONS.items() if flag & Flag(flags)],
    }


def input_rows(setup: Setup, sample: Samples) -> list[tuple[str, str, str]]:
    """Name, value and age of every input."""
    now = int(sample.time_ns[0])
    counts_age = f"{(now - int(sample.counts_time_ns[0])) * NS * 1e3:.1f} ms"
    out = [
        (f"axis {a.name}", f"{counts / a.counts_per_mm:.4f} mm", counts_age)
        for a, counts in zip(setup.machine.axes, sample.counts[0].tolist(), strict=True)
    ]
    for i, sensor in enumerate(setup.machine.sensors):
        degc = float(sample.degc[0, i])
        known = np.isfinite(degc)
        age = f"{(now - int(sample.degc_time_ns[0, i])) * NS:.1f} s"
        out.append((sensor.name, f"{degc:.2f} °C" if known else "no reading", age if known else "-"))
    if setup.file.role.spindle:
        out.append(("spindle", f"{float(sample.spindle_rpm[0]):.0f} 1/min", "-"))
    read = {"load_kg": ("load", "kg"), "force_n": ("force", "N")}
    for channel, (name, unit) in read.items():
        if channel in setup.model.channels:
            out.append((name, f"{getattr(setup.file.inputs, channel):g} {unit}", "run file"))
    return out
