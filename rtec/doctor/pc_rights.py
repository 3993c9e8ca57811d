"""What this user may ask of the kernel: a real-time priority, locked memory."""

from rtec.doctor.pc_found import Finding
from rtec.doctor.pc_read import CAP_IPC_LOCK, CAP_SYS_NICE, UNLIMITED, Pc
from rtec.loop.run_file import Realtime

HIGHEST = 98
ENOUGH_BYTES = 4 * 2**30
"""Everything that the process maps counts against the limit, libraries too; a small limit refuses it all."""
LOG_IN = "log out and in again, or start the service anew; `ulimit -r -l` shows the limits"


def priority(pc: Pc, wanted: Realtime, user: str) -> Finding:
    """May this user have a SCHED_FIFO priority?"""
    topic = "real-time priority"
    if not wanted.priority:
        return Finding(
            topic, "[realtime] priority = 0: not asked for", "better", "any other program may hold up the loop"
        )
    throttle = pc.number("proc/sys/kernel/sched_rt_runtime_us")
    if throttle == 0:
        how = ("sudo sysctl kernel.sched_rt_runtime_us=950000",)
        return Finding(topic, "kernel.sched_rt_runtime_us is 0: none for anybody", "wrong", commands=how)
    if pc.capable(CAP_SYS_NICE):
        return Finding(topic, f"{wanted.priority} allowed (CAP_SYS_NICE)", "good")
    limit = pc.limit("Max realtime priority")
    if limit is None:
        return Finding(topic, "/proc/self/limits cannot be read", "unknown")
    if limit == UNLIMITED or limit >= wanted.priority:
        return Finding(topic, f"{wanted.priority} allowed (limit {limit if limit != UNLIMITED else 'none'})", "good")
    return Finding(
        topic,
        f"not allowed: limit {limit}, the loop asks for {wanted.priority}",
        "wrong",
        "any other program may hold up the loop",
        limits=(f"{user} - rtprio {HIGHEST}",),
        unit=(f"LimitRTPRIO={HIGHEST}",),
        commands=(LOG_IN,),
    )


def locked_memory(pc: Pc, wanted: Realtime, user: str) -> Finding:
    """May this user keep memory from being swapped?"""
    topic = "locked memory"
    if not wanted.lock_memory:
        why = "a page that is not in memory is fetched in the middle of a cycle"
        return Finding(topic, "[realtime] lock_memory = false: not asked for", "better", why)
    if pc.capable(CAP_IPC_LOCK):
        return Finding(topic, "allowed (CAP_IPC_LOCK)", "good")
    limit = pc.limit("Max locked memory")
    if limit is None:
        return Finding(topic, "/proc/self/limits cannot be read", "unknown")
    if limit == UNLIMITED or limit >= ENOUGH_BYTES:
        return Finding(
            topic, "allowed (no limit)" if limit == UNLIMITED else f"allowed up to {limit / 2**30:.1f} GiB", "good"
        )
    return Finding(
        topic,
        f"not allowed: limit {limit / 2**20:.0f} MiB, too little for all of the loop's memory",
        "wrong",
        "a page that is not in memory is fetched in the middle of a cycle",
        limits=(f"{user} - memlock unlimited",),
        unit=("LimitMEMLOCK=infinity",),
        commands=(LOG_IN,),
    )
