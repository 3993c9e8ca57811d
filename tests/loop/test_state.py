"""The kept state: nothing that is cut off, wherever, is taken for whole. Oracle: what was written before."""

import fcntl
import multiprocessing
import os
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.correction.flags import MODE_HOLD, MODE_OFF, MODE_ON
from rtec.daemon.recover import WAITED, AtStart, recover, why_waits
from rtec.errors import RtecError
from rtec.loop import state_files
from rtec.loop.clock import VirtualClock
from rtec.loop.ports import HOLDS
from rtec.loop.records import Samples
from rtec.loop.state import (
    IMAGE_BYTES,
    SLOT_BYTES,
    WHY_BYTES,
    Saved,
    StateWriter,
    is_damaged,
    newest,
    read_slot,
    state_from_text,
    state_text,
)
from rtec.loop.state_files import (
    DiskState,
    MemoryState,
    StatePlaces,
    disk_is_damaged,
    read_disk,
    state_memory,
    state_places,
)
from rtec.loop.step import Step
from rtec.wording import TO_RESUME
from tests.support import setups


@pytest.fixture(scope="module")
def step(tmp_path_factory: pytest.TempPathFactory) -> Step:
    return Step(setups.setup(tmp_path_factory.mktemp("run")).step_settings())


def sample(step: Step, time_ns: int) -> Samples:
    out = Samples.empty(step.layout, 1)
    out.time_ns[0], out.mode[0] = time_ns, MODE_ON
    out.counts[0] = [time_ns, -time_ns]
    return out


def kept(step: Step, n: int, mode: int = MODE_ON, output: tuple[int, int] | None = None) -> NDArray[np.uint8]:
    """An image into which n cycles were written; the k-th has ledger (k, -k) where none is given."""
    image = np.zeros(IMAGE_BYTES, np.uint8)
    writer = StateWriter(image, step, MODE_ON)
    writer.order = mode
    for k in range(1, n + 1):
        step.state.floats[:] = k + 0.25
        step.state.ints[:] = k
        writer.keep(sample(step, 1000 * k), np.array(output or (k, -k)), k)
    return image


def test_the_last_cycle_is_read_to_the_bit(step: Step) -> None:
    saved = newest(kept(step, 5).tobytes())
    assert saved is not None
    assert (saved.sequence, saved.row, saved.time_ns, saved.mode) == (5, 5, 5000, MODE_ON)
    assert (saved.clean, saved.waits) == (False, False)
    assert (saved.output.tolist(), saved.counts.tolist()) == ([5, -5], [5000, -5000])
    assert saved.state.floats.tobytes() == np.full(step.state.floats.size, 5.25).tobytes()
    assert saved.state.ints.tolist() == [5] * step.state.ints.size


def test_nothing_written_is_nothing_read() -> None:
    assert newest(b"") is None
    assert newest(bytes(IMAGE_BYTES)) is None
    assert newest(b"\xff" * IMAGE_BYTES) is None


def test_torn_at_every_byte(step: Step) -> None:
    """The sixth write stops after k bytes, for every k: the fifth is there, or the sixth, whole; from behind too."""
    before, after = kept(step, 5).tobytes(), kept(step, 6).tobytes()
    slot = read_slot(after, 0)
    assert slot is not None
    size = len(slot.words)
    assert after[size:SLOT_BYTES] == before[size:SLOT_BYTES]
    for k in range(size + 1):
        for torn in (after[:k] + before[k:], before[: size - k] + after[size - k : size] + before[size:]):
            saved = newest(torn)
            assert saved is not None
            assert saved.output.tolist() == [saved.sequence, -saved.sequence]
            assert saved.sequence == (6 if torn[:size] == after[:size] else 5)


def test_a_file_that_ends_at_every_byte(step: Step) -> None:
    image = kept(step, 6).tobytes()
    size = len(read_slot(image, 0).words) - WHY_BYTES  # type: ignore[union-attr]
    for k in [*range(size + 64), *range(SLOT_BYTES - 8, SLOT_BYTES + size + 64)]:
        saved = newest(image[:k])
        whole = 6 if k >= size - 4 else None  # the upper half of the last word is not used
        assert (None if saved is None else saved.sequence) == whole


def test_every_bit_that_turns_is_noticed(step: Step) -> None:
    """A wrong bit anywhere in the younger slot: the older one counts."""
    image = bytearray(kept(step, 6).tobytes())
    size = len(read_slot(bytes(image), 0).words) - WHY_BYTES  # type: ignore[union-attr]
    for k in range(size - 4):  # the upper half of the last word is not used
        image[k] ^= 1 << (k % 8)
        saved = newest(bytes(image))
        assert saved is not None
        assert saved.sequence == 5, k
        image[k] ^= 1 << (k % 8)


def test_a_second_writer_goes_on_without_touching_the_newest_first(step: Step) -> None:
    image = kept(step, 5)
    StateWriter(image, step, MODE_ON, 5)
    found = newest(image.tobytes())
    assert found is not None
    assert found.sequence == 5
    StateWriter(image, step, MODE_ON, 5).keep(sample(step, 9), np.array([9, 9]), 9)
    found, other = newest(image.tobytes()), read_slot(image.tobytes(), 1)
    assert found is not None
    assert other is not None
    assert (found.sequence, other.sequence) == (6, 5)


def test_memory_is_plain_text_in_a_log_and_back(step: Step) -> None:
    state = step.fresh_state()
    state.floats[:4] = [0.1, -0.0, np.inf, 1e-310]
    state.floats[4] = np.nan
    state.ints[0] = 2**62
    again = state_from_text(state_text(state), state)
    assert again is not None
    assert again.floats.tobytes() == state.floats.tobytes()
    assert again.ints.tobytes() == state.ints.tobytes()
    for wrong in (None, {}, {"floats": ["x"], "ints": []}, {"floats": ["0x1p0"], "ints": [1]}, [1], "no"):
        assert state_from_text(wrong, state) is None


def test_on_disk_two_slots_in_turns(step: Step, tmp_path: Path) -> None:
    """Torn at every byte of the third write; and another start of the computer is noticed."""
    path = tmp_path / "deep" / "run.state"
    disk = DiskState(path)
    images = []
    for n in (3, 4, 9):
        saved = newest(kept(step, n).tobytes())
        assert saved is not None
        disk.write(saved)
        images.append(path.read_bytes())
    disk.close()
    assert [newest(i).sequence for i in images] == [3, 4, 9]  # type: ignore[union-attr]
    for k in range(0, SLOT_BYTES, 7):
        torn = newest(images[2][:k] + images[1][k:])
        assert torn is not None
        assert torn.sequence in (4, 9)
        assert torn.output.tolist() == [torn.sequence, -torn.sequence]
    assert read_disk(path)[1] is False
    path.write_bytes(images[2][: 2 * SLOT_BYTES] + b"another start of the computer")
    found, new_boot = read_disk(path)
    assert (found is not None, new_boot) == (True, True)
    assert read_disk(tmp_path / "nothing") == (None, True)


def test_memory_that_belongs_to_one_loop(step: Step, tmp_path: Path) -> None:
    path, clock = tmp_path / "run.state", VirtualClock()
    with state_memory(path, clock) as image:
        StateWriter(image, step, MODE_ON).keep(sample(step, 1), np.array([1, 2]), 1)
        found = MemoryState(path).newest()
        assert found is not None
        assert found.output.tolist() == [1, 2]
        assert MemoryState(path).snapshot() is None
        with pytest.raises(RtecError, match="another rtec runs with this run file"), state_memory(path, clock):
            pass
    with state_memory(path, clock) as image:
        again = newest(image.tobytes())
        assert again is not None
        assert again.output.tolist() == [1, 2]
    path.unlink()
    path.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(RtecError, match="cannot be made"), state_memory(path, clock):
        pass


def test_places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One place a run file, wherever it is started from; systemd's folders come first."""
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    places = state_places(tmp_path / "run.toml", tmp_path / "logs")
    assert places.memory.parent == Path("/dev/shm")  # noqa: S108
    assert places.disk == tmp_path / "logs" / "run.state"
    assert state_places(tmp_path / "x" / ".." / "run.toml", None).memory == places.memory
    assert state_places(tmp_path / "other.toml", None).memory != places.memory
    assert state_places(tmp_path / "run.toml", None).disk is None
    monkeypatch.setenv("RUNTIME_DIRECTORY", "/run/rtec:/run/more")
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/rtec")
    places = state_places(tmp_path / "run.toml", tmp_path / "logs")
    assert (places.memory.parent, places.disk) == (Path("/run/rtec"), Path("/var/lib/rtec/run.state"))


def found(saved: Saved | None, **more: object) -> AtStart:
    told: dict[str, object] = {
        "saved": saved,
        "new_boot": False,
        "slack_s": 0.002,
        "output": np.array([5, -5]),
        "counts": np.array([5000, -5000]),
        "start_mode": MODE_ON,
    }
    return AtStart(**{**told, **more})  # type: ignore[arg-type]


def saved_of(step: Step, **more: object) -> Saved:
    out = newest(kept(step, 5, **more).tobytes())  # type: ignore[arg-type]
    assert out is not None
    return out


def test_a_first_start_takes_what_the_actuator_has(step: Step) -> None:
    start = recover(step, found(None))
    assert (start.output.tolist(), start.mode, start.waits, start.notes) == ([5, -5], MODE_ON, "", [])
    assert step.output_of(step.state).tolist() == [5, -5]


def test_after_a_kill_ledger_mode_and_memory_are_taken_over(step: Step) -> None:
    saved = saved_of(step, mode=MODE_HOLD)
    step.restore(step.fresh_state())
    start = recover(step, found(saved))
    assert (start.output.tolist(), start.mode, start.waits, start.sequence) == ([5, -5], MODE_HOLD, "", 5)
    assert len(start.notes) == 1
    floats = step.source.floats.at
    assert step.state.floats[floats["d"]].tolist() == [5.25, 5.25]
    assert step.state.floats[floats["m"]].tolist() == [5.25] * 9
    assert step.state.floats[floats["speed"]].tolist() == [0.0, 0.0]


def test_an_axis_that_moved_has_no_direction(step: Step) -> None:
    """X moved by 1 mm meanwhile; Z by less than its dead band. Oracle: what each was before."""
    saved = saved_of(step)
    recover(step, found(saved, counts=np.array([6000, -5001])))
    assert step.state.floats[step.source.floats.at["d"]].tolist() == [0.0, 5.25]
    recover(step, found(saved, counts=None))
    assert step.state.floats[step.source.floats.at["d"]].tolist() == [0.0, 0.0]
    assert int(step.state.ints[step.source.ints.at["started"]][0]) == 0


def test_an_actuator_that_lost_its_ledger_waits(step: Step) -> None:
    saved = saved_of(step, output=(120, -44))
    start = recover(step, found(saved, output=np.array([0, 0])))
    assert "the actuator has X +0.00 µm, Z +0.00 µm, the run before left X -60.00 µm, Z +22.00 µm" in start.waits
    assert start.output.tolist() == [0, 0]
    near = recover(step, found(saved, output=np.array([121, -44])))
    assert near.waits == ""
    not_yet = recover(step, found(saved, output=None))
    assert not_yet.waits == ""
    assert not_yet.expected is not None
    assert not_yet.expected.tolist() == [120, -44]


def test_a_computer_that_was_started_anew_keeps_ledger_and_mode_alone(step: Step) -> None:
    saved = saved_of(step, mode=MODE_OFF)
    step.restore(step.fresh_state())
    start = recover(step, found(saved, new_boot=True, slack_s=1.0))
    assert (start.output.tolist(), start.mode) == ([5, -5], MODE_OFF)
    assert step.state.floats[step.source.floats.at["m"]].tolist() == [0.0] * 9


def test_a_run_file_that_was_changed_since_decides_the_mode(step: Step) -> None:
    assert recover(step, found(saved_of(step, mode=MODE_OFF), start_mode=MODE_HOLD)).mode == MODE_HOLD


def ended(step: Step, mode: int, start_mode: int = MODE_ON) -> Saved:
    """The state of a run that ended in order."""
    image = np.zeros(IMAGE_BYTES, np.uint8)
    writer = StateWriter(image, step, start_mode)
    writer.order = mode
    writer.finish(sample(step, 1), np.array([120, 7]), 1)
    out = newest(image.tobytes())
    assert out is not None
    return out


@pytest.mark.parametrize(
    ("ordered", "file", "then"),
    [
        (MODE_OFF, MODE_ON, MODE_OFF),
        (MODE_HOLD, MODE_ON, MODE_HOLD),
        (MODE_ON, MODE_ON, MODE_ON),
        (MODE_ON, MODE_HOLD, MODE_HOLD),
    ],
)
def test_an_order_that_stops_stays_after_an_end_in_order(step: Step, ordered: int, file: int, then: int) -> None:
    """An orderly restart must not undo what a person ordered in doubt; nor does it go on correcting by itself."""
    start = recover(step, found(ended(step, ordered, file), start_mode=file, output=np.array([0, 0])))
    assert (start.mode, start.waits) == (then, "")
    assert [("was ordered before the run ended" in n) for n in start.notes] == [True] * (then != file)
    assert start.output.tolist() == [0, 0]


def test_the_order_of_another_step_ends_with_its_run(step: Step) -> None:
    """A sign check ends with an order to zero; the run after it is the run file's."""
    check = replace(ended(step, MODE_OFF), structure=b"a step of one constant".ljust(32))
    start = recover(step, found(check))
    assert (start.mode, start.notes) == (MODE_ON, [])


def test_counts_that_were_lost_between_two_runs_wait_for_an_order(step: Step) -> None:
    """A box without supply begins at nothing, where the axes stand; an offset register has lost its number alone, and
    has nothing: any other number is somebody's."""
    box = recover(step, found(ended(step, MODE_ON), inserts=True))
    assert "the actuator has X -2.50 µm, Z +2.50 µm, the run before left X -60.00 µm, Z -3.50 µm" in box.waits
    assert recover(step, found(ended(step, MODE_ON), inserts=True, output=np.array([120, 7]))).waits == ""
    later = recover(step, found(ended(step, MODE_ON), inserts=True, output=None))
    assert later.expected is not None
    assert later.expected.tolist() == [120, 7]
    assert recover(step, found(ended(step, MODE_ON), output=np.array([0, 0]))).waits == ""
    assert "the actuator has X -2.50 µm, Z +2.50 µm" in recover(step, found(ended(step, MODE_ON))).waits
    register = recover(step, found(ended(step, MODE_ON), output=None))
    assert register.expected is not None
    assert register.or_zero


def test_a_wait_that_was_cut_off_goes_on(step: Step) -> None:
    image = np.zeros(IMAGE_BYTES, np.uint8)
    writer = StateWriter(image, step, MODE_ON)
    writer.waits = True
    writer.keep(sample(step, 1), np.array([5, -5]), 1)
    start = recover(step, found(newest(image.tobytes())))
    assert start.waits == f"{WAITED}; {HOLDS}"
    assert start.notes[0].startswith(
        "the run before waited for an order to resume: its ledger (X -2.50 µm, Z +2.50 µm)"
    )


def test_the_next_start_says_what_was_waited_for_and_so_does_the_one_after(step: Step, tmp_path: Path) -> None:
    """A sensor jumped; the register of another device did nothing. Oracle: the sensor's own reason, on disk, too."""
    jumped = f"T1: jumped from 20.00 to 90.00 °C: look at its plug; if it is right: {TO_RESUME}"
    reasons = {"temp": ["T2: no answer", jumped], "cell": ["silent for 3 s"]}
    says = "device temp: T1: jumped from 20.00 to 90.00 °C: look at its plug"
    for _ in range(2):
        image = np.zeros(IMAGE_BYTES, np.uint8)
        writer = StateWriter(image, step, MODE_ON)
        writer.waits = True
        writer.tell_why(why_waits(reasons))
        writer.keep(sample(step, 1), np.array([5, -5]), 1)
        in_memory = newest(image.tobytes())
        assert in_memory is not None
        disk = DiskState(tmp_path / "state")
        disk.write(in_memory)
        on_disk, _ = read_disk(tmp_path / "state")
        disk.close()
        for saved in (in_memory, on_disk):
            start = recover(step, found(saved))
            assert start.waits == f"{WAITED}: {says}; {HOLDS}"
        reasons = {"cell": [start.waits]}
    writer.tell_why("µ" * 300)
    torn = bytearray(image.tobytes())
    assert newest(bytes(torn)).why == "µ" * 256  # type: ignore[union-attr]
    torn[SLOT_BYTES + len(newest(image.tobytes()).words) - WHY_BYTES] ^= 1  # type: ignore[union-attr]
    saved = newest(bytes(torn))
    assert saved is not None
    assert recover(step, found(saved)).waits == f"{WAITED}; {HOLDS}", "half a text is no reason"


def test_a_state_that_is_damaged_is_told_and_one_way_waited_for(step: Step) -> None:
    """What the actuator tells by itself is good; of one that cannot tell, nobody knows anything."""
    told = recover(step, found(None, damaged="the state in /x is damaged"))
    assert (told.output.tolist(), told.waits) == ([5, -5], "")
    assert told.notes[0].startswith("the state in /x is damaged; the ledger is taken from the actuator")
    silent = recover(step, found(None, output=None, damaged="the state in /x is damaged", one_way=True))
    assert silent.waits.startswith("the state in /x is damaged; nobody knows what the actuator has")
    assert (silent.output.tolist(), silent.notes) == ([0, 0], [])


def test_a_register_whose_units_changed_is_not_begun_from_nothing(step: Step) -> None:
    """It stands at 120 of another unit: to begin with 0 would be a jump. After (0, 0) there is nothing to jump."""
    other = replace(saved_of(step, output=(120, -44)), units=b"another", clean=True)
    assert "other axes, counts_per_mm or output units" in recover(step, found(other, one_way=True, output=None)).waits
    at_rest = replace(other, output=np.array([0, 0]))
    assert recover(step, found(at_rest, one_way=True, output=None)).waits == ""
    box = recover(step, found(replace(other, clean=False)))
    assert (box.waits, box.output.tolist(), len(box.notes)) == ("", [5, -5], 1)


def test_damaged_is_what_was_written_and_is_not_whole(step: Step) -> None:
    assert not is_damaged(b"")
    assert not is_damaged(bytes(IMAGE_BYTES))
    image = bytearray(kept(step, 5).tobytes())
    assert not is_damaged(bytes(image))
    for k in range(2):
        image[k * SLOT_BYTES + 200] ^= 1
    assert is_damaged(bytes(image))


def test_a_state_file_that_somebody_removes_is_made_anew(step: Step, tmp_path: Path) -> None:
    path, saved = tmp_path / "run.state", saved_of(step)
    disk = DiskState(path)
    disk.write(saved)
    path.unlink()
    assert read_disk(path)[0] is None
    disk.write(saved)
    disk.close()
    back, new_boot = read_disk(path)
    assert back is not None
    assert (back.words, new_boot) == (saved.words, False)


def test_two_daemons_never_write_one_state(tmp_path: Path) -> None:
    """Not even by two names of one folder. Oracle: the state that the first has written, read again."""
    (tmp_path / "state").mkdir()
    (tmp_path / "other").symlink_to(tmp_path / "state")
    first, second = DiskState(tmp_path / "state" / "run.state"), DiskState(tmp_path / "other" / "run.state")
    clock = VirtualClock(1)
    first.lock(clock)
    with pytest.raises(RtecError, match="another rtec keeps its state there"):
        second.lock(clock)
    assert clock.now_ns() > 1_900_000_000  # one that is just ending gets so long
    first.close()
    second.lock(clock)
    second.close()


def test_a_copy_of_the_process_keeps_no_state_locked(tmp_path: Path) -> None:
    """A worker that hangs when its daemon is killed must not keep the next one from starting. Oracle: `flock`."""
    disk = DiskState(tmp_path / "run.state")
    disk.lock(VirtualClock(1))
    kept = disk.path.stat()
    here, there = multiprocessing.Pipe()
    context = multiprocessing.get_context("fork")
    process = context.Process(target=_holds, args=(there, kept))
    process.start()
    assert here.recv() == []
    with disk.path.open("rb") as other, pytest.raises(BlockingIOError):
        fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)  # this process still has it
    disk.close()
    here.send("end")
    process.join()


def _holds(there: Connection, kept: os.stat_result) -> None:
    """Tell which of its descriptors are of a file; stay until told to end."""
    opened = [fd for fd in Path("/proc/self/fd").iterdir() if fd.exists()]
    there.send([fd.name for fd in opened if os.path.samestat(fd.stat(), kept)])
    there.recv()


@pytest.mark.parametrize("kind", ["fifo", "folder"])
def test_a_state_that_is_no_file_is_refused_and_nobody_waits_for_it(tmp_path: Path, kind: str) -> None:
    """Opening a FIFO to read it waits for ever for somebody who writes into it."""
    path = tmp_path / "run.state"
    if kind == "fifo":
        os.mkfifo(path)
    else:
        path.mkdir()
    assert read_disk(path) == (None, True)
    assert not disk_is_damaged(path)
    assert MemoryState(path).newest() is None
    clock = VirtualClock(1)
    if kind == "fifo":
        with pytest.raises(RtecError, match="is no ordinary file; remove it"):
            DiskState(path).lock(clock)
    with pytest.raises(RtecError, match=r"is no ordinary file|Is a directory"), state_memory(path, clock):
        pass


def test_memory_that_was_deleted_can_still_be_read(tmp_path: Path, step: Step) -> None:
    """By the supervisor, so that the copy on disk goes on; and it says so."""
    path = tmp_path / "a.state"
    with state_memory(path, VirtualClock(1)) as image:
        reader = MemoryState(path)
        writer = StateWriter(image, step, MODE_ON)
        writer.keep(sample(step, 1), step.output_of(step.state), 7)
        saved = reader.newest()
        assert saved is not None
        assert (saved.row, reader.deleted) == (7, False)
        path.unlink()
        writer.keep(sample(step, 2), step.output_of(step.state), 8)
        saved = reader.newest()
        assert saved is not None
        assert (saved.row, reader.deleted) == (8, True)
        path.write_bytes(b"another loop's")
    assert path.read_bytes() == b"another loop's"
    reader.close()


def test_a_look_at_the_kept_state_removes_nothing(tmp_path: Path) -> None:
    """A dry run beside a daemon that just begins: its image exists, and nothing is in it yet."""
    places = StatePlaces(tmp_path / "memory", None)
    places.memory.write_bytes(bytes(IMAGE_BYTES))
    assert state_files.kept(places) is None
    assert places.memory.exists()
    assert state_files.kept(StatePlaces(tmp_path / "none", tmp_path / "nor this")) is None
