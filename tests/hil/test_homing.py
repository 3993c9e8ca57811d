"""`rtec ctl home` with an encoder box on a pseudo terminal: real processes, real clock, three runs.

Oracles: places of the box's encoders, moved by hand; the logs, each replayed bit by bit; the events.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from rtec.loop.clock import RealClock
from rtec.loop.run_file import load_setup
from rtec.playback.replay import replay_log
from rtec_drivers.box.simulator import BoxSimulator
from rtec_drivers.pty_peer import PtyPeer
from tests.hil.test_ctl import Running, events, status
from tests.support import setups
from tests.support.box_peer import StillPlant
from tests.support.command import here
from tests.support.modbus_peer import until

pytestmark = [pytest.mark.xdist_group("real-clock"), pytest.mark.usefixtures("runtime_folder")]


class Bench:
    """A machine whose encoders hang on a box that got its supply at X 12 mm, Z 300 mm."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.plant = folder, StillPlant(2)
        self.box = BoxSimulator(self.plant, 2)
        self.port = folder / "box"
        content = setups.tables(folder)
        content["run"]["zero"] = "ordered"
        content["role"] |= {"counts": "encoders", "actuator": "encoders"}
        content["device"]["encoders"] = {
            "driver": "serial_box",
            "port": str(self.port),
            "max_speed_mm_s": {"X": 400.0, "Z": 400.0},
            "timeout_ms": 20.0,
        }
        content["run"]["rate_hz"] = 100.0
        self.config = setups.write(folder, content)
        self.axes = load_setup(self.config).machine.axes

    def move(self, **mm: float) -> None:
        """Move axes by that much."""
        for k, axis in enumerate(self.axes):
            self.plant.position[k] += round(mm.get(axis.name, 0.0) * axis.counts_per_mm)


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    bench = Bench(tmp_path)
    with PtyPeer(bench.box, RealClock(), bench.port):
        yield bench


@contextmanager
def running(bench: Bench, name: str) -> Iterator[Running]:
    one = Running(bench.config, bench.folder / f"{name}.arrows")
    try:
        one.until_it_runs()
        yield one
    finally:
        one.process.kill()
        one.process.communicate()


def report(one: Running) -> dict[str, Any]:
    found: dict[str, Any] = status(one)
    return found


def held(one: Running) -> str:
    """Why the correction holds, as `rtec status` has it."""
    return " ".join(report(one)["status"]["devices"].get("encoders", []))


def test_over_three_runs(bench: Bench) -> None:
    """Nobody ordered: it holds. Homed: it corrects. The next run goes on. With another start of the box: it holds."""
    bench.move(X=5.0)
    with running(bench, "first") as one:
        assert until(lambda: "nobody has ordered them" in held(one))
        for arguments, why in (
            (("X=0",), "name all axes; missing: Z"),
            (("X=0", "Z=90000"), "outside its travel"),
            (("X=0", "Y=0"), "the machine has no axis 'Y'"),
        ):
            refused = here("ctl", "home", *arguments, bench.config)
            assert refused.returncode == 2
            assert why in refused.stderr
        done = here("ctl", "home", "X=17", "Z=300", bench.config)
        assert (done.returncode, done.stdout) == (0, "homed: X 17.0000 mm, Z 300.0000 mm\n")
        assert until(lambda: not held(one))
        bench.move(X=-2.0, Z=1.5)
        assert until(lambda: report(one)["status"]["position_mm"] == {"X": 15.0, "Z": 301.5})
        assert until(lambda: abs(report(one)["status"]["applied_um"]["X"]) > 0.2)
        corrected = here("ctl", "home", "X=15.01", bench.config)
        assert corrected.stdout == "homed: X 15.0100 mm (was 15.0000)\n"
        one.end()
        said = [(e["what"], e["text"]) for e in events(one)]
        assert ("home", "X=17 Z=300") in said
        assert ("homed", "homed: X 17.0000 mm, Z 300.0000 mm") in said
    for log in sorted(bench.folder.glob("first*.arrows")):
        assert replay_log(load_setup(bench.config), log, check=True).different == 0
    assert len(list(bench.folder.glob("first*.arrows"))) == 3

    bench.move(X=1.0)
    with running(bench, "second") as one:
        assert until(lambda: report(one)["status"]["position_mm"] == {"X": 16.01, "Z": 301.5})
        assert until(lambda: not held(one))
        one.end()

    bench.box.reset()
    with running(bench, "third") as one:
        assert until(lambda: "this device was without supply (start 2, before 1)" in held(one))
        assert here("ctl", "resume", bench.config).returncode == 1
        assert here("ctl", "home", "X=16.01", "Z=301.5", bench.config).returncode == 0
        assert until(lambda: not held(one))
        one.end()


def test_an_axis_that_moves_is_not_homed(bench: Bench) -> None:
    """A position is of one instant. Oracle: 0.1 mm of motion at each look, ten times the limit."""
    counts = bench.plant.counts

    def moving(now_ns: int) -> list[int]:
        bench.move(X=0.1)
        return counts(now_ns)

    bench.plant.counts = moving  # type: ignore[method-assign]
    with running(bench, "run") as one:
        done = here("ctl", "home", "X=0", "Z=300", bench.config, "--json")
        assert done.returncode == 1
        assert json.loads(done.stdout)["text"].startswith("not homed: X moved by up to 0.")
        one.end()
