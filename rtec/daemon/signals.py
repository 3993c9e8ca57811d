"""What the signals of a daemon mean while it runs, how a child is started deaf to them, and who started it."""

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import parent_process, resource_tracker
from types import FrameType
from typing import Final

SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP)


@contextmanager
def signals(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Hand them all to the handler; the previous handlers come back afterwards."""
    previous = {number: signal.signal(number, handler) for number in SIGNALS}
    try:
        yield
    finally:
        for number, old in previous.items():
            signal.signal(number, old)


@contextmanager
def signals_wait() -> Iterator[None]:
    """A child started meanwhile is deaf to Ctrl-C from its first instruction, until it says itself what to do with it.

    Here a signal that comes meanwhile is handled afterwards.
    """
    resource_tracker.ensure_running()  # started by `Process.start` it would let the signals through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def starter() -> int:
    """Process number of whoever started this process; `os.getppid` says another as soon as that one is gone.

    It was told when this process was started: one that is killed in that very moment is missed all the same.
    """
    parent = parent_process()
    return os.getppid() if parent is None or parent.pid is None else parent.pid
