"""`rtec doctor CONFIG` and drivers that misbehave. Oracle: what the fake driver does, said in each test."""

import threading
from pathlib import Path
from typing import Any

import pytest

from rtec.arrays import Ints
from rtec.daemon.dry_run import dry_run
from rtec.loop.clock import RealClock, VirtualClock
from rtec.loop.run_file import load_setup
from rtec_drivers.sim import SimDriver
from tests.support.doctor_rig import ALL_SIM, Fake, run_file, seen, sim, texts, with_fake

pytestmark = pytest.mark.xdist_group("real-clock")
FAKE_ROLES = {"counts": "fake", "actuator": "fake"}


def test_a_driver_that_hangs_holds_up_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Oracle: the other device's values; the event that the driver waits for is not set before the end."""
    free = threading.Event()
    with_fake(monkeypatch, opens=free)
    path = run_file(tmp_path, {**ALL_SIM, "temperatures": ["box"]}, {"box": sim(tmp_path), "stuck": {"driver": "fake"}})
    monkeypatch.setattr("rtec.doctor.devices.CLOSE_S", 0.2)
    found, by_name = seen(path, 0.5, open_s=1.5)
    free.set()
    assert texts(by_name["stuck"]) == ["hangs while it is opened: no end within 1.5 s"]
    assert texts(by_name["box"]) == []
    assert [v.name for v in by_name["box"].values][:2] == ["axis X", "axis Z"]
    assert not found.well


def test_a_driver_that_breaks_holds_up_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_: Fake) -> Fake:
        raise ZeroDivisionError("by its author")

    with_fake(monkeypatch, __enter__=broken)
    path = run_file(tmp_path, ALL_SIM, {"box": sim(tmp_path), "bad": {"driver": "fake"}})
    _, by_name = seen(path, 0.5)
    assert texts(by_name["bad"]) == ["its driver fails: ZeroDivisionError: by its author"]
    assert texts(by_name["box"]) == []


def test_an_actuator_is_never_told_anything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Oracle: the driver's own list of what it was asked; its output is read and shown."""
    kind = with_fake(monkeypatch)
    _, by_name = seen(run_file(tmp_path, FAKE_ROLES, {"fake": {"driver": "fake"}}), 0.2)
    assert kind.asked == ["closed"]
    values = {v.name: (v.value, v.unit) for v in by_name["fake"].values if v.name.startswith("applied")}
    assert values == {"applied X": (12.0, "counts"), "applied Z": (-7.0, "counts")}


def test_an_output_beyond_the_stop_limit_is_said_before_a_run_waits_for_an_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By hand: 240 counts are 120 µm of X, stop_um is 100; 200 counts are 100."""

    def has(_: SimDriver, output: Ints) -> None:
        output[:] = [-240, 200]

    monkeypatch.setattr(SimDriver, "read_output", has)
    path = run_file(tmp_path, ALL_SIM, {"box": sim(tmp_path)})
    _, by_name = seen(path, 0.2)
    assert "it has +120.00 µm of axis X, and stop_um is 100: the loop would wait for an order" in texts(by_name["box"])
    (reason,) = [r for r in dry_run(load_setup(path))["reasons"] if "actuator" in r]
    assert reason.startswith("the actuator has X +120.00 µm, Z -100.00 µm, and stop_um of X is 100")


@pytest.mark.parametrize(
    ("does", "rate_hz", "said", "enough"),
    [
        ({"late_s": 0.0045}, 200.0, "counts older than 5 ms hold the correction, and a cycle takes 5 ms: the device ",
         "0.025, 5 cycles"),
        ({"late_s": 0.0045}, 401.0, "", ""),  # two cycles and a little
        ({"late_s": 0.0}, 200.0, "", ""),  # latched when it is read: no older in any cycle
        ({"late_s": 0.0045, "later": (30, 0.006)}, 1000.0, "3.3 % of the counts are older than 5 ms when read; ",
         "0.009: the oldest were 6 ms old"),
        ({"late_s": 0.0045, "later": (150, 0.006)}, 1000.0, "", ""),  # rtec doctor may have been late itself
    ],
)  # fmt: skip
def test_counts_that_the_guard_finds_too_old_now_and_then(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, does: dict[str, Any], rate_hz: float, said: str, enough: str
) -> None:
    """Oracle: the ages that the fake device gives, against counts_max_age_s = 0.005 and the cycle.

    What is proposed is longer than the oldest.
    """
    with_fake(monkeypatch, **does)
    path = run_file(tmp_path, FAKE_ROLES, {"fake": {"driver": "fake"}}, rate_hz)
    _, by_name = seen(path, 0.3, clock=OneThread())
    found = [fault for fault in by_name["fake"].wrong if "older than" in fault.what]
    assert bool(found) == bool(said)
    if found:
        assert found[0].what.startswith(said)
        assert f"[guard] counts_max_age_s = {enough}" in found[0].mend


@pytest.mark.parametrize(
    ("does", "said"),
    [
        ({"takes_s": 0.004}, "reading counts takes 4.00 ms, at most 4.00 ms, of a cycle of 1 ms"),
        ({"late_s": 0.02}, "counts are 20.0 ms old when they are read; the correction would hold"),
        ({"late_s": -10.0}, "counts are from the future, 10 s ahead: the correction would hold"),
        ({"first": 500_000}, "axis X is at 250.150 mm; its travel_mm is 0 to 200"),
        ({"every": 1}, "fake: no answer"),
        ({"every": 4}, "counts: 75 of 300 readings failed, the last: fake: no answer"),
    ],
)
def test_counts_that_the_loop_could_not_use(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, does: dict[str, Any], said: str
) -> None:
    """Oracle: what the fake device does, on a clock on which nothing else takes time."""
    with_fake(monkeypatch, **does)
    path = run_file(tmp_path, FAKE_ROLES, {"fake": {"driver": "fake"}})
    _, by_name = seen(path, 0.3, clock=OneThread())
    assert said in texts(by_name["fake"])


def test_a_hiccup_is_told_and_not_wrong(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with_fake(monkeypatch, every=100)
    path = run_file(tmp_path, FAKE_ROLES, {"fake": {"driver": "fake"}})
    _, by_name = seen(path, 0.3, clock=OneThread())
    assert texts(by_name["fake"]) == []
    assert "counts: 3 of 300 readings failed, the last: fake: no answer" in by_name["fake"].told


class OneThread(VirtualClock):
    """A virtual clock that only the look's thread moves; the doctor, waiting for it, waits in life."""

    def sleep_until_ns(self, instant_ns: int) -> None:
        if threading.current_thread() is threading.main_thread():
            RealClock().sleep_until_ns(RealClock().now_ns() + 1_000_000)
        else:
            super().sleep_until_ns(instant_ns)


def test_a_role_that_a_driver_cannot_play_and_an_output_that_it_does_not_take(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with_fake(monkeypatch)
    role = {**FAKE_ROLES, "spindle": "fake"}
    output = {"X": {"kind": "following_error", "resolution_um": 1.0}}
    _, by_name = seen(run_file(tmp_path, role, {"fake": {"driver": "fake"}}, output=output), 0.1)
    first, second = by_name["fake"].wrong
    assert first.what == "[role] spindle names it, but driver 'fake' cannot do this"
    assert first.mend == ("it can be: counts, temperatures, actuator",)
    assert second.what == "[output.X] takes pulses"


def test_temperatures_outside_the_machines_range_and_a_sensor_that_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Oracle: 99 °C, which is outside the first sensor's range in the machine file; the fake device's own fault."""
    with_fake(monkeypatch, fails=1, read_temperatures=_hot)
    role = {**FAKE_ROLES, "temperatures": ["fake"]}
    _, by_name = seen(run_file(tmp_path, role, {"fake": {"driver": "fake"}}), 0.2)
    assert [
        t for t in texts(by_name["fake"]) if t.startswith("T_spindle_front: 99.0 °C; the machine file's range_degc")
    ]


def _hot(self: Fake, degc: Any, time_ns: Any) -> None:
    degc[0], time_ns[0] = 99.0, self.clock.now_ns()
