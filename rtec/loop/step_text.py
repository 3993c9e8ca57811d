"""The text of one cycle in pieces, for `kernel.py` to put together: `{name}` lines are blocks, `<name>` words."""

IMPORTS = """
from rtec.correction.guard import guard_update
from rtec.correction.ledger import ledger_update
from rtec.effects.derived import direction_update, lag_update, motion_update, reversal_update, since_reversal
from rtec.model.kernel.build import sin_cos


"""

SENSOR = """\
value = degc[n, {s}]
oldest[0] = min(oldest[0], degc_time_ns[n, {s}])
if value != value:
    slow_why[0] |= 2
    broken = True
elif value < s_low[{s}] or value > s_high[{s}]:
    slow_why[0] |= 4
    broken = True
elif value < u_low[{s}] or value > u_high[{s}]:
    slow_why[0] |= 8
"""

SPINDLE = """\
value = spindle_rpm[n]
if value != value:
    slow_why[0] |= 2
    broken = True
elif value < u_low[{s}] or value > u_high[{s}]:
    slow_why[0] |= 8
"""

CONSTANT = """\
if constants[{i}] < u_low[{s}] or constants[{i}] > u_high[{s}]:
    slow_why[0] |= 8
"""

RANGE = """\
if {x}[a] < {x}_low[a] or {x}[a] > {x}_high[a]:
    why |= 8
"""

TURNING = """\
if first:
    extreme[a] = q[a]
d[a], extreme[a] = direction_update(d[a], extreme[a], q[a], dead_band[a])
""".splitlines()

TURNING_SINCE = """\
if first:
    extreme[a] = q[a]
    turn[a] = math.inf
d[a], extreme[a], turn[a] = reversal_update(d[a], extreme[a], turn[a], q[a], dead_band[a])
since[a] = since_reversal(extreme[a], turn[a])
""".splitlines()

# By the stamps of the counts; a stamp that comes again leaves its motion to the next.
MOTION = """\
gone_s = (counts_time_ns[n] - motion_at[0]) * 1e-9
if first or gone_s > 0.0:
    motion_at[0] = counts_time_ns[n]
    for a in <moving>:
        if not first:
            vel[a], acc[a] = motion_update(vel[a], acc[a], q[a] - motion_q[a], gone_s, motion_filter[0])
        motion_q[a] = q[a]
""".splitlines()

STEP = '''
@njit
def step(
    time_ns, mode, counts_time_ns, counts, degc, degc_time_ns, spindle_rpm,
    requested_um, applied_um, output, flags, c, k, f, i,
):
    """One cycle a sample: constants `c`, `k`; state `f`, `i`, changed in place."""
    {names}
    for n in range(len(time_ns)):
        t = time_ns[n]
        first = started[0] == 0
        if first:
            started[0] = 1
            last[0] = t
        dt = max(0, min(t - last[0], longest[0])) * 1e-9
        last[0] = t

        # Fresh and in range?
        why = 0
        if t - counts_time_ns[n] > max_age[0]:
            why |= 1
        for a in range(<axes>):
            q[a] = counts[n, a] / counts_per_mm[a]
            {turning}
            if q[a] < q_low[a] or q[a] > q_high[a]:
                why |= 8
        {motion}
        {ranges}
        # Temperatures are looked at when one has a new instant; what was found then stands until the next.
        changed = ready[0] == 0
        {news}
        if changed:
            slow_why[0] = 0
            oldest[0] = t
            broken = False
            {sensors}
            {spindle}
            {constant}
            if not broken:
                {keep}
                slow_part(m, p, u, (t - slow_at[0]) * 1e-9, ready[0] == 0)
                ready[0] = 1
                slow_at[0] = t
        why |= slow_why[0]
        {age}
        order = mode[n]
        if ready[0] == 1:
            tip = fast_part(m, <arrays>)
            {wanted}
            for a in <active>:
                size = abs(target[a])
                if not size <= warning[a]:
                    why |= 32
                if not size <= stop[a]:
                    why |= 16

        # Hold, fade, off?
        if order >= 2:
            why |= 64
        elif order != 1:
            why |= 128
        hold = (why & <hold>) != 0 and (why & 128) == 0
        to_zero = (why & 128) != 0
        if not hold:
            held_at[0] = 0
        elif held_at[0] == 0:
            held_at[0] = t
        elif fade[0] > 0 and t - held_at[0] > fade[0]:
            why |= 256
            hold = False
            to_zero = True
        if hold:
            why |= 2048

        # Guard and ledger, each axis.
        for a in <active>:
            goal = 0.0 if to_zero else target[a]
            now[a], speed[a] = guard_update(
                now[a], speed[a], goal, hold, dt, stop[a], slew[a], acceleration[a]
            )
            if not hold and now[a] != goal:
                why |= 512
            if t >= due[a]:
                due[a] = t + period[a]
                units = now[a] * per_um[a]
                if units < lowest[a] or units > highest[a]:
                    units = min(max(units, lowest[a]), highest[a])
                    why |= 1024
                out[a], allowance[a] = ledger_update(
                    units, out[a], allowance[a], dt, quantum[a], rate[a]
                )
        for a in range(<axes>):
            requested_um[n, a] = target[a]
            applied_um[n, a] = now[a]
            output[n, a] = out[a]
        flags[n] = why
'''
