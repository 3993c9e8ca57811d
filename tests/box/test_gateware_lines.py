"""What a chip does with its lines: filter, index latch, relay. Oracle: the lines, made by hand, and arithmetic."""

import struct
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest

from rtec.correction.quadrature import encode
from rtec_drivers.box.gateware import Chip
from rtec_drivers.box.simulator import unstuff
from tests.support import gateware
from tests.support.gateware import frame, missing

pytestmark = pytest.mark.skipif(bool(missing()), reason=missing())

NOT_RESUMED, HELD, MOVING, FAULT = 1, 2, 4, 8


@pytest.fixture
def chip() -> Iterator[Chip]:
    with gateware.chip() as made:
        yield made


def test_the_relay_waits_until_the_outputs_follow(chip: Chip) -> None:
    """2^16 clocks after every start; until then the controller has the encoder itself."""
    for _ in range(2):
        assert not chip.relay
        chip.run(2**16 - 400, [0, 0])
        assert not chip.relay
        chip.run(800, [0, 0])
        assert chip.relay
        chip.reset()


@pytest.mark.parametrize(("length", "clocks", "passes"), [(0, 1, True), (3, 3, False), (3, 4, True), (9, 9, False)])
def test_what_is_shorter_than_the_filter_leaves_no_trace(chip: Chip, length: int, clocks: int, passes: bool) -> None:
    chip.settings(filter_length=length)
    a = np.zeros(200, np.uint8)
    a[50 : 50 + clocks] = 1
    still = np.zeros_like(a)
    a_out, b_out, _ = chip.lines(0, a, still, still)
    assert bool(a_out.any()) is passes
    assert not b_out.any()
    assert (chip.ledger(0).raw, chip.ledger(0).illegal) == (0, 0)


@pytest.mark.parametrize("direction", [1, -1])
def test_the_index_passes_and_its_count_is_kept(chip: Chip, direction: int) -> None:
    """The pulse is between counts 7 and 8 of a steady motion; it comes out between the same two edges."""
    place = direction * (np.arange(400) // 20)
    a, b = encode(place)
    z = (np.abs(place) == 7).astype(np.uint8)
    out = chip.lines(1, a, b, z)
    late = int(np.flatnonzero(out[0] | out[1])[0] - np.flatnonzero(a | b)[0])
    assert late > 0
    for given, came in zip((a, b, z), out, strict=True):
        np.testing.assert_array_equal(came[late:], given[:-late])
    assert chip.ledger(1).at_index == 7 * direction


def test_a_balance_at_full_speed(chip: Chip) -> None:
    """An edge every clock, both axes, there and back: none is lost."""
    chip.run(1, [100_000, -70_000])
    chip.run(100, [100_000, -70_000])
    assert [chip.ledger(i).raw for i in range(2)] == [100_000, -70_000]
    assert [chip.ledger(i).corrected for i in range(2)] == [100_000, -70_000]
    chip.run(1, [-5, 3])
    chip.run(100, [-5, 3])
    assert [(chip.ledger(i).raw, chip.ledger(i).illegal) for i in range(2)] == [(-5, 0), (3, 0)]


def test_a_start_with_lines_high_counts_nothing(chip: Chip) -> None:
    """Power comes on with all lines high, the reset is as short as the boards', the filter as long as it can be."""
    chip.settings(filter_length=63)
    chip.power(rst=True, a=0, b=0, clocks=200)
    chip.power(rst=True, a=3, b=3, clocks=15)
    chip.power(rst=False, a=3, b=3, clocks=400)
    assert [(chip.ledger(i).raw, chip.ledger(i).inserted) for i in range(2)] == [(0, 0), (0, 0)]
    assert status(chip) == NOT_RESUMED
    chip.power(rst=False, a=2, b=3, clocks=400)
    assert [abs(chip.ledger(i).raw) for i in range(2)] == [1, 0]


@pytest.mark.parametrize("whole_cycles", [False, True])
@pytest.mark.parametrize("direction", [1, -1])
def test_the_index_keeps_its_place_while_counts_are_inserted(chip: Chip, whole_cycles: bool, direction: int) -> None:
    """The index comes out as it came, a latency later, and the controller latches raw + inserted there.

    Oracle: a count of the lines that go out, the index made by hand, and the ledger at the end.
    """
    chip.settings(interval=40, whole_cycles=whole_cycles)
    command(chip, 40, -40)
    chip.run(0, [0, 0])
    place = direction * (np.arange(6000) // 50)
    a, b = encode(place)
    z = (np.abs(place) % 40 == 9).astype(np.uint8)
    quiet = chip.ledger(0).inserted
    a_out, b_out, z_out = chip.lines(0, a, b, z)
    late = int(np.flatnonzero(z_out)[0] - np.flatnonzero(z)[0])
    np.testing.assert_array_equal(z_out[late:], z[:-late])
    step = np.diff(np.array([[0, 3], [1, 2]])[a_out, b_out], prepend=quiet % 4)
    counted = np.cumsum((step + 1) % 4 - 1) + quiet
    latched = counted[np.flatnonzero(np.diff(z_out) == 1) + 1]
    inserted = latched - direction * (9 + 40 * np.arange(len(latched)))
    assert chip.ledger(0).inserted == 40
    assert (np.diff(inserted) >= 0).all()
    assert 0 < inserted[0] < inserted[-1] <= 40
    assert chip.ledger(0).at_index == direction * (9 + 40 * (len(latched) - 1))


@pytest.mark.parametrize(("whole_cycles", "wanted", "has"), [(False, 11, 11), (True, 11, 12), (True, -10, -8)])
def test_counts_come_no_faster_than_the_board_says(chip: Chip, whole_cycles: bool, wanted: int, has: int) -> None:
    """At rest, so that every edge that goes out is an inserted one. Whole cycles: the nearest that 2 counts allow."""
    chip.settings(interval=333, whole_cycles=whole_cycles)
    command(chip, wanted, 0)
    chip.run(333 * (abs(has) - 3), [0, 0])
    assert abs(chip.ledger(0).inserted) < abs(has)
    assert status(chip) & MOVING
    chip.run(1400, [0, 0])
    ledger = chip.ledger(0)
    assert (ledger.inserted, ledger.corrected, ledger.closest) == (has, has, 333)
    assert not status(chip) & MOVING


def test_the_limit_in_whole_cycles_is_passed_by_one_count_at_most(chip: Chip) -> None:
    """The limit is no multiple of 4. Oracle: docs/encoder-box.md."""
    chip.settings(interval=10, whole_cycles=True, limit=11)
    for wanted in (1000, -1000):
        command(chip, wanted, 0)
        chip.run(2000, [0, 0])
        assert chip.ledger(0).inserted == (12 if wanted > 0 else -12)


def test_silence_in_the_middle_of_a_way(chip: Chip) -> None:
    """Held where it is, at once, no longer on its way, and not resumed by a READ. Oracle: two milliseconds."""
    chip.settings(interval=2000, hold_after_ms=3)
    command(chip, 100, 100)
    chip.run(chip.clk_hz * 6 // 1000, [0, 0])
    held, other = (chip.ledger(i).inserted for i in range(2))
    assert 5 <= other <= held <= other + 1 <= 11  # the targets of the axes are taken one after the other
    assert status(chip) == HELD
    chip.run(chip.clk_hz * 6 // 1000, [40, -40])
    chip.run(100, [40, -40])
    assert [chip.ledger(i).inserted for i in range(2)] == [held, other]
    assert [chip.ledger(i).corrected for i in range(2)] == [held + 40, other - 40]
    command(chip, 100, 100)
    chip.run(2500, [40, -40])
    assert chip.ledger(0).inserted > held


def test_both_lines_at_once_are_flagged_and_pass(chip: Chip) -> None:
    """A transition that cannot be: it goes out as it came, counts nothing, and is remembered until RESUME."""
    command(chip, 0, 0)
    a = np.zeros(300, np.uint8)
    a[100:] = 1
    a_out, b_out, _ = chip.lines(0, a, a, np.zeros_like(a))
    np.testing.assert_array_equal(a_out, b_out)
    assert a_out[-1] == 1
    assert (chip.ledger(0).raw, chip.ledger(0).inserted) == (0, 0)
    assert status(chip) & FAULT
    resume(chip)
    assert not status(chip) & FAULT


def resume(chip: Chip) -> None:
    """The order, to start 1."""
    chip.send(frame(4, 1, (1).to_bytes(2, "little")))
    chip.settle()
    chip.received()


def command(chip: Chip, *targets: int) -> None:
    """Resume and command."""
    resume(chip)
    chip.send(frame(3, 2, struct.pack("<H2i", 1, *targets)))
    chip.settle()


def status(chip: Chip) -> int:
    """What a READ says."""
    chip.send(frame(2, 3))
    chip.settle()
    return unstuff(chip.received()[1:-1])[6]


FORKED = """
import os, signal, sys
from pathlib import Path
from rtec_drivers.box.gateware import Chip

chip = Chip(Path(sys.argv[1]))
others = [t for t in Path("/proc/self/task").iterdir() if t.name != str(os.getpid())]
while any((t / "stat").read_text().rpartition(")")[2].split()[0] != "S" for t in others):
    pass  # until the chip's threads wait for work
child = os.fork()
if child == 0:
    signal.alarm(30)
    del chip
    os._exit(0)
ended = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
chip.run(100, [0] * chip.axes)
sys.exit(ended)
"""


def test_a_forked_process_does_not_end_the_threads_of_a_chip_that_is_not_its_own() -> None:
    """Oracle: the kernel; a process that waits for threads which it does not have is ended by its alarm."""
    assert subprocess.run([sys.executable, "-c", FORKED, gateware.library()], check=False).returncode == 0
