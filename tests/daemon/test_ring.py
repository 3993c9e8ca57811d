"""The shared-memory ring. Oracle throughout: rows are a known function of their number, so that what the consumer gets,
what it misses and what is torn can be told from the rows alone, without trusting the ring's own counters."""

import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtec.daemon.ring import Ring
from rtec.errors import RtecError
from rtec.loop.records import Commands, Layout, Samples
from tests.support import proof

LAYOUT = Layout(("X", "Z"), ("T_spindle", "T_bed", "T_air"))
SHM = Path("/dev/shm")  # noqa: S108


def fill(samples: Samples, commands: Commands, row: int) -> None:
    """Make every element of every field a number that only this row and this element have."""
    at = 0
    for array in (*samples.arrays().values(), *commands.arrays().values()):
        flat = array.reshape(-1)
        if array.dtype == np.int8:
            flat[:] = row % 127
        else:
            flat[:] = row * 64.0 + np.arange(at, at + flat.size)
        at += flat.size


def expected(rows: list[int]) -> tuple[Samples, Commands]:
    samples, commands = Samples.empty(LAYOUT, len(rows)), Commands.empty(LAYOUT, len(rows))
    for i, row in enumerate(rows):
        fill(samples.rows(i, i + 1), commands.rows(i, i + 1), row)
    return samples, commands


def assert_rows(block: tuple[Samples, Commands], rows: list[int]) -> None:
    """Every field of every row is that of the row of this number: order, content, dtype, shape."""
    for found, wanted in zip(block, expected(rows), strict=True):
        for name, array in wanted.arrays().items():
            got = found.arrays()[name]
            assert got.dtype == array.dtype
            np.testing.assert_array_equal(got, array, err_msg=name)


def row_numbers(samples: Samples) -> list[int]:
    return [int(t) // 64 for t in samples.time_ns]


def produce(ring: Ring, n: int) -> None:
    for row in range(ring.head, ring.head + n):
        fill(*ring.slots[row % ring.capacity], row)
        ring.publish()


@pytest.fixture
def ring() -> Iterator[Ring]:
    with Ring.create(LAYOUT, 8) as made:
        yield made


def test_rows_come_out_as_they_went_in(ring: Ring) -> None:
    produce(ring, 5)
    assert_rows(ring.drain(3), [0, 1, 2])
    assert_rows(ring.drain(), [3, 4])
    assert_rows(ring.drain(), [])
    assert (ring.overruns, ring.head, ring.tail) == (0, 5, 5)


def test_drained_rows_are_copies(ring: Ring) -> None:
    produce(ring, 4)
    block = ring.drain()
    produce(ring, 20)
    assert_rows(block, [0, 1, 2, 3])


def test_the_slot_being_written_is_never_given(ring: Ring) -> None:
    """Eight slots: with 8 rows waiting, the slot of row 0 is the one being written, so row 0 is lost, and no other."""
    produce(ring, 8)
    samples, _ = ring.slots[8 % ring.capacity]
    samples.counts[:] = -1
    assert_rows(ring.drain(), list(range(1, 8)))
    assert ring.overruns == 1


class _Late(Ring):
    """A consumer that is overtaken between copying and checking: the producer runs in the second barrier."""

    overtake = 0

    def _barrier(self) -> None:
        super()._barrier()
        self.overtake, n = 0, self.overtake
        if n < 0:  # the first barrier of a drain arms the second
            self.overtake = -n
        elif n:
            produce(self, n)


def test_rows_overwritten_while_copied_are_dropped_and_counted() -> None:
    """Rows 0-6 wait; 4 more appear after the copy: head 11, rows below 11 - 8 + 1 = 4 are no longer safe."""
    with _Late.create(LAYOUT, 8) as ring:
        produce(ring, 7)
        ring.overtake = -4
        assert_rows(ring.drain(), [4, 5, 6])
        assert ring.overruns == 4
        assert_rows(ring.drain(), [7, 8, 9, 10])
        assert ring.overruns == 4


@settings(max_examples=150, deadline=None)
@given(
    capacity=st.integers(2, 9),
    turns=st.lists(st.tuples(st.integers(0, 25), st.integers(0, 12)), max_size=12),
)
def test_wrap_around_and_overruns(capacity: int, turns: list[tuple[int, int]]) -> None:
    """Oracle: a plain list of the row numbers written so far, of which the last capacity - 1 can be had."""
    with Ring.create(LAYOUT, capacity) as ring:
        written: list[int] = []
        taken = 0
        lost = 0
        for n_write, n_read in turns:
            produce(ring, n_write)
            written += range(len(written), len(written) + n_write)
            first = max(taken, len(written) - (capacity - 1))
            lost += first - taken
            wanted = written[first : first + n_read]
            assert_rows(ring.drain(n_read), wanted)
            taken = first + len(wanted)
            assert ring.overruns == lost


def test_fields_lie_on_lines_of_their_own(ring: Ring) -> None:
    """Structure of arrays: each field is one contiguous array that starts on a 64-byte line."""
    for block in (ring._samples, ring._commands):
        for array in block.arrays().values():
            assert array.flags.c_contiguous
            assert array.shape[0] == 8
    produce(ring, 3)
    arrays = (*ring._samples.arrays().values(), *ring._commands.arrays().values())
    starts = {a.__array_interface__["data"][0] % 64 for a in arrays}
    assert starts == {0}


def test_attached_ring_is_the_same_memory(ring: Ring) -> None:
    with Ring.attach(ring.name) as other:
        assert (other.layout, other.capacity) == (ring.layout, ring.capacity)
        produce(ring, 3)
        assert_rows(other.drain(), [0, 1, 2])
        assert ring.tail == 3
        words = ("stop_requested", "reloads", "producer_heartbeat_ns", "consumer_heartbeat_ns", "cycles")
        for value, word in enumerate((*words, "deadline_misses", "error_code"), start=-3):
            setattr(other, word, value)
            assert getattr(ring, word) == value
        assert (ring.head, ring.tail, ring.overruns) == (3, 3, 0)


def test_producer_started_again_goes_on_where_the_first_ended(ring: Ring) -> None:
    produce(ring, 5)
    with Ring.attach(ring.name) as second:
        produce(second, 2)
        assert_rows(ring.drain(), list(range(7)))


def _full_speed(name: str, n: int) -> None:
    with Ring.attach(name) as ring:
        produce(ring, n)
        ring.cycles = n


@pytest.mark.parametrize(("capacity", "max_rows"), [(16, 16), (64, 7), (4096, 4096)])
def test_two_processes_at_full_speed(capacity: int, max_rows: int) -> None:
    """No torn row, rows in order, and the rows missing from the sequence are exactly those counted as overruns."""
    n = proof.of(30_000, 10_000)
    with Ring.create(LAYOUT, capacity) as ring:
        producer = multiprocessing.get_context("spawn").Process(target=_full_speed, args=(ring.name, n))
        producer.start()
        next_row = missing = 0
        while ring.tail < n:
            assert producer.exitcode in (None, 0)
            lost_before = ring.overruns
            samples, commands = ring.drain(max_rows)
            rows = row_numbers(samples)
            assert_rows((samples, commands), rows)
            assert rows == list(range(rows[0], rows[0] + len(rows))) if rows else True
            if rows:
                missing += rows[0] - next_row
                next_row = rows[-1] + 1
            assert ring.overruns >= lost_before
        producer.join(30)
        assert ring.cycles == n
        assert missing + (n - next_row) == ring.overruns


def test_name_goes_with_the_owner_and_only_once() -> None:
    with Ring.create(LAYOUT, 8) as ring:
        path = SHM / ring.name
        assert path.exists()
        with Ring.attach(ring.name) as other:
            other.unlink()
        assert path.exists(), "only the owner removes the name"
        ring.unlink()
        assert not path.exists()
        path.write_text("somebody else's by now")
        ring.unlink()
        produce(ring, 2)
        assert_rows(ring.drain(), [0, 1])
    assert path.exists(), "the second unlink touched another's file"
    path.unlink()


def test_views_outlive_the_ring() -> None:
    with Ring.create(LAYOUT, 8) as ring:
        samples, commands = ring.slots[0]
    fill(samples, commands, 3)
    assert_rows((samples, commands), [3])
    assert ring.head == 0


_HOLD = """
import signal, sys
from rtec.loop.records import Layout
from rtec.daemon.ring import Ring
ring = Ring.create(Layout(("X",), ()), 8, sys.argv[1])
print("made", flush=True)
signal.pause()
"""


def test_killed_owner_leaks_nothing_for_long() -> None:
    """A name in use is refused; after SIGKILL of its owner the next ring of that name takes its place."""
    name = f"rtec-test-{os.getpid()}"
    with subprocess.Popen([sys.executable, "-c", _HOLD, name], stdout=subprocess.PIPE) as owner:
        try:
            assert owner.stdout is not None
            assert owner.stdout.readline() == b"made\n"
            with pytest.raises(RtecError, match="in use by a running process"):
                Ring.create(LAYOUT, 8, name)
        finally:
            owner.send_signal(signal.SIGKILL)
    assert (SHM / name).exists()
    with Ring.create(LAYOUT, 8, name) as ring:
        produce(ring, 1)
        assert_rows(ring.drain(), [0])
    assert not (SHM / name).exists()


_HOLD_ANY = """
import signal
from rtec.loop.records import Layout
from rtec.daemon.ring import Ring
print(Ring.create(Layout(("X",), ()), 8).name, flush=True)
signal.pause()
"""


def test_a_ring_of_a_killed_owner_goes_with_the_next_one_that_is_made() -> None:
    """Whatever its name, as long as nobody else had it; that of a living owner stays."""
    with subprocess.Popen([sys.executable, "-c", _HOLD_ANY], stdout=subprocess.PIPE) as owner:
        try:
            assert owner.stdout is not None
            name = owner.stdout.readline().decode().strip()
            with Ring.create(LAYOUT, 8):
                assert (SHM / name).exists()
        finally:
            owner.send_signal(signal.SIGKILL)
    with Ring.create(LAYOUT, 8):
        assert not (SHM / name).exists()


_QUIET = """
import sys
from rtec.daemon.ring import Ring
ring = Ring.attach(sys.argv[1])
ring.slots
ring.publish()
"""


def test_processes_end_silently_and_leave_the_ring(ring: Ring) -> None:
    """A process that never closes prints no warning at its end and takes nobody's memory away."""
    done = subprocess.run([sys.executable, "-Wd", "-c", _QUIET, ring.name], capture_output=True, check=True)
    assert done.stderr == b""
    assert (SHM / ring.name).exists()
    assert ring.head == 1


@pytest.mark.parametrize("name", ["", "a/b", "../x", ".hidden"])
def test_names_with_paths_are_refused(name: str) -> None:
    with pytest.raises(RtecError, match="name"):
        Ring.attach(name)


def test_what_is_not_a_ring_is_refused(ring: Ring) -> None:
    with pytest.raises(RtecError, match="cannot be opened"):
        Ring.attach("rtec-there-is-no-such-ring")
    with pytest.raises(RtecError, match="at least 2"):
        Ring.create(LAYOUT, 1)
    whole = (SHM / ring.name).read_bytes()
    path = SHM / f"rtec-test-wrong-{os.getpid()}"
    try:
        for content in (b"", b"x" * 64, whole[:-1], whole[:24] + b"{" * 100, b"\xff" * len(whole)):
            path.write_bytes(content)
            with pytest.raises(RtecError, match="not a ring"):
                Ring.attach(path.name)
    finally:
        path.unlink()


def test_no_room_is_an_error_at_creation() -> None:
    """Memory is reserved when the ring is made (an exabyte is more than any /dev/shm has)."""
    with pytest.raises(RtecError, match="no room"):
        Ring.create(LAYOUT, 1 << 52, "rtec-test-too-big")
    assert not (SHM / "rtec-test-too-big").exists()
