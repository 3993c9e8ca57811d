"""Heat that no sensor, or the wrong one, recorded: what a slow residual and a thermal finding leave open."""

import math

import numpy as np

from rtec.diagnosis.doubts import Doubt
from rtec.effects import Effect
from rtec.estimation.candidates import real
from rtec.estimation.noise import Whitener, minutes
from rtec.estimation.readings import Readings
from rtec.wording import number

SLOW_S, RECORD_S = 600.0, 3600.0
"""A drift with at least so long a memory, in a record of at least so long, may be heat."""
LARGE = 1.0
"""Where it is at least so many times the white noise."""
BODIES = {
    "axis_expansion": (("screw", "nut", "scale"), "on the screw, nut or scale of {axis}"),
    "axis_expansion_nonuniform": (("screw", "nut", "scale"), "on the screw, nut or scale of {axis}"),
    "backlash_temperature": (("screw", "nut"), "on the screw or nut of {axis}"),
    "spindle_growth": (("spindle", "bearing", "head"), "on the spindle or its bearings"),
    "spindle_tilt": (("spindle", "bearing", "head"), "on the spindle or its bearings"),
}
"""What a sensor should be on for an effect to be its own: words in its name, and the place in words."""
UNITS = {"um": "µm", "urad": "µrad"}


def stands_for(readings: Readings, effect: Effect) -> Doubt | None:
    """That a sensor stands for a body that no recorded sensor is on; None where one is, or the effect has none.

    Args:
        readings: the readings.
        effect: that was named.
    """
    sensor = getattr(effect, "sensor", None)
    if sensor is None or effect.effect not in BODIES:
        return None
    known, where = BODIES[effect.effect]
    axis = str(getattr(effect, "axis", ""))
    recorded = [n for n in readings.machine.sensor_names if any(n in s.channels for s in readings.states)]
    on_it = [n for n in recorded if any(w in n.lower() for w in known) or (axis and n.lower() == f"t_{axis.lower()}")]
    if on_it:
        return None
    place = where.format(axis=axis)
    message = f"{effect.effect} follows {sensor}; no sensor {place} was recorded, which moves alike."
    return Doubt("other_sensor", message, "Record one there before the compensation relies on this sensor.")


def unrecorded_heat(readings: Readings, noise: Whitener) -> Doubt | None:
    """That the residual grows and falls over hours while no temperature was recorded; None where one was.

    Args:
        readings: the readings.
        noise: of what the model leaves.
    """
    machine = readings.machine
    for name in machine.sensor_names:
        for state in readings.states:
            if name in state.channels and np.nanmax(state.channels[name], initial=-np.inf) - np.nanmin(
                state.channels[name], initial=np.inf
            ) > real(machine, name):
                return None
    found = []
    for s, n in zip(readings.series, noise.noises, strict=True):
        slow = n.sigma * math.sqrt(n.drift + n.offset)
        long = float(s.time_s[-1] - s.time_s[0]) >= RECORD_S and n.tau_s >= SLOW_S
        if long and slow > LARGE * n.sigma:
            found.append((slow, n.tau_s, s))
    if not found:
        return None
    slow, memory, s = max(found, key=lambda f: f[0])
    m = readings.measurements[s.source]
    message = (
        f"{m.name} {s.column} grows and falls by {number(slow)} {UNITS.get(s.unit, s.unit)} with a memory of "
        f"{minutes(memory)}: slow, and unexplained by anything recorded."
    )
    moves = [a.name for a in machine.axes if float(np.ptp(readings.states[s.source].value(a.channel)[s.row])) > 0.0]
    bodies = [f"the screw or scale of {a}" for a in moves[:1]] + ["spindle", "column", "bed", "air"]
    return Doubt("no_temperature", message, f"Record temperatures of {', '.join(bodies)}.", fatal=True)
