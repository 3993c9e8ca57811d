"""What effects propose for a component error, and why they propose nothing.

Oracles: the effects' own `check` and `channels`; numpy's rank of what two of them do to the same states.
"""

import itertools
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.effects import EFFECTS, Effect, State
from rtec.effects.base import Surroundings, component_kind
from rtec.effects.cyclic import CyclicScrew, widest_phase_gap
from rtec.effects.thermal import AxisExpansion, BedBending
from rtec.machine import Machine
from rtec.machine.machine import Sensor
from tests.support.machines import turning_centre, vertical_mill

Floats = NDArray[np.float64]
SENSORS = ("T_spindle", "T_air", "T_coolant", "T_bed", "T_column", "T_front", "T_back", "T_nut")
MILL = replace(vertical_mill(), sensors=tuple(Sensor(s) for s in SENSORS))
LATHE = turning_centre()
MOST = 150
NEVER_BY_ITSELF = {"servo_phase", "change_over", "expression"}
"""A phase mismatch in one axis is a lag; both axes change over; an expression is the user's."""
ONLY_GEOMETRY = {"squareness", "parallelism"}
"""Constant angles: a machine at rest has them too."""


def offered(machine: Machine, component: str, without: tuple[str, ...] = ()) -> Surroundings:
    """Everything varies but some channels."""
    spans = {n: (0.0, 400.0) for n in machine.channel_names if n not in without}
    axis = next((a for a in machine.axes if a.name == component[2:]), None)
    sensors = tuple(s for s in machine.sensor_names if s not in without)
    return Surroundings(machine, component, axis, sensors, spans, 5 * 86400.0, 30.0)


def proposed(around: Surroundings) -> Iterator[Effect]:
    for kind in EFFECTS.values():
        yield from kind.suggest(around)


every_component = pytest.mark.parametrize(
    ("machine", "component"), [(m, c) for m in (MILL, LATHE) for c in m.components], ids=lambda v: str(v)[:12]
)


@every_component
def test_what_is_proposed_stands_and_reads_what_varies(machine: Machine, component: str) -> None:
    around = offered(machine, component)
    found = list(proposed(around))
    assert len(found) < MOST
    assert len({e.model_dump_json() for e in found}) == len(found), "each once"
    for effect in found:
        effect.check(machine, "proposed")
        assert effect.component == component
        assert component_kind(component, machine) in type(effect).feeds
        assert set(effect.channels(machine)) <= set(around.channels)
        assert all(p.grid or np.isfinite([p.low, p.high]).all() for p in effect.nonlinear(machine))


def test_a_screw_may_be_warm_later_than_its_sensor() -> None:
    """Oracle: a sensor on the nut is warm before the screw is; each sensor is proposed at once and late."""
    found = [e for e in proposed(offered(MILL, "EXX")) if isinstance(e, AxisExpansion)]
    for late in (False, True):
        assert {e.sensor for e in found if e.lag is late} == set(SENSORS)


def test_one_side_of_a_part_may_stay_as_it_is() -> None:
    """Oracle: a bed bends by the difference of its sides, also where only one of them warms up."""
    around = offered(MILL, "EZX", ("T_air", "T_back"))
    around = replace(around, still=("T_air", "T_back"))
    pairs = {(e.front, e.back) for e in proposed(around) if isinstance(e, BedBending)}
    assert ("T_front", "T_back") in pairs
    assert not any("T_air" in pair for pair in pairs), "the air is no part"


def test_every_effect_is_proposed_somewhere() -> None:
    names = {e.effect for m in (MILL, LATHE) for c in m.components for e in proposed(offered(m, c))}
    assert names == set(EFFECTS) - NEVER_BY_ITSELF


@every_component
def test_where_nothing_varies_nothing_is_proposed_and_each_says_why(machine: Machine, component: str) -> None:
    around = offered(machine, component, machine.channel_names)
    assert {e.effect for e in proposed(around)} <= ONLY_GEOMETRY
    kind = component_kind(component, machine)
    for name, effect in EFFECTS.items():
        if kind in effect.feeds and name not in ONLY_GEOMETRY | {"expression"}:
            assert effect.missing(around), name
        if kind not in effect.feeds:
            assert not effect.missing(around), f"{name} does not feed {component}: there is nothing to mend"


@every_component
def test_a_channel_that_does_not_vary_is_not_read(machine: Machine, component: str) -> None:
    """And an effect that is gone without it says which it was."""
    whole = {e.effect for e in proposed(offered(machine, component))}
    for channel in machine.channel_names:
        around = offered(machine, component, (channel,))
        left = list(proposed(around))
        assert not [e for e in left if channel in e.channels(machine)]
        for name in whole - {e.effect for e in left}:
            assert EFFECTS[name].missing(around), f"{name} without {channel}"


def test_a_feed_without_a_velocity_names_the_way_on() -> None:
    """Oracle: the key of the TOML and the column; a feed alone does not say that the axis moved while it was read."""
    axis = LATHE.axes[0]
    none = offered(LATHE, f"EY{axis.name}", (axis.velocity_channel,))
    feed = replace(none, channels={**none.channels, "feed_mm_min": (500.0, 8000.0)})
    without, with_feed = (EFFECTS["guide_lift"].missing(around) for around in (none, feed))
    assert without == f"the velocity of {axis.name} never changes, or was not recorded"
    assert with_feed.startswith(without)
    assert "moves_at_feed = true under [table]" in with_feed
    assert with_feed.endswith(f"or add the column v{axis.channel}_mm_s")


def states(machine: Machine, n: int = 400) -> State:
    rng = np.random.default_rng(11)
    channels = {n_: rng.uniform(5.0, 395.0, n) for a in machine.axes for n_ in (a.channel, a.since_reversal_channel)}
    for a in machine.axes:
        channels |= {a.direction_channel: np.where(rng.random(n) < 0.5, -1.0, 1.0)}
        channels |= {a.velocity_channel: rng.normal(0.0, 80.0, n), a.acceleration_channel: rng.normal(0.0, 2e3, n)}
        channels[a.since_reversal_channel] = rng.exponential(3.0, n)
    channels |= {s: 20.0 + np.cumsum(rng.normal(0.0, 0.4, n)) for s in machine.sensor_names}
    channels |= {"spindle_rpm": np.repeat(rng.uniform(0.0, 5000.0, n // 10), 10)}
    channels |= {"load_kg": rng.uniform(0.0, 500.0, n), "force_n": rng.normal(0.0, 500.0, n)}
    return State(machine, np.linspace(0.0, 3e5, n), channels)


def span(effect: Effect, s: State) -> np.ndarray:
    theta = {p.name: p.start for p in effect.nonlinear(s.machine)}
    columns = [np.broadcast_to(b, len(s)) for b in effect.basis(s.machine, s, theta)]
    q, r = np.linalg.qr(np.stack(columns, axis=1))
    return q[:, np.abs(np.diag(r)) > 1e-12]


@every_component
def test_no_two_names_for_one_thing(machine: Machine, component: str) -> None:
    """Two effects whose contributions span the same space could never be told apart by any test."""
    s = states(machine)
    spans = [(e, span(e, s)) for e in proposed(offered(machine, component))]
    for (one, a), (other, b) in itertools.combinations(spans, 2):
        if one.effect != other.effect and a.shape == b.shape:
            smallest = np.linalg.svd(a.T @ b, compute_uv=False).min()
            assert smallest < 0.9999, f"{one!r} is {other!r}"


def test_as_few_temperatures_as_an_effect_needs_are_enough() -> None:
    """One for an expansion, two for a difference; with one fewer the reason is told."""
    for component, effect, needed in (("EXX", "axis_expansion", 1), ("EXX", "backlash_temperature", 1),
                                      ("EBX", "column_tilt", 2), ("EYX", "bed_bending", 2)):  # fmt: skip
        for given in (needed - 1, needed):
            names = tuple(s for s in SENSORS if s not in SENSORS[-given:]) if given else SENSORS
            around = offered(MILL, component, names)
            kind = EFFECTS[effect]
            assert len(list(kind.suggest(around))) >= (given == needed)
            assert bool(kind.missing(around)) == (given < needed)


def test_harmonics_are_offered_where_phases_cover_the_turn_however_long_the_steps() -> None:
    """Oracle: phases counted by hand. Steps of 2.1 turns visit ten, those of two turns one, a dense walk all."""
    mill = replace(MILL, axes=tuple(replace(a, pitch_mm=10.0) for a in MILL.axes))
    axis = next(a for a in mill.axes if a.name == "X")
    pitch = 10.0
    steps = np.linspace(0.0, 90.0, 10)
    assert widest_phase_gap(2.1 * steps, pitch) == pytest.approx(0.1)
    assert widest_phase_gap(2.0 * steps, pitch) == 1.0
    assert widest_phase_gap(steps, None) == 1.0

    def finest(places_mm: Floats) -> int:
        around = replace(offered(mill, f"E{axis.name}{axis.name}"), places_mm={axis.channel: places_mm})
        return max(e.harmonics for e in CyclicScrew.suggest(around) if isinstance(e, CyclicScrew))

    assert finest(2.1 * steps) == 2
    assert finest(2.0 * steps) == 1
    assert finest(np.linspace(0.0, 39.0, 40) * 2.025 * pitch) == 8
    assert finest(np.linspace(0.0, 2.0 * pitch, 129)) == 16
