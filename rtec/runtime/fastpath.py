"""The fast path: the loop in a process of its own, writing into the ring that the supervisor made.

It owns the count source and the actuator. It ends when its cycles are done, when the supervisor asks through the
ring, or when the supervisor is gone; in each case the devices hold, then close.
"""

import os
import signal
from contextlib import ExitStack
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from rtec.errors import DriverError, RtecError
from rtec.runtime.clock import RealClock
from rtec.runtime.config import load_setup
from rtec.runtime.devices import Ports, make_devices, open_ports
from rtec.runtime.loop import Loop, Row, bind_rows
from rtec.runtime.realtime import prepare_process
from rtec.runtime.ring import Ring
from rtec.runtime.step import Step

PARENT_CHECK_CYCLES = 256


def fast_path(config: Path, ring_name: str, pipe: Connection, cycles: int | None) -> None:
    """Run the loop; tell the supervisor through the pipe: ("ready", …), then ("done", …) or ("error", text)."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        pipe.send(("done", _run(config, ring_name, pipe, cycles)))
    except RtecError as e:
        pipe.send(("error", str(e)))
    finally:
        pipe.close()


def read_ledger(ports: Ports, axes: int) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """What the actuator says is applied already."""
    output = np.zeros(axes, dtype=np.int64)
    ports.actuator.read_output(output)
    return output


def _run(config: Path, ring_name: str, pipe: Connection, cycles: int | None) -> dict[str, Any]:
    setup = load_setup(config)
    clock = RealClock()
    step = Step(setup.step_settings())
    step.warm_up()
    with Ring.attach(ring_name) as ring, ExitStack() as stack:
        rows = bind_rows(step, ring.slots)
        ports = open_ports(setup, make_devices(setup, clock), stack)
        output = read_ledger(ports, len(step.layout.axes))
        step.resume(output)
        loop = Loop(step, ports, clock, setup.period_ns, rows, ring.ordered_mode)
        _rehearse(ports, output)
        warnings = prepare_process(setup.file.realtime)
        pipe.send(("ready", {"output": output.tolist(), "warnings": warnings}))
        loop.run(cycles, _after_cycle(loop, ring, os.getppid()))
        return summary(loop, step)


def _rehearse(ports: Ports, output: np.ndarray[Any, np.dtype[np.int64]]) -> None:
    """Say to the actuator once what it already has, so that the first cycle is not the slow one."""
    try:
        ports.actuator.apply(output)
    except DriverError:
        return  # the loop meets the same error, counts it and goes on


def _after_cycle(loop: Loop, ring: Ring, parent: int) -> Any:
    stats = loop.stats

    def go_on(row: Row) -> bool:
        del row
        ring.publish()
        ring.deadline_misses = stats.misses
        loop.mode = ring.ordered_mode
        alive = stats.cycles % PARENT_CHECK_CYCLES != 0 or os.getppid() == parent
        return alive and not ring.stop_requested

    return go_on


def summary(loop: Loop, step: Step) -> dict[str, Any]:
    """What the loop did, as plain data."""
    stats = loop.stats
    return {
        "cycles": stats.cycles,
        "deadline_misses": stats.misses,
        "wake_up": stats.wake_up.summary(),
        "compute": stats.compute.summary(),
        "driver_errors": stats.driver_errors,
        "last_error": stats.last_error,
        "output": dict(zip(step.layout.axes, step.output_of(step.state).tolist(), strict=True)),
    }
