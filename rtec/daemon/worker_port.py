"""The loop's port to a worker: a small object in the loop's process that looks at what the worker publishes."""

from collections.abc import Mapping
from types import TracebackType
from typing import Final, Self

import numpy as np

from rtec.daemon.published import OPEN, STARTING, Published, Reader
from rtec.errors import DriverError, DriverFault, DriverTimeout, DriverUnavailable
from rtec.loop.clock import Clock
from rtec.loop.ports import FloatArray, IntArray
from rtec.machine import Machine

LOOK_NS: Final = 10_000_000
"""While the worker opens its device, it is looked at so often."""
OPENS_NS: Final = 20_000_000_000
"""Opening may take so long."""
SILENT_NS: Final = 1_000_000_000
"""A worker that shows no life for so long is told as silent."""
ERRORS: Final = {kind.__name__: kind for kind in (DriverError, DriverUnavailable, DriverTimeout, DriverFault)}


class WorkerPort:
    """The loop's side of a worker: a device like any other, that looks at memory and waits for nothing.

    Args:
        name: of the device.
        memory: where its worker publishes.
        sensors: of the machine.
        clock: the monotonic one; all processes share it.
    """

    def __init__(self, name: str, memory: Published, sensors: int, clock: Clock) -> None:
        self._name, self._memory, self._clock = name, memory, clock
        self._reader = Reader(memory, sensors)

    def __enter__(self) -> Self:
        """Wait until the worker has opened its device.

        Raises:
            DriverUnavailable: it could not, or does not say.
        """
        memory, end_ns = self._memory, self._clock.now_ns() + OPENS_NS
        while memory.state == STARTING and not memory.said.read() and self._clock.now_ns() < end_ns:
            self._clock.sleep_until_ns(self._clock.now_ns() + LOOK_NS)
        if memory.state != OPEN:
            why = memory.told.read().get("open") or memory.said.read().get("worker")
            raise DriverUnavailable(why[0] if why else "its worker does not say whether it is open")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Let go; the supervisor ends the worker."""

    @property
    def must_resume(self) -> str:
        """Why the device waits for an order to resume; "" where it does not."""
        return "".join(self._memory.told.read().get("resume", ()))

    def resume(self) -> None:
        """Hand the order on to the worker."""
        self._memory.resumes += 1

    def read_temperatures(self, degc: FloatArray, time_ns: IntArray) -> None:
        """Fill in what the worker published last, °C and instants, ns; then tell what is wrong.

        Raises:
            DriverError: as the driver itself; or the worker is dead or silent.
        """
        reader = self._reader
        reader.look()
        np.copyto(degc, reader.degc, where=reader.read)
        np.copyto(time_ns, reader.time_ns, where=reader.read)
        self._check("temperatures")

    def read_spindle(self) -> float:
        """Give the spindle speed that the worker published last, 1/min.

        Raises:
            DriverError: as the driver itself; or the worker is dead or silent.
        """
        self._check("spindle")
        self._reader.look()
        return float(self._reader.rpm[0])

    def _check(self, does: str) -> None:
        memory = self._memory
        said = memory.said.read()
        if said:
            raise DriverUnavailable(said["worker"][0])
        silent_ns = self._clock.now_ns() - memory.heartbeat_ns
        if silent_ns > SILENT_NS:
            raise DriverTimeout(f"its worker has shown no life for {silent_ns // 1_000_000_000} s")
        wrong = memory.told.read().get(does)
        if wrong:
            raise ERRORS.get(wrong[0], DriverFault)(wrong[1])


def worker_ports(memories: Mapping[str, Published], machine: Machine, clock: Clock) -> dict[str, WorkerPort]:
    """The loop's ports, by device."""
    return {name: WorkerPort(name, m, len(machine.sensor_names), clock) for name, m in memories.items()}
