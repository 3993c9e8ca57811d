"""What `rtec status` prints.

Oracles: the figures that went in; `json`; a real pseudo-terminal for what only a terminal gets.
"""

import json
import os
import pty
import sys
import threading
from contextlib import suppress
from typing import Any, cast

import pytest

from rtec.cli.control import show, watched
from rtec.control.client import Client
from rtec.control.desk import Desk
from rtec.loop.clock import VirtualClock
from tests.support import setups
from tests.support.control_rig import FakeDaemon


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Desk:
    setup = setups.setup(tmp_path_factory.mktemp("run"))
    return Desk(FakeDaemon(setup), VirtualClock(10), {"machine": setup.machine.name, "config": str(setup.path)})


class Asked:
    """Stands for a client; somebody presses Ctrl-C after three answers."""

    def __init__(self, desk: Desk) -> None:
        self._desk, self.left = desk, 3

    def status(self) -> dict[str, Any]:
        if not self.left:
            raise KeyboardInterrupt
        self.left -= 1
        return self._desk.status()


def watch(desk: Desk, clock: VirtualClock, as_json: bool) -> None:
    with pytest.raises(KeyboardInterrupt):
        watched(cast(Client, Asked(desk)), clock, as_json)


def test_the_table_has_the_figures(desk: Desk, capsys: pytest.CaptureFixture[str]) -> None:
    show(desk.status())
    lines = capsys.readouterr().out.splitlines()
    assert "mode on: the correction follows the model" in lines
    x = next(line.split() for line in lines if line.startswith(" X "))
    assert x == ["X", "0.0500", "+1.50", "+1.25", "not", "known", "+2"]
    bed = next(line.split() for line in lines if line.startswith(" T_bed"))
    assert bed == ["T_bed", "21.25", "°C", "0.5", "s"]
    assert any(line.split() == ["T_air", "not", "read"] for line in lines)
    assert "7200000 cycles in 2.0 h, 3 deadlines missed" in lines


def test_watched_into_a_pipe_page_follows_page(desk: Desk, capsys: pytest.CaptureFixture[str]) -> None:
    """A second apart; with --json a line each, that programs can read."""
    clock = VirtualClock(0)
    watch(desk, clock, as_json=False)
    out = capsys.readouterr().out
    assert out.count("mode on:") == 3
    assert "\x1b" not in out
    assert clock.now_ns() == 3_000_000_000
    watch(desk, VirtualClock(0), as_json=True)
    found = [json.loads(line)["status"]["misses"] for line in capsys.readouterr().out.splitlines()]
    assert found == [3, 3, 3]


def test_watched_on_a_terminal_the_page_is_drawn_over(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    """The cursor goes up and lines are erased in between; it is shown again at the end."""
    near, far = pty.openpty()
    drawn = bytearray()

    def read() -> None:
        with suppress(OSError):  # the other end is closed
            while data := os.read(near, 65_536):
                drawn.extend(data)

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    monkeypatch.setenv("TERM", "xterm")
    with os.fdopen(far, "w", encoding="utf-8") as out, monkeypatch.context() as there:
        there.setattr(sys, "stdout", out)
        watch(desk, VirtualClock(0), as_json=False)
    reader.join(20)
    os.close(near)
    assert drawn.count(b"mode on:") >= 3
    assert b"\x1b[1A" in drawn
    assert drawn.rstrip().endswith(b"\x1b[?25h")
