"""`python -m rtec_drivers.hil.far_side CONFIG --part machine`: one process of the bench, until its input ends.

The machine and its encoder box are one process, slow sensors another, so that neither disturbs the loop, nor the
sensors the box. Orders come as lines of JSON. When the input ends without one, the parent process has ended, and this
one removes its files.
"""

import argparse
import json
import os
import shutil
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from rtec.daemon.process import prepare_process
from rtec.loop.clock import RealClock
from rtec.loop.run_file import Realtime
from rtec.loop.state_files import state_places
from rtec.machine import Machine, load_machine
from rtec.tomlfile import validated
from rtec_drivers.box.driver import BoxOptions
from rtec_drivers.box.gateware import LONGEST_MS, Chip, GatewareBox, on_a_port
from rtec_drivers.box.simulator import BoxSimulator
from rtec_drivers.can.driver import CanTemperatureOptions
from rtec_drivers.count_tracker import axis_order
from rtec_drivers.hil.bus_devices import adapter, slave_line
from rtec_drivers.hil.injector import Box, Injector, Switch, box_switches, can_switches, modbus_switches
from rtec_drivers.hil.plant import InBoxOrder, MachinePlant, Recorder, Sensed
from rtec_drivers.hil.wiring import SENSED, TRACK, Wiring, read_wiring
from rtec_drivers.modbus.driver import ModbusOptions
from rtec_drivers.pty_peer import PtyPeer
from rtec_drivers.sim import SimDriver

CLOCK = RealClock()
FOLLOW_S = 0.01
PRIORITY = 60
"""Below the loop's, above all others: the box must answer while the loop waits for it."""
SWITCH_S = 1e-4
"""Interval, s, at which a thread passes the interpreter on: the box must not wait 5 ms for another thread."""
JUNCTION_DEGC = 25.0
"""Temperature of terminals that the machine does not have as sensors."""


class MachinePart:
    """The simulated machine and its encoder box."""

    def __init__(self, wiring: Wiring, folder: Path, stack: ExitStack, every_ms: int) -> None:
        sys.setswitchinterval(SWITCH_S)
        self.warnings = prepare_process(Realtime(priority=PRIORITY, cpu=_other_cpu(wiring)))
        machine = load_machine(Path(wiring.tables["run"]["machine"]))
        _compile(wiring, machine)
        simulated = SimDriver(wiring.options, machine, CLOCK).machine
        self._plant = MachinePlant(simulated, Sensed(folder / SENSED, len(machine.sensors)), every_ms * 1_000_000)
        (name,) = (n for n, bus in wiring.buses.items() if bus == "box")
        options = _options(BoxOptions, wiring.tables["device"][name])
        plant = InBoxOrder(self._plant, axis_order(options.axes, machine))
        axes, opts, link = len(machine.axes), wiring.options, wiring.link(folder, name)
        more = (32, opts.hold_after_ms, opts.counts_per_s, options.box_serial or 42)
        self._box: Box
        if wiring.gateware is None:
            self._box = BoxSimulator(plant, axes, *more)
            peer = PtyPeer(self._box, CLOCK, link)
        else:
            self._box = GatewareBox(Chip(wiring.gateware), plant, axes, *more, longest_ms=LONGEST_MS)
            peer = on_a_port(self._box, CLOCK, link)
        self._peer = stack.enter_context(peer)
        stack.enter_context(_ticking(self._follow))
        self.switches: dict[str, Switch] = box_switches(
            self._peer, self._box, self._plant, machine.axes[0].counts_per_mm
        )

    def start(self, now_ns: int) -> None:
        """Start the machine."""
        with self._peer.lock:
            self._plant.start(now_ns)

    def finish(self, folder: Path) -> dict[str, Any]:
        """Stop recording; write the record, and report the ledger in the machine.

        The loop has ended, but its last command may still be on the line.
        """
        self._peer.settle()
        with self._peer.lock:
            self._plant.follow(CLOCK.now_ns())
            machine, track = self._plant.machine, self._plant.recorder.track()
            inserted = machine.inserted_counts.tolist()
        track.save(folder / TRACK)
        return {
            "inserted": inserted,
            "commands": self._box.commands,
            "damaged": self._peer.faults.garbled,
            "answers": self._peer.faults.passed,
        }

    def _follow(self) -> None:
        """Advance the machine, even when the box is not asked."""
        with self._peer.lock:
            self._plant.follow(CLOCK.now_ns())


class SensorPart:
    """Modbus lines and CAN adapters."""

    def __init__(self, wiring: Wiring, folder: Path, stack: ExitStack, every_ms: int) -> None:
        del every_ms
        self.warnings: list[str] = []
        machine = load_machine(Path(wiring.tables["run"]["machine"]))
        sensed = Sensed(folder / SENSED, len(machine.sensors))
        sensors = _Sensors(sensed, machine.sensor_names)
        peers: dict[str, list[PtyPeer]] = {"modbus": [], "can": []}
        lines, adapters = [], []
        for name, bus in wiring.buses.items():
            table, where = wiring.tables["device"][name], f"{wiring.path}: [device.{name}]"
            link = wiring.link(folder, name)
            if bus == "modbus":
                lines.append(slave_line(_options(ModbusOptions, table), sensors, where))
                peers[bus].append(stack.enter_context(PtyPeer(lines[-1], CLOCK, link)))
            elif bus == "can":
                options = _options(CanTemperatureOptions, table)
                adapters.append(adapter(options, sensors, lambda: sensed.rpm, wiring.path.parent, where))
                peers[bus].append(stack.enter_context(PtyPeer(adapters[-1], CLOCK, link)))
        self.switches = modbus_switches(peers["modbus"], lines) | can_switches(peers["can"], adapters)
        self._peers = peers["modbus"] + peers["can"]

    def start(self, now_ns: int) -> None:
        """Do nothing: sensors need no start."""

    def finish(self, folder: Path) -> dict[str, Any]:
        """Do nothing: there is no record."""
        del folder
        return {"messages": sum(p.faults.passed for p in self._peers)}


PARTS: dict[str, Any] = {"machine": MachinePart, "sensors": SensorPart}


class _Sensors(dict[str, Any]):
    """Value by name of a reading: a sensor's temperature, or that of a module's terminals."""

    def __init__(self, sensed: Sensed, names: tuple[str, ...]) -> None:
        super().__init__({name: (lambda k=k: sensed.degc(k)) for k, name in enumerate(names)})

    def __missing__(self, name: str) -> Any:
        return lambda: JUNCTION_DEGC


def _compile(wiring: Wiring, machine: Machine) -> None:
    """Run another machine of the same kind for a second, so that the first real tick is not the slow one."""
    other = SimDriver(wiring.options.model_copy(update={"warm_up_s": 0.0}), machine, CLOCK).machine
    recorder = Recorder(other, 1)
    other.advance_to(1_100_000_000)
    recorder.look()
    recorder.track()


def _options(kind: Any, table: dict[str, Any]) -> Any:
    return validated(kind, {k: v for k, v in table.items() if k != "driver"}, "hil")


def _other_cpu(wiring: Wiring) -> int | None:
    """A processor that is not the loop's; by default the loop has the last one."""
    allowed = sorted(os.sched_getaffinity(0))
    loop = wiring.tables.get("realtime", {}).get("cpu", allowed[-1])
    others = [cpu for cpu in allowed if cpu != loop]
    return others[0] if others else None


@contextmanager
def _ticking(tick: Any) -> Iterator[None]:
    stop = threading.Event()

    def run() -> None:
        while not stop.wait(FOLLOW_S):
            tick()

    thread = threading.Thread(target=run, name="rtec-hil-machine", daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def _serve(part: Any, folder: Path) -> bool:
    """Carry out orders until the one to stop; return whether it came."""
    injector = Injector(part.switches, CLOCK)
    try:
        for line in sys.stdin:
            order = json.loads(line)
            if order["do"] == "start":
                part.start(order["at_ns"])
                injector.start(order["at_ns"], [tuple(f) for f in order["faults"]])
            else:
                injector.stop()
                _say(part.finish(folder))
                return True
        return False
    finally:
        injector.stop()


def _say(what: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(what) + "\n")
    sys.stdout.flush()


def main(arguments: list[str]) -> int:
    """Serve one part of the bench."""
    parser = argparse.ArgumentParser(prog="rtec_drivers.hil.far_side", description=__doc__)
    parser.add_argument("config", type=Path)
    parser.add_argument("--part", choices=sorted(PARTS), required=True)
    parser.add_argument("--folder", type=Path, required=True, help="for ports, and for what is handed over")
    parser.add_argument("--every-ms", type=int, default=10, help="the tip is looked at this often")
    parser.add_argument("--gateware", type=Path, help="a library of simulated gateware: in the place of the box")
    given = parser.parse_args(arguments)
    with ExitStack() as stack:
        part = PARTS[given.part](read_wiring(given.config, given.gateware), given.folder, stack, given.every_ms)
        ordered = False
        with suppress(BrokenPipeError):  # the parent process was killed before it read that
            _say({"ready": True, "warnings": part.warnings})
            ordered = _serve(part, given.folder)
    if not ordered:
        state_places(given.config, None).memory.unlink(missing_ok=True)
        shutil.rmtree(given.folder, ignore_errors=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
