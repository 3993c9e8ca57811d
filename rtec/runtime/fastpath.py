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
from numpy.typing import NDArray

from rtec.errors import RtecError
from rtec.runtime.clock import RealClock
from rtec.runtime.config import Setup, load_setup
from rtec.runtime.devices import Ports, make_devices, open_ports
from rtec.runtime.loop import Loop, Row, bind_rows
from rtec.runtime.realtime import prepare_process
from rtec.runtime.records import MODE_HOLD, Commands, Samples
from rtec.runtime.ring import Ring
from rtec.runtime.step import Step

PARENT_CHECK_CYCLES = 256
REHEARSAL_CYCLES = 100

Output = NDArray[np.int64]


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


def read_ledger(ports: Ports, axes: int) -> Output:
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
        warnings = _rehearse(setup, ports, output)
        pipe.send(("ready", {"output": output.tolist(), "warnings": warnings}))
        try:
            loop.run(cycles, _after_cycle(loop, ring, os.getppid()))
        finally:
            ports.actuator.hold()
        return summary(loop, step)


def _rehearse(setup: Setup, ports: Ports, output: Output) -> list[str]:
    """Go through the whole cycle a few times with a held step, so that the first real cycle is not the slow one.

    The step is a second one that holds what the actuator already has: nothing moves, nothing is recorded.
    """
    step = Step(setup.step_settings())
    step.resume(output)
    rows = bind_rows(step, [(Samples.empty(step.layout, 1), Commands.empty(step.layout, 1))])
    warnings = prepare_process(setup.file.realtime)
    loop = Loop(step, ports, RealClock(), setup.period_ns, rows, MODE_HOLD)
    loop.run(REHEARSAL_CYCLES, lambda _: True)
    return warnings


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
