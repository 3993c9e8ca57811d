"""What the status says is left, from the JSON of `rtec compare`, and how it is shown.

Oracles: root mean squares worked out here from plain numbers; a backlash B, which leaves B/2 at every reading.
"""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rtec.control.client import carry_out
from rtec.control.desk import Desk
from rtec.control.facts import axis_rows, footer, headline, held, troubles, um_text, well
from rtec.control.residual import LARGEST_BYTES, Residual
from rtec.diagnosis.compare.compare import compare
from rtec.loop.clock import VirtualClock
from rtec.loop.orders import Order
from rtec.model import Model
from rtec.wording import POSITIONS_NOT_KNOWN
from tests.support import setups
from tests.support.control_rig import FakeDaemon
from tests.support.diagnosis_examples import effects, laser, small_machine


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> FakeDaemon:
    return FakeDaemon(setups.setup(tmp_path_factory.mktemp("run")))


@pytest.fixture(scope="module")
def model(daemon: FakeDaemon) -> Model:
    return daemon.setup.model


def item(name: str, n: int, rms: float, *components: str, **more: Any) -> dict[str, Any]:
    found = {"name": name, "column": "reading_um", "unit": "um", "n": n, "components": list(components)}
    return {**found, "rms_residual_um": rms, "noise_floor_um": 0.5, "worst": [], **more}


def written(folder: Path, model: Model, *items: dict[str, Any]) -> Residual:
    path = folder / "compared.json"
    path.write_text(json.dumps({"model": model.name, "measurements": items, "seed": 1}), encoding="utf-8")
    return Residual(path)


def test_readings_along_an_axis_are_taken_together(tmp_path: Path, model: Model) -> None:
    """By their number; a laser off the axis counts, angles and readings across do not."""
    residual = written(
        tmp_path,
        model,
        item("laser-x", 300, 2.0, "EXX", "EBX"),
        item("probe", 100, 4.0, "EXC", column="reading_x_um"),
        item("ball-bar", 900, 50.0, "EXX", "EZZ"),
        item("level", 900, 60.0, "EBX", unit="urad"),
        item("autocollimator", 900, 65.0, "EXX", "EBX", unit="urad"),
        item("straightness", 900, 70.0, "EYX"),
        item("laser-z", 10, 3.0, "EZZ"),
    )
    axes = residual.facts(model)["axes"]
    assert axes["X"]["rms_um"] == pytest.approx(math.sqrt((300 * 4 + 100 * 16) / 400))
    assert axes["X"]["from"] == ["laser-x", "probe"]
    assert axes["Z"] == {"rms_um": 3.0, "noise_um": 0.5, "from": ["laser-z"]}
    assert set(axes) == {"X", "Z"}


def test_what_rtec_compare_gives_is_understood(tmp_path: Path) -> None:
    """The model knows the scale and not the backlash of 3 µm: 1.5 µm are left of X."""
    scale, backlash = "scale,component=EXX,axis=X,k=40", "backlash,component=EXX,axis=X,B=3"
    model = Model(small_machine(), effects(scale), name="first")
    compared = compare(model, [laser([scale, backlash], 3, noise={"white_um": 0.01})])
    path = tmp_path / "compared.json"
    path.write_text(json.dumps(compared.facts()), encoding="utf-8")
    found = Residual(path).facts(model)
    assert found["trouble"] == ""
    assert found["axes"]["X"]["rms_um"] == pytest.approx(1.5, rel=0.01)


def test_a_new_comparison_is_read_without_a_new_start(tmp_path: Path, model: Model) -> None:
    residual = written(tmp_path, model, item("laser-x", 300, 2.0, "EXX"))
    assert residual.facts(model)["axes"]["X"]["rms_um"] == 2.0
    written(tmp_path, model, item("laser-x", 300, 1.25, "EXX"))
    assert residual.facts(model)["axes"]["X"]["rms_um"] == 1.25
    (tmp_path / "compared.json").unlink()
    assert residual.facts(model)["axes"] == {}


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (None, "no such file yet; `rtec compare MODEL MEASUREMENT --json`"),
        (b"[" * 100_000, "is not what `rtec compare --json` prints"),
        (b'{"model": "m"}', "is not what `rtec compare --json` prints"),
        (b"\xff", "is not what `rtec compare --json` prints"),
        (b" " * (LARGEST_BYTES + 1), "too large"),
        (json.dumps({"model": "other", "measurements": []}).encode(), "compares model 'other'"),
        (
            json.dumps({"model": "m", "measurements": [item("laser-x", 3, -1.0, "EXX")]}).encode(),
            "is not what `rtec compare --json` prints",
        ),
    ],
)
def test_a_file_that_is_no_good_is_told_and_changes_nothing_else(
    tmp_path: Path, model: Model, content: bytes | None, says: str
) -> None:
    path = tmp_path / "compared.json"
    if content is not None:
        path.write_bytes(content)
    found = Residual(path).facts(model)
    assert says in found["trouble"]
    assert found["axes"] == {}


def test_without_a_comparison_the_history_says_it(model: Model) -> None:
    """The newest entry that knows; a number that is none is no number."""
    history = ({"rms_held_out": 3.0}, {"rms_after": 1.5, "unit": "um"}, {"rms_after": "x"}, {"change": "renamed"})
    assert Residual(None).facts(replace(model, history=history))["model"]["rms"] == 1.5
    assert Residual(None).facts(replace(model, history=()))["model"]["rms"] is None


def test_it_stands_beside_requested_and_applied(tmp_path: Path, daemon: FakeDaemon, model: Model) -> None:
    """Three numbers for each axis; a comparison that cannot be read is no trouble of the machine."""
    residual = written(tmp_path, model, item("laser-x", 300, 2.0, "EXX"))
    found = Desk(daemon, VirtualClock(1), {}, residual).status()
    assert [[row[0], *row[2:5]] for row in axis_rows(found)] == [
        ["X", "+1.50", "+1.25", "2.00"],
        ["Z", "-2.50", "not known", "not known"],
    ]
    assert all(float(row[1]) == found["status"]["position_mm"][row[0]] for row in axis_rows(found))
    found["status"]["devices"] = {"box": (f"{POSITIONS_NOT_KNOWN}: nobody has ordered them",)}
    assert [row[1] for row in axis_rows(found)] == ["not known", "not known"]
    assert "residual of X: root mean square of laser-x; noise 0.50 µm" in footer(found)
    missing = Desk(daemon, VirtualClock(1), {}, Residual(tmp_path / "none.json")).status()
    assert well(missing)
    assert any("none.json: no such file yet" in line for line in footer(missing))


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"devices": {"sensors": ["silent"]}}, "device sensors: silent"),
        ({"log": "no room"}, "log: no room"),
    ],
)
def test_what_somebody_has_to_look_at(daemon: FakeDaemon, changed: dict[str, Any], says: str) -> None:
    """Each makes the exit status 1; so does a loop that stands."""
    fresh = Desk(daemon, VirtualClock(1_000_000_001), {}).status()
    assert troubles(fresh) == []
    assert troubles({**fresh, "status": {**fresh["status"], **changed}}) == [says]
    late = Desk(daemon, VirtualClock(1_100_000_001), {}).status()
    assert troubles(late) == ["the loop stands: its newest row is 1.1 s old"]


@pytest.mark.parametrize("flag", ["STALE_COUNTS", "STALE_TEMPERATURE", "SENSOR_FAULT"])
@pytest.mark.parametrize("mode", ["on", "hold", "off"])
def test_an_input_that_is_stale_or_faulty_makes_the_exit_status_1(daemon: FakeDaemon, flag: str, mode: str) -> None:
    """Oracle: the help of `rtec status`. The device need not report a fault of its own, and nothing need be ordered."""
    fresh = Desk(daemon, VirtualClock(1_000_000_001), {}).status()
    assert well({**fresh, "status": {**fresh["status"], "mode": mode}})
    assert not well({**fresh, "status": {**fresh["status"], "mode": mode, "flags": [flag, "HELD"]}})


def test_a_hold_that_nobody_ordered_makes_the_exit_status_1(daemon: FakeDaemon) -> None:
    """Oracle: as above; a hold that was ordered does not."""
    fresh = Desk(daemon, VirtualClock(1_000_000_001), {}).status()
    for mode, flags, good in (("on", ["OUT_OF_RANGE", "HELD"], False), ("hold", ["ORDERED_HOLD", "HELD"], True)):
        assert well({**fresh, "status": {**fresh["status"], "mode": mode, "flags": flags}}) == good


def test_rows_that_were_lost_stay_in_sight_and_are_no_alarm_for_ever(daemon: FakeDaemon) -> None:
    fresh = Desk(daemon, VirtualClock(1_000_000_001), {}).status()
    lost = {**fresh, "status": {**fresh["status"], "overruns": 3}}
    assert well(lost)
    assert "3 rows of this run are in no log; the events say when and why" in footer(lost)


def test_on_while_it_holds_is_not_called_following(daemon: FakeDaemon) -> None:
    """Oracle: the flags of the row. Only a hold that nobody ordered contradicts the order."""
    origin = {"machine": "mill", "config": "mill.toml"}
    fresh = Desk(daemon, VirtualClock(1_000_000_001), origin).status()
    assert headline(fresh)[1] == "mode on: the correction follows the model"
    wrong = {"flags": ["HELD"], "reasons": ["counts are stale"], "devices": {"box": ["silent"]}}
    stuck = {**fresh, "status": {**fresh["status"], **wrong}}
    assert headline(stuck)[1] == "mode on is ordered, but the correction stays where it is: see why"
    assert held(stuck["status"]) == "device box: silent; counts are stale"
    ordered = {**stuck, "status": {**stuck["status"], "mode": "hold"}}
    assert headline(ordered)[1] == "mode hold: the correction stays where it is"


def test_a_run_of_tables_alone_says_what_is_true(daemon: FakeDaemon) -> None:
    """Nothing follows the model but the files. Oracle: the mode, and the files of the run file."""
    origin = {"machine": "mill", "config": "mill.toml", "actuator": False, "tables": {"X": "/etc/x.comp"}}
    fresh = Desk(daemon, VirtualClock(1_000_000_001), origin).status()
    assert headline(fresh)[1:] == [
        "mode on; without an actuator the loop commands nothing",
        "the tables are rewritten as the model predicts: X in /etc/x.comp",
    ]
    ordered = {**fresh, "status": {**fresh["status"], "mode": "hold"}}
    assert headline(ordered)[2] == "the tables stay as they are: X in /etc/x.comp"


@pytest.mark.parametrize(("um", "shown"), [(-0.001, "+0.00"), (-0.0, "+0.00"), (-0.006, "-0.01"), (None, "not known")])
def test_no_correction_is_minus_nothing(um: float | None, shown: str) -> None:
    assert um_text(um) == shown


class Answers:
    """A daemon that takes every order, and whose next rows are written down."""

    def __init__(self, *statuses: dict[str, Any]) -> None:
        self._statuses = list(statuses)

    def status(self) -> dict[str, Any]:
        """The next, at last the same again and again."""
        return self._statuses.pop(0) if len(self._statuses) > 1 else self._statuses[0]

    def order(self, order: Order, text: str = "") -> str:
        """Taken."""
        return f"{order} ordered {text}"


def test_enable_says_so_where_the_correction_stays(daemon: FakeDaemon) -> None:
    """Held rows from before the order say nothing; those behind it do. Oracle: instants written down here."""
    fresh = Desk(daemon, VirtualClock(1_000_000_001), {}).status()
    event = {"what": "enable", "time_ns": 50, "row": 1, "utc": "", "text": "", "who": "root"}

    def at(time_ns: int, *flags: str) -> dict[str, Any]:
        status = {**fresh["status"], "time_ns": time_ns, "flags": list(flags), "reasons": ["counts are stale"]}
        return {**fresh, "pid": 1, "events_total": 1, "events": [event], "status": status}

    before = {**at(50, "HELD"), "events_total": 0, "events": []}
    clock = VirtualClock(1)
    went_on = Answers(before, before, at(50, "HELD"), at(70))
    good = carry_out(went_on, Order.ENABLE, "", clock)  # type: ignore[arg-type]
    assert good.done
    assert good.text == "the correction follows the model; applied now: X +1.25 µm, Z not known"
    stays = Answers(before, before, at(50, "HELD"), at(200_000_050, "HELD"))
    held_up = carry_out(stays, Order.ENABLE, "", clock)  # type: ignore[arg-type]
    assert (held_up.done, held_up.text) == (
        False,
        "enabled, but the correction stays where it is: counts are stale",
    )


def test_resume_waits_for_the_first_readings_behind_it(daemon: FakeDaemon) -> None:
    """A device that has forgotten its position is without one until the next. Oracle: instants written down here."""
    fresh = Desk(daemon, VirtualClock(1_000_000_001), {}).status()
    event = {"what": "resume", "time_ns": 50, "row": 1, "utc": "", "text": "", "who": "root"}

    def at(time_ns: int, *wrong: str) -> dict[str, Any]:
        devices = {"scales": list(wrong)} if wrong else {}
        status = {**fresh["status"], "time_ns": time_ns, "takeovers": 1, "devices": devices}
        return {**fresh, "pid": 1, "events_total": 1, "events": [event], "status": status}

    before = at(50, "the position is not known")
    before = {**before, "events_total": 0, "events": [], "status": {**before["status"], "takeovers": 0}}
    clock = VirtualClock(1)
    comes = Answers(before, at(60, "no new positions"), at(70_000_000))
    good = carry_out(comes, Order.RESUME, "", clock)  # type: ignore[arg-type]
    assert (good.done, good.text) == (True, "the devices go on from where they are")
    on_hold = at(70_000_000)
    on_hold["status"]["mode"] = "hold"
    still = carry_out(Answers(before, on_hold), Order.RESUME, "", clock)  # type: ignore[arg-type]
    assert still.done
    assert still.text == (
        "the devices go on from where they are; the correction stays held, as ordered: `rtec ctl enable` ends that"
    )
    stays = Answers(before, at(60, "no new positions"), at(1_200_000_000, "no new positions"))
    missing = carry_out(stays, Order.RESUME, "", clock)  # type: ignore[arg-type]
    assert (missing.done, missing.text) == (False, "resumed, but scales: no new positions")
