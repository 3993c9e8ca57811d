"""Grid encoder: its nuisances, the sign question of [XT 1], and the tables of [XT] from a simulated bridge machine."""

from typing import Any

import numpy as np
import pytest

from rtec.errors import ConfigError, MeasurementError
from rtec.machine import Machine
from rtec.metrology.grid.compare import certain, directions, feeds, places
from rtec.metrology.grid.paths import edges_of
from rtec.metrology.grid.setup import GridSetup, analyse
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.sim.campaign.campaign import simulate
from rtec.sim.campaign.settings import DayPhase, DrivenPath, ReadingNoise, Settings
from rtec.sim.campaign.truth import truth_of
from tests.support import proof
from tests.support.exact_chain import exact_tip_error_um
from tests.support.machines import axis, machine, turning_centre


def bridge(corner: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Machine:
    """[XT]'s machine; arms of X and of Z's carrier count from `corner`, so that components are those seen there."""
    axes = {
        "X": axis("X", list(corner), travel_mm=[-2000.0, 2000.0]),
        "Y": axis("Y", travel_mm=[-2000.0, 2100.0]),
        "Z": axis("Z", [0.0, 0.0, 0.0], travel_mm=[-2000.0, 2000.0]),
    }
    links = {"head": [0.0, 0.0, -corner[2]]}
    axes["X"]["offset_mm"] = [corner[0], corner[1], 0.0]
    return machine("bridge", ["Y", "Z", "head"], ["X"], axes, links)


def measured(m: Machine, plane: str, origin: list[float], effects: tuple[str, ...], seed: int = 1, cycles: int = 1,
             noise_um: float = 0.2, **path: Any) -> Measurement:  # fmt: skip
    grid = make_instrument("grid_encoder", {"plane": plane, "origin_mm": origin}, None, None, m, "test")
    settings = Settings(noise=ReadingNoise(white_um=noise_um), path=DrivenPath.model_validate(path),
                        phase=(DayPhase(name="cold", cycles=cycles),))  # fmt: skip
    return simulate(truth_of(m, effects=effects), grid, settings, seed, f"{plane} {origin}")


def own(component: str, expression: str) -> str:
    """One true effect, whose only coefficient is one."""
    return f"expression,component={component},expression=one*({expression}),linear={{one='1'}},one=1"


def item(items: tuple[Any, ...], name: str) -> Any:
    return {i.name: i for i in items}[name]


# ---- instrument


def test_the_sign_of_eb_in_xt_1_is_settled_by_the_exact_product() -> None:
    """Oracle: the product of transforms. A turn EB of the table moves e_x by +EB z and e_z by -EB x: [XT 1] has the
    second right and the first wrong (`-EB z`). A turn keeps lengths; the printed pair would make a square grow."""
    m, eb = bridge(), 20.0
    x, z = 300.0, 500.0
    e = exact_tip_error_um(m, np.array([x, 0.0, z]), {"EBX": eb})
    assert e[0] == pytest.approx(+eb * z * 1e-3, abs=1e-3)
    assert e[2] == pytest.approx(-eb * x * 1e-3, abs=1e-3)
    place = np.array([x, z])
    grows = [place @ np.array([sign * eb * z, -eb * x]) for sign in (1.0, -1.0)]
    assert grows[0] == 0.0
    assert grows[1] != 0.0


def test_a_turned_plate_is_a_nuisance_and_squareness_is_not() -> None:
    """Oracle: a plate turned by +φ reads a point at p at R(-φ) p; worked out with a true rotation."""
    m = bridge()
    setup = {"plane": "XZ", "origin_mm": [0.0, 0.0, 0.0]}
    grid = make_instrument("grid_encoder", setup, None, None, m, "test")
    made = measured(m, "XZ", [0.0, 0.0, 0.0], (), noise_um=0.0, kinds=("square",))
    turn = {n.name: n for n in grid.nuisance(made.state(), made.run)}["alignment"]
    phi = 50e-6
    p = np.stack([made.channels["x"], np.zeros(len(made)), made.channels["z"]])
    back = np.array([[np.cos(phi), 0, -np.sin(phi)], [0, 1, 0], [np.sin(phi), 0, np.cos(phi)]])  # about Y by -φ
    np.testing.assert_allclose(turn.values * 50.0, ((back @ p - p) * 1e3)[[0, 2]], atol=1e-3)
    turned = {k: v + 50.0 * turn.values[i] for i, (k, v) in enumerate(made.readings.items())}
    plain, other = (
        analyse(Measurement(made.name, grid, m, made.run, made.time_s, made.channels, r)).items[0]
        for r in (made.readings, turned)
    )
    assert plain.name == other.name == "EB0Z"
    assert other.value == pytest.approx(plain.value, abs=1e-6)


def test_paths_have_their_pieces() -> None:
    """Oracle: the paths as [XT Fig. 8] draws them, counted by hand."""
    made = measured(bridge(), "YZ", [0.0, 100.0, 200.0], (), noise_um=0.0)
    edges = edges_of(made)
    assert len(np.unique(made.run)) == 2 + 2 + 2
    count = {k: sum(e.along == k for e in edges) for k in (0, 1)}
    assert count == {0: 4 + 2 + 2, 1: 4 + 2 + 2}
    ls = [e for e in edges if e.run >= 5 and e.along == 1]
    assert [(e.way, e.came, e.beside_mm) for e in ls] == [(1, 1, 100.0), (1, -1, 100.0)]
    np.testing.assert_allclose(np.unique(np.abs(made.channels["v_y"])), [0.0, 1000.0 / 60.0])


# ---- [XT Tables 4-9]: values put in as true effects; noise 0.2 µm; within the last digit that is printed


def u_of(letter: str, middle: float) -> str:
    return f"(({letter} - ({middle})) / 80)"


XZ1 = tuple(
    own(c, e)
    for c, e in {
        "EB0Z": "-7.5",
        "EXX": "-7.3 * (x + 362) / 160",
        "EZZ": "0.4 * (z - 433) / 160",
        # Straightness is that of the place measured: the part that the pitch's own arm along x makes is in it.
        "EZX": f"-1.3 * {u_of('x', -282)} ** 2 - 18.6 * (x + 362) / 160 * (x + 362) / 1000",
        "EXZ": f"-1.9 * {u_of('z', 513)} ** 2",
        "EBX": "-18.6 * (x + 362) / 160",
        "EBY": "-6.8 / 0.16 * (y + 200) / 2177",
    }.items()
)


def test_table_4_of_one_setup() -> None:
    m = bridge((-362.0, -200.0, 593.0))
    # Ten readings a millimetre: with two the pitch alone would have a standard error as large as its last digit.
    made = measured(m, "XZ", [-282.0, -200.0, 513.0], XZ1, cycles=3, step_mm=0.1)
    items = analyse(made).items
    paper = {"EB0Z": -7.5, "EXX": -7.3, "EZZ": 0.4, "EZX": 1.3, "EXZ": 1.9, "EBX": -18.6}
    for name, value in paper.items():
        assert item(items, name).value == pytest.approx(value, abs=0.1), name
    units = {i.name: i.unit for i in items}
    assert units["EB0Z"] == units["EBX"] == "µm/m"
    assert units["EXX"] == units["EZX"] == "µm"
    assert "EBZ" not in units  # Z's turn has no arm on X: a rigid body shows none


def test_table_5_roll_between_setups() -> None:
    m = bridge((-362.0, -200.0, 593.0))
    one, two = (analyse(measured(m, "XZ", [-282.0, y, 513.0], XZ1, seed=s)) for s, y in ((3, -200.0), (4, 1977.0)))
    (roll,) = places(one, two)
    assert roll.name == "EBY"
    assert roll.value * 0.16 == pytest.approx(6.8, abs=0.1)
    assert certain([roll])


def test_table_6_cross_talk() -> None:
    effects = (own("EAY", "0.5 * 1.9 / 0.16 * (1 - tanh((z + 430) / 5))"), own("EA0Z", "12"), own("EYY", "0.02 * y"))
    one, two = (analyse(measured(bridge(), "YZ", [0.0, 1400.0, z], effects, seed=5)) for z in (-602.0, -258.0))
    (talk,) = places(one, two)
    assert talk.name == "EAY(y, z)"
    assert "cross-talk" in talk.means
    assert talk.value * 0.16 == pytest.approx(1.9, abs=0.1)


def test_table_7_straightness_by_direction() -> None:
    effects = (own("EXZ", f"(3.1 + 0.7 * d_z) * {u_of('z', -679)} ** 2"),)
    found = directions(analyse(measured(bridge(), "XZ", [281.0, 0.0, -679.0], effects, seed=6)))
    assert item(found, "EXZ(z, +)").value == pytest.approx(-3.8, abs=0.1)
    assert item(found, "EXZ(z, -)").value == pytest.approx(-2.4, abs=0.1)
    assert "EXZ(+) - (-)" in {i.name for i in certain(found)}


def test_table_8_turn_by_direction() -> None:
    found = directions(analyse(measured(bridge(), "XY", [281.0, 0.0, 0.0], (own("ECX", "2.5 * d_x"),), seed=7)))
    turn = item(found, "ECX(+) - (-)")
    assert turn.value * 0.1 == pytest.approx(0.5, abs=0.1)
    assert "ECX(+) - (-)" in {i.name for i in certain(found)}


def table_9(**path: Any) -> tuple[Any, ...]:
    fast = "(abs(v_{0}) - 25 / 3) / (475 / 3)"
    y, z = fast.format("y"), fast.format("z")
    effects = (
        own("EYY", f"1.2 * (y - 1415) / 160 * {y}"),
        own("EZZ", f"-0.3 * (z + 692) / 160 * {z}"),
        own("EZY", f"-6.9 * {u_of('y', 1415)} ** 2 * {y}"),
        own("EYZ", f"-1.2 * {u_of('z', -692)} ** 2 * {z}"),
        own("EAY", f"1.5 * (y - 1335) / 160 * {y}"),
    )
    m = bridge((0.0, 1335.0, -612.0))
    made = measured(m, "YZ", [0.0, 1415.0, -692.0], effects, seed=8, kinds=("square",),
                    feeds_mm_min=(500.0, 10000.0), **path)  # fmt: skip
    return feeds(analyse(made))


def test_table_9_feeds() -> None:
    found = table_9(cycles=3)
    paper = {"EYY": 1.2, "EZZ": -0.3, "EZY": 6.9, "EYZ": 1.2}
    for name, value in paper.items():
        assert item(found, f"{name}(fast) - (slow)").value == pytest.approx(value, abs=0.1), name


def test_table_9_pitch_takes_many_readings() -> None:
    """Oracle: least squares by hand. 1.5 µm/m over 160 mm, seen from sides 160 mm apart, is 0.04 µm at the ends. The
    slope of a line through n readings of noise s has a standard error of s √12 / √n over its length; four means of 2c
    lines (c squares, both senses) make up the item. Its last digit takes about 60 times the readings of the others."""
    for step_mm, cycles in ((0.5, 3), (0.05, 5)):
        pitch = item(table_9(step_mm=step_mm, cycles=cycles), "EAY(fast) - (slow)")
        readings = 156.0 / step_mm * 2.0 * cycles
        by_hand = 2.0 * 0.2 * np.sqrt(12.0 / readings) / 0.16
        assert pitch.u == pytest.approx(2.0 * by_hand * 160.0 / 156.0, rel=0.1)
        assert abs(pitch.value - 1.5) < pitch.u
    assert pitch.value == pytest.approx(1.5, abs=0.1)


def test_a_pitch_shows_twice_on_a_square() -> None:
    """Oracle: the truth, and half the variance of what the axis' own travel alone gives; a pitch that is there only
    while the axis moves makes the two disagree, and the uncertainty says so."""
    from rtec.metrology.grid.setup import angle_moving, angle_of

    m = bridge((0.0, -80.0, 0.0))
    still = analyse(measured(m, "YZ", [0.0, 0.0, 0.0], (own("EAY", "8 * (y + 80) / 160"),), kinds=("square",)))
    both, alone = angle_of(still, 0), angle_moving(still, 0, 1000.0)
    assert both is not None
    assert alone is not None
    assert both[0] == pytest.approx(8.0, abs=3.0 * both[1])
    assert both[1] == pytest.approx(alone[1] / np.sqrt(2.0), rel=0.1)
    gone = own("EAY", "8 * (y + 80) / 160 * abs(v_y) * 60 / 1000")
    moving = angle_of(analyse(measured(m, "YZ", [0.0, 0.0, 0.0], (gone,), kinds=("square",))), 0)
    assert moving is not None
    assert moving[1] > 1.5


def rigid(seed: int) -> tuple[GridSetup, GridSetup]:
    effects = (
        "scale,component=EYY,axis=Y,k=12", "squareness,component=EA0Z,alpha=-15", "squareness,component=EC0Y,alpha=20",
    )  # fmt: skip
    path: dict[str, Any] = {"feeds_mm_min": (500.0, 10000.0), "step_mm": 4.0}
    m = bridge()
    one, two = (
        analyse(measured(m, "YZ", [0.0, 0.0, z], effects, 2 * seed + i, **path)) for i, z in enumerate((-600.0, -250.0))
    )
    return one, two


def test_a_rigid_machine_shows_no_cross_talk_direction_or_velocity() -> None:
    """Oracle: nothing of the kind is true. False alarms in at most 5 % of the machines, all questions of a machine
    asked together; that it does find what is there, the tables above show."""
    alarms, machines = 0, proof.of(200, 40)
    for seed in range(machines):
        one, two = rigid(seed)
        asked = (*places(one, two), *directions(one), *feeds(one))
        alarms += bool(certain(asked))
    assert alarms <= 0.05 * machines


def test_uncertainty_holds_the_truth_and_knows_the_plate() -> None:
    """Oracle: the truth, inside ±U (95 %) in at least 90 % of 60 seeds; a plate of ±2 µm widens U by its own share."""
    inside = 0
    for seed in range(60):
        items = analyse(measured(bridge(), "YZ", [0.0, 0.0, 0.0], (own("EA0Z", "-20"),), seed, kinds=("square",))).items
        found = item(items, "EA0Z")
        inside += abs(found.value + 20.0) <= found.u
    assert inside >= 54
    made = measured(bridge(), "YZ", [0.0, 0.0, 0.0], (), kinds=("square",))
    grid = make_instrument("grid_encoder", made.instrument.setup.model_dump() | {"accuracy_um": 2.0}, None, None,
                           made.machine, "test")  # fmt: skip
    coarse = Measurement(made.name, grid, made.machine, made.run, made.time_s, made.channels, made.readings)
    fine, wide = item(analyse(made).items, "EYY"), item(analyse(coarse).items, "EYY")
    assert wide.u == pytest.approx(np.hypot(fine.u, 2.0 * 2.0 / np.sqrt(3.0)))


@pytest.mark.parametrize(
    ("plane", "origin", "words"),
    [("XY", [0.0, 0.0, 0.0], "cannot travel in both"), ("XZ", [190.0, 0.0, 100.0], "axis X would go from")],
)
def test_what_a_machine_cannot_do_is_told(plane: str, origin: list[float], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        measured(turning_centre(), plane, origin, ())


def test_a_recording_without_straight_pieces_is_told() -> None:
    made = measured(bridge(), "YZ", [0.0, 0.0, 0.0], ())
    still = {**made.channels, "y": made.channels["z"]}
    with pytest.raises(MeasurementError, match="no straight piece along Y or Z"):
        edges_of(Measurement("slant", made.instrument, made.machine, made.run, made.time_s, still, made.readings))
