"""Candidate terms of each component error, among which the error on held-out runs chooses."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rtec.characterise.coverage import accelerated, followed, highest_degree, places_mm, several_speeds
from rtec.effects import Effect, effect_class
from rtec.effects.base import component_kind
from rtec.effects.registry import all_effects
from rtec.effects.spindle import of_spindle
from rtec.estimation.candidates import away_from, library
from rtec.estimation.gram.source import Source, both_ways, gone_along, lags_s, reads, speed_varies
from rtec.estimation.gram.stream import Term
from rtec.estimation.readings import read
from rtec.estimation.visible import VisibleComponent, moves
from rtec.machine.chain import component_unit

DEGREES = (0, 1, 2, 3, 4, 5, 6)
"""Quadratics are typically enough [G 3.6]; a higher degree is chosen if it lowers the error on held-out runs."""
BEND = 2
"""Degree of a linear deviation that is no squareness."""
REGIONS = (5, 9)
"""Numbers of knots for the regions of an axis."""
LIFTS = (0.5, 0.75, 1.0)
"""Powers of the speed with which an oil film lifts a slide."""
EXPONENTS = (1.0, 1.5, 2.0)
"""Powers of the speed with which a spindle's heat grows."""


FREE = ("load_deformation", "backlash_load")
"""Effects of the catalogue beyond those of `geometry`, `extended` and `thermal` that a free choice tries."""
THERMAL = {
    "axis_expansion", "axis_expansion_nonuniform", "bed_bending", "column_tilt", "mount_expansion", "spindle_growth",
    "spindle_tilt",
}  # fmt: skip
"""Effects of `thermal`."""
PLAYS = ("nut", "screw")
"""Parts, in the name of a sensor, whose heat changes the play of an axis; without such a sensor any may tell it."""
DEGREE = {"axis_expansion": 1, "axis_expansion_nonuniform": 2, "bed_bending": 2}
"""Power of the position in an effect of temperature; 0 for the others."""


EVERY_MACHINE = ("scale", "squareness", "backlash")
"""Errors that every machine has; a backlash along its own axis."""


def every_machine_has(effect: Effect) -> bool:
    """Whether every machine has an effect: of backlashes one along the axis itself."""
    along = effect.component[1] == effect.component[2]
    return effect.effect in EVERY_MACHINE and (effect.effect != "backlash" or along)


Drive = tuple[str, ...]


def drive(effect: Effect) -> Drive:
    """Component, name and sensors of an effect, without its delay and its degrees."""
    return effect.component, effect.effect, *(str(getattr(effect, n, "")) for n in ("sensor", "front", "back"))


@dataclass(frozen=True, eq=True)
class TermCandidate:
    """A term that may be chosen.

    Attributes:
        term: effect with fixed non-linear parameters, and its columns.
        kind: "position", "direction", "velocity", "acceleration", "region", "cross", "cyclic", "temperature",
            "difference", "speed", "other".
        feature: sensors or speed that drive it, with their lag; empty for geometry.
        channels: sensors, speed or axis that drive it.
        direct: the readings show its component directly, not only through a lever arm.
        offered: whether it may be chosen; otherwise it only shows with what a chosen term is confounded.
        away: of what grows along an axis: 2 by a sensor that is named after another axis, 1 by one that is named after
            none where the axis has its own, else 0.
    """

    term: Term
    kind: str
    feature: str = ""
    channels: tuple[str, ...] = ()
    direct: bool = True
    offered: bool = True
    away: int = 0

    @property
    def component(self) -> str:
        """Component error that the term feeds."""
        return self.term.effect.component

    @property
    def effect(self) -> str:
        """Name of its effect."""
        return self.term.effect.effect

    @property
    def label(self) -> str:
        """Short name: effect, component, columns, feature."""
        which = "" if self.term.only is None else " " + "+".join(self.column_names)
        drive = f" of {self.feature}" if self.feature else ""
        degrees = getattr(self.term.effect, "degrees", None)
        which += f" degree {degrees[0]}" if degrees else ""
        return f"{self.term.effect.effect}({self.component}){which}{drive}"

    @property
    def column_names(self) -> tuple[str, ...]:
        """Indices of the effect's coefficients in this term, as texts."""
        return tuple(str(i) for i in self.term.only or ())


def geometry(seen: VisibleComponent, sources: Sequence[Source]) -> list[TermCandidate]:
    """Position, direction, region and cyclic candidates of a component."""
    axis, name = seen.axis, seen.name
    if axis is None or not seen.moves:
        return []
    if name[2] == "0":
        return [_candidate("position", "squareness", name)]
    along: dict[str, Any] = {"axis": axis.name}
    linear = name[1] == axis.direction
    out = [_candidate("position", "scale", name, **along)] if linear else []
    places = places_mm(sources, name, axis)
    if not len(places):
        return out
    named = any(s.measurement.instrument.component == name for s in sources)
    # A linear deviation across an axis is its squareness, unless a file names the component.
    least = BEND if component_kind(name, sources[0].measurement.machine) == "straightness" and not named else 0
    degrees = [k for k in DEGREES if least <= k <= highest_degree(places, axis)]
    out += [_candidate("position", "polynomial_position", name, degrees=(k,), **along) for k in degrees]
    if least == BEND and not degrees and len(places) > BEND:
        # Too few places to correct a bend, but a rotation that grows along the axis gives the same readings.
        bend = _candidate("position", "polynomial_position", name, degrees=(BEND,), **along)
        out.append(replace(bend, offered=False))
    mine = [s for s in sources if reads(s, name)]
    if both_ways(axis, mine):
        out.append(_candidate("direction", "backlash", name, **along))
        out += [_candidate("direction", "backlash_position", name, only=(k,), degree=k, **along) for k in (1, 2)]
    for knots in REGIONS if gone_along(axis, mine) else ():
        at = tuple(float(v) for v in np.linspace(places[0], places[-1], knots))
        inner = tuple(range(1, knots - 1))  # with constant and slope these span the same as all of them
        out.append(_candidate("region", "piecewise_position", name, only=inner, knots_mm=at, **along))
    if linear and axis.pitch_mm is not None:
        theta = {"pitch": axis.pitch_mm}
        out.append(_candidate("cyclic", "cyclic_screw", name, theta, harmonics=1, **along))
        out.append(_candidate("cyclic", "cyclic_screw", name, theta, only=(2, 3), harmonics=2, **along))
    return out


def extended(seen: VisibleComponent, sources: Sequence[Source]) -> Iterator[TermCandidate]:
    """Candidates that no rigid body has [XT 2]: a component that depends on the speed or on another axis.

    Only where the measurements that read the component cover this: several speeds, all thirds of both axes.
    """
    axis, name = seen.axis, seen.name
    if axis is None or not seen.moves or name[2] == "0":
        return
    machine = sources[0].measurement.machine
    kind = component_kind(name, machine)
    if several_speeds(sources, name, axis):
        if kind == "positioning":
            yield _candidate("velocity", "servo_lag", name, axis=axis.name)
        if kind in ("straightness", "tilt"):
            for q in LIFTS:
                yield _candidate("velocity", "guide_lift", name, {"q": q}, axis=axis.name)
    if kind == "positioning" and accelerated(sources, name, axis):
        yield _candidate("acceleration", "inertia", name, axis=axis.name)
    for other in (a for a in machine.axes if a.name != axis.name and followed(sources, name, axis, a)):
        whole = _candidate("cross", "cross_talk", name, axis=axis.name, other=other.name)
        for k in range(len(whole.term.effect.coefficients(machine))):
            yield _candidate("cross", "cross_talk", name, only=(k,), axis=axis.name, other=other.name)


def thermal(seen: VisibleComponent, sources: Sequence[Source], varying: Sequence[str]) -> Iterator[TermCandidate]:
    """Temperature, difference and speed candidates of a component: alone, times position, times its square."""
    axis, taus, runs = seen.axis, lags_s(sources), speed_varies(sources)
    machine = sources[0].measurement.machine
    kind = component_kind(seen.name, machine)
    growth = "spindle_tilt" if component_unit(seen.name) == "urad" else "spindle_growth"
    own = axis is not None or of_spindle(machine, seen.name, runs)
    shift = growth if own or kind != "link" else "mount_expansion"
    # Where an axis moves, its mounting shifts or turns the readings as much as a body that is no spindle does.
    twice = not own and any(moves(s.measurement, a) for s in sources for a in machine.axes)
    along = axis is not None and seen.name[1] == axis.direction
    turns = along and axis is not None and both_ways(axis, [s for s in sources if reads(s, seen.name)])
    near = [n for n in varying if any(part in n.lower() for part in PLAYS)]
    for sensor in varying:
        for tau in (None, *taus):
            lag: dict[str, Any] = {} if tau is None else {"lag": True}
            theta = {} if tau is None else {"tau": tau}
            said = sensor if tau is None else f"{sensor} lagged {tau:g} s"
            more: dict[str, Any] = {"feature": said, "channels": (sensor,), "sensor": sensor, **lag}
            if seen.axis is None and twice:
                continue
            if seen.axis is None:
                yield _candidate("temperature", shift, seen.name, theta, **more)
                continue
            yield _candidate("temperature", "mount_expansion", seen.name, theta, **more)
            if axis is not None and seen.moves and seen.name[2] != "0":
                more["axis"] = axis.name
                away = away_from(machine, sensor, axis.name, varying)
                for grows in ("axis_expansion", "axis_expansion_nonuniform"):
                    yield replace(_candidate("temperature", grows, seen.name, theta, **more), away=away)
                if tau is None and turns and not away and (sensor in near or not near):
                    yield replace(_candidate("temperature", "backlash_temperature", seen.name, **more), away=away)
    for front, back in itertools.combinations(varying, 2):
        more = {"feature": f"{front} - {back}", "channels": (front, back), "front": front, "back": back}
        yield _candidate("difference", "column_tilt", seen.name, **more)
        if axis is not None and seen.moves and kind == "straightness":
            yield _candidate("difference", "bed_bending", seen.name, axis=axis.name, **more)
    if axis is None and runs:
        for p, tau in itertools.product(EXPONENTS, taus):
            said = f"spindle_rpm to the {p:g} lagged {tau:g} s"
            theta = {"tau": tau, "p": p}
            yield _candidate("speed", growth, seen.name, theta, feature=said, channels=("spindle_rpm",))


def at_constant_temperature(one: TermCandidate, candidates: Sequence[TermCandidate]) -> TermCandidate | None:
    """The candidate with the same shape at constant temperature; None where there is none."""
    if one.kind not in ("temperature", "difference"):
        return None
    return next((c for c in candidates if c.offered and is_at_constant(c.term.effect, one.term.effect)), None)


def is_at_constant(effect: Effect, thermal: Effect) -> bool:
    """Whether an effect has the shape that an effect of `thermal` has at constant temperature."""
    degree = DEGREE.get(thermal.effect, 0)
    linear = ("scale",) if degree == 1 else ()
    names = ("squareness",) if thermal.component[2] == "0" else ("polynomial_position", *linear)
    alike = effect.component == thermal.component and effect.effect in names
    return alike and getattr(effect, "degrees", (degree,)) == (degree,)


def catalogue(sources: Sequence[Source], allowed: Sequence[str] | None, there: set[str]) -> list[TermCandidate]:
    """Candidates of effects that the user named or that come from a plug-in, if they are no candidates already.

    Args:
        sources: the measurements.
        allowed: names of the effects that may be candidates; None for a free choice: `FREE`, and plug-ins.
        there: names of effects that are candidates already.
    """
    kinds = all_effects()
    free = [n for n, k in kinds.items() if n in FREE or not k.__module__.startswith("rtec.effects.")]
    names = free if allowed is None else allowed
    wanted = [n for n in names if n not in there and n not in THERMAL]
    if not wanted:
        return []
    found, _ = library(read([s.measurement for s in sources], smooth=False), wanted)
    machine, out = sources[0].measurement.machine, []
    moving = {c for a in machine.axes for c in (a.channel, *a.moving_channels)}
    for c in found:
        channels = c.effect.channels(machine)
        by = ", ".join(n for n in channels if n not in moving) or c.effect.effect
        for theta in c.thetas:
            at = "".join(f" {n} {v:.4g}" for n, v in theta.items())
            out.append(TermCandidate(Term(c.effect, dict(theta)), "other", f"{by}{at}", channels))
    return out


def _candidate(
    kind: str,
    effect: str,
    component: str,
    theta: Mapping[str, float] | None = None,
    *,
    only: tuple[int, ...] | None = None,
    feature: str = "",
    channels: tuple[str, ...] = (),
    **arguments: Any,
) -> TermCandidate:
    made = effect_class(effect, "fit").model_validate({"effect": effect, "component": component, **arguments})
    return TermCandidate(
        Term(made, dict(theta or {}), only),
        kind,
        feature,
        channels or ((arguments["axis"],) if "axis" in arguments else ()),
    )
