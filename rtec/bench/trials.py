"""The trials of the benchmark: hidden effects, their right names, and faults of the records.

The natural size of an effect is two to four times the white noise; at signal-to-noise 1 it equals the noise.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from rtec.bench.rig import campaign as c
from rtec.bench.rig.campaign import CampaignPlan, Errors, Record
from rtec.bench.rig.machine import PITCH_MM, SENSORS, Day, bearing_seen, day, description, displaced, growth_seen

Floats = NDArray[np.float64]
Rng = np.random.Generator
Table = Mapping[str, Any]

NATURAL_UM, FAINT_UM = (1.5, 3.0), (0.5, 0.7)


@dataclass(frozen=True)
class Right:
    """A right name: of an effect, of a component ("" for any), with a sensor ("" for any)."""

    effect: str
    component: str = ""
    sensor: str = ""


Names = tuple[Right, ...]


@dataclass(frozen=True)
class Trial:
    """A data set with its truth.

    Attributes:
        group, what, seed, size: identify the trial.
        records: content of the measurement files.
        base: effects of the model: effect table and coefficients by name.
        hidden: right names of each hidden effect.
        variables: channels of an effect outside the catalogue.
        doubt: fault of the record or of the machine file; else empty.
        machine: content of the machine file.
        law: columns of the truth that follow from recorded channels, by reading, (n, k); sizes and zero are free.
    """

    group: str
    what: str
    seed: int
    size: str
    records: tuple[Record, ...]
    base: tuple[tuple[Table, Mapping[str, float]], ...] = ()
    hidden: tuple[Names, ...] = ()
    variables: frozenset[str] = frozenset()
    doubt: str = ""
    machine: Mapping[str, Any] = field(default_factory=description)
    law: Mapping[str, Floats] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """Name of the data set."""
        return f"{self.group}-{self.what}-{self.size}-{self.seed}"


@dataclass(frozen=True)
class Maker:
    """Tools for making one trial: its random numbers, day and size."""

    rng: Rng
    size_um: float
    form: str
    of: Day

    def sized(self, values: Floats) -> Floats:
        """Values scaled to the trial's size, with a random sign."""
        spread = float(np.std(values))
        return np.asarray(values * (self.rng.choice([-1.0, 1.0]) * self.size_um / max(spread, 1e-12)))

    def record(
        self, plan: CampaignPlan, errors: Errors, name: str = "record", sensors: tuple[str, ...] = SENSORS
    ) -> Record:
        """A record of a plan with these component errors."""
        return c.read(plan, errors, self.rng, self.form, c.recorded(plan, self.of, self.rng, sensors), name)


Parts = dict[str, Any]
Builder = Callable[[Maker], Parts]


def _known_scale(m: Maker, plan: CampaignPlan) -> tuple[Errors, tuple[tuple[Table, Mapping[str, float]], ...]]:
    """A scale error and a backlash that the model has."""
    a = plan.axis or "X"
    k, b = m.rng.uniform(5.0, 25.0), m.rng.uniform(1.0, 4.0)
    e = f"E{a}{a}"
    error = k * 1e-3 * plan.q + 0.5 * b * plan.direction[a]
    return {e: error}, (
        ({"effect": "scale", "component": e, "axis": a}, {"k": k}),
        ({"effect": "backlash", "component": e, "axis": a}, {"B": b}),
    )


def _law(plan: CampaignPlan, *effect: Floats) -> dict[str, Floats]:
    """Columns of scale error, backlash and an effect, (n,) or (n, k), in a laser's readings."""
    return {"reading_um": np.column_stack([plan.q, plan.direction[plan.axis or "X"], *effect])}


def _plus(*errors: Errors) -> dict[str, Floats]:
    out: dict[str, Floats] = {}
    for one in errors:
        for key, value in one.items():
            out[key] = out.get(key, 0.0) + value
    return out


# --- effects that change from run to run -------------------------------------------------------------------------


def load_shift(m: Maker) -> Parts:
    """The table yields under its load, as a spring that stiffens at a stop."""
    plan = c.line(m.rng)
    known, base = _known_scale(m, plan)
    w = plan.load_kg / 100.0
    shift = w / (1.0 + 0.03 * w)
    return {
        "records": (m.record(plan, _plus(known, {"EXX": m.sized(shift)})),),
        "base": base,
        "law": _law(plan, shift),
        "hidden": ((Right("load_deformation", "EXX"), Right("load_shift", "EXX")),),
    }


def load_bow(m: Maker) -> Parts:
    """The bed is a beam on two supports; the load rolls over it."""
    plan = c.line(m.rng, "straightness", across="Z")
    s = np.clip((plan.q + 60.0) / 720.0, 0.0, 1.0)
    sag = plan.load_kg / 100.0 * (s * (1.0 - s)) ** 2
    return {
        "records": (m.record(plan, {"EZX": m.sized(sag)}),),
        "hidden": ((Right("load_deformation", "EZX"),),),
    }


def column_lean(m: Maker) -> Parts:
    """The column's front is warmer than its back; it bends, and the spindle tilts."""
    plan = c.drift(m.rng)
    lean = m.of.of("front", plan.time_s) - m.of.of("back", plan.time_s)
    turned = displaced({"EB0spindle": m.sized(lean) * 8.0}, plan.pose_mm)[:, 0]
    scale = m.size_um / max(float(np.std(turned)), 1e-12)
    return {
        "records": (m.record(plan, {"EB0spindle": m.sized(lean) * 8.0 * scale}),),
        "hidden": ((Right("column_tilt", "", "T_front-T_back"),),),
    }


def speed_shift(m: Maker) -> Parts:
    """Centrifugal force on the balls: the bearings shift with the square of the speed, a little less when preloaded."""
    plan = c.drift(m.rng)
    index = np.searchsorted(m.of.time_s, plan.time_s, side="right") - 1
    speed = m.of.rpm[index] / 1000.0
    return {
        "records": (m.record(plan, {"EZ0spindle": m.sized(speed**2 / (1.0 + 0.002 * speed**2))}),),
        "hidden": ((Right("spindle_speed_shift", ""),),),
    }


# --- simple against complex forms --------------------------------------------------------------------------------


def abbe(m: Maker) -> Parts:
    """The guide of X is bent to a circle: it pitches, and the height of the beam changes from run to run."""
    plan = c.line(m.rng)
    known, base = _known_scale(m, plan)
    pitch = np.arcsin(plan.scaled("X") * 0.05)
    effect = displaced({"EBX": pitch}, plan.pose_mm, c.BEAM_MM)[:, 0]
    pitch = pitch * (m.size_um / float(np.std(effect - np.polyval(np.polyfit(plan.q, effect, 1), plan.q))))
    return {
        "records": (m.record(plan, _plus(known, {"EBX": pitch})),),
        "base": base,
        "hidden": (
            (Right("guide_curvature", "EBX"), Right("angular_motion", "EBX"), Right("polynomial_position", "EBX")),
        ),
    }


def bowed_angle(m: Maker) -> Parts:
    """A guide that is bent more at one end: its angle has a slope and a bow."""
    plan = c.line(m.rng, "angular", across="B")
    u = plan.scaled("X")
    angle = m.sized(np.sinh(u + 0.5)) * 2.0
    return {
        "records": (m.record(plan, {"EBX": angle}),),
        "hidden": (
            (Right("angular_motion", "EBX"), Right("guide_curvature", "EBX"), Right("polynomial_position", "EBX")),
        ),
    }


def plain_bow(m: Maker) -> Parts:
    """A screw with a bow, nothing else."""
    plan = c.line(m.rng)
    known, base = _known_scale(m, plan)
    bow = np.cosh(1.1 * plan.scaled("X"))
    return {
        "records": (m.record(plan, _plus(known, {"EXX": m.sized(bow)})),),
        "base": base,
        "law": _law(plan, bow),
        "hidden": ((Right("polynomial_position", "EXX"),),),
    }


def warm_screw(m: Maker) -> Parts:
    """The finite-element screw grows; a sensor is on the nut only."""
    plan = c.line(m.rng)
    known, base = _known_scale(m, plan)
    record = m.record(plan, _plus(known, {"EXX": m.sized(m.of.growth(plan.q, plan.time_s))}))
    seen = growth_seen(plan.q, plan.time_s, record.channels)
    return {
        "records": (record,),
        "base": base,
        "hidden": ((Right("axis_expansion", "EXX"),),),
        "law": _law(plan, seen),
    }


def servo(m: Maker) -> Parts:
    """A position loop with lag: the slide lags by speed over gain, less before the lag has built up."""
    plan = c.line(m.rng)
    known, base = _known_scale(m, plan)
    v = plan.velocity_mm_s["X"]
    lag = v * (1.0 - np.exp(-plan.since_mm / np.maximum(np.abs(v) * 0.05, 1e-6)))
    return {
        "records": (m.record(plan, _plus(known, {"EXX": m.sized(lag)})),),
        "base": base,
        "law": _law(plan, lag),
        "hidden": ((Right("servo_lag", "EXX"),),),
    }


# --- outside the catalogue ---------------------------------------------------------------------------------------


def _outside(m: Maker, curve: Callable[[Floats, float], Floats]) -> Parts:
    plan = c.line(m.rng)
    known, base = _known_scale(m, plan)
    at = m.rng.uniform(-0.5, 0.5)
    return {
        "records": (m.record(plan, _plus(known, {"EXX": m.sized(curve(plan.scaled("X"), at))})),),
        "base": base,
        "variables": frozenset({"x"}),
    }


def bump(m: Maker) -> Parts:
    """One worn place."""
    wide = m.rng.uniform(0.05, 0.12)
    return _outside(m, lambda u, at: np.exp(-0.5 * ((u - at) / wide) ** 2))


def sawtooth(m: Maker) -> Parts:
    """A rack in sections, each laid with the same slope."""
    return _outside(m, lambda u, at: np.mod((u - at) / 0.31, 1.0))


def step(m: Maker) -> Parts:
    """A joint between two lengths of guide."""
    return _outside(m, lambda u, at: 1.0 / (1.0 + np.exp(-(u - at) / 0.01)))


# --- the record or the machine file is wrong ---------------------------------------------------------------------


def wrong_pitch(m: Maker) -> Parts:
    """The machine file has a wrong pitch of the screw."""
    plan = c.line(m.rng)
    known, base = _known_scale(m, plan)
    wave = np.tanh(0.7 * np.sin(2.0 * np.pi * plan.q / PITCH_MM["X"] + m.rng.uniform(0.0, 6.28)))
    said = float(m.rng.choice([5.0, 20.0, 12.0, 16.0]))
    return {
        "records": (m.record(plan, _plus(known, {"EXX": m.sized(wave)})),),
        "base": base,
        "doubt": "wrong_pitch",
        "machine": description({"X": said}),
    }


def wrong_factor(m: Maker) -> Parts:
    """A channel that the model needs is in a wrong unit."""
    plan = c.line(m.rng)
    known, base = _known_scale(m, plan)
    lag = m.sized(plan.velocity_mm_s["X"])
    k = float(np.sum(lag * plan.velocity_mm_s["X"]) / np.sum(plan.velocity_mm_s["X"] ** 2))
    record = m.record(plan, _plus(known, {"EXX": 3.0 * lag}))
    factor = float(m.rng.choice([60.0, 1.0 / 60.0, 1000.0, 25.4, 5.0, 2.0]))
    channels = {**record.channels, "v_x": record.channels["v_x"] * factor}
    return {
        "records": (replace(record, channels=channels),),
        "base": (*base, ({"effect": "servo_lag", "component": "EXX", "axis": "X"}, {"tau": 3.0 * k})),
        "doubt": "wrong_channel",
    }


def swapped_sensors(m: Maker) -> Parts:
    """The labels of two sensors are exchanged."""
    plan = c.line(m.rng)
    known, base = _known_scale(m, plan)
    other = str(m.rng.choice(["T_spindle", "T_air", "T_cool"]))
    growth = plan.q * 1e-3 * m.of.of("nut", plan.time_s)
    k = 4.0 * m.size_um / float(np.std(growth))
    record = m.record(plan, _plus(known, {"EXX": k * growth}))
    channels = {**record.channels, "T_nut": record.channels[other], other: record.channels["T_nut"]}
    table = {"effect": "axis_expansion", "component": "EXX", "axis": "X", "sensor": "T_nut"}
    return {
        "records": (replace(record, channels=channels),),
        "base": (*base, (table, {"k": k})),
        "doubt": "swapped_sensors",
    }


def moved_origin(m: Maker) -> Parts:
    """The axis has another home position than at the fit of the model."""
    plan = c.line(m.rng)
    known, base = _known_scale(m, plan)
    u = plan.scaled("X")
    size = 4.0 * m.size_um / float(np.std(1.5 * u**2 - 0.5 + 0.8 * (2.5 * u**3 - 1.5 * u)))
    curve = size * (1.5 * u**2 - 0.5) + 0.8 * size * (2.5 * u**3 - 1.5 * u)
    record = m.record(plan, _plus(known, {"EXX": curve}))
    channels = {**record.channels, "x": record.channels["x"] + m.rng.choice([-1.0, 1.0]) * m.rng.uniform(30.0, 80.0)}
    table = {"effect": "polynomial_position", "component": "EXX", "axis": "X", "degrees": [2, 3]}
    return {
        "records": (replace(record, channels=channels),),
        "base": (*base, (table, {"c2": size, "c3": 0.8 * size})),
        "doubt": "moved_origin",
    }


def contradiction(m: Maker) -> Parts:
    """One of three files has the wrong sign."""
    records = []
    for k in range(3):
        plan = c.line(m.rng, runs=5, step_mm=40.0, hours=3.0, alike=True)
        curve = m.size_um * 2.0 * np.sin(2.0 * plan.scaled("X"))
        records.append(m.record(plan, {"EXX": curve}, f"record-{k + 1}"))
    last = records[-1]
    records[-1] = replace(last, readings={n: -v for n, v in last.readings.items()})
    return {"records": tuple(records), "doubt": "contradiction"}


def other_machine(m: Maker) -> Parts:
    """One of three files is of another machine of the same kind."""
    records = []
    for k in range(3):
        plan = c.line(m.rng, runs=5, step_mm=40.0, hours=3.0, alike=True)
        u = plan.scaled("X")
        curve = m.size_um * 2.0 * (np.sin(2.0 * u) if k else np.cos(3.1 * u))
        records.append(m.record(plan, {"EXX": curve}, f"record-{k + 1}"))
    return {"records": tuple(records), "doubt": "contradiction"}


def one_pass(m: Maker) -> Parts:
    """A single pass in one direction."""
    plan = c.one_way(c.line(m.rng, per_way=60))
    return {"records": (m.record(plan, {"EXX": m.sized(plan.q)}),), "doubt": "one_pass"}


# --- sensors missing, gaps, aliases ------------------------------------------------------------------------------


def no_sensors(m: Maker) -> Parts:
    """The screw grows, and no temperature was recorded."""
    plan = c.line(m.rng)
    known, base = _known_scale(m, plan)
    growth = m.sized(m.of.growth(plan.q, plan.time_s))
    return {
        "records": (m.record(plan, _plus(known, {"EXX": growth}), sensors=()),),
        "base": base,
        "doubt": "no_temperature",
        "variables": frozenset({"x", "time_s"}),
    }


def nut_unseen(m: Maker) -> Parts:
    """The screw grows; coolant, air and bed have sensors, nut and screw none."""
    plan = c.line(m.rng)
    known, base = _known_scale(m, plan)
    growth = m.sized(m.of.growth(plan.q, plan.time_s))
    return {
        "records": (m.record(plan, _plus(known, {"EXX": growth}), sensors=("T_cool", "T_air", "T_bed")),),
        "base": base,
        "hidden": ((Right("axis_expansion", "EXX"),),),
    }


def gaps(m: Maker) -> Parts:
    """The spindle grows with its bearing, in a record of nine hours with runs of ten minutes."""
    plan = c.drift(m.rng)
    plan = c.at(plan, np.flatnonzero((plan.time_s % 1620.0) < 600.0))
    return {
        "records": (m.record(plan, {"EZ0spindle": m.sized(m.of.of("bearing", plan.time_s))}),),
        "hidden": ((Right("spindle_growth", ""), Right("mount_expansion", "", "T_spindle")),),
    }


def alias(m: Maker) -> Parts:
    """A wave near the step between equal targets."""
    step_mm = float(m.rng.choice([20.0, 25.0, 30.0]))
    plan = c.line(m.rng, step_mm=step_mm)
    known, base = _known_scale(m, plan)
    period = step_mm * m.rng.uniform(0.86, 0.96)
    wave = m.sized(np.sin(2.0 * np.pi * plan.q / period + m.rng.uniform(0.0, 6.28)))
    return {
        "records": (m.record(plan, _plus(known, {"EXX": wave})),),
        "base": base,
        "doubt": "alias",
        "variables": frozenset({"x"}),
    }


def speed_gaps(m: Maker) -> Parts:
    """The spindle grows with its bearing; only the air and the speed are recorded, with 17 minutes between the runs."""
    plan = c.drift(m.rng, points=46)
    plan = c.at(plan, np.flatnonzero((plan.time_s % 1620.0) < 600.0))
    growth = m.sized(m.of.of("bearing", plan.time_s) - m.of.of("air", plan.time_s))
    return {
        "records": (m.record(plan, {"EZ0spindle": growth}, sensors=("T_air",)),),
        "hidden": ((Right("spindle_growth", ""),),),
    }


# --- several effects on a plate ----------------------------------------------------------------------------------


def _plate(m: Maker, count: int) -> Parts:
    plan = c.plate(m.rng)
    x, y = plan.scaled("X"), plan.scaled("Y")
    ones = np.ones(len(plan))
    choices: list[tuple[dict[str, Floats], float, Names]] = [
        ({"EC0Y": ones}, 0.15, (Right("squareness"), Right("parallelism"))),
        ({"EYX": np.cosh(1.2 * x)}, 1.0, (Right("straightness", "EYX"), Right("polynomial_position", "EYX"))),
        ({"EXX": x + 0.03 * x**2}, 1.0, (Right("scale", "EXX"), Right("polynomial_position", "EXX"))),
        (
            {"EXY": np.sinh(1.5 * y) - np.polyval(np.polyfit(y, np.sinh(1.5 * y), 1), y)},
            1.0,
            (Right("straightness", "EXY"),),
        ),
        ({"EYY": np.cosh(y)}, 1.0, (Right("polynomial_position", "EYY"),)),
    ]
    errors: dict[str, Floats] = {}
    hidden = []
    for i in m.rng.permutation(len(choices))[:count]:
        shape, _, names = choices[int(i)]
        ((component, values),) = shape.items()
        moved = displaced({component: values}, plan.pose_mm)
        column = moved[:, int(np.argmax(moved.std(axis=0)))]
        values = values * (m.rng.choice([-1.0, 1.0]) * m.size_um / float(np.std(column)))
        errors = _plus(errors, {component: values})
        hidden.append(names)
    return {"records": (m.record(plan, errors),), "hidden": tuple(hidden)}


def two_on_plate(m: Maker) -> Parts:
    """Two effects on one plate."""
    return _plate(m, 2)


def three_on_plate(m: Maker) -> Parts:
    """Three effects on one plate."""
    return _plate(m, 3)


# --- runs to be predicted ----------------------------------------------------------------------------------------


def spindle_heat(m: Maker) -> Parts:
    """The spindle grows with its bearing; its housing has a sensor."""
    plan = c.drift(m.rng)
    record = m.record(plan, {"EZ0spindle": m.sized(m.of.of("bearing", plan.time_s))})
    return {
        "records": (record,),
        "hidden": ((Right("spindle_growth", ""), Right("mount_expansion", "", "T_spindle")),),
        "law": {"reading_axial_um": bearing_seen(plan.time_s, record.channels)},
    }


def _improved(builder: Builder, form: str) -> Builder:
    """A builder of an effect with every fourth run held back, with a noise of a form; empty for any."""

    def build(m: Maker) -> Parts:
        parts = builder(replace(m, form=form or m.form))
        return {**parts, "records": tuple(map(c.with_runs_held_back, parts["records"]))}

    return build


# --- nothing hidden ----------------------------------------------------------------------------------------------


def _clean(form: str, kind: str) -> Builder:
    def build(m: Maker) -> Parts:
        m = replace(m, form=form)
        if kind == "drift":
            return {"records": (m.record(c.drift(m.rng), {}),)}
        lengths = [int(v) for v in m.rng.integers(6, 46, 14)] if kind == "uneven" else None
        plan = c.line(m.rng, lengths=lengths)
        known, base = _known_scale(m, plan)
        return {"records": (m.record(plan, known),), "base": base}

    return build


GROUPS: dict[str, Mapping[str, Builder]] = {
    "run_level": {f.__name__: f for f in (load_shift, load_bow, column_lean, speed_shift)},
    "lean": {f.__name__: f for f in (abbe, bowed_angle, plain_bow, warm_screw, servo)},
    "beyond": {f.__name__: f for f in (bump, sawtooth, step)},
    "wrong_file": {f.__name__: f for f in (wrong_pitch, wrong_factor, swapped_sensors, moved_origin)},
    "contradicting": {f.__name__: f for f in (contradiction, other_machine)},
    "one_pass": {"one_pass": one_pass},
    "unrecorded": {f.__name__: f for f in (no_sensors, nut_unseen)},
    "gaps": {f.__name__: f for f in (gaps, speed_gaps)},
    "aliases": {"alias": alias},
    "plates": {f.__name__: f for f in (two_on_plate, three_on_plate)},
    "improve": {
        f"{form or 'any'}_{f.__name__}": _improved(f, form)
        for form, effects in (
            ("", (load_shift, plain_bow, warm_screw, servo, spindle_heat)),
            ("bursts", (load_shift, plain_bow, warm_screw, servo, spindle_heat)),
            ("warm_up", (warm_screw, spindle_heat)),
        )
        for f in effects
    },
    "quiet": {f"{form}_{kind}": _clean(form, kind) for form in c.FORMS for kind in ("line", "drift", "uneven")},
}
FAINT = ("run_level", "lean")
"""Groups with further trials at signal-to-noise 1."""
HOURS = 9.0


def build(group: str, what: str, seed: int, size: str = "natural") -> Trial:
    """Make a trial; the same arguments give the same numbers, bit for bit."""
    rng = np.random.default_rng([seed, crc32(f"{group}|{what}|{size}".encode())])
    low, high = FAINT_UM if size == "faint" else NATURAL_UM
    forms = ("white", "memory", "wander", "zeros", "quantised")
    maker = Maker(rng, float(rng.uniform(low, high)), str(rng.choice(forms)), day(rng, HOURS))
    return Trial(group, what, seed, size, **GROUPS[group][what](maker))


def trials(seeds: Sequence[int], groups: Sequence[str] = tuple(GROUPS)) -> Iterator[tuple[str, str, int, str]]:
    """Arguments of `build` for all trials of some seeds, group by group."""
    for group in groups:
        for what in GROUPS[group]:
            for seed in seeds:
                yield group, what, seed, "natural"
                if group in FAINT:
                    yield group, what, seed, "faint"
