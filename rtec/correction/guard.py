"""The guard: it limits what a model may do to the machine. This file alone defines what the machine will do.

Every cycle, in this order:

1. Judge the inputs (`judge_counts`, `judge_range`, `judge_sensor`, `judge_spindle`, `judge_age`): fresh, possible, and
   inside the range that the model was fitted in? Unknown or impossible temperatures never reach the model (`known`);
   it goes on with the temperatures before.
2. Judge the model's request (`judge_request`): below the warning limit, below the stop limit?
3. Judge the orders, and whether the actuator follows its commands (`judge_mode`).
4. Decide for all axes together (`decide`): follow the model, fade to zero, hold, wait, or stand still.
5. Move each axis (`move`, `guard_update`) within acceleration, slew and stop limit; then the ledger, which
   holds whole units of the sink (`ledger_update`), within the sink's range (`within_sink`).

While anything is wrong the correction brakes within its acceleration limit and stays where it comes to rest: never a
jump, never a silent zero. While the actuator is in trouble, the correction is held at the actuator's output, without
braking, because a command that the actuator ignores moves nothing; it goes on from there, from rest. A gap between two
cycles counts as one cycle at most (`cycle_s`), so one large command never makes up for a pause.

A correction of c µm is `units_per_um · c` units of the sink. The ledger, the part of the correction that is in the
machine, holds the whole units that were output. No remainder is lost, because each cycle starts from the whole
correction again. For pulse insertion the units are encoder counts and, at every instant,

    raw counts + inserted counts = corrected counts.

Sign: inserted counts make the controller believe that the axis is further on, so the axis stops sooner [G 4.2.1]:
`inserted = -correction · counts per µm`. Offsets added to a command have the sign of the correction.

The functions are compiled where numba is installed, and are plain Python elsewhere. `rtec.loop.step_source` writes
the source that calls them for a machine's axes and sensors; it decides nothing.
"""

import math
from typing import Final

from rtec.correction.flags import HOLD_REASONS, MODE_HOLD, MODE_ON, ORDER_MASK, OUTPUT_TROUBLE, OUTPUT_UNCONFIRMED, Flag
from rtec.correction.sinks import DEAD_BAND
from rtec.jit import njit

# Plain integers: the compiler knows no enumerations.
_STALE_COUNTS: Final = int(Flag.STALE_COUNTS)
_STALE_TEMPERATURE: Final = int(Flag.STALE_TEMPERATURE)
_SENSOR_FAULT: Final = int(Flag.SENSOR_FAULT)
_OUT_OF_RANGE: Final = int(Flag.OUT_OF_RANGE)
_OVER_STOP_LIMIT: Final = int(Flag.OVER_STOP_LIMIT)
_OVER_WARNING_LIMIT: Final = int(Flag.OVER_WARNING_LIMIT)
_ORDERED_HOLD: Final = int(Flag.ORDERED_HOLD)
_ORDERED_OFF: Final = int(Flag.ORDERED_OFF)
_FADING: Final = int(Flag.FADING)
_LIMITED: Final = int(Flag.LIMITED)
_SATURATED: Final = int(Flag.OUTPUT_SATURATED)
_HELD: Final = int(Flag.HELD)
_TROUBLE: Final = int(Flag.OUTPUT_TROUBLE)

FOLLOW: Final = 0
"""Decision: move towards the model's request."""
FADE: Final = 1
"""Decision: move towards zero."""
HOLD: Final = 2
"""Decision: brake, and stay at the resulting value."""
WAIT: Final = 3
"""Decision: do not move in this cycle; the actuator has not confirmed the command before."""
STAND: Final = 4
"""Decision: do not move at all; the actuator would not follow."""


@njit
def cycle_s(time_ns: int, last_ns: int, longest_ns: int) -> float:
    """Time, s, that a cycle may use: since the cycle before, at most `longest_ns`, never below zero."""
    return max(0, min(time_ns - last_ns, longest_ns)) * 1e-9


@njit
def not_ahead(time_ns: int, instant_ns: int) -> int:
    """The instant of a reading; one of the future is of another clock, and counts as old as it is ahead."""
    return min(instant_ns, 2 * time_ns - instant_ns)


@njit
def judge_counts(time_ns: int, latched_ns: int, max_age_ns: int) -> int:
    """Flag counts that were latched too long ago."""
    return _STALE_COUNTS if time_ns - not_ahead(time_ns, latched_ns) > max_age_ns else 0


@njit
def judge_range(value: float, low: float, high: float) -> int:
    """Flag a channel outside the range that the model was fitted in. Both ends are inside; a NaN is not flagged."""
    return _OUT_OF_RANGE if value < low or value > high else 0


@njit
def judge_sensor(degc: float, lowest: float, highest: float, fitted_low: float, fitted_high: float) -> int:
    """Flag a temperature, °C, that is unknown (NaN), outside its sensor's range, or outside the fitted range."""
    if math.isnan(degc):
        return _STALE_TEMPERATURE
    if degc < lowest or degc > highest:
        return _SENSOR_FAULT
    return judge_range(degc, fitted_low, fitted_high)


@njit
def judge_spindle(rpm: float, fitted_low: float, fitted_high: float) -> int:
    """Flag a spindle speed, 1/min, that is unknown (NaN) or outside the fitted range."""
    if math.isnan(rpm):
        return _STALE_TEMPERATURE
    return judge_range(rpm, fitted_low, fitted_high)


@njit
def known(reasons: int) -> bool:
    """Whether temperatures and spindle speed with these flags are numbers that the model may use."""
    return (reasons & (_STALE_TEMPERATURE | _SENSOR_FAULT)) == 0


@njit
def judge_age(time_ns: int, oldest_ns: int, max_age_ns: int) -> int:
    """Flag temperatures of which the oldest was acquired too long ago."""
    return _STALE_TEMPERATURE if time_ns - oldest_ns > max_age_ns else 0


@njit
def judge_request(requested_um: float, warning_um: float, stop_um: float) -> int:
    """Flag a correction beyond the warning or the stop limit; a NaN is beyond both."""
    reasons = 0
    if not abs(requested_um) <= warning_um:
        reasons |= _OVER_WARNING_LIMIT
    if not abs(requested_um) <= stop_um:
        reasons |= _OVER_STOP_LIMIT
    return reasons


@njit
def judge_mode(mode: int) -> int:
    """Flag the ordered mode, and an actuator in trouble; `mode` is that of the sample."""
    order = mode & ORDER_MASK
    reasons = 0
    if order >= MODE_HOLD:
        reasons |= _ORDERED_HOLD
    elif order != MODE_ON:
        reasons |= _ORDERED_OFF
    if mode & OUTPUT_TROUBLE:
        reasons |= _TROUBLE
    return reasons


@njit
def decide(reasons: int, mode: int, time_ns: int, held_since_ns: int, fade_after_ns: int) -> tuple[int, int, int]:
    """Decide what the correction does in this cycle.

    The order of precedence: an actuator in trouble (whatever was ordered, nothing moves); an order to fade, which is
    followed with stale inputs, too; every other reason to hold. A hold of more than `fade_after_ns` becomes a fade.
    Every decision waits for the actuator to confirm the command before.

    Args:
        reasons: flags of this cycle so far.
        mode: that of the sample.
        time_ns: instant of the cycle.
        held_since_ns: instant from which the correction is held; 0 where it is not.
        fade_after_ns: longest hold; 0: no limit.

    Returns:
        FOLLOW, FADE, HOLD, WAIT or STAND; the flags, with those of the decision; `held_since_ns` for the next cycle.
    """
    if reasons & _TROUBLE:
        return STAND, reasons | _HELD, held_since_ns if held_since_ns else time_ns
    decision = HOLD
    if reasons & _ORDERED_OFF:
        decision, held_since_ns = FADE, 0
    elif (reasons & HOLD_REASONS) == 0:
        decision, held_since_ns = FOLLOW, 0
    elif held_since_ns == 0:
        held_since_ns = time_ns
    elif fade_after_ns > 0 and time_ns - held_since_ns > fade_after_ns:
        decision, reasons = FADE, reasons | _FADING
    if decision == HOLD:
        reasons |= _HELD
    if mode & OUTPUT_UNCONFIRMED:
        return WAIT, reasons | (0 if decision == HOLD else _LIMITED), held_since_ns
    return decision, reasons, held_since_ns


@njit
def may_command(decision: int) -> bool:
    """Whether the ledger may move, so that there is a new command."""
    return decision < WAIT


@njit
def move(
    decision: int,
    applied_um: float,
    speed_um_s: float,
    requested_um: float,
    dt_s: float,
    stop_um: float,
    slew_um_s: float,
    acceleration_um_s2: float,
) -> tuple[float, float, int]:
    """Move the applied correction of one axis as decided; give it, its speed, and LIMITED while it is on the way.

    After STAND it goes on from rest; after WAIT, with the speed that braking would have given.
    """
    if decision == STAND:
        return applied_um, 0.0, 0
    if decision == WAIT:
        return applied_um, math.copysign(max(0.0, abs(speed_um_s) - acceleration_um_s2 * dt_s), speed_um_s), 0
    goal_um = 0.0 if decision == FADE else requested_um
    applied_um, speed_um_s = guard_update(
        applied_um, speed_um_s, goal_um, decision == HOLD, dt_s, stop_um, slew_um_s, acceleration_um_s2
    )
    return applied_um, speed_um_s, (0 if decision == HOLD or applied_um == goal_um else _LIMITED)


@njit
def within_sink(units: float, output: int, lowest: float, highest: float) -> tuple[float, int]:
    """Limit units of output to the sink's range; flag where they are outside it.

    A ledger `output` that is outside already, as after a reload of a smaller range, never moves further away, and comes
    back as fast as the correction does: the range itself would be a jump.
    """
    if units < lowest or units > highest:
        return min(max(units, min(lowest, output)), max(highest, output)), _SATURATED
    return units, 0


@njit
def guard_update(
    applied: float, speed: float, target: float, hold: bool, dt: float, stop: float, slew: float, acceleration: float
) -> tuple[float, float]:
    """Move the applied correction towards its target for one cycle.

    Args:
        applied: correction now, µm.
        speed: its speed, µm/s.
        target: where it should go, µm; not used while held.
        hold: brake and stay. A correction beyond `stop`, as after a reload of a lower limit, goes to `stop`.
        dt: length of the cycle, s.
        stop, slew, acceleration: limits, µm, µm/s, µm/s².

    Returns:
        applied and speed after the cycle. Speed never exceeds `slew`, changes by at most `acceleration · dt`, and is
        always low enough to come to rest at a constant target; `applied` never exceeds `stop`; where it is
        beyond already, it never moves further away.
    """
    if dt <= 0.0:
        return applied, speed
    change = acceleration * dt
    bound = max(stop, abs(applied))
    wanted, arriving, goal = 0.0, False, applied
    if not hold or bound > stop:
        goal = min(max(applied if hold else target, -stop), stop)
        per_cycle = abs(goal - applied) / dt
        # Braking by `change` a cycle from k·change takes a distance of k(k+1)/2·change. k whole cycles fit; the rest of
        # the distance is divided among the k+1 cycles that it takes.
        wanted = per_cycle
        if per_cycle >= change:
            k = math.floor(0.5 * (math.sqrt(1.0 + 8.0 * per_cycle / change) - 1.0))
            wanted = k * change + (per_cycle - 0.5 * k * (k + 1.0) * change) / (k + 1.0)
        wanted = min(slew, wanted)
        arriving = wanted == per_cycle
        if goal < applied:
            wanted = -wanted
    limited = min(max(wanted, speed - change), speed + change)
    if arriving and limited == wanted:
        return goal, limited
    return min(max(applied + limited * dt, -bound), bound), limited


@njit
def ledger_update(
    wanted: float, output: int, allowance: float, dt: float, quantum: int, rate: float
) -> tuple[int, float]:
    """Move the ledger towards the wanted units for one cycle.

    Args:
        wanted: the applied correction in units, not rounded.
        output: units in the ledger.
        allowance: units that may be output now, accumulated at `rate`.
        dt: length of the cycle, s.
        quantum: smallest step, units (4: whole encoder cycles).
        rate: units per second that the sink and the controller can follow.

    Returns:
        output and allowance after the cycle. Output changes by whole quanta, at most at the rate.
    """
    allowance = min(allowance + rate * dt, quantum + rate * dt)
    left = wanted - output
    if abs(left) <= DEAD_BAND * quantum:
        return output, allowance
    steps = math.floor(abs(left) / quantum + 0.5)
    moved = min(steps, math.floor(allowance / quantum)) * quantum
    return output + (moved if left > 0.0 else -moved), allowance - moved
