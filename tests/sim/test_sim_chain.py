"""The exact product and the errors that go into it, against plain 4 × 4 matrices written out here."""

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.machine import Machine, machine_from
from rtec.sim.geometry import ExactChain
from rtec.sim.machine import SimulatedMachine
from tests.support.sim_example import plain, plain_machine, plain_truth, shipped

Floats = NDArray[np.float64]


def shift(v: Floats | list[float]) -> Floats:
    out = np.eye(4)
    out[:3, 3] = v
    return out


def small(eps: Floats, delta: Floats) -> Floats:
    a, b, c = eps
    return np.array([[1, -c, b, delta[0]], [c, 1, -a, delta[1]], [-b, a, 1, delta[2]], [0, 0, 0, 1]])


def milling_machine() -> Machine:
    axis = {"travel_mm": [0.0, 500.0], "counts_per_mm": 1000}
    data = {
        "machine": {"name": "mill", "tool_chain": ["Z", "head", "tool"], "work_chain": ["Y", "X", "pallet"]},
        "axis": {k: {"direction": k, **axis, "offset_mm": o} for k, o in AXIS_OFFSETS.items()},
        "link": {"head": {"offset_mm": [10.0, 20.0, 30.0]}, "tool": {"offset_mm": [0.0, 0.0, -90.0]}},
    }
    return machine_from(data, "mill")


AXIS_OFFSETS = {"X": [1.0, 2.0, 3.0], "Y": [4.0, 5.0, 6.0], "Z": [7.0, 8.0, 300.0]}


def test_exact_product_with_axes_on_both_sides() -> None:
    """Oracle: the chain of a milling machine multiplied out link by link from the written conventions."""
    chain = ExactChain(milling_machine())
    rng = np.random.default_rng(5)
    q = rng.uniform(0, 400, (6, 3))
    delta, eps = rng.normal(0, 0.05, (6, 6, 3)), rng.normal(0, 1e-4, (6, 6, 3))
    square = rng.normal(0, 1e-4, (3, 3))
    unit = np.eye(3)
    at = {name: k for k, name in enumerate(chain.links)}
    got = chain.tip_mm(q, delta, eps, square)
    for i in range(6):
        x, y, z = (q[i, a] * (unit[a] + np.cross(square[a], unit[a])) for a in range(3))

        def own(name: str, i: int = i) -> Floats:
            return small(eps[i, at[name]], delta[i, at[name]])

        def relative(name: str, i: int = i) -> Floats:
            return small(-eps[i, at[name]], -delta[i, at[name]])

        tool = shift(AXIS_OFFSETS["Z"] + z) @ own("Z") @ shift([10, 20, 30]) @ own("head")
        tool = tool @ shift([0, 0, -90]) @ own("tool")
        work = shift(AXIS_OFFSETS["Y"] - y) @ relative("Y") @ shift(AXIS_OFFSETS["X"] - x) @ relative("X")
        work = work @ shift([0, 0, 0]) @ own("pallet")
        np.testing.assert_allclose(got[i], (np.linalg.inv(work) @ tool)[:3, 3], atol=1e-10)
    zero = chain.tip_mm(q, 0 * delta, 0 * eps, 0 * square)
    np.testing.assert_allclose(zero, chain.nominal_mm(q), atol=1e-10)


def test_error_is_what_the_derived_chain_says_to_first_order() -> None:
    """Oracle: `rtec.machine`'s lever arms, derived another way; they differ by second order only."""
    for machine in (milling_machine(), shipped()[0]):
        chain = ExactChain(machine)
        rng = np.random.default_rng(8)
        q = rng.uniform(0, 150, (1, len(machine.axes)))
        delta, eps = rng.normal(0, 20, (1, len(chain.links), 3)), rng.normal(0, 20, (1, len(chain.links), 3))
        square = rng.normal(0, 20, (len(machine.axes), 3))
        named: dict[str, float] = {}
        for k, link in enumerate(chain.links):
            tag = link if link in machine.axis_names else f"0{link}"
            named |= {f"E{c}{tag}": delta[0, k, i] for i, c in enumerate("XYZ")}
            named |= {f"E{c}{tag}": eps[0, k, i] for i, c in enumerate("ABC")}
        for a, axis in enumerate(machine.axes):
            named |= {f"E{c}0{axis.name}": square[a, i] for i, c in enumerate("ABC")}
        linear = machine.chain.tip_error_um(q[0], [named[name] for name in machine.components])
        exact = (chain.tip_mm(q, delta * 1e-3, eps * 1e-6, square * 1e-6) - chain.nominal_mm(q))[0] * 1e3
        np.testing.assert_allclose(exact, linear, atol=0.02)
        assert np.max(np.abs(linear)) > 10


def shapes_at(sim: SimulatedMachine, name: str, q: float) -> dict[str, float]:
    """The six motions of an axis at a position, straight from the truth's words."""
    axis = sim.truth.axis[name]
    return {
        key[1]: shape.slope_per_m * q * 1e-3
        + sum(a * np.sin(2 * np.pi * q / length + phase) for a, length, phase in shape.waves)
        + sum(h * np.exp(-(((q - centre) / width) ** 2)) for h, centre, width in shape.bumps)
        for key, shape in {**axis.motion_um, **axis.motion_urad}.items()
    }


@pytest.mark.parametrize("direction", [-1.0, 1.0])
def test_geometric_error_of_the_shipped_machine(direction: float) -> None:
    """Oracle: the truth file worked out by hand here (shapes, screw, play, growth) and a plain 4 × 4 chain."""
    machine, truth = shipped()
    sim = SimulatedMachine(machine, truth, seed=4)
    sim.work(3 * 3600, 2400, 0.3)
    q = {"X": 63.7, "Z": 217.9}
    degc = {**dict(zip(truth.body, sim.thermal.body_degc[:-1], strict=True)), "air": sim.thermal.air_degc}
    links = {name: dict.fromkeys("XYZABC", 0.0) for name in ("Z", "X", "turret", "tool", "spindle", "workpiece")}
    tilt = {name: {f"{k}0": v for k, v in truth.axis[name].squareness_urad.items()} for name in "XZ"}
    for g in (*truth.growth_um, *truth.growth_urad):
        rise = degc[g.body] - (degc[g.minus] if g.minus else 20.0)
        where = tilt if g.motion.endswith("0") else links
        where[g.link][g.motion] = where[g.link].get(g.motion, 0.0) + rise * (g.per_degc + g.per_degc2 * rise)
    for d, phase in zip(truth.drift_um, np.random.default_rng([4, 4]).uniform(0, 2 * np.pi, 2), strict=True):
        wave = 2 * np.pi * 3 / d.period_h
        links[d.link][d.motion] += d.amplitude * (np.sin(wave + phase) - np.sin(phase))
    for name, along in (("X", "X"), ("Z", "Z")):
        axis, screw, pitch = truth.axis[name], truth.axis[name].screw, machine.axis(name).pitch_mm or 0.0
        turn = 2 * np.pi * q[name] / pitch
        m = q[name] - screw.encoder_um * 1e-3 * np.sin(turn + screw.encoder_phase_rad)
        low, high = machine.axis(name).travel_mm
        fine = np.linspace(screw.fixed_at_mm, m, 20001)
        middle = (fine[1:] + fine[:-1]) / 2
        segment = np.clip((middle - low) / (high - low) * len(screw.bodies), 0, len(screw.bodies) - 1).astype(int)
        rise_at = np.array([degc[b] for b in screw.bodies])[segment] - 20.0
        strain = screw.um_per_m_degc * 1e-3 * rise_at * (1 + screw.bend_per_degc * rise_at)
        turn = 2 * np.pi * m / pitch
        error = np.sum(strain * np.diff(fine)) + shapes_at(sim, name, m)[along]
        error += screw.cyclic_um * np.sin(turn + screw.cyclic_phase_rad)
        error += screw.cyclic2_um * np.sin(2 * turn + screw.cyclic2_phase_rad)
        error += (m - q[name]) * 1e3 - direction * axis.backlash_um / 2
        for motion, value in shapes_at(sim, name, q[name]).items():
            links[name][motion] += error if motion == along else value
    sides = {}
    for side, names in (("tool", machine.tool_chain), ("work", machine.work_chain)):
        product = np.eye(4)
        for name in names:
            place = np.array([120.0, 0.0, 80.0]) if name == "tool" else np.zeros(3)
            if name in q:
                line = np.eye(3)["XYZ".index(name)]
                eps0 = np.array([tilt[name].get(k, 0.0) for k in ("A0", "B0", "C0")]) * 1e-6
                place = q[name] * (line + np.cross(eps0, line))
            own = np.array([links[name][k] for k in "XYZABC"])
            product = product @ shift(place) @ small(own[3:] * 1e-6, own[:3] * 1e-3)
        sides[side] = product
    tip = (np.linalg.inv(sides["work"]) @ sides["tool"])[:3, 3]
    wanted = (tip - np.array([120.0 + q["X"], 0.0, 80.0 + q["Z"]])) * 1e3
    got = sim.geometric_error_at_um([[q["X"], q["Z"]]], direction)[0]
    np.testing.assert_allclose(got, wanted, atol=0.005)
    assert np.max(np.abs(wanted)) > 10


def test_geometric_error_of_a_machine_without_errors_is_zero() -> None:
    """Oracle: zero."""
    sim = plain()
    assert np.max(np.abs(sim.geometric_error_at_um([[0.0, 0.0], [150.0, 77.0]], 1.0))) < 1e-9


def test_a_linear_scale_takes_play_and_screw_out_of_the_error() -> None:
    """Oracle: with a perfect scale nothing is left; with an error of the scale, its own shape is."""
    screw = {"cyclic_um": 2.0}
    on_screw, on_scale = plain(screw=screw, backlash_um=6.0), plain(encoder="scale", backlash_um=6.0)
    q = [[41.25, 10.0]]
    assert abs(on_screw.geometric_error_at_um(q, 1.0)[0, 0] - (2.0 - 3.0)) < 1e-6  # a quarter pitch, half the play
    assert np.max(np.abs(on_scale.geometric_error_at_um(q, 1.0))) < 1e-9
    wave = {"EXX": {"waves": [[5.0, 300.0, 0.0]]}}
    bad = SimulatedMachine(plain_machine(), plain_truth(encoder="scale", motion_um=wave))
    assert abs(bad.geometric_error_at_um(q, 1.0)[0, 0] - 5.0 * np.sin(2 * np.pi * 41.25 / 300)) < 1e-3
