"""Writes the source of one cycle: counts and temperatures in, correction out, for one machine and model structure.

It is the model's kernel with guard and ledger behind it, in one function over n samples; the loop calls it with
n = 1, replay with n = many, so that both are the same machine code. All numbers that a user can change (limits,
coefficients, ranges) come in as arrays; only sizes and channel indices are written into the text.

The text of one cycle in pieces, for `kernel.py` to put together: `{name}` lines are blocks, `<name>` words.
"""

from dataclasses import dataclass

from rtec.correction.guard import HOLD_REASONS
from rtec.machine import Machine
from rtec.machine.machine import CONSTANT_CHANNELS
from rtec.model.kernel.write import EXTRA_ARRAYS, KernelSource

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


class Places:
    """Names for parts of one array, laid one behind the other."""

    def __init__(self, **sizes: int) -> None:
        self.at: dict[str, slice] = {}
        start = 0
        for name, size in sizes.items():
            self.at[name] = slice(start, start + size)
            start += size
        self.size = start

    def lines(self, array: str) -> list[str]:
        """Assignments that give each part a name."""
        return [f"{name} = {array}[{s.start}:{s.stop}]" for name, s in self.at.items()]


@dataclass(frozen=True)
class StepSource:
    """Text of the step, and where things lie in its arrays.

    Attributes:
        text: functions `slow_part`, `fast_part`, `step`.
        numbers: constants, floats: parameters, scales, limits, ranges.
        times: constants, integers: ages and periods in ns.
        floats, ints: the state.
    """

    text: str
    numbers: Places
    times: Places
    floats: Places
    ints: Places


def write_step(machine: Machine, kernel: KernelSource, parameters: int) -> StepSource:
    """Write the step for a machine and the kernel of its model."""
    a, s, slow = len(machine.axes), len(machine.sensors), len(machine.slow_channels)
    since = "since" in kernel.arrays
    extra = {f"{name}_{end}": a for name in kernel.arrays if name in EXTRA_ARRAYS for end in ("low", "high")}
    motion = {"motion_q": a, "vel": a, "acc": a} if kernel.moving else {}
    numbers = Places(
        p=parameters, counts_per_mm=a, dead_band=a, warning=a, stop=a, slew=a, acceleration=a,
        per_um=a, quantum=a, rate=a, lowest=a, highest=a,
        q_low=a, q_high=a, u_low=slow, u_high=slow, s_low=s, s_high=s,
        constants=len(CONSTANT_CHANNELS), motion_filter=1, **extra,
    )  # fmt: skip
    times = Places(max_age=2, fade=1, longest=1, period=a)
    floats = Places(
        m=kernel.memory, q=a, d=a, extreme=a, u=slow, target=a, now=a, speed=a, allowance=a,
        **motion, **({"turn": a, "since": a} if since else {}),
    )  # fmt: skip
    ints = Places(
        started=1, last=1, ready=1, slow_at=1, slow_why=1, oldest=1, held_at=1, degc_at=s, out=a, due=a,
        **({"motion_at": 1} if kernel.moving else {}),
    )  # fmt: skip
    text = "\n".join([IMPORTS + kernel.text, "", *_step_lines(machine, kernel, [numbers, times, floats, ints]), ""])
    return StepSource(text, numbers, times, floats, ints)


def _step_lines(machine: Machine, kernel: KernelSource, places: list[Places]) -> list[str]:
    names = [line for part, array in zip(places, "ckfi", strict=True) for line in part.lines(array)]
    spindle = len(machine.sensors)
    keep = [f"degc_at[{s}] = degc_time_ns[n, {s}]" for s in kernel.sensors]
    keep += [f"u[{s}] = degc[n, {s}]" for s in kernel.sensors]
    keep += [f"u[{spindle}] = spindle_rpm[n]"] if kernel.uses_spindle else []
    constants = {machine.slow_channels.index(c): CONSTANT_CHANNELS.index(c) for c in kernel.constants}
    keep += [f"u[{at}] = constants[{i}]" for at, i in constants.items()]
    active = [i for i, axis in enumerate(machine.axes) if axis.compensate]
    # Exclusive or: nothing but zeros means nothing new, in a handful of instructions for all sensors together.
    differ = [f"(degc_time_ns[n, {s}] ^ degc_at[{s}])" for s in kernel.sensors]
    news = [f"changed |= ({' | '.join(differ)}) != 0"] if differ else []
    news += [f"changed |= spindle_rpm[n] != u[{spindle}]"] if kernel.uses_spindle else []
    wanted = [f"target[{i}] = -tip[{'XYZ'.index(machine.axes[i].direction)}]" for i in active]
    blocks = {
        "names": names,
        "news": news,
        "sensors": [line for s in kernel.sensors for line in SENSOR.format(s=s).splitlines()],
        "spindle": SPINDLE.format(s=spindle).splitlines() if kernel.uses_spindle else [],
        "constant": [x for at, i in constants.items() for x in CONSTANT.format(s=at, i=i).splitlines()],
        "turning": TURNING_SINCE if "since" in kernel.arrays else TURNING,
        "motion": MOTION if kernel.moving else [],
        "ranges": _ranges([name for name in kernel.arrays if name in EXTRA_ARRAYS]),
        # Only sensors age: a model without any would else hold for ever once its first cycle is old enough.
        "age": ["if t - oldest[0] > max_age[1]:", "    why |= 2"] if kernel.sensors else [],
        "keep": keep,
        "wanted": wanted,
    }
    words = {
        "axes": str(len(machine.axes)),
        "active": f"({', '.join(map(str, active))},)",
        "moving": f"({', '.join(map(str, kernel.moving))},)",
        "hold": str(HOLD_REASONS),
        "arrays": ", ".join(kernel.arrays),
    }
    return _filled(STEP, blocks, words)


def _ranges(names: list[str]) -> list[str]:
    """Lines that compare each of these arrays with the model's range, axis by axis; a NaN never gets in here."""
    lines = [f"    {line}" for name in names for line in RANGE.format(x=name).splitlines()]
    return ["for a in range(<axes>):", *lines] if lines else []


def _filled(template: str, blocks: dict[str, list[str]], words: dict[str, str]) -> list[str]:
    """Put blocks of lines in place of `{name}` lines, at their indentation, and words in place of `<name>`."""
    out = []
    for line in template.splitlines():
        name = line.strip()[1:-1]
        if line.strip() == f"{{{name}}}" and name in blocks:
            indent = line[: len(line) - len(line.lstrip())]
            out += [indent + inner for inner in blocks[name]]
        else:
            out.append(line)
    text = "\n".join(out)
    for word, replacement in words.items():
        text = text.replace(f"<{word}>", replacement)
    return text.splitlines()
