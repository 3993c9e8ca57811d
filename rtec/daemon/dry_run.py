"""All checks of a run without a command: files, devices, first readings, the model's request.

Many devices are polled and give their first reading after a second or two, so the check waits for it. On a busy
computer a reading may become stale before it is checked; the check then waits for a fresh one.
"""

from contextlib import ExitStack
from typing import Any, Final

import numpy as np

from rtec.arrays import Ints
from rtec.correction.flags import HOLD_REASONS, MODE_ON, REASONS, Flag
from rtec.daemon.disk import folder_faults
from rtec.errors import DriverError
from rtec.loop.clock import Clock, RealClock
from rtec.loop.devices import Ports, make_devices, open_ports
from rtec.loop.output import beyond
from rtec.loop.records import NEVER_NS, Samples
from rtec.loop.run_file import Setup
from rtec.loop.state import units_of
from rtec.loop.state_files import kept, state_places
from rtec.loop.step import Step
from rtec.loop.zero import Zero, beyond_travel
from rtec.wording import listed

NS = 1e-9
WAIT_S: Final = 3.0
"""Longest wait for readings, s; the same as in `rtec doctor`."""
LOOK_NS: Final = 20_000_000
STALE: Final = Flag.STALE_COUNTS | Flag.STALE_TEMPERATURE


def dry_run(setup: Setup, clock: Clock | None = None, wait_s: float = WAIT_S) -> dict[str, Any]:
    """Open every device and step until all readings are present and fresh; the actuator is opened, but not commanded.

    Args:
        setup: the setup to check.
        clock: None: the computer's.
        wait_s: longest wait for readings.

    Returns:
        `inputs`: (name, value, age) as text; `requested_um` by axis, empty without counts or without a temperature that
        the model reads; `unread`: those temperatures; `reasons` for which the guard would hold;
        `troubles` of devices, and of the folders for log and state.

    Raises:
        RtecError: a file is at fault, or a device cannot be opened.
    """
    clock = clock or RealClock()
    step = Step(setup.step_settings())
    step.warm_up()
    sample = Samples.empty(step.layout, 1)
    sample.degc[:] = np.nan
    sample.spindle_rpm[:] = np.nan
    sample.mode[0] = MODE_ON
    sample.counts_time_ns[0] = NEVER_NS
    with ExitStack() as stack:
        ports = open_ports(setup, make_devices(setup, clock), stack)
        zero, output = _zero(setup, ports, step), np.zeros_like(sample.counts[0])
        _read(ports, sample, zero, output)  # a device may get ready at the first read; that is no wait
        end_ns, stale = clock.now_ns() + round(wait_s / NS), int(STALE)
        while True:
            wrong = _read(ports, sample, zero, output)
            sample.time_ns[0] = clock.now_ns()
            commands = step.run(sample)
            flags = int(commands.flags[0]) & HOLD_REASONS
            stale &= flags
            there = not wrong and not stale and bool(np.isfinite(sample.degc[0]).all())
            if there or clock.now_ns() >= end_ns:
                break
            clock.sleep_until_ns(clock.now_ns() + LOOK_NS)
    flags = flags & ~int(STALE) | stale  # an input that was fresh at one read is alive
    read = int(sample.counts_time_ns[0]) != NEVER_NS
    known = zero.known and read
    if not known:
        flags &= ~int(Flag.OUT_OF_RANGE)
    unread = [
        name
        for name, degc in zip(step.layout.sensors, sample.degc[0].tolist(), strict=True)
        if name in setup.model.channels and not np.isfinite(degc)
    ]
    requested = dict(zip(step.layout.axes, commands.requested_um[0].tolist(), strict=True))
    return {
        "inputs": input_rows(setup, sample, known),
        "requested_um": requested if read and not unread else {},
        "unread": unread,
        "reasons": [
            *(text for text in (zero.why, zero.restarted, beyond(step, output)) if text),
            *(text for flag, text in REASONS.items() if flag & Flag(flags)),
        ],
        "troubles": [*wrong, *folder_faults(setup)],
        "notes": [*(beyond_travel(setup.machine, sample.counts[0]) if known else []), *unlimited(setup)],
    }


def _zero(setup: Setup, ports: Ports, step: Step) -> Zero:
    """The zero of the axes as the next run will find it."""
    zero = Zero(ports.counts, step.layout.axes, by_order=setup.file.run.zero == "ordered")
    saved = kept(state_places(setup.path, setup.state_folder))
    if saved is not None and saved.units == units_of(step):
        zero.go_on(saved.zero, saved.supply, saved.homed)
    return zero


def unlimited(setup: Setup) -> list[str]:
    """A line on positions and temperatures that the model reads without a range, outside of which it would hold."""
    read, machine = setup.model.channels, setup.machine
    names = [a.channel for a in machine.axes if a.channel in read] + [n for n in machine.sensor_names if n in read]
    without = [name for name in names if name not in setup.model.valid_range]
    if not without:
        return []
    return [
        f"the model has no [valid_range] of {listed(without)}: the correction does not hold where nobody has measured "
        "(a model of rtec fit has the ranges of its readings)"
    ]


def _read(ports: Ports, sample: Samples, zero: Zero, output: Ints) -> list[str]:
    """Read everything once, the counts last, since they age first; give the faults, a line a device."""
    wrong = {}
    try:
        ports.actuator.read_output(output)
    except DriverError as e:
        wrong[ports.name("output")] = str(e)
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
    try:
        counts = np.zeros_like(sample.counts[0])
        sample.counts_time_ns[0] = ports.counts.read_counts(counts)
        zero.lost()
        sample.counts[0] = counts + zero.offset
    except DriverError as e:
        wrong[ports.name("counts")] = str(e)
    return [f"device {name}: {text}" for name, text in wrong.items()]


def input_rows(setup: Setup, sample: Samples, zero_known: bool = True) -> list[tuple[str, str, str]]:
    """Name, value and age of every input."""
    now = int(sample.time_ns[0])
    read_ns = int(sample.counts_time_ns[0])
    counts_age = "-" if read_ns == NEVER_NS else f"{(now - read_ns) * NS * 1e3:.1f} ms"
    unknown = "not known" if read_ns != NEVER_NS else "no reading"
    out = [
        (f"axis {a.name}", f"{counts / a.counts_per_mm:.4f} mm" if zero_known else unknown, counts_age)
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
