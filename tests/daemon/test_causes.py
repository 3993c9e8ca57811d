"""What a flag is about. Oracles: the flags that the real step gives for a row; names and limits of the run file."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rtec.control.desk import Desk
from rtec.control.facts import axis_rows, headline, input_rows, um_text
from rtec.control.prometheus import metrics
from rtec.correction.flags import MODE_ON, REASONS, Flag
from rtec.daemon.causes import causes
from rtec.daemon.ring import Ring
from rtec.daemon.status import RowWatch, Status
from rtec.loop.clock import VirtualClock
from rtec.loop.records import NEVER_NS, Commands, Samples
from rtec.loop.run_file import Setup
from rtec.loop.step import Step
from tests.support import plain_step, setups
from tests.support.control_rig import FakeDaemon

NOW_NS = 10**12
FRESH_NS = NOW_NS - 1_000_000


@pytest.fixture
def setup(tmp_path: Path) -> Setup:
    return setups.setup(tmp_path)


@pytest.fixture(autouse=True)
def _plain(monkeypatch: pytest.MonkeyPatch) -> None:
    plain_step.use(monkeypatch)


class Row:
    """A row of good inputs; a test spoils what it is about."""

    def __init__(self, setup: Setup) -> None:
        self.setup, self.step = setup, Step(setup.step_settings())
        self.sample = Samples.empty(self.step.layout, 1)
        self.sample.counts[0] = [round(100.0 * a.counts_per_mm) for a in setup.machine.axes]
        self.sample.degc[:], self.sample.spindle_rpm[:] = 22.0, 0.0
        self.sample.time_ns[:], self.sample.mode[:] = NOW_NS, MODE_ON
        self.sample.counts_time_ns[:] = self.sample.degc_time_ns[:] = FRESH_NS

    def sensor(self, name: str) -> int:
        return self.setup.machine.sensor_names.index(name)

    def status(self) -> Status:
        """Status of the row as the daemon makes it."""
        layout = self.step.layout
        with Ring.create(layout, 8) as ring:
            watch = RowWatch(layout)
            watch.look(self.sample, self.step.run(self.sample), ring)
            return replace(watch.status, causes=causes(self.setup, watch.status))


def test_a_good_row_has_none(setup: Setup) -> None:
    assert Row(setup).status().causes == {}


def test_stale_counts_name_their_device(setup: Setup) -> None:
    row = Row(setup)
    row.sample.counts_time_ns[:] = NOW_NS - 14_200_000_000
    text = "those of device box are 14.2 s old, and 0.005 s are allowed"
    assert row.status().causes == {"STALE_COUNTS": text}
    assert row.status().reasons == [f"{REASONS[Flag.STALE_COUNTS]}: {text}"]
    row.sample.counts_time_ns[:] = NEVER_NS
    row.sample.counts[:] = 0
    status = row.status()
    assert status.causes["STALE_COUNTS"] == "device box has sent none yet"
    assert "axis" not in str(status.causes)  # nothing is known of its position


def test_what_was_never_read_is_not_known(setup: Setup) -> None:
    """Neither counts nor a temperature. Oracle: docs/control.md: what is not known is null; NaN before it is sent."""
    row = Row(setup)
    row.sample.counts_time_ns[:] = NEVER_NS
    row.sample.degc[:], row.sample.degc_time_ns[:] = np.nan, 0
    status = row.status()
    assert set(status.counts.values()) == {None}
    assert np.isnan([status.counts_age_s, *status.requested_um.values(), *status.degc_age_s.values()]).all()
    assert {um_text(um) for um in status.requested_um.values()} == {"not known"}
    daemon = FakeDaemon(setup)
    daemon.status = status
    report = Desk(daemon, VirtualClock(NOW_NS), {}).status()
    facts = report["status"]
    assert facts["counts_age_s"] is None
    for key in ("counts", "position_mm", "requested_um", "degc", "degc_age_s"):
        assert set(facts[key].values()) == {None}, key
    assert not [line for line in metrics(report).splitlines() if "rtec_counts_age" in line or "temperature_age" in line]
    assert [row[1:3] for row in axis_rows(report)] == [["not known", "not known"]] * len(setup.machine.axes)
    assert input_rows(report)[0] == ["counts", "not read", ""]


def test_ages_are_those_of_now_where_the_loop_stands(setup: Setup) -> None:
    """The row is 3 s and 70 s old; its counts were 0.44 ms old in it, and its temperature 1 s. Oracle: the sums."""
    row = Row(setup)
    row.sample.counts_time_ns[:] = NOW_NS - 440_000
    row.sample.degc_time_ns[:] = NOW_NS - 1_000_000_000
    daemon = FakeDaemon(setup)
    daemon.status = row.status()
    for stands_s, ages in ((0.5, {"0.44 ms", "1.0 s"}), (3.0, {"3.0 s", "4.0 s"}), (70.0, {"70.0 s", "71.0 s"})):
        report = Desk(daemon, VirtualClock(NOW_NS + round(stands_s * 1e9)), {}).status()
        assert {age for *_, age in input_rows(report) if age} == ages


def test_a_correction_beyond_a_lowered_limit_goes_back(setup: Setup) -> None:
    """Held or not: `rtec.correction.guard` takes it to the limit. Oracle: stop_um of X, 100 µm."""
    daemon = FakeDaemon(setup)
    for um, mode, says in (
        (100.0, "hold", "mode hold: the correction stays where it is"),
        (100.5, "hold", "mode hold: the correction goes back to stop_um of X at its slew limit, and stays there"),
        (-100.5, "on", "mode on is ordered, but the correction goes back to stop_um of X at its slew limit, and stays"),
        (-99.0, "on", "mode on is ordered, but the correction stays where it is: see why"),
    ):
        flags = Flag.HELD | Flag.OVER_STOP_LIMIT
        daemon.status = replace(daemon.status, mode=mode, flags=flags, applied_um={"X": um, "Z": 3.0})
        report = Desk(daemon, VirtualClock(NOW_NS), {"machine": "m", "config": "c"}).status()
        assert report["beyond_stop"] == ({"X": 100.0} if "back" in says else {})
        assert headline(report)[1].startswith(says)


def test_a_temperature_that_is_stale_or_missing_names_its_sensor(setup: Setup) -> None:
    """A sensor that the model does not read holds nothing, and is not named."""
    row = Row(setup)
    row.sample.degc_time_ns[0, row.sensor("T_bed")] = NOW_NS - 41_000_000_000
    unread = next(s for s in setup.machine.sensor_names if s not in setup.model.channels)
    row.sample.degc_time_ns[0, row.sensor(unread)] = 0
    stale = "sensor T_bed of device box was read 41 s ago, and 30 s are allowed"
    assert row.status().causes == {"STALE_TEMPERATURE": stale}
    row = Row(setup)
    row.sample.degc[0, row.sensor("T_spindle_front")] = np.nan
    missing = "sensor T_spindle_front of device box has no reading"
    assert row.status().causes == {"STALE_TEMPERATURE": missing}


def test_an_impossible_temperature_names_its_sensor_and_range(setup: Setup) -> None:
    row = Row(setup)
    low, high = next(s.range_degc for s in setup.machine.sensors if s.name == "T_bed")
    row.sample.degc[0, row.sensor("T_bed")] = 1372.0
    text = f"sensor T_bed of device box reads 1372.00 °C, and its range is {low:g} to {high:g} °C"
    assert row.status().causes == {"SENSOR_FAULT": text}


def test_the_device_of_several_is_the_one_whose_options_name_the_sensor(setup: Setup) -> None:
    role = setup.file.role.model_copy(update={"temperatures": ("rail", "box")})
    device = {**setup.file.device, "rail": {"driver": "x", "sensor": [{"name": "T_bed"}]}}
    both = replace(setup, file=setup.file.model_copy(update={"role": role, "device": device}))
    row = Row(both)
    row.sample.degc[0, [row.sensor("T_bed"), row.sensor("T_spindle_front")]] = np.nan
    expected = {"sensor T_bed of device rail has no reading", "sensor T_spindle_front has no reading"}
    assert set(row.status().causes["STALE_TEMPERATURE"].split("; ")) == expected


def test_out_of_range_names_what_is_outside(setup: Setup) -> None:
    x = setup.machine.axis("X")
    ranges = {x.channel: (120.0, 200.0), "T_bed": (18.0, 21.5)}
    row = Row(replace(setup, model=replace(setup.model, valid_range=ranges)))
    axis, sensor = "axis X is at 100 mm, and the model knows 120 to 200", "sensor T_bed of device box is at 22 °C"
    assert row.status().causes == {"OUT_OF_RANGE": f"{axis}; {sensor}, and the model knows 18 to 21.5"}


def test_a_request_over_a_limit_names_the_axis_and_its_size(setup: Setup) -> None:
    limits = {name: x.model_copy(update={"warning_um": 1e-4, "stop_um": 1e-3}) for name, x in setup.file.limits.items()}
    row = Row(replace(setup, file=setup.file.model_copy(update={"limits": {**setup.file.limits, "X": limits["X"]}})))
    status = row.status()
    um = status.requested_um["X"]
    assert status.causes == {
        "OVER_STOP_LIMIT": f"{um:+.2f} µm for axis X, and stop_um is 0.001",
        "OVER_WARNING_LIMIT": f"{um:+.2f} µm for axis X, and warning_um is 0.0001",
    }


def test_an_output_that_gives_no_more_stays_so_until_its_next_value(setup: Setup) -> None:
    """A register that takes a value a second: only one row of a thousand has a new one. Oracle: that second."""
    layout = Step(setup.step_settings()).layout
    with Ring.create(layout, 8) as ring:
        watch = RowWatch(layout, period_ns=1_000_000_000)
        seen = []
        for k, flag in enumerate([0, int(Flag.OUTPUT_SATURATED), 0, 0, 0]):
            sample, command = Samples.empty(layout, 1), Commands.empty(layout, 1)
            sample.time_ns[0], command.flags[0] = NOW_NS + 400_000_000 * k, flag
            watch.look(sample, command, ring)
            seen.append(Flag.OUTPUT_SATURATED in watch.status.flags)
    assert seen == [False, True, True, True, False]
