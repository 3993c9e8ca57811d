"""Writes the source of one cycle: counts and temperatures in, correction out, for one machine and model structure.

It is the model's kernel followed by guard and ledger, in one function over n samples. The loop calls it with n = 1,
a replay with many, so both run the same machine code. All numbers that a user can change (limits, coefficients,
ranges) come in as arrays; only sizes and channel indices are written into the source.

The source decides nothing: the functions of `rtec.correction.guard` decide whether and how far a correction may move.
In its templates below, `{name}` lines are replaced by blocks of lines and `<name>` by words.
"""

from dataclasses import dataclass

from rtec.loop.records import NEVER_NS
from rtec.machine import Machine
from rtec.machine.machine import CONSTANT_CHANNELS
from rtec.model.kernel.write import EXTRA_ARRAYS, KernelSource

IMPORTS = """
from rtec.correction.guard import (
    cycle_s, decide, judge_age, judge_counts, judge_mode, judge_range, judge_request, judge_sensor, judge_spindle,
    known, may_command, move, not_ahead, within_sink,
)
from rtec.correction.guard import ledger_update
from rtec.effects.derived import direction_update, lag_update, motion_update, reversal_update, since_reversal
from rtec.model.kernel.build import sin_cos


"""

SENSOR = """\
slow_why[0] |= judge_sensor(degc[n, {s}], s_low[{s}], s_high[{s}], u_low[{s}], u_high[{s}])
oldest[0] = min(oldest[0], not_ahead(t, degc_time_ns[n, {s}]))
"""

SPINDLE = "slow_why[0] |= judge_spindle(spindle_rpm[n], u_low[{s}], u_high[{s}])"

CONSTANT = "slow_why[0] |= judge_range(constants[{i}], u_low[{s}], u_high[{s}])"

RANGE = "why |= judge_range({x}[a], {x}_low[a], {x}_high[a])"

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

# Counts with the same stamp bring no new motion.
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
            started[0] = int(counts_time_ns[n] != <never>)  # the first counts are no motion
            last[0] = t
        dt = cycle_s(t, last[0], longest[0])
        last[0] = t

        # Fresh and in range?
        why = judge_mode(mode[n]) | judge_counts(t, counts_time_ns[n], max_age[0])
        for a in range(<axes>):
            q[a] = counts[n, a] / counts_per_mm[a]
            {turning}
            why |= judge_range(q[a], q_low[a], q_high[a])
        {motion}
        {ranges}
        # Temperatures are judged when one has a new instant; the result holds until the next.
        changed = ready[0] == 0
        {news}
        if changed:
            slow_why[0] = 0
            oldest[0] = t
            {sensors}
            {spindle}
            {constant}
            if known(slow_why[0]):
                {keep}
                slow_part(m, p, u, (t - slow_at[0]) * 1e-9, ready[0] == 0)
                ready[0] = 1
                slow_at[0] = t
        why |= slow_why[0]
        {age}
        if ready[0] == 1:
            tip = fast_part(m, <arrays>)
            {request}
            for a in <active>:
                why |= judge_request(target[a], warning[a], stop[a])

        # Guard and ledger, each axis.
        decision, why, held_at[0] = decide(why, mode[n], t, held_at[0], fade[0])
        for a in <active>:
            now[a], speed[a], limited = move(
                decision, now[a], speed[a], target[a], dt, stop[a], slew[a], acceleration[a]
            )
            why |= limited
            if may_command(decision) and t >= due[a]:
                due[a] = t + period[a]
                units, saturated = within_sink(now[a] * per_um[a], out[a], lowest[a], highest[a])
                why |= saturated
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
    """Names for consecutive parts of one array."""

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
    """Source of the step, and the places of its numbers in the arrays.

    Attributes:
        text: functions `slow_part`, `fast_part`, `step`.
        memory: text that identifies the meaning of the state: the model's kernel, and the places.
        numbers: constants, floats: parameters, scales, limits, ranges.
        times: constants, integers: ages and periods in ns.
        floats, ints: the state.
    """

    text: str
    memory: str
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
    memory = "\n".join([kernel.text, *floats.lines("f"), *ints.lines("i")])
    return StepSource(text, memory, numbers, times, floats, ints)


def _step_lines(machine: Machine, kernel: KernelSource, places: list[Places]) -> list[str]:
    names = [line for part, array in zip(places, "ckfi", strict=True) for line in part.lines(array)]
    spindle = len(machine.sensors)
    keep = [f"degc_at[{s}] = degc_time_ns[n, {s}]" for s in kernel.sensors]
    keep += [f"u[{s}] = degc[n, {s}]" for s in kernel.sensors]
    keep += [f"u[{spindle}] = spindle_rpm[n]"] if kernel.uses_spindle else []
    constants = {machine.slow_channels.index(c): CONSTANT_CHANNELS.index(c) for c in kernel.constants}
    keep += [f"u[{at}] = constants[{i}]" for at, i in constants.items()]
    active = [i for i, axis in enumerate(machine.axes) if axis.compensate]
    # Exclusive or: the result is zero where no time has changed; a handful of instructions for all sensors together.
    differ = [f"(degc_time_ns[n, {s}] ^ degc_at[{s}])" for s in kernel.sensors]
    news = [f"changed |= ({' | '.join(differ)}) != 0"] if differ else []
    news += [f"changed |= spindle_rpm[n] != u[{spindle}]"] if kernel.uses_spindle else []
    request = [f"target[{i}] = -tip[{'XYZ'.index(machine.axes[i].direction)}]" for i in active]
    blocks = {
        "names": names,
        "news": news,
        "sensors": [line for s in kernel.sensors for line in SENSOR.format(s=s).splitlines()],
        "spindle": [SPINDLE.format(s=spindle)] if kernel.uses_spindle else [],
        "constant": [CONSTANT.format(s=at, i=i) for at, i in constants.items()],
        "turning": TURNING_SINCE if "since" in kernel.arrays else TURNING,
        "motion": MOTION if kernel.moving else [],
        "ranges": _ranges([name for name in kernel.arrays if name in EXTRA_ARRAYS]),
        # Only sensors age: a model without any would else hold for ever once its first cycle is old enough.
        "age": ["why |= judge_age(t, oldest[0], max_age[1])"] if kernel.sensors else [],
        "keep": keep,
        "request": request,
    }
    words = {
        "axes": str(len(machine.axes)),
        "never": str(NEVER_NS),
        "active": f"({', '.join(map(str, active))},)",
        "moving": f"({', '.join(map(str, kernel.moving))},)",
        "arrays": ", ".join(kernel.arrays),
    }
    return _filled(STEP, blocks, words)


def _ranges(names: list[str]) -> list[str]:
    """Lines that compare each of these arrays with the model's range, axis by axis; none of these can be a NaN here."""
    lines = [f"    {RANGE.format(x=name)}" for name in names]
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
