"""Directions of approach that a table does not say. Oracle: a slide that is moved by hand here, with its overrun."""

from pathlib import Path

import numpy as np
import pytest

from rtec.errors import MeasurementError
from rtec.metrology.contradicted import contradicted
from rtec.metrology.files.load import load_measurement
from rtec.metrology.measurement import Measurement
from tests.support.measurement_examples import TOML, machine

TARGETS = [0.0, 10.0, 20.0, 30.0, 40.0, 50.0]


def walked(stops: list[float], past_mm: float) -> list[int]:
    """Direction of the last motion at each stop of a slide that goes past both ends of each way by so much."""
    out, at, low, high = [], -past_mm, min(stops), max(stops)
    for i, stop in enumerate(stops):
        if stop in (low, high) and i and stops[i - 1] == stop:
            at += past_mm if stop == high else -past_mm
        elif i and abs(stop - stops[i - 1]) == high - low:
            at = stop - past_mm  # back to the beginning, and past it
        out.append(int(np.sign(stop - at)))
        at = stop
    return out


STRAIGHTNESS = """[measurement]
instrument = "straightness"
axis = "X"
machine = "turning-centre"
[setup]
direction = "Z"
"""


def measured(folder: Path, stops: list[float], more: str = "", values: str = "") -> Measurement:
    return written(folder, f"run,time_s,x_mm{more}", [f"1,{2.5 * i},{x}{values}" for i, x in enumerate(stops)])


def written(folder: Path, names: str, rows: list[str], toml: str = TOML) -> Measurement:
    (folder / "laser-x.csv").write_text(f"{names},reading_um\n" + "\n".join(f"{r},0.1" for r in rows) + "\n")
    (folder / "laser-x.toml").write_text(toml)
    return load_measurement(folder / "laser-x.csv", machine())


@pytest.mark.parametrize("times", [1, 3])
def test_an_end_that_is_read_once_more_was_left_and_approached_from_the_other_side(tmp_path: Path, times: int) -> None:
    there_and_back = [*TARGETS, *TARGETS[::-1], *TARGETS, *TARGETS[::-1]]
    stops = [x for x in there_and_back for _ in range(times)]
    m = measured(tmp_path, stops)
    assert m.channels["d_x"].tolist() == [d for d in walked(there_and_back, 5.0) for _ in range(times)]
    assert "no column dir_x: the axis is taken to go past both ends of each way" in m.notes


def test_ways_that_all_go_to_one_side_approach_every_target_so(tmp_path: Path) -> None:
    assert measured(tmp_path, TARGETS * 3).channels["d_x"].tolist() == walked(TARGETS * 3, 5.0) == [1] * 18
    assert measured(tmp_path, TARGETS[::-1]).channels["d_x"].tolist() == [-1] * 6


@pytest.mark.parametrize(
    ("stops", "more", "values"),
    [
        ([*TARGETS, *TARGETS[-2::-1]], "", ""),  # turned round at the end itself
        ([*TARGETS, *TARGETS[::-1]], ",dir_x", ",1"),
        ([*TARGETS, *TARGETS[::-1]], ",vx_mm_s", ",3"),
        ([0.0, 10.0, 10.0, 20.0, 30.0, 30.0, 20.0, 10.0], "", ""),
        ([0.0, 10.0], "", ""),
    ],
)
def test_any_other_order_is_left_to_the_positions(tmp_path: Path, stops: list[float], more: str, values: str) -> None:
    m = measured(tmp_path, stops, more, values)
    assert not any("go past" in n for n in m.notes)
    assert ("d_x" in m.channels) == (more == ",dir_x")


THERE_AND_BACK = [*TARGETS, *TARGETS[::-1], *TARGETS, *TARGETS[::-1]]


def test_another_axis_that_moves_between_the_runs_changes_no_direction(tmp_path: Path) -> None:
    rows = [f"{1 + i // 12},{2.5 * i},{x},{100 + 80 * (i // 12)}" for i, x in enumerate(THERE_AND_BACK)]
    assert written(tmp_path, "run,time_s,x_mm,z_mm", rows).channels["d_x"].tolist() == walked(THERE_AND_BACK, 5.0)


def test_an_axis_that_moves_within_the_runs_too_leaves_the_directions_to_the_positions(tmp_path: Path) -> None:
    rows = [f"1,{2.5 * i},{x},{100 + i % 6}" for i, x in enumerate(THERE_AND_BACK)]
    assert "d_x" not in written(tmp_path, "run,time_s,x_mm,z_mm", rows).channels


def test_a_straightness_probe_that_reads_each_end_twice_was_overrun_there(tmp_path: Path) -> None:
    rows = [f"1,{2.5 * i},{x}" for i, x in enumerate(THERE_AND_BACK)]
    m = written(tmp_path, "run,time_s,x_mm", rows, STRAIGHTNESS)
    assert m.channels["d_x"].tolist() == walked(THERE_AND_BACK, 5.0)
    assert "no column dir_x: the axis is taken to go past both ends of each way" in m.notes


@pytest.mark.parametrize("toml", [TOML, STRAIGHTNESS])
def test_the_sign_of_a_recorded_velocity_is_the_direction(tmp_path: Path, toml: str) -> None:
    """The ends are read on the way in and on the way out; targets in no order that positions alone would show."""
    stops = [0.0, 10.0, 25.0, 25.0, 50.0, 50.0, 30.0, 0.0, 0.0, 0.0, 40.0]
    signs = [1, 1, 1, 1, 1, -1, -1, -1, -1, 1, 1]
    rows = [f"1,{2.5 * i},{x},{30 * d}" for i, (x, d) in enumerate(zip(stops, signs, strict=True))]
    assert written(tmp_path, "run,time_s,x_mm,vx_mm_s", rows, toml).channels["d_x"].tolist() == signs


def test_a_reading_at_velocity_zero_has_the_direction_of_the_last_motion(tmp_path: Path) -> None:
    stops, speeds = [0.0, 10.0, 20.0, 20.0, 20.0, 10.0, 10.0], [0, 0, 30, -30, 0, 0, 30]
    rows = [f"1,{2.5 * i},{x},{v}" for i, (x, v) in enumerate(zip(stops, speeds, strict=True))]
    m = written(tmp_path, "run,time_s,x_mm,vx_mm_s", rows)
    assert m.channels["d_x"].tolist() == [0, 1, 1, -1, -1, -1, 1]


def test_velocities_that_are_all_zero_are_those_of_targets_read_at_rest(tmp_path: Path) -> None:
    m = measured(tmp_path, THERE_AND_BACK, ",vx_mm_s", ",0")
    assert m.channels["d_x"].tolist() == walked(THERE_AND_BACK, 5.0)


@pytest.mark.parametrize("stops_s", [0.0, 2.0])
def test_an_axis_that_keeps_its_feed_between_readings_was_read_on_the_run(tmp_path: Path, stops_s: float) -> None:
    """Two feeds, there and back; an axis that stops for two seconds at each target was at rest there."""
    rows, now = [], 0.0
    for feed in (600.0, 3000.0):
        for way in (TARGETS, TARGETS[::-1]):
            for x in way:
                rows.append(f"1,{now:.3f},{x},{feed},0.1")
                now += 10.0 * 60.0 / feed + stops_s
            now += 5.0
    (tmp_path / "laser-x.csv").write_text("run,time_s,x_mm,feed_mm_min,reading_um\n" + "\n".join(rows) + "\n")
    (tmp_path / "laser-x.toml").write_text(TOML)
    m = load_measurement(tmp_path / "laser-x.csv", machine())
    if stops_s:
        assert "v_x" not in m.channels
        assert m.state().value("v_x").tolist() == [0.0] * 24
    else:
        assert m.channels["v_x"].tolist() == [10.0] * 6 + [-10.0] * 6 + [50.0] * 6 + [-50.0] * 6
        assert m.channels["d_x"].tolist() == [1.0] * 6 + [-1.0] * 6 + [1.0] * 6 + [-1.0] * 6
        assert sum("went at its feed while it was read" in n for n in m.notes) == 1


@pytest.mark.parametrize("stops_s", [0.0, 2.0])
def test_a_straightness_probe_on_the_run_has_the_velocity_of_the_feed(tmp_path: Path, stops_s: float) -> None:
    """Oracle: the times that the motion takes; a probe that stopped, or not, has no known velocity."""
    rows, now = [], 0.0
    for feed in (600.0, 3000.0):
        for x in TARGETS:
            rows.append(f"1,{now:.3f},{x},{feed}")
            now += 10.0 * 60.0 / feed + stops_s
        now += 5.0
    m = written(tmp_path, "run,time_s,x_mm,feed_mm_min", rows, STRAIGHTNESS)
    assert ("v_x" in m.channels, m.state().has("v_x")) == (not stops_s, not stops_s)
    if not stops_s:
        assert m.channels["v_x"].tolist() == [10.0] * 6 + [50.0] * 6


MOVES = "[table]\nmoves_at_feed = true\n"


@pytest.mark.parametrize("toml", [TOML, STRAIGHTNESS])
@pytest.mark.parametrize("given", [False, True])
def test_the_user_may_say_that_the_axis_moved_at_its_feed(tmp_path: Path, toml: str, given: bool) -> None:
    """Oracle: the walk with its overruns; the times are of no use, 2.5 s from each reading to the next."""
    names, way = "run,time_s,x_mm,feed_mm_min" + ",dir_x" * given, walked(THERE_AND_BACK, 5.0)
    feeds = [600.0] * 12 + [3000.0] * 12
    rows = [f"{1 + i // 12},{2.5 * i},{x},{feeds[i]}" + f",{way[i]}" * given for i, x in enumerate(THERE_AND_BACK)]
    silent = written(tmp_path, names, rows, toml)
    assert "v_x" not in silent.channels
    m = written(tmp_path, names, rows, toml + MOVES)
    assert m.channels["v_x"].tolist() == [d * f / 60.0 for d, f in zip(way, feeds, strict=True)]
    assert m.channels["d_x"].tolist() == way
    assert "no column vx_mm_s: the feed in the direction of motion, as moves_at_feed says" in m.notes


def test_a_feed_in_no_known_order_goes_as_the_positions(tmp_path: Path) -> None:
    """Oracle: the order of the positions; the first reading has the direction of the first motion."""
    rows = [f"1,{2.5 * i},{x},600" for i, x in enumerate([0.0, 0.0, 20.0, 50.0, 35.0, 10.0])]
    m = written(tmp_path, "run,time_s,x_mm,feed_mm_min", rows, STRAIGHTNESS + MOVES)
    assert m.channels["v_x"].tolist() == [10.0, 10.0, 10.0, 10.0, -10.0, -10.0]


@pytest.mark.parametrize(
    ("names", "row", "said"),
    [
        ("", "", "moves_at_feed = true needs the column feed_mm_min"),
        (",feed_mm_min,vx_mm_s", ",600,3", "but the velocity of X has a column"),
        (",feed_mm_min,z_mm", ",600,{i:b}", "here X and Z moved; give the column"),
    ],
)
def test_a_feed_that_tells_no_velocity_is_refused(tmp_path: Path, names: str, row: str, said: str) -> None:
    rows = [f"1,{2.5 * i},{x}{row.format(i=i)}" for i, x in enumerate(TARGETS)]
    with pytest.raises(MeasurementError, match=said):
        written(tmp_path, f"run,time_s,x_mm{names}", rows, STRAIGHTNESS + MOVES)


def test_numbers_as_large_as_a_file_can_hold_say_nothing(tmp_path: Path) -> None:
    """Oracle: numpy's warnings are errors here."""
    m = measured(tmp_path, [0.0, 1.7e308, -1.7e308, 1.0, 2.0], ",feed_mm_min", ",1e308")
    assert not {"v_x", "d_x"} & set(m.channels)


def logged(folder: Path, rows: list[str]) -> Measurement:
    """As `written`, of rows with their own reading or none."""
    (folder / "laser-x.csv").write_text("run,time_s,x_mm,z_mm,feed_mm_min,reading_um\n" + "\n".join(rows) + "\n")
    (folder / "laser-x.toml").write_text(TOML)
    return load_measurement(folder / "laser-x.csv", machine())


@pytest.mark.parametrize("z_moves", [False, True])
@pytest.mark.parametrize("lost", [(), (3, 17)])
def test_a_log_between_the_cycles_hides_no_overrun(tmp_path: Path, lost: tuple[int, ...], z_moves: bool) -> None:
    """Nine rows at the first target after each cycle, while Z may be parked; two readings are lost, one at an end."""
    rows, t = [], 0.0
    for i, x in enumerate(THERE_AND_BACK):
        rows.append(f"{1 + i // 12},{t},{x},100,3000,{'' if i in lost else 0.1}")
        t += 2.5
        if i % 12 == 11:
            rows += [f"{1 + i // 12},{t + 60 * k},{x},{100 + 50 * z_moves},0," for k in range(9)]
            t += 540.0
    m = logged(tmp_path, rows)
    read = np.array([i for i, row in enumerate(rows) if not (row.endswith(",0,") and i % 21 >= 12)])
    assert m.channels["d_x"][read].tolist() == walked(THERE_AND_BACK, 5.0)
    assert set(np.delete(m.channels["d_x"], read)) == {-1.0}
    assert "no column dir_x: the axis is taken to go past both ends of each way" in m.notes


def test_a_log_between_the_runs_hides_no_feed(tmp_path: Path) -> None:
    """600 mm/min, read each second on the way; then nine rows at rest, without a reading."""
    rows, t = [], 0.0
    for run in (1, 2, 3):
        way = [10.0 * k for k in range(16)][:: 1 if run % 2 else -1]
        rows += [f"{run},{t + k},{x},100,600,0.1" for k, x in enumerate(way)]
        rows += [f"{run},{t + 15 + 60 * k},{way[-1]},100,0," for k in range(1, 10)]
        t += 900.0
    m = logged(tmp_path, rows)
    v = m.channels["v_x"].reshape(3, 25)
    np.testing.assert_array_equal(v[:, :16], np.array([[10.0], [-10.0], [10.0]]) * np.ones(16))
    assert not v[:, 16:].any()


def test_positions_at_the_end_of_all_numbers_are_no_fault() -> None:
    """Their difference overflows. Oracle: the largest number of 64 bits."""
    ends = np.array([-1.7e308, 1.7e308])
    assert contradicted(np.zeros(2), ends, np.ones(2)) is None
