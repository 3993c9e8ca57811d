"""All checks of a run without commanding anything: files, devices, first readings, what the model asks for.

Many devices are polled and give their first reading after a second or two: it is waited for.
"""

from contextlib import ExitStack
from typing import Any, Final

import numpy as np

from rtec.correction.flags import HOLD_REASONS, MODE_ON, REASONS, Flag
from rtec.errors import DriverError
from rtec.loop.clock import Clock, RealClock
from rtec.loop.devices import Ports, make_devices, open_ports
from rtec.loop.records import Samples
from rtec.loop.run_file import Setup
from rtec.loop.step import Step

NS = 1e-9
WAIT_S: Final = 3.0
"""So long may the first readings take, as long as `rtec doctor` looks."""
LOOK_NS: Final = 20_000_000


def dry_run(setup: Setup, clock: Clock | None = None, wait_s: float = WAIT_S) -> dict[str, Any]:
    """Open every device, wait for a reading of everything, step once; the actuator is opened, and commanded nothing.

    Args:
        setup: what would run.
        clock: the computer's where not given.
        wait_s: longest wait for the first readings.

    Returns:
        `inputs`: (name, value, age) as text; `requested_um` by axis; `reasons` why the guard would hold;
        `troubles` of devices.

    Raises:
        RtecError: a file or device is not as it should be.
    """
    clock = clock or RealClock()
    step = Step(setup.step_settings())
    step.warm_up()
    sample = Samples.empty(step.layout, 1)
    sample.degc[:] = np.nan
    sample.spindle_rpm[:] = np.nan
    with ExitStack() as stack:
        ports = open_ports(setup, make_devices(setup, clock), stack)
        wrong = _first_readings(ports, sample, clock, wait_s)
        sample.counts_time_ns[0] = ports.counts.read_counts(sample.counts[0])
        sample.time_ns[0] = clock.now_ns()
    sample.mode[0] = MODE_ON
    commands = step.run(sample)
    flags = int(commands.flags[0]) & HOLD_REASONS
    return {
        "inputs": input_rows(setup, sample),
        "requested_um": dict(zip(step.layout.axes, commands.requested_um[0].tolist(), strict=True)),
        "reasons": [text for flag, text in REASONS.items() if flag & Flag(flags)],
        "troubles": wrong,
    }


def _first_readings(ports: Ports, sample: Samples, clock: Clock, wait_s: float) -> list[str]:
    """Read everything until all of it is there, or the time is over; give what is wrong with devices then."""
    end_ns = clock.now_ns() + round(wait_s / NS)
    while True:
        wrong = _read(ports, sample)
        there = not wrong and bool(np.isfinite(sample.degc[0]).all())
        if there or clock.now_ns() >= end_ns:
            return wrong
        clock.sleep_until_ns(clock.now_ns() + LOOK_NS)


def _read(ports: Ports, sample: Samples) -> list[str]:
    """Read everything once, good values into the sample; give what is wrong, a line a device."""
    wrong = {}
    try:
        ports.counts.read_counts(sample.counts[0])
    except DriverError as e:
        wrong[ports.name("counts")] = str(e)
    for k, source in enumerate(ports.temperatures):
        try:
            source.read_temperatures(sample.degc[0], sample.degc_time_ns[0])
        except DriverError as e:
            wrong[ports.name("temperatures", k)] = str(e)
    if ports.spindle is not None:
        try:
            sample.spindle_rpm[0] = ports.spindle.read_spindle()
        except DriverError as e:
            wrong[ports.name("spindle")] = str(e)
    return [f"device {name}: {text}" for name, text in wrong.items()]


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
