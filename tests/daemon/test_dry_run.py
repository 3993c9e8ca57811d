"""A dry run with devices that are polled, or silent. Oracle: registers of the slaves, and when they answer."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rtec.cli.main import status
from rtec.daemon.dry_run import dry_run, unlimited
from rtec.errors import DriverTimeout
from rtec.loop.clock import VirtualClock
from rtec.loop.run_file import load_setup
from rtec_drivers.sim import SimDriver
from tests.support import setups
from tests.support.doctor_rig import run_file, sim
from tests.support.modbus_peer import FakeSlave, line, serial, slave_table

pytestmark = pytest.mark.xdist_group("real-clock")
ROLE = {"counts": "box", "actuator": "box", "temperatures": ["polled"]}


def dry(folder: Path, slaves: dict[int, FakeSlave], capsys: pytest.CaptureFixture[str]) -> tuple[int, dict[str, Any]]:
    with line(slaves) as bus:
        sensors = {"a": slave_table(1, "T_spindle_front", timeout_s=2.0), "b": slave_table(2, "T_bed", timeout_s=0.2)}
        polled = {"driver": "modbus", "serial": serial(bus.port), "slave": sensors}
        path = run_file(folder, ROLE, {"box": sim(folder), "polled": polled})
        code = status(["run", str(path), "--dry-run", "--json"])
    return code, json.loads(capsys.readouterr().out)


def test_first_readings_are_waited_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The first slave needs 0.4 s for its first answer: 25.0 and 21.5 degrees all the same, and it is ready."""
    setups.setup(tmp_path)
    slaves = {1: FakeSlave(value=lambda _: 250, delay_s=0.4), 2: FakeSlave(value=lambda _: 215)}
    code, found = dry(tmp_path, slaves, capsys)
    values = {name: value for name, value, _ in found["inputs"]}
    assert (values["T_spindle_front"], values["T_bed"]) == ("25.00 °C", "21.50 °C")
    assert (code, found["reasons"], found["troubles"]) == (0, [], [])


def test_one_that_stays_silent_is_named_and_ends_with_status_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    setups.setup(tmp_path)
    code, found = dry(tmp_path, {1: FakeSlave(value=lambda _: 250), 2: FakeSlave(silent=True)}, capsys)
    assert code == 1
    assert found["reasons"] == ["a temperature (or the spindle speed) is stale or was never read"]
    assert len(found["troubles"]) == 1
    assert "device polled: " in found["troubles"][0]
    assert "T_bed" in found["troubles"][0]
    assert (found["unread"], found["requested_um"]) == (["T_bed"], {})


def test_without_the_temperatures_no_correction_is_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the model's own channels. It had been +0.00 µm for each axis."""
    setups.setup(tmp_path)
    path = run_file(tmp_path, {"counts": "box", "actuator": "box", "temperatures": []}, {"box": sim(tmp_path)})
    assert status(["run", str(path), "--dry-run"]) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert "the model would ask for" not in said
    assert "cannot be computed: the model reads T_spindle_front and T_bed, never read here" in said


@pytest.mark.parametrize("key", ["log_folder", "state_folder"])
@pytest.mark.parametrize(("place", "why"), [("file", "it is no folder"), ("file/logs", "{}/file is no folder")])
def test_a_folder_that_the_run_cannot_use_is_said_and_it_is_not_ready(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], key: str, place: str, why: str
) -> None:
    """Oracle: a run of the same file, which is refused; and the folder, in which a dry run makes nothing."""
    content = setups.tables(tmp_path)
    content["run"][key] = place
    path = setups.write(tmp_path, content)
    (tmp_path / "file").touch()
    before = sorted(tmp_path.iterdir())
    text = f"[run] {key} {tmp_path / place}: {why.format(tmp_path)}"
    assert status(["run", str(path), "--dry-run", "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["troubles"] == [text]
    assert sorted(tmp_path.iterdir()) == before
    if key == "log_folder":
        assert status(["run", str(path), "--duration", "0.1"]) == 2
        assert f"rtec: {text}" in capsys.readouterr().err


def test_a_folder_that_is_not_there_yet_is_ready(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content = setups.tables(tmp_path)
    content["run"]["log_folder"] = "not/yet"
    assert status(["run", str(setups.write(tmp_path, content)), "--dry-run", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["troubles"] == []
    assert not (tmp_path / "not").exists()


class BusyClock(VirtualClock):
    """The computer does something else for 0.1 s before each of the first looks at the clock."""

    looks = 20

    def now_ns(self) -> int:
        if self.looks:
            self.looks -= 1
            self.sleep_until_ns(super().now_ns() + 100_000_000)
        return super().now_ns()


def test_a_busy_computer_is_no_stale_device(tmp_path: Path) -> None:
    """Counts are stale after 5 ms; here 0.1 s goes by between a reading and the look at it, and later does not."""
    clock = BusyClock()
    found = dry_run(setups.setup(tmp_path), clock)
    assert (clock.looks, found["reasons"], found["troubles"]) == (0, [], [])
    clock.looks = 10**6
    assert dry_run(setups.setup(tmp_path), clock)["reasons"] == ["counts are stale"]


def test_counts_that_were_fresh_once_are_not_blamed_for_a_silent_sensor(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The temperatures never come; the computer is busy from the third look on, until the time is over."""

    def silent(*_: object) -> None:
        raise DriverTimeout("no answer")

    class Later(BusyClock):
        looks = 0

        def sleep_until_ns(self, instant_ns: int) -> None:
            super().sleep_until_ns(instant_ns)
            self.slept = getattr(self, "slept", 0) + 1
            if self.slept == 3:
                self.looks = 10**6

    monkeypatch.setattr(SimDriver, "read_temperatures", silent)
    found = dry_run(setups.setup(tmp_path), Later())
    assert found["reasons"] == ["a temperature (or the spindle speed) is stale or was never read"]
    assert found["troubles"] == ["device box: no answer"]


def test_without_any_counts_no_position_is_made_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a box that never answers, beside sensors that do. Oracle: its own error."""

    def silent(*_: object) -> None:
        raise DriverTimeout("no answer within 1 ms")

    monkeypatch.setattr(SimDriver, "read_counts", silent)
    found = dry_run(setups.setup(tmp_path), VirtualClock(1))
    assert found["troubles"] == ["device box: no answer within 1 ms"]
    assert found["requested_um"] == {}
    axes = [row for row in found["inputs"] if row[0].startswith("axis")]
    assert [row[1:] for row in axes] == [("no reading", "-")] * len(axes)
    assert all("°C" in value for name, value, _ in found["inputs"] if name.startswith("T_"))


def test_the_first_counts_of_a_device_are_no_motion(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A readout sends its first line after 60 ms. Oracle: the same machine, at rest, of which the first read has the
    counts; a motion from 0 would add half of the play of 4 µm."""
    read, at_rest = SimDriver.read_counts, setups.tables(tmp_path)
    del at_rest["device"]["box"]["program"]

    def found(fails: int) -> dict[str, Any]:
        tries: list[int] = []

        def late(self: SimDriver, counts: Any) -> int:
            tries.append(1)
            if len(tries) <= fails:
                raise DriverTimeout("no line yet")
            at_ns = read(self, counts)
            counts[:] += 60_000
            return at_ns

        monkeypatch.setattr(SimDriver, "read_counts", late)
        out = dry_run(load_setup(setups.write(tmp_path, at_rest)), VirtualClock(1))
        assert len(tries) > fails
        return out

    wanted, later = found(0), found(4)
    assert wanted["inputs"][0][:2] == later["inputs"][0][:2]
    assert later["requested_um"]["X"] == pytest.approx(wanted["requested_um"]["X"], abs=0.1)


def test_a_model_without_ranges_is_said(tmp_path: Path) -> None:
    """Oracle: the model's channels, and the ranges that it is given."""
    made = setups.setup(tmp_path)
    reads = [c for c in made.model.channels if c in {"x", "z", *made.machine.sensor_names}]
    assert reads
    bare = replace(made, model=replace(made.model, valid_range={}))
    (note,) = unlimited(bare)
    assert all(name in note for name in reads)
    assert unlimited(replace(made, model=replace(made.model, valid_range=dict.fromkeys(reads, (0.0, 40.0))))) == []
