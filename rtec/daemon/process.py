"""Asks the system for real-time treatment of this process; what is not granted is said in one sentence."""

import ctypes
import gc
import os

from rtec.loop.run_file import Realtime

MCL_CURRENT_AND_FUTURE = 3
PR_SET_TIMERSLACK = 29
HOW = "see docs/real-time.md"
WORKER_PRIORITY = 1
"""Of drivers' threads: below every loop, above all that is not real time."""


def prepare_process(wanted: Realtime) -> list[str]:
    """Raise this process to SCHED_FIFO, lock its memory, pin it, switch the garbage collector off.

    Returns:
        one plain warning for everything that was refused; empty when all was granted.
    """
    refused = []
    if wanted.priority and not _fifo(wanted.priority):
        refused.append(f"SCHED_FIFO priority {wanted.priority}")
    if wanted.lock_memory and not _lock_memory():
        refused.append("locking memory")
    if not _pin(wanted.cpu):
        refused.append(f"processor {wanted.cpu}")
    ctypes.CDLL(None, use_errno=True).prctl(PR_SET_TIMERSLACK, 1, 0, 0, 0)
    gc.collect()
    gc.freeze()
    gc.disable()
    if not refused:
        return []
    return [f"no real-time treatment for: {', '.join(refused)}; the loop runs, with later wake-ups ({HOW})"]


def _fifo(priority: int) -> bool:
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (OSError, AttributeError):
        return False
    return True


def _lock_memory() -> bool:
    libc = ctypes.CDLL(None, use_errno=True)
    return bool(libc.mlockall(MCL_CURRENT_AND_FUTURE) == 0)


def _pin(cpu: int | None) -> bool:
    """Stay on one processor: the one asked for, else the last where there are several."""
    try:
        allowed = sorted(os.sched_getaffinity(0))
        if cpu is None and len(allowed) < 2:
            return True
        os.sched_setaffinity(0, {allowed[-1] if cpu is None else cpu})
    except (OSError, AttributeError):
        return False
    return True


def prepare_worker() -> None:
    """Give the calling thread the lowest real-time priority, where the system grants it.

    A driver's thread in the loop's process is not urgent. But while it holds the interpreter the loop waits for it, and
    if any ordinary program may keep it off the processor meanwhile, the loop waits for that program.
    """
    _fifo(WORKER_PRIORITY)
