"""The bench: the all-simulated run, then the daemon behind real buses without and with correction, side by side."""

import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from rtec.correction.flags import MODE_OFF, MODE_ON
from rtec.errors import ConfigError
from rtec.hil import Course, FaultOrder, HilOrder, HilResult, OffAndOn, SoakOrder, SoakResult, Tell
from rtec.loop.clock import VirtualClock
from rtec.loop.devices import make_devices, open_ports
from rtec.loop.loop import Loop, Row, bind_rows
from rtec.loop.records import Commands, Samples
from rtec.loop.run_file import load_setup
from rtec.loop.step import Step
from rtec_drivers.hil.bus_run import BusRun, ends_politely, every_ms_of, held_spans, run_on_buses
from rtec_drivers.hil.faults import FAULTS, Bus
from rtec_drivers.hil.findings import (
    RECOVER_S,
    checks_of,
    compared_spans,
    faults_found,
    held_check,
    improvement_check,
    quiet_spans,
    unheld_spans,
)
from rtec_drivers.hil.plant import Recorder, TipTrack, accuracy, directions, errors_um
from rtec_drivers.hil.soak import soak
from rtec_drivers.hil.wiring import HilOptions, Wiring, read_wiring
from rtec_drivers.sim import SimDriver

TOLD_CYCLES = 1000


def simulated_run(
    config: Path, duration_s: float, mode: int, every_ms: int, tell: Callable[[int, int], None]
) -> TipTrack:
    """Run the simulated machine.

    Args:
        config: run file whose one device is the simulated machine.
        duration_s: duration, s.
        mode: MODE_ON or MODE_OFF.
        every_ms: period of recording the tip, ms.
        tell: called with the number of cycles done, and of all.
    """
    setup, clock = load_setup(config), VirtualClock(1_000_000_000)
    step = Step(setup.step_settings())
    devices = make_devices(setup, clock)
    (device,) = devices.values()
    if not isinstance(device, SimDriver):
        raise TypeError("the all-simulated run has one device, the simulated machine")
    rows = bind_rows(step, [(Samples.empty(step.layout, 1), Commands.empty(step.layout, 1))])
    cycles = round(duration_s * setup.file.run.rate_hz)
    recorder = Recorder(device.machine, every_ms * 1_000_000)
    with ExitStack() as stack:
        loop = Loop(step, open_ports(setup, devices, stack), clock, setup.period_ns, rows, mode)

        def after(row: Row) -> bool:
            del row
            recorder.look()
            if loop.stats.cycles % TOLD_CYCLES == 0:
                tell(loop.stats.cycles, cycles)
            return True

        loop.run(cycles, after)
    return recorder.track()


WORDS: Mapping[Bus, str] = {
    "box": "RTEC box link, serial, over a pty",
    "modbus": "Modbus RTU over a pty",
    "can": "CAN by slcan over a pty",
}


class HilBench:
    """Puts the simulated machine of a run file's `[hil]` behind the buses of its devices."""

    options_model = HilOptions

    def faults(self) -> Mapping[str, str]:
        """All faults: name, and description."""
        return {name: fault.what for name, fault in FAULTS.items()}

    def run(self, order: HilOrder, tell: Tell) -> HilResult:
        """Make all four runs: simulated and behind buses, off and on."""
        wiring = read_wiring(order.config, order.gateware)
        _check_faults(order.faults, wiring)
        off_s = order.off_s or wiring.options.off_s
        on_s = max([order.on_s or wiring.options.on_s, *(f.end_s + RECOVER_S for f in order.faults)])
        _check_length(off_s, on_s, wiring)
        every_ms = every_ms_of(on_s)
        with ends_politely(), tempfile.TemporaryDirectory(prefix="rtec-hil-", ignore_cleanup_errors=True) as name:
            folder = Path(name)
            simulated = wiring.simulated(folder)
            sim_off, sim_on = (
                simulated_run(simulated, seconds, mode, every_ms, lambda a, b: tell("all simulated", a, b))
                for seconds, mode in ((off_s, MODE_OFF), (on_s, MODE_ON))
            )
            off = run_on_buses(wiring, folder, "off", off_s, (), every_ms, tell)
            on = run_on_buses(wiring, folder, "on", on_s, order.faults, every_ms, tell, order.keep)
            return _result(wiring, order, off, on, (sim_off, sim_on))

    def soak(self, order: SoakOrder, tell: Tell) -> SoakResult:
        """Run for a long time, with random faults."""
        return soak(order, tell)


def _words(bus: Bus, wiring: Wiring) -> str:
    simulated = f"; simulated gateware {wiring.gateware}" if bus == "box" and wiring.gateware else ""
    return WORDS[bus] + simulated


def _check_faults(faults: Sequence[FaultOrder], wiring: Wiring) -> None:
    """Refuse a fault of a bus that the run file does not have."""
    there = set(wiring.buses.values())
    missing = sorted({f.name for f in faults if FAULTS[f.name].bus not in there})
    if missing:
        raise ConfigError(
            f"{wiring.path}: no device for {', '.join(missing)}; the run file has {', '.join(sorted(there))}"
        )


def _check_length(off_s: float, on_s: float, wiring: Wiring) -> None:
    """Refuse runs that are not longer than the time to settle."""
    least_s = wiring.options.settle_s + 1.0
    if min(off_s, on_s) < least_s:
        raise ConfigError(
            f"{wiring.path}: {min(off_s, on_s):g} s are too short: the first settle_s = {wiring.options.settle_s:g} s "
            f"do not count; give at least {least_s:g} s"
        )


def _result(
    wiring: Wiring, order: HilOrder, off: BusRun, on: BusRun, simulated: tuple[TipTrack, TipTrack]
) -> HilResult:
    names = directions(on.setup.machine)
    settle_s = wiring.options.settle_s
    off_s, on_s = off.duration_s, on.duration_s
    found = faults_found(order.faults, on.logbook, on.track, on.watch, on_s, names)
    quiet = unheld_spans(quiet_spans(found, settle_s, on_s), held_spans(on.logbook, on.start_ns))
    spans = compared_spans(quiet, off_s)
    buses, alike = (
        OffAndOn(accuracy(a, names, spans), accuracy(b, names, spans)) for a, b in ((off.track, on.track), simulated)
    )
    return HilResult(
        machine=on.setup.machine.name,
        rate_hz=on.setup.file.run.rate_hz,
        off_s=off_s,
        on_s=on_s,
        wiring={name: _words(bus, wiring) for name, bus in wiring.buses.items()},
        buses=buses,
        simulated=alike,
        compared_s=sum(high - low for low, high in spans),
        off_timing=_timing(off),
        on_timing=_timing(on),
        faults=found,
        checks=[
            *checks_of("uncorrected", off, (), not order.shared),
            *checks_of("corrected", on, found, not order.shared),
            held_check("corrected", on, order.faults, not order.shared),
            improvement_check(buses, alike, spans, not order.shared),
        ],
        warnings=list(dict.fromkeys([*off.warnings, *on.warnings])),
        course=_course(off.track, on.track, names),
        log=on.log if order.keep else None,
        stopped=on.report.interrupted,
    )


def _timing(run: BusRun) -> dict[str, Any]:
    summary = run.report.summary
    keys = ("cycles", "deadline_misses", "wake_up", "compute", "driver_errors")
    return {**{k: summary[k] for k in keys}, "devices": summary.get("devices", {})}


def _course(off: TipTrack, on: TipTrack, names: tuple[str, ...]) -> Course:
    """Both runs at the corrected run's instants, as far as the uncorrected one goes."""
    off_um = np.full((len(on.time_s), len(names)), np.nan)
    for k, column in enumerate(errors_um(off, names).T):
        off_um[:, k] = np.interp(on.time_s, off.time_s, column, right=np.nan)
    return Course(names, on.time_s, off_um, errors_um(on, names))
