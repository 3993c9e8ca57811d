"""Who keeps one worker alive: starts it, starts it again after growing waits when it died, ends it when it hangs."""

import multiprocessing
import signal
from collections.abc import Callable
from typing import Any, Final

from rtec.daemon.published import FAILED, OPEN
from rtec.daemon.signals import signals_wait
from rtec.daemon.worker import Task, work
from rtec.daemon.worker_port import OPENS_NS
from rtec.loop.clock import Clock

HANGS_NS: Final = OPENS_NS
"""A worker that shows no life for so long is killed and started again; opening may take that long too."""
FIRST_WAIT_NS: Final = 500_000_000
LONGEST_WAIT_NS: Final = 30_000_000_000
STOP_TIMEOUT_S: Final = 3.0


class Kept:
    """One worker and its restarts."""

    def __init__(self, task: Task, clock: Clock, tell: Callable[[str], None]) -> None:
        self._task, self._clock, self._tell = task, clock, tell
        self._process: Any = None
        self._wait_ns, self._begun_ns, self._again_ns = FIRST_WAIT_NS, 0, 0

    def start(self) -> None:
        """Start it; what an earlier one left in the memory is forgotten."""
        context = multiprocessing.get_context("spawn")
        self._task.memory.forget()
        self._process = context.Process(
            target=work, args=(self._task,), name=f"rtec-worker-{self._task.name}", daemon=True
        )
        self._begun_ns = self._clock.now_ns()
        with signals_wait():
            self._process.start()

    def look(self, again: bool) -> None:
        """See how it does; start it anew when its time has come, where that is wanted."""
        now_ns, memory = self._clock.now_ns(), self._task.memory
        if self._process is None:
            if again and now_ns >= self._again_ns:
                self.start()
        elif not self._process.is_alive():
            self._ended(now_ns, again)
        elif now_ns - max(memory.heartbeat_ns, self._begun_ns) > HANGS_NS:
            self._process.kill()
        elif memory.state == OPEN and memory.said.read():
            memory.said.write({})
            self._tell(f"[device.{self._task.name}] its new worker has opened it")
        if self._process is not None and now_ns - self._begun_ns > 2 * LONGEST_WAIT_NS:
            self._wait_ns = FIRST_WAIT_NS

    def ask_to_end(self) -> None:
        """Ask; `end` waits."""
        self._task.memory.stop_requested = 1

    def end(self, clean_up: Callable[[], None]) -> None:
        """See it gone."""
        process, self._process = self._process, None
        if process is not None:
            process.join(STOP_TIMEOUT_S)
            if process.is_alive():
                process.kill()
                process.join()
        clean_up()

    def _ended(self, now_ns: int, again: bool) -> None:
        self._process.join()
        memory, process = self._task.memory, self._process
        why = memory.told.read().get("open") if memory.state == FAILED else None
        text = why[0] if why else f"its worker, process {process.pid}, ended ({_how(process.exitcode)})"
        self._process = None
        self._again_ns = now_ns + self._wait_ns
        if again:
            text = f"{text}; a new one is started in {self._wait_ns * 1e-9:g} s"
            self._tell(f"[device.{self._task.name}] {text}")
        memory.said.write({"worker": [text]})
        self._wait_ns = min(2 * self._wait_ns, LONGEST_WAIT_NS)


def _how(code: int) -> str:
    if code >= 0:
        return f"exit code {code}"
    try:
        return signal.Signals(-code).name
    except ValueError:
        return f"signal {-code}"
