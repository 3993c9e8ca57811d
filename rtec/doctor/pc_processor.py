"""The processor that the loop runs on: is it its own, how deeply it sleeps, its speed, its firmware."""

from rtec.doctor.pc_found import Finding
from rtec.doctor.pc_read import Pc, as_list
from rtec.loop.run_file import Realtime

CPU = "sys/devices/system/cpu"
SHALLOW_US = 20
"""Waking from deeper than this is seen in the loop's wake-ups."""


def loops_processor(pc: Pc, wanted: Realtime) -> int | None:
    """The processor that the loop will stay on: the one asked for, else the last of those allowed."""
    allowed = pc.allowed()
    if wanted.cpu is not None:
        return wanted.cpu
    return allowed[-1] if allowed else None


def isolation(pc: Pc, wanted: Realtime) -> Finding:
    """Does the loop have a processor of its own?"""
    topic, ours = "own processor", loops_processor(pc, wanted)
    online, isolated = pc.processors(f"{CPU}/online"), pc.processors(f"{CPU}/isolated")
    if ours is None or online is None or isolated is None:
        return Finding(topic, "not to be read here", "unknown")
    if ours not in online:
        how = (f"[realtime] cpu: one of {as_list(online)}",)
        return Finding(topic, f"there is no processor {ours}; there are {as_list(online)}", "wrong", commands=how)
    if ours in isolated:
        return Finding(topic, f"{ours}, isolated", "good")
    if len(online) == 1:
        return Finding(topic, "there is only one processor", "better", "everything else runs on the loop's processor")
    why = "other programs and interrupts run on the loop's processor"
    if isolated:
        how = (f"[realtime] cpu = {isolated[-1]} in the run file",)
        return Finding(topic, f"{as_list(isolated)} isolated, but the loop takes {ours}", "better", why, commands=how)
    last = online[-1]
    others = as_list([n for n in online if n != last])
    words = (f"isolcpus=managed_irq,domain,{last}", f"nohz_full={last}", f"rcu_nocbs={last}", f"irqaffinity={others}")
    how = (f"[realtime] cpu = {last} in the run file",)
    return Finding(
        topic, f"{ours} of {as_list(online)}, shared with all others", "better", why, kernel=words, commands=how
    )


def idle_states(pc: Pc, wanted: Realtime) -> Finding:
    """How deeply may the loop's processor sleep?"""
    topic, ours = "idle states", loops_processor(pc, wanted)
    states = []
    for folder in pc.folders(f"{CPU}/cpu{ours}/cpuidle"):
        place = pc.inside(folder)
        latency_us, off = pc.number(f"{place}/latency"), pc.number(f"{place}/disable")
        if latency_us is not None and not off:
            states.append((latency_us, pc.text(f"{place}/name") or folder.name))
    if not states:
        return Finding(topic, "not to be read here", "unknown")
    deepest_us, name = max(states)
    if deepest_us <= SHALLOW_US:
        return Finding(topic, f"deepest {name}, {deepest_us} µs to wake up", "good")
    return Finding(
        topic,
        f"deepest {name}, {deepest_us} µs to wake up",
        "better",
        "a processor that sleeps deeply wakes up late",
        kernel=("processor.max_cstate=1", "intel_idle.max_cstate=1") if _intel(pc) else ("processor.max_cstate=1",),
        commands=(f"sudo cpupower idle-set -D {SHALLOW_US}   # at once, until the next start",),
    )


def governor(pc: Pc, wanted: Realtime) -> Finding:
    """Does the processor run at full speed?"""
    topic, ours = "speed governor", loops_processor(pc, wanted)
    found = pc.text(f"{CPU}/cpu{ours}/cpufreq/scaling_governor")
    if found is None:
        return Finding(topic, "not to be read here", "unknown")
    if found == "performance":
        return Finding(topic, found, "good")
    how = ("sudo cpupower frequency-set -g performance   # Debian: package linux-cpupower",)
    return Finding(topic, found, "better", "after an idle moment the processor first runs slowly", commands=how)


def firmware(pc: Pc, before: int | None, after: int | None, seconds: float) -> Finding:
    """System management interrupts while the wake-ups were measured."""
    topic = "firmware (SMI)"
    if before is None or after is None:
        why = "" if _intel(pc) else "only Intel processors count them"
        how = "sudo modprobe msr, then sudo rtec doctor" if _intel(pc) else ""
        return Finding(topic, "count not to be read here", "unknown", why, commands=(how,) if how else ())
    if after == before:
        return Finding(topic, f"no interrupt in {seconds:g} s", "good")
    why = "the firmware stops all processors without the kernel knowing, for up to milliseconds"
    how = "firmware set-up (BIOS): legacy USB support, power and fan management off; then measure again"
    return Finding(topic, f"{after - before} interrupts in {seconds:g} s", "better", why, commands=(how,))


def _intel(pc: Pc) -> bool:
    return "GenuineIntel" in (pc.text("proc/cpuinfo") or "")
