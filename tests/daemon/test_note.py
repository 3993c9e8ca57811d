"""A note in shared memory. Oracles: what was written; a writer in a process of its own at full speed."""

import multiprocessing
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from rtec.daemon.ring import NOTE_BYTES, Note, Ring
from rtec.loop.records import Layout

LAYOUT = Layout(("X",), ())


def pair(barrier: Callable[[], None] = lambda: None) -> tuple[Note, Note, NDArray[np.int64], NDArray[np.uint8]]:
    version, text = np.zeros(1, np.int64), np.zeros(NOTE_BYTES, np.uint8)
    return Note(version, text, lambda: None), Note(version, text, barrier), version, text


def test_what_is_written_is_read() -> None:
    writer, reader, version, _ = pair()
    assert reader.read() == {}
    reasons = {"box": ["silent for 0.21 s"], "thermometer": ["T_bed: open wire", "Gehäuse: 3 °C ‰ 漢"]}
    writer.write(reasons)
    assert reader.read() == reasons
    writer.write({})
    assert reader.read() == {}
    assert int(version[0]) == 4


def test_the_same_again_is_not_written_again() -> None:
    writer, _, version, _ = pair()
    for _ in range(3):
        writer.write({"box": ["silent"]})
    assert int(version[0]) == 2


def test_what_is_too_long_is_cut_and_still_read() -> None:
    """A thousand devices with a page each do not fit; all that fits is whole JSON, and nothing is written outside."""
    writer, reader, _, text = pair()
    writer.write({"box": ["ü" * 100_000]})
    assert reader.read() == {"box": ["ü" * 400]}
    many = {f"device {k}": ["x" * 500] for k in range(60)}
    writer.write(many)
    found = reader.read()
    assert list(found) == list(many)
    assert all(t and set(t) == {"x"} for texts in found.values() for t in texts)
    writer.write({f"device {k}": ["y"] for k in range(10_000)})
    assert reader.read() == {}
    assert text.size == NOTE_BYTES


def test_a_text_that_is_being_written_is_not_taken() -> None:
    """The reader keeps what it had, whether the writing began before its copy or in the middle of it."""
    writer, reader, version, text = pair()
    writer.write({"box": ["first"]})
    assert reader.read() == {"box": ["first"]}
    version[0] += 1
    text[4:20] = 0
    assert reader.read() == {"box": ["first"]}

    writer, _, version, text = pair()
    writer.write({"box": ["first"]})
    calls = 0

    def disturb() -> None:
        nonlocal calls
        calls += 1
        version[0] += 2

    disturbed = Note(version, text, disturb)
    assert disturbed.read() == {}
    assert calls == 10


def _write(name: str, n: int) -> None:
    with Ring.attach(name) as ring:
        assert ring.note is not None
        for k in range(n):
            ring.note.write({"box": [f"{k} " * (1 + k % 60)]})
        ring.cycles = n


def test_two_processes() -> None:
    """Every text that is read is whole: one number, repeated as often as that number says."""
    with Ring.create(LAYOUT, 8) as ring:
        writer = multiprocessing.get_context("spawn").Process(target=_write, args=(ring.name, 20_000))
        writer.start()
        seen = -1
        while ring.cycles == 0:
            assert writer.exitcode in (None, 0)
            assert ring.note is not None
            for texts in ring.note.read().values():
                words = texts[0].split()
                assert len(set(words)) == 1
                k = int(words[0])
                assert k >= seen
                assert len(words) == 1 + k % 60
                seen = k
        writer.join(30)
        assert ring.note is not None
        assert ring.note.read()["box"][0].startswith("19999 ")
