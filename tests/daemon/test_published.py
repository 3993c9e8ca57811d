"""Readings in shared memory: never torn, never waited for, gone with the last process.

Oracle: an invariant that every reading written in one go has, and no mixture of two of them; the kernel's own list of
this process's descriptors.
"""

import gc
import multiprocessing
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtec.daemon.published import FAILED, NEVER, OPEN, Published, PublishedReader
from rtec.daemon.workers import BEGINS_NS, OPENS_NS, WorkerPort, late
from rtec.errors import DriverFault, DriverTimeout, DriverUnavailable
from rtec.loop.clock import VirtualClock

SENSORS, READINGS, MOST_LOOKS = 10_000, 100, 3_000_000
GAPS = 1000


def _hammer(memory: Published, pipe: Any) -> None:
    """Write readings in which everything says the same number, until told to stop; say the last number."""
    degc, time_ns, k = np.zeros(SENSORS), np.zeros(SENSORS, np.int64), 0
    pipe.send(0)
    while k % 100 or not pipe.poll():
        k += 1
        degc[:], time_ns[:] = k, k
        memory.publish(degc, time_ns, float(k))
        sum(range(k * 7919 % GAPS))  # other work, now more, now less, so that a reader finds gaps of all lengths
    pipe.send(k)


def test_no_reading_is_ever_torn() -> None:
    memory = Published.create(SENSORS)
    reader, last, new = PublishedReader(memory, SENSORS), 0, 0
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=_hammer, args=(memory, there), daemon=True)
    process.start()
    assert here.recv() == 0
    for _ in range(MOST_LOOKS):
        reader.look()
        os.sched_yield()  # where both share a processor the writer is stopped anywhere, also half-way
        k = int(reader.rpm[0]) if reader.read[0] else 0
        assert k >= last
        if k != last:
            assert (reader.degc == k).all()
            assert (reader.time_ns == k).all()
            last, new = k, new + 1
        if new >= READINGS:
            break
    here.send("stop")
    written = here.recv()
    process.join()
    assert process.exitcode == 0
    assert new == READINGS  # it read while the other wrote
    assert reader.look()
    assert reader.rpm[0] == reader.degc[-1] == reader.time_ns[0] == written


def test_a_reading_that_is_overtaken_while_it_is_copied_is_taken_anew() -> None:
    """The writer comes between the copy and the second look at the version; the first copy counts for nothing."""
    memory = Published.create(2)
    reader, barrier = PublishedReader(memory, 2), memory.barrier
    memory.publish(np.full(2, 20.0), np.full(2, 5), 100.0)
    turns = iter([False, True])

    def meanwhile() -> None:
        if next(turns, False):
            memory.barrier = barrier
            memory.publish(np.full(2, 30.0), np.full(2, 6), 200.0)

    memory.barrier = meanwhile
    assert reader.look()
    assert (reader.degc.tolist(), reader.time_ns.tolist(), reader.rpm.tolist()) == ([30.0, 30.0], [6, 6], [200.0])


def test_half_written_is_not_read_and_not_waited_for() -> None:
    """A writer killed in the middle leaves an odd version; the next one makes it good."""
    memory = Published.create(2)
    reader = PublishedReader(memory, 2)
    memory.publish(np.array([20.0, 21.0]), np.array([5, NEVER]), 100.0)
    assert reader.look()
    memory.version += 1
    memory._degc[0] = 99.0
    assert not reader.look()
    assert (reader.degc.tolist(), reader.read.tolist()) == ([20.0, 21.0], [True, False])
    memory.publish(np.array([22.0, 23.0]), np.array([6, 7]), 200.0)
    assert reader.look()
    assert (reader.degc.tolist(), reader.time_ns.tolist()) == ([22.0, 23.0], [6, 7])


def _port(clock: VirtualClock) -> tuple[Published, WorkerPort]:
    memory = Published.create(3)
    return memory, WorkerPort("t", memory, 3, clock)


def test_the_port_fills_its_own_sensors_and_tells_as_the_driver_did() -> None:
    clock = VirtualClock(10**9)
    memory, port = _port(clock)
    degc, time_ns = np.array([1.0, 2.0, 3.0]), np.array([1, 2, 3])
    memory.publish(np.array([np.nan, 20.0, np.nan]), np.array([NEVER, 900, NEVER]), 50.0)
    memory.heartbeat_ns, memory.state = clock.now_ns(), OPEN
    with port:
        port.read_temperatures(degc, time_ns)
        assert (degc.tolist(), time_ns.tolist()) == ([1.0, 20.0, 3.0], [1, 900, 3])
        assert port.read_spindle() == 50.0

        memory.device_note.write({"temperatures": ["DriverFault", "sensor broken"], "resume": ["lost"]})
        memory.publish(np.array([np.nan, 21.0, np.nan]), np.array([NEVER, 950, NEVER]), 51.0)
        with pytest.raises(DriverFault, match="sensor broken"):
            port.read_temperatures(degc, time_ns)
        assert degc[1] == 21.0  # what is good is filled in first
        assert port.read_spindle() == 51.0
        assert port.must_resume == "lost"
        port.resume()
        assert memory.resumes == 1

        clock.sleep_until_ns(clock.now_ns() + 3 * 10**9)
        with pytest.raises(DriverTimeout, match="no life for 3 s"):
            port.read_spindle()
        memory.worker_note.write({"worker": ["it ended"]})
        with pytest.raises(DriverUnavailable, match="it ended"):
            port.read_temperatures(degc, time_ns)


def test_a_new_worker_inherits_no_words_and_no_readings() -> None:
    memory, port = _port(VirtualClock())
    degc, time_ns = np.array([1.0, 2.0, 3.0]), np.array([1, 2, 3])
    memory.publish(np.full(3, 20.0), np.full(3, 900), 50.0)
    memory.device_note.write({"temperatures": ["DriverFault", "of the old one"]})
    memory._words[10] += 1  # killed while it wrote words
    memory.forget()
    port.read_temperatures(degc, time_ns)
    assert (degc.tolist(), time_ns.tolist()) == ([1.0, 2.0, 3.0], [1, 2, 3])
    assert np.isnan(port.read_spindle())


@pytest.mark.parametrize(("state", "told"), [(FAILED, {"open": ["no such port"]}), (0, {})])
def test_what_was_not_opened_is_refused(state: int, told: dict[str, list[str]]) -> None:
    memory, port = _port(VirtualClock())
    memory.device_note.write(told)
    memory.state = state
    with pytest.raises(DriverUnavailable, match="no such port" if told else "does not say"):
        port.__enter__()


def test_the_memory_goes_with_its_last_user() -> None:
    def mine() -> int:
        return sum("rtec-readings" in str(fd.readlink()) for fd in Path("/proc/self/fd").iterdir() if fd.is_symlink())

    gc.collect()
    before = mine()
    memory = Published.create(4)
    assert mine() > before
    memory.close()
    del memory
    assert mine() == before


def test_a_new_process_gets_longer_to_begin_than_its_device_to_open() -> None:
    """A busy computer takes half a minute to load programs; a port that hangs is given up after 20 s."""
    memory, clock = Published.create(1), VirtualClock(10**12)
    begun_ns = clock.now_ns()
    clock.sleep_until_ns(begun_ns + BEGINS_NS)
    assert not late(memory, begun_ns, clock)
    clock.sleep_until_ns(begun_ns + BEGINS_NS + 1)
    assert late(memory, begun_ns, clock)
    memory.heartbeat_ns = clock.now_ns()
    clock.sleep_until_ns(clock.now_ns() + OPENS_NS)
    assert not late(memory, begun_ns, clock)
    clock.sleep_until_ns(clock.now_ns() + 1)
    assert late(memory, begun_ns, clock)
