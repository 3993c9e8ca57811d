"""Ball bar as an instrument: exact reading, arms, table of [BB], files with angles, simulated circles."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtec.errors import ConfigError, MeasurementError
from rtec.metrology.ball_bar.causes import causes
from rtec.metrology.ball_bar.circle import circle_of
from rtec.metrology.ball_bar.design import stacked_design
from rtec.metrology.files.load import load_measurement, save_measurement
from rtec.metrology.instruments.ball_bar import circle_channels, travelled_deg
from rtec.sim.campaign.campaign import simulate, simulate_with_truth
from rtec.sim.campaign.settings import DayPhase, DrivenPath, Settings
from rtec.sim.campaign.truth import truth_of
from tests.support.ball_bar_examples import ROWS, bar, gantry, recorded
from tests.support.exact_chain import exact_tip_error_um, exact_tip_errors_um
from tests.support.machines import turning_centre, vertical_mill
from tests.support.sim_example import QUIET

SETUPS = [(0.0, 150.0, "ccw"), (30.0, 146.969, "cw"), (144.568, 40.0, "ccw"), (-60.0, 100.0, "cw")]
ZETA_DEG = np.arange(3.0, 360.0, 11.0)  # off the quadrants, where the clearance has not yet gone from flank to flank


@pytest.mark.parametrize(("height", "radius", "direction"), SETUPS)
@pytest.mark.parametrize("name", ROWS)
def test_every_row_of_the_table_comes_out_of_the_chain(name: str, height: float, radius: float, direction: str) -> None:
    """Oracles: the row as printed; and the exact product of transforms with nothing neglected, |r_m| - L0."""
    m = gantry()
    instrument = bar(m, height_mm=height, radius_mm=radius, direction=direction)
    s, lam = instrument.setup.sense, radius / np.hypot(radius, height)
    row, errors, size = ROWS[name]
    zeta = np.deg2rad(ZETA_DEG)
    expected = size * row(zeta, lam, radius, height, s)
    shapes = errors(zeta, radius, s)

    circle = circle_of(recorded(m, instrument, ZETA_DEG[::s], np.zeros(len(zeta))))
    order = np.argsort(np.rad2deg(circle.angle_rad) % 360.0)
    cause = next(c for c in causes(circle, bent=True) if c.name == name)
    derived = size * stacked_design([cause], [circle])[order, 0]
    np.testing.assert_allclose(derived, expected, atol=1e-9)

    pose = np.stack([radius * np.cos(zeta), radius * np.sin(zeta), np.zeros(len(zeta))], axis=1)
    tip = exact_tip_errors_um(m, pose, {c: size * v for c, v in shapes.items()})
    exact = instrument.exact_um(m, pose, tip)[0]
    # Second order: e²/2L of errors of up to 7 µm, and a rotation's own square.
    np.testing.assert_allclose(exact, expected, atol=1.5e-3)
    arms = sum(instrument.arms_of(m, pose, c)[0] * size * v for c, v in shapes.items())
    np.testing.assert_allclose(arms, expected, atol=1e-9)


@pytest.mark.parametrize(("height", "radius", "direction"), SETUPS)
def test_centre_offset_is_the_fixed_ball_off_the_centre(height: float, radius: float, direction: str) -> None:
    """Oracles: the row `-λ ex cos ζ`, and the distance to a ball that is really moved."""
    m = gantry()
    instrument = bar(m, height_mm=height, radius_mm=radius, direction=direction)
    zeta = np.deg2rad(ZETA_DEG)
    made = recorded(m, instrument, ZETA_DEG[:: instrument.setup.sense], np.zeros(len(zeta)))
    x, y, *_ = instrument.nuisance(made.state(), made.run)
    lam, angle = radius / np.hypot(radius, height), np.deg2rad(made.channels["angle_deg"])
    np.testing.assert_allclose(x.values[0], -lam * np.cos(angle), atol=1e-12)
    np.testing.assert_allclose(y.values[0], -lam * np.sin(angle), atol=1e-12)
    moving = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(len(angle), -height)], axis=1)
    moved = np.linalg.norm(moving - [5e-3, -3e-3, 0.0], axis=1) - np.hypot(radius, height)
    np.testing.assert_allclose(5.0 * x.values[0] - 3.0 * y.values[0], moved * 1e3, atol=3e-4)


@pytest.mark.parametrize("make", [turning_centre, vertical_mill])
def test_exact_reading_is_the_distance_of_two_real_balls(make: Any) -> None:
    """Oracle: both balls carried by their own side of the chain, true transforms multiplied out."""
    from tests.support.instrument_examples import frames

    m = make()
    plane = "ZX" if make is turning_centre else "YZ"
    instrument = bar(m, plane=plane, centre_mm=[150.0, 0.0 if make is turning_centre else 150.0, 150.0],
                     radius_mm=100.0, height_mm=20.0)  # fmt: skip
    channels = circle_channels(m, instrument.setup, np.deg2rad(ZETA_DEG))
    pose = np.stack([channels.get(a.channel, np.zeros(len(ZETA_DEG))) for a in m.axes], axis=1)
    rng = np.random.default_rng(2)
    for where in pose[::4]:
        errors = dict(zip(m.components, rng.uniform(-15, 15, len(m.components)), strict=True))
        real = frames(m, where, errors)
        ideal = np.linalg.inv(real.ideal_work) @ real.ideal_tool
        table_ball = ideal[:3, 3] - instrument.bar_mm(m, where[None])[0]
        length = np.linalg.norm(real.place() - table_ball) - instrument.setup.length_mm
        tip = np.array([exact_tip_error_um(m, where, errors)])
        # `exact_tip_error_um` has [G 2.6]'s small-angle matrices, the frames true rotations: (45 µrad)² over 1 m.
        assert instrument.exact_um(m, where[None], tip)[0, 0] == pytest.approx(length * 1e3, abs=0.01)


def test_exact_and_linear_differ_by_the_second_order_only() -> None:
    """Oracle: `(e² - (u·e)²) / 2L0`, worked out by hand; 0.0333 µm for 100 µm across 150 mm."""
    m = gantry()
    instrument = bar(m)
    pose = np.array([[150.0, 0.0, 0.0]])
    assert instrument.exact_um(m, pose, np.array([[0.0, 100.0, 0.0]]))[0, 0] == pytest.approx(
        0.1**2 / 300 * 1e3, rel=1e-5
    )
    assert instrument.exact_um(m, pose, np.array([[1e-6, 0.0, 0.0]]))[0, 0] == pytest.approx(1e-6, rel=1e-6)


# ---- files


def written(tmp_path: Path, rows: list[str], setup: str, head: str = "run,time_s,angle_deg,reading_um") -> Path:
    (tmp_path / "bb.csv").write_text("\n".join([head, *rows]) + "\n")
    (tmp_path / "bb.toml").write_text(
        '[measurement]\ninstrument = "ball_bar"\nmachine = "gantry"\n[setup]\nplane = "XY"\n'
        f"centre_mm = [10.0, 20.0, 30.0]\nradius_mm = 100.0\nfeed_mm_min = 1200.0\n{setup}\n"
    )
    return tmp_path / "bb.csv"


@pytest.mark.parametrize("direction", ["ccw", "cw"])
def test_angles_become_positions_directions_and_velocities(tmp_path: Path, direction: str) -> None:
    """Oracle: the circle differentiated numerically; at a turning point an axis still has the direction it came in."""
    s = 1 if direction == "ccw" else -1
    angle = s * np.arange(0.0, 360.5, 0.5)
    rows = [f"1,{i * 0.05:.3f},{a},{i}" for i, a in enumerate(angle)]
    m = load_measurement(written(tmp_path, rows, f'direction = "{direction}"'), gantry())
    c = m.channels
    np.testing.assert_allclose(c["x"], 10 + 100 * np.cos(np.deg2rad(angle)))
    np.testing.assert_allclose(c["y"], 20 + 100 * np.sin(np.deg2rad(angle)))
    np.testing.assert_allclose(c["z"], 30.0)
    seconds = np.deg2rad(0.5) * 100.0 / 20.0  # from one angle to the next at 1200 mm/min
    for name in "xy":
        v = np.gradient(c[name], seconds)
        np.testing.assert_allclose(c[f"v_{name}"][1:-1], v[1:-1], atol=1e-3)
        np.testing.assert_allclose(c[f"a_{name}"][2:-2], np.gradient(v, seconds)[2:-2], atol=1e-3)
        before = np.sign(np.diff(c[name], prepend=2 * c[name][0] - c[name][1] if name == "y" else c[name][0] - 1e-6))
        np.testing.assert_array_equal(c[f"d_{name}"], before)
    assert not any("as fixed" in n for n in m.notes)
    save_measurement(m, tmp_path / "again.csv")
    again = load_measurement(tmp_path / "again.csv", gantry())
    assert all(np.allclose(again.channels[k], v, atol=1e-9) for k, v in c.items())


def test_positions_are_as_good_as_angles(tmp_path: Path) -> None:
    """Oracle: the same circle given by angles."""
    angle = np.arange(180.0, 402.0, 2.0)
    x, y = 10 + 100 * np.cos(np.deg2rad(angle)), 20 + 100 * np.sin(np.deg2rad(angle))
    rows = [f"1,{i},{a:.4f},{b:.4f},0" for i, (a, b) in enumerate(zip(x, y, strict=True))]
    setup = 'direction = "ccw"\nstart_deg = 190.0\narc_deg = 200.0\novershoot_deg = 10.0'
    m = load_measurement(written(tmp_path, rows, setup, "run,time_s,x_mm,y_mm,reading_um"), gantry())
    circle = circle_of(m)
    np.testing.assert_allclose(np.rad2deg(circle.angle_rad), np.arange(190.0, 391.0, 2.0), atol=1e-3)
    assert circle.left_out == 10


@pytest.mark.parametrize(
    ("rows", "head", "setup", "words"),
    [
        (["1,0,10,0", "1,1,9,0"], None, 'direction = "ccw"', ["run 1 goes cw", "'ccw'"]),
        (["1,0,0", "1,1,0"], "run,time_s,reading_um", 'direction = "ccw"', ["'angle_deg'", "'x_mm'"]),
        (
            ["1,0,110,20,0", "1,1,108,20,0"],
            "run,time_s,x_mm,y_mm,reading_um",
            'direction = "ccw"',
            ["row 2", "2.00 mm"],
        ),
        (["1,0,10,0"], None, 'direction = "up"', ["direction", "'ccw' or 'cw'"]),
    ],
)
def test_what_cannot_be_is_told(
    tmp_path: Path, rows: list[str], head: str | None, setup: str, words: list[str]
) -> None:
    with pytest.raises(MeasurementError) as caught:
        load_measurement(written(tmp_path, rows, setup, head or "run,time_s,angle_deg,reading_um"), gantry())
    assert all(w in str(caught.value) for w in words), str(caught.value)


def test_a_plane_without_an_axis_is_told() -> None:
    with pytest.raises(MeasurementError, match="no axis along Y"):
        bar(turning_centre(), plane="XY")


@pytest.mark.parametrize("direction", ["ccw", "cw"])
@pytest.mark.parametrize("wrapped", [False, True])
@pytest.mark.parametrize("over", [30.0, 200.0])
def test_overshoot_is_told_from_the_arc(direction: str, wrapped: bool, over: float) -> None:
    """Oracle: the arc by construction, angles going on or starting again at 360."""
    instrument = bar(gantry(), direction=direction, start_deg=-20.0, arc_deg=220.0, overshoot_deg=over)
    way = np.arange(-over, 220.5 + over, 0.5)
    angle = -20.0 + instrument.setup.sense * way
    given = angle % 360.0 if wrapped else angle
    np.testing.assert_allclose(travelled_deg(instrument.setup, given, np.ones(len(way), np.int64)), way, atol=1e-9)
    circle = circle_of(recorded(gantry(), instrument, given, way))
    assert (circle.reading_um.min(), circle.reading_um.max(), circle.left_out) == (0.0, 220.0, 4 * over)


@pytest.mark.parametrize("over", [0.0, 90.0, 180.0, 200.0])
@pytest.mark.parametrize("begins", [0.0, 0.25, -10.0])
def test_a_recording_may_begin_with_the_arc(over: float, begins: float) -> None:
    """Oracle: the arc by construction; the overshoot was run and is not in the file, or only a part of it is."""
    instrument = bar(gantry(), start_deg=-20.0, arc_deg=220.0, overshoot_deg=over)
    way = np.arange(begins, 220.0, 0.5)
    for angle in (-20.0 + way, (-20.0 + way) % 360.0):
        np.testing.assert_allclose(travelled_deg(instrument.setup, angle, np.ones(len(way), np.int64)), way, atol=1e-9)


# ---- simulated


def circles(step_deg: float = 1.0) -> Settings:
    return Settings(
        noise=QUIET, path=DrivenPath(step_deg=step_deg), phase=(DayPhase(name="cold", cycles=1),),
        nuisance={"centre": 0.0, "height": 0.0},
    )  # fmt: skip


def test_a_simulated_circle_is_exact_and_knows_its_speed() -> None:
    """Oracle: true component errors by hand, the exact product, and the distance."""
    m = gantry()
    instrument = bar(
        m, height_mm=30.0, radius_mm=146.969, direction="cw", start_deg=10.0, arc_deg=220.0, overshoot_deg=5.0
    )
    effects = ("scale,component=EXX,axis=X,k=-40", "backlash,component=EYY,axis=Y,B=-6",
               "squareness,component=EC0X,alpha=60",
               "expression,component=EXX,expression=c*v_x,linear={c='1'},c=0.2")  # fmt: skip
    truth = truth_of(m, effects=effects)
    made = simulate_with_truth(truth, instrument, circles(step_deg=1.0))
    c, got = made.measurement.channels, made.measurement.readings["reading_um"]
    assert len(got) == 231
    np.testing.assert_allclose(np.hypot(c["v_x"], c["v_y"]), 1000.0 / 60.0)
    dt = np.diff(made.measurement.time_s)
    np.testing.assert_allclose(dt, np.deg2rad(1.0) * 146.969 / (1000 / 60), rtol=1e-6)
    for i in range(0, 231, 7):
        errors = {"EXX": -40e-3 * c["x"][i] + 0.2 * c["v_x"][i], "EYY": -3.0 * c["d_y"][i], "EC0X": 60.0}
        pose = np.array([c["x"][i], c["y"][i], c["z"][i]])
        tip = exact_tip_error_um(m, pose, errors)
        r = np.array([c["x"][i], c["y"][i], -30.0]) + tip * 1e-3
        assert got[i] == pytest.approx((np.linalg.norm(r) - instrument.setup.length_mm) * 1e3, abs=1e-3)


def test_a_circle_beyond_the_travel_is_told() -> None:
    with pytest.raises(ConfigError, match=r"axis X would go from 150 to 450 mm"):
        simulate(truth_of(gantry(), effects=()), bar(gantry(), centre_mm=[300, 0, 0]), circles())
