"""The all-simulated run of the same machine and program: the loop of `rtec run` on a virtual clock, no bus."""

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from rtec.loop.clock import VirtualClock
from rtec.loop.devices import make_devices, open_ports
from rtec.loop.loop import Loop, Row, bind_rows
from rtec.loop.records import Commands, Samples
from rtec.loop.run_file import load_setup
from rtec.loop.step import Step
from rtec_drivers.hil.plant import Recorder
from rtec_drivers.hil.track import TipTrack
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
