"""Spoilt text for every reader of text from outside; `python -m tests.fuzz` feeds a million of each kind.

Oracle: `tests.fuzz` itself allows nothing but reading and refusing. It is tried on readers that do worse.
"""

import os
from pathlib import Path

import pytest

from rtec.errors import ConfigError
from tests import fuzz

KINDS = (
    *("requests", "expressions", "comparisons"),
    *("run files", "run files, whole", "machine files", "model files"),
)


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_but_reading_and_refusing(kind: str, tmp_path: Path) -> None:
    kinds = fuzz.kinds(tmp_path)
    assert tuple(kinds) == KINDS
    read, seeds = kinds[kind]
    found = fuzz.feed(read, seeds, 300, seed=11)
    assert found.faults == []
    assert found.read > 0
    assert found.refused > found.read // 10


def test_readers_that_do_worse_are_found() -> None:
    """One that falls over, one that runs what it reads, one that starts a program."""

    def falls_over(text: bytes) -> bool:
        return len(text.decode()) > 0

    def runs_it(text: bytes) -> bool:
        if text != b"1+1":
            exec("1")  # noqa: S102 (what is looked for)
        return True

    def starts_one(text: bytes) -> bool:
        if text != b"1+1":
            os.system("true")  # noqa: S605 (what is looked for)
            raise ConfigError("refused afterwards")
        return True

    assert any("UnicodeDecodeError" in fault for _, fault in fuzz.feed(falls_over, (b"1+1",), 200, 1).faults)
    assert any("exec" in fault for _, fault in fuzz.feed(runs_it, (b"1+1",), 20, 1).faults)
    assert fuzz.feed(starts_one, (b"1+1",), 5, 1).faults


def test_an_input_that_never_ends_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fuzz, "LONGEST_S", 1)

    def hangs(text: bytes) -> bool:
        while text != b"1+1":
            continue
        return True

    found = fuzz.feed(hangs, (b"1+1",), 1, 3)
    assert [fault for _, fault in found.faults] == ["took longer than 1 s"]
