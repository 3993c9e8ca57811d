"""Slow devices in processes of their own.

A device that gives temperatures or the spindle speed and nothing else is opened, polled and closed by a worker
(`rtec.daemon.worker`). It publishes what it reads (`rtec.daemon.published`); in the loop's process a small port
object looks at that memory (`rtec.daemon.worker_port`). The supervisor starts the workers, starts those that died
again, with growing waits, and ends those that hang (`rtec.daemon.worker_keeper`).

Workers are spawned by the supervisor, never by the loop's process: that one has locked memory, threads and real-time
priority, none of which a child should begin with.
"""

from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Self

from rtec.daemon.published import Published
from rtec.daemon.worker import Task
from rtec.daemon.worker_keeper import Kept
from rtec.errors import RtecError
from rtec.loop.clock import Clock
from rtec.loop.devices import driver_class
from rtec.loop.run_file import Setup


def names_for_workers(setup: Setup) -> list[str]:
    """Devices of a run file that have a worker: read for temperatures or spindle speed, and nothing else.

    A driver whose class says `IN_LOOP = True` stays in the loop's process.
    """
    role = setup.file.role
    slow = dict.fromkeys((*role.temperatures, *([role.spindle] if role.spindle else [])))
    names = [n for n in slow if n not in (role.counts, role.actuator) and n in setup.file.device]
    return [n for n in names if not _in_loop(setup.file.device[n].get("driver"), f"{setup.path}: [device.{n}]")]


def _in_loop(driver: object, where: str) -> bool:
    """Also where there is no such driver: the loop, which makes all devices once, says so best."""
    try:
        return bool(getattr(driver_class(str(driver), where), "IN_LOOP", False))
    except RtecError:
        return True


class Workers:
    """All workers of a run: starts them on entry, ends them on exit.

    Args:
        setup: what runs.
        clock: the monotonic one.
        tell: is told in words when a worker ends and when a new one is there.

    Attributes:
        memories: by device, for the loop's process.
    """

    def __init__(self, setup: Setup, clock: Clock, tell: Callable[[str], None]) -> None:
        role, machine = setup.file.role, setup.machine
        self.memories: dict[str, Published] = {}
        self._kept: Sequence[Kept] = []
        kept = []
        for name in names_for_workers(setup):
            memory = self.memories[name] = Published.create(len(machine.sensor_names))
            does = (name in role.temperatures, name == role.spindle)
            kept.append(Kept(Task(name, setup.file.device[name], machine, setup.path, *does, memory), clock, tell))
        self._kept = kept

    def __enter__(self) -> Self:
        for kept in self._kept:
            kept.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for kept in self._kept:
            kept.ask_to_end()
        for kept, memory in zip(self._kept, self.memories.values(), strict=True):
            kept.end(memory.close)

    def look(self, again: bool = True) -> None:
        """See how they do; called some 50 times a second, waits for nothing.

        Args:
            again: start those that ended anew. At the start of a run they are not: it does not begin without them.
        """
        for kept in self._kept:
            kept.look(again)
