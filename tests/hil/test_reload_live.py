"""Reload, orders and full disks while the daemon runs: real processes, real clock.

Oracles: the logs, each replayed bit by bit from its own beginning; the slew limit; the kernel's /dev/full.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

from rtec.correction.flags import Flag
from rtec.daemon.disk import new_log_path
from rtec.daemon.status import Report, Status
from rtec.daemon.supervisor import Supervisor
from rtec.log.folder import log_files
from rtec.log.reader import LogReader
from rtec.loop.orders import Order
from rtec.loop.run_file import Setup, load_setup
from rtec.model import Model, save_model
from rtec.playback.replay import replay_log
from tests.support import setups

pytestmark = [pytest.mark.xdist_group("real-clock"), pytest.mark.usefixtures("runtime_folder")]
SLEW_UM_S = 50.0


class Script:
    """Does one thing after the other, each when the one before has come about."""

    def __init__(self, *steps: tuple[Callable[[Supervisor], object], Callable[[Status], bool]]) -> None:
        self.steps, self.at, self.begun, self.seen = list(steps), 0, False, list[Status]()
        self.supervisor: Supervisor | None = None

    def __call__(self, status: Status) -> None:
        assert self.supervisor is not None
        if not status.cycles or self.at >= len(self.steps):
            return
        do, until = self.steps[self.at]
        if not self.begun:
            do(self.supervisor)
            self.begun = True
        elif until(status):
            self.seen.append(status)
            self.at, self.begun = self.at + 1, False
            if self.at == len(self.steps):
                self.supervisor.end()


def run(setup: Setup, log: Path | None, script: Script, seconds: float = 60.0) -> tuple[Report, Supervisor]:
    supervisor = script.supervisor = Supervisor(setup, log, script)
    report = supervisor.run(seconds)
    assert script.at == len(script.steps), f"step {script.at} did not come about: {supervisor.status}"
    return report, supervisor


@pytest.fixture
def setup(tmp_path: Path) -> Setup:
    return setups.setup(tmp_path)


def change(setup: Setup, **limits: Any) -> Callable[[Supervisor], object]:
    """Write other limits of X, then order to reload."""

    def do(supervisor: Supervisor) -> None:
        content = setups.tables(setup.base)
        content["limits"]["X"].update(limits)
        setup.path.write_text(tomli_w.dumps(content), encoding="utf-8")
        supervisor.order(Order.RELOAD)

    return do


def other_model(setup: Setup) -> Callable[[Supervisor], object]:
    """Write a model without backlash, then order to reload."""

    def do(supervisor: Supervisor) -> None:
        model = setup.model
        save_model(Model(model.machine, model.effects[:1] + model.effects[2:]), setup.base / "model.toml")
        supervisor.order(Order.RELOAD)

    return do


def spoil(setup: Setup) -> Callable[[Supervisor], object]:
    def do(supervisor: Supervisor) -> None:
        (setup.base / "model.toml").write_text("[model", encoding="utf-8")
        supervisor.order(Order.RELOAD)

    return do


def test_limits_model_and_a_broken_model(setup: Setup, tmp_path: Path) -> None:
    """Three files of the log, each replays to the bit with the files of its time; nowhere a jump."""
    still = Script(
        (lambda _: None, lambda s: abs(s.applied_um["X"]) > 10.0),
        (change(setup, stop_um=8.0, warning_um=7.0), lambda s: "limits of X" in s.reload),
        (lambda _: None, lambda s: abs(s.applied_um["X"]) <= 8.0),
        (other_model(setup), lambda s: s.reloads == 2 and "model" in s.reload),
        (spoil(setup), lambda s: "the old one stays in force" in s.reload),
        (lambda s: s.order(Order.HOLD), lambda s: Flag.ORDERED_HOLD in s.flags),
        (lambda s: s.order(Order.MARK, "first part"), lambda _: True),
    )
    kept = [(tmp_path / name).read_bytes() for name in ("run.toml", "model.toml")]
    report, supervisor = run(setup, tmp_path / "log.arrows", still)
    assert report.warnings == []
    assert still.seen[3].reload == "reloaded: model"
    assert "not valid TOML" in still.seen[4].reload
    logs = [tmp_path / "log.arrows", tmp_path / "log-2.arrows", tmp_path / "log-3.arrows"]
    assert report.log == logs[-1]
    applied_um, time_ns = [], []
    for log in logs:
        with LogReader(log) as reader:
            blocks = list(reader.blocks())
        applied_um += [commands.applied_um for _, commands in blocks]
        time_ns += [samples.time_ns for samples, _ in blocks]
    um, ns = np.concatenate(applied_um), np.concatenate(time_ns)
    assert len(um) == report.summary["cycles"]
    assert (np.abs(np.diff(um, axis=0)).max(axis=1) <= SLEW_UM_S * np.diff(ns) * 1e-9 * (1 + 1e-9)).all()

    for name, data in zip(("run.toml", "model.toml"), kept, strict=True):
        (tmp_path / name).write_bytes(data)
    assert replay_log(load_setup(setup.path), logs[0], check=True).different == 0
    content = setups.tables(tmp_path)
    content["limits"]["X"].update(stop_um=8.0, warning_um=7.0)
    setup.path.write_text(tomli_w.dumps(content), encoding="utf-8")
    assert replay_log(load_setup(setup.path), logs[1], check=True).different == 0
    model = setup.model
    save_model(Model(model.machine, model.effects[:1] + model.effects[2:]), tmp_path / "model.toml")
    third = replay_log(load_setup(setup.path), logs[2], check=True)
    assert (third.different, third.notes) == (0, [])

    lines = (tmp_path / "log.events.jsonl").read_text(encoding="utf-8").splitlines()
    assert len(lines) == len(supervisor.events.newest)
    assert '"what": "mark", "text": "first part"' in lines[-1]


def test_orders_reach_the_loop(setup: Setup) -> None:
    """Hold, fade, enable; to resume makes the loop take over the ledger of a box that is well, without a jump."""
    orders = Script(
        (lambda _: None, lambda s: abs(s.applied_um["X"]) > 5.0),
        (lambda s: s.order(Order.HOLD), lambda s: s.kept_mode == s.mode == "hold" and Flag.ORDERED_HOLD in s.flags),
        (lambda s: s.order(Order.FADE), lambda s: s.kept_mode == s.mode == "off" and abs(s.applied_um["X"]) < 0.1),
        (lambda s: s.order(Order.ENABLE), lambda s: s.mode == "on" and abs(s.applied_um["X"]) > 5.0),
        (lambda s: s.order(Order.RESUME), lambda s: s.takeovers == 1),
    )
    report, _ = run(setup, None, orders)
    assert report.summary["takeovers"] == 1
    assert report.summary["driver_errors"] == 0


def test_a_full_disk_costs_the_log_and_nothing_else(setup: Setup, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every write fails from some row on, as on a full disk; then there is room again. The correction never notices."""
    import os

    from rtec.log import recording

    monkeypatch.setattr(recording, "RETRY_NS", 200_000_000)
    real_write, full = os.write, [False]

    def write(fd: int, data: Any) -> int:
        if full[0]:
            with open("/dev/full", "wb", buffering=0) as no_room:  # noqa: PTH123
                return no_room.write(data)
        return real_write(fd, data)

    monkeypatch.setattr(os, "write", write)

    def fill(_: Supervisor) -> None:
        full[0] = True

    def clear(_: Supervisor) -> None:
        full[0] = False

    room = Script(
        (lambda _: None, lambda s: s.cycles > 600),
        (fill, lambda s: "No space left" in s.log),
        (lambda _: None, lambda s: abs(s.applied_um["X"]) > 5.0 and bool(s.log)),
        (clear, lambda s: s.log == ""),
        (lambda _: None, lambda s: s.log == ""),
    )
    report, _ = run(setup, setup.base / "log.arrows", room)
    assert report.summary["driver_errors"] == 0
    assert report.warnings[0].startswith("logging stopped, the correction went on: ")
    assert sum("logging goes on in" in warning for warning in report.warnings) == 1
    assert sum("events wait until they can be written" in warning for warning in report.warnings) == 1
    events = [json.loads(line)["text"] for line in (setup.base / "log.events.jsonl").read_text().splitlines()]
    assert [w for w in report.warnings if w in events] == report.warnings  # each, the first ones written late
    first, second = setup.base / "log.arrows", setup.base / "log-2.arrows"
    assert not (setup.base / "log-3.arrows").exists()
    for log in (first, second):
        assert replay_log(setup, log, check=True).different == 0
    with LogReader(first) as a, LogReader(second) as b:
        assert 0 < a.rows + b.rows <= report.summary["cycles"]
        assert a.rows + b.rows + report.overruns <= report.summary["cycles"]
        assert int(b.header["first_row"]) >= a.rows


def test_the_model_of_each_log_is_kept_beside_it(setup: Setup, tmp_path: Path) -> None:
    """After a reload each file replays to the bit with the copy that its note names; the run file has another model."""
    path = new_log_path(setup)
    assert path is not None
    script = Script(
        (lambda _: None, lambda s: abs(s.applied_um["X"]) > 10.0),
        (other_model(setup), lambda s: s.reloads == 1 and "model" in s.reload),
        (lambda _: None, lambda s: s.cycles > 100),
    )
    report, _ = run(setup, path, script)
    assert report.warnings == []
    first, second = log_files(path.parent)
    now = load_setup(setup.path)
    assert replay_log(now, second, check=True).different == 0
    notes = replay_log(now, first).notes
    copies = sorted((path.parent / "models").iterdir())
    assert len(copies) == 2
    copy = next(c for c in copies if f"[run] model = {str(c)!r} is" in notes[0])
    content = setups.tables(tmp_path)
    content["run"]["model"] = str(copy)
    setup.path.write_text(tomli_w.dumps(content), encoding="utf-8")
    own = replay_log(load_setup(setup.path), first, check=True)
    assert (own.different, own.unchecked) == (0, 0)
    assert not [note for note in own.notes if "model" in note]
