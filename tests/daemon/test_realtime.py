"""What the loop's process asks of the system. Oracle: the system's own account of the process, in one of its own."""

import json
import os
import subprocess
import sys

import pytest

from rtec.daemon.process import child_context

CODE = """
import gc, json, os
from rtec.loop.run_file import Realtime
from rtec.daemon.process import prepare_process
said = prepare_process(Realtime(priority=7))
locked = next(line for line in open("/proc/self/status") if line.startswith("VmLck:")).split()[1]
print(json.dumps([said, gc.isenabled(), os.sched_getscheduler(0) == os.SCHED_FIFO, os.sched_getparam(0).sched_priority,
                  int(locked), len(os.sched_getaffinity(0))]))
"""


def test_what_is_granted_holds_and_what_is_refused_is_said() -> None:
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True)
    said, collects, fifo, priority, locked_kib, processors = json.loads(done.stdout)
    assert not collects
    assert processors == 1 or "processor" in said[0]
    assert (fifo and priority == 7) or "SCHED_FIFO priority 7" in said[0]
    assert locked_kib > 0 or "locking memory" in said[0]
    assert len(said) <= 1
    if os.geteuid() == 0 and fifo and locked_kib:
        assert said == []


@pytest.mark.parametrize(("forks", "threads", "way"), [(True, 1, "fork"), (True, 2, "spawn"), (False, 1, "spawn")])
def test_a_copy_is_made_only_of_a_process_of_one_thread(
    forks: bool, threads: int, way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Oracle: fork(2): the copy has one thread, and every lock that another one held is held for ever."""
    monkeypatch.setattr("threading.active_count", lambda: threads)
    assert child_context(forks).get_start_method() == way
