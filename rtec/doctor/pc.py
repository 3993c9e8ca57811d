"""Is this computer fit for real time? Its shortcomings, and how to mend them.

In this order: the kernel, the kind of computer, its clock, swap; the loop's processor (is it reserved, its idle
states, its speed, its firmware); the user's rights (real-time priority, locked memory).

All of it is read from /proc and /sys below a root folder: `/` in use, an artificial tree in tests. A missing file
reads as None.
"""

import os
import pwd
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rtec.doctor.found import PcFinding, PcFound
from rtec.doctor.wakeup import WakeUps, judged, measured
from rtec.errors import DriverUnavailable
from rtec.loop.run_file import Realtime, RunFile
from rtec.tomlfile import read_kind, validated

CAP_IPC_LOCK, CAP_SYS_NICE = 14, 23
"""Bits of CapEff in /proc/PID/status (capabilities(7))."""
UNLIMITED = -1
SMI_COUNT = 0x34
"""MSR_SMI_COUNT of Intel processors (Software Developer's Manual, volume 4)."""


@dataclass(frozen=True)
class Pc:
    """This computer's files.

    Attributes:
        root: folder above them.
    """

    root: Path = Path("/")

    def text(self, path: str) -> str | None:
        """Content of a small file without surrounding white space; None where it cannot be read."""
        try:
            return (self.root / path).read_text(encoding="utf-8", errors="replace").strip()
        except OSError:
            return None

    def number(self, path: str) -> int | None:
        """Content of a file with one integer."""
        text = self.text(path)
        try:
            return int(text) if text is not None else None
        except ValueError:
            return None

    def folders(self, path: str) -> list[Path]:
        """Sorted entries of a folder; empty where it cannot be read."""
        try:
            return sorted((self.root / path).iterdir())
        except OSError:
            return []

    def inside(self, path: Path) -> str:
        """A path of `folders` as an argument of the other methods."""
        return str(path.relative_to(self.root))

    def processors(self, path: str) -> list[int] | None:
        """A list of processors in the kernel's notation, "0-2,7"; None where it is missing or not understood."""
        text = self.text(path)
        return None if text is None else processor_list(text)

    def allowed(self) -> list[int]:
        """Processors that this process may run on."""
        return processor_list(self.status("Cpus_allowed_list") or "") or []

    def status(self, key: str) -> str | None:
        """An entry of /proc/self/status."""
        for line in (self.text("proc/self/status") or "").splitlines():
            name, _, value = line.partition(":")
            if name == key:
                return value.strip()
        return None

    def capable(self, bit: int) -> bool | None:
        """Has this process a capability?"""
        text = self.status("CapEff")
        try:
            return None if text is None else bool(int(text, 16) >> bit & 1)
        except ValueError:
            return None

    def limit(self, name: str) -> int | None:
        """Soft limit of this process, by its name in /proc/self/limits; `UNLIMITED` for none."""
        for line in (self.text("proc/self/limits") or "").splitlines():
            if line.startswith(name):
                soft = line.removeprefix(name).split()[:1]
                return _number(soft[0]) if soft else None
        return None

    def smi_count(self, processor: int) -> int | None:
        """System management interrupts since power on, from the counter of an Intel processor.

        Needs root and the kernel module msr; None without.
        """
        try:
            with (self.root / f"dev/cpu/{processor}/msr").open("rb", buffering=0) as file:
                file.seek(SMI_COUNT)
                data = file.read(8)
        except OSError:
            return None
        return int.from_bytes(data[:4], "little") if len(data) == 8 else None


def _number(text: str) -> int | None:
    if text == "unlimited":
        return UNLIMITED
    return int(text) if text.isdigit() else None


def processor_list(text: str) -> list[int] | None:
    """Numbers of a list such as "0-2,7"; None where the text is no list."""
    out: list[int] = []
    try:
        for part in (p for p in text.split(",") if p.strip()):
            first, _, last = part.partition("-")
            out += range(int(first), int(last or first) + 1)
    except ValueError:
        return None
    return out


def as_list(numbers: list[int]) -> str:
    """Text such as "0-2,7"; the inverse of `processor_list`."""
    runs: list[list[int]] = []
    for n in sorted(set(numbers)):
        if runs and n == runs[-1][1] + 1:
            runs[-1][1] = n
        else:
            runs.append([n, n])
    return ",".join(str(a) if a == b else f"{a}-{b}" for a, b in runs)


GOOD_CLOCKS = ("tsc", "arch_sys_counter", "kvm-clock", "hyperv_clocksource_tsc_page", "riscv_clocksource")
"""Clock sources that are read within some ten ns without a system call."""
RT_PACKAGE = {
    "debian": "sudo apt install linux-image-rt-$(dpkg --print-architecture), then restart with that kernel",
    "ubuntu": "sudo pro enable realtime-kernel, then restart",
    "fedora": "a kernel with PREEMPT_RT of your choice; Fedora has none of its own",
    "rhel": "sudo dnf install kernel-rt, then restart",
}


def kernel(pc: Pc) -> PcFinding:
    """Is the kernel PREEMPT_RT?"""
    version = pc.text("proc/version")
    if version is None:
        return PcFinding("kernel", "/proc/version cannot be read", "unknown")
    release = pc.text("proc/sys/kernel/osrelease") or version.split(" ")[2 if version.count(" ") > 2 else 0]
    if "PREEMPT_RT" in version or pc.text("sys/kernel/realtime") == "1":
        return PcFinding("kernel", f"{release}, PREEMPT_RT", "good")
    kind = next((k for k in ("PREEMPT_DYNAMIC", "PREEMPT") if k in version), "no PREEMPT_RT")
    why = "an ordinary kernel is good for 1 kHz on most PCs; PREEMPT_RT has the shorter worst case"
    known = re.findall(r"^ID(?:_LIKE)?=\"?([^\"\n]*)", pc.text("etc/os-release") or "", re.MULTILINE)
    names = [name for line in known for name in line.split()]
    how = next((RT_PACKAGE[n] for n in names if n in RT_PACKAGE), "install the PREEMPT_RT kernel of your distribution")
    return PcFinding("kernel", f"{release}, {kind}", "better", why, commands=(how,))


def host(pc: Pc) -> PcFinding:
    """Is it a real computer, a virtual one, or a container?"""
    cpuinfo = pc.text("proc/cpuinfo")
    if cpuinfo is None:
        return PcFinding("computer", "/proc/cpuinfo cannot be read", "unknown")
    model = re.search(r"^(?:model name|Model|Hardware)\s*:\s*(.+)$", cpuinfo, re.MULTILINE)
    name = model[1].strip() if model else "processor of unknown kind"
    virtual = bool(re.search(r"^flags\s*:.*\bhypervisor\b", cpuinfo, re.MULTILINE))
    inside = (["a container"] if _container(pc) else []) + (["a virtual machine"] if virtual else [])
    if not inside:
        return PcFinding("computer", name, "good")
    why = "a virtual machine runs when its host lets it" if virtual else "limits and devices are what it was given"
    return PcFinding("computer", f"{name}; {' in '.join(inside)}", "better", why)


def clock_source(pc: Pc) -> PcFinding:
    """Clock source of the kernel."""
    place = "sys/devices/system/clocksource/clocksource0"
    current = pc.text(f"{place}/current_clocksource")
    if current is None:
        return PcFinding("clock source", "not to be read here", "unknown")
    if current in GOOD_CLOCKS:
        return PcFinding("clock source", current, "good")
    why = f"reading {current} takes microseconds each time; the kernel prefers tsc where it trusts it"
    return PcFinding("clock source", current, "better", why, commands=("sudo dmesg | grep -i tsc   # why not tsc?",))


def swap(pc: Pc, memory_is_locked: bool) -> PcFinding:
    """Is there swap? Memory on a disk is slow."""
    text = pc.text("proc/swaps")
    if text is None:
        return PcFinding("swap", "/proc/swaps cannot be read", "unknown")
    places = [line.split()[0] for line in text.splitlines()[1:] if line.strip()]
    if not places:
        return PcFinding("swap", "none", "good")
    if memory_is_locked:
        return PcFinding("swap", f"{', '.join(places)}; the loop's memory is locked, so it is not swapped", "good")
    why = "memory that was swapped out is read back from the disk in the middle of a cycle"
    off = ("sudo swapoff -a   # and its lines out of /etc/fstab",)
    return PcFinding("swap", ", ".join(places), "better", why, commands=off)


def _container(pc: Pc) -> bool:
    groups = pc.text("proc/1/cgroup") or ""
    marks = (pc.root / ".dockerenv", pc.root / "run/.containerenv", pc.root / "run/systemd/container")
    return any(m.exists() for m in marks) or bool(re.search(r"docker|lxc|kubepods|containerd", groups))


CPU = "sys/devices/system/cpu"
SHALLOW_US = 20
"""Exit latency, µs; a deeper idle state shows in the loop's wake-ups."""


def loops_processor(pc: Pc, realtime: Realtime) -> int | None:
    """The loop's processor: the one in the run file, else the last allowed one."""
    allowed = pc.allowed()
    if realtime.cpu is not None:
        return realtime.cpu
    return allowed[-1] if allowed else None


def isolation(pc: Pc, realtime: Realtime) -> PcFinding:
    """Does the loop have a processor of its own?"""
    topic, ours = "own processor", loops_processor(pc, realtime)
    online, isolated = pc.processors(f"{CPU}/online"), pc.processors(f"{CPU}/isolated")
    if ours is None or online is None or isolated is None:
        return PcFinding(topic, "not to be read here", "unknown")
    if ours not in online:
        how = (f"[realtime] cpu: one of {as_list(online)}",)
        return PcFinding(topic, f"there is no processor {ours}; there are {as_list(online)}", "wrong", commands=how)
    if ours in isolated:
        return PcFinding(topic, f"{ours}, isolated", "good")
    if len(online) == 1:
        return PcFinding(topic, "there is only one processor", "better", "everything else runs on the loop's processor")
    why = "other programs and interrupts run on the loop's processor"
    if isolated:
        how = (f"[realtime] cpu = {isolated[-1]} in the run file",)
        return PcFinding(topic, f"{as_list(isolated)} isolated, but the loop takes {ours}", "better", why, commands=how)
    last = online[-1]
    others = as_list([n for n in online if n != last])
    words = (f"isolcpus=managed_irq,domain,{last}", f"nohz_full={last}", f"rcu_nocbs={last}", f"irqaffinity={others}")
    how = (f"[realtime] cpu = {last} in the run file",)
    return PcFinding(
        topic, f"{ours} of {as_list(online)}, shared with all others", "better", why, kernel=words, commands=how
    )


def idle_states(pc: Pc, realtime: Realtime) -> PcFinding:
    """How deeply may the loop's processor sleep?"""
    topic, ours = "idle states", loops_processor(pc, realtime)
    states = []
    for folder in pc.folders(f"{CPU}/cpu{ours}/cpuidle"):
        place = pc.inside(folder)
        latency_us, off = pc.number(f"{place}/latency"), pc.number(f"{place}/disable")
        if latency_us is not None and not off:
            states.append((latency_us, pc.text(f"{place}/name") or folder.name))
    if not states:
        return PcFinding(topic, "not to be read here", "unknown")
    deepest_us, name = max(states)
    if deepest_us <= SHALLOW_US:
        return PcFinding(topic, f"deepest {name}, {deepest_us} µs to wake up", "good")
    return PcFinding(
        topic,
        f"deepest {name}, {deepest_us} µs to wake up",
        "better",
        "a processor that sleeps deeply wakes up late",
        kernel=("processor.max_cstate=1", "intel_idle.max_cstate=1") if _intel(pc) else ("processor.max_cstate=1",),
        commands=(f"sudo cpupower idle-set -D {SHALLOW_US}   # at once, until the next start",),
    )


def governor(pc: Pc, realtime: Realtime) -> PcFinding:
    """Does the processor run at full speed?"""
    topic, ours = "speed governor", loops_processor(pc, realtime)
    setting = pc.text(f"{CPU}/cpu{ours}/cpufreq/scaling_governor")
    if setting is None:
        return PcFinding(topic, "not to be read here", "unknown")
    if setting == "performance":
        return PcFinding(topic, setting, "good")
    how = ("sudo cpupower frequency-set -g performance   # Debian: package linux-cpupower",)
    return PcFinding(topic, setting, "better", "after an idle moment the processor first runs slowly", commands=how)


def firmware(pc: Pc, before: int | None, after: int | None, seconds: float) -> PcFinding:
    """System management interrupts during the measurement of the wake-ups."""
    topic = "firmware (SMI)"
    if before is None or after is None:
        why = "" if _intel(pc) else "only Intel processors count them"
        how = "sudo modprobe msr, then sudo rtec doctor" if _intel(pc) else ""
        return PcFinding(topic, "count not to be read here", "unknown", why, commands=(how,) if how else ())
    if after == before:
        return PcFinding(topic, f"no interrupt in {seconds:g} s", "good")
    why = "the firmware stops all processors without the kernel knowing, for up to milliseconds"
    how = "firmware set-up (BIOS): legacy USB support, power and fan management off; then measure again"
    return PcFinding(topic, f"{after - before} interrupts in {seconds:g} s", "better", why, commands=(how,))


def _intel(pc: Pc) -> bool:
    return "GenuineIntel" in (pc.text("proc/cpuinfo") or "")


HIGHEST = 98
ENOUGH_BYTES = 4 * 2**30
"""Limit of locked memory, bytes, that is enough: all maps of the process count, libraries too."""
LOG_IN = "log out and in again, or restart the service; `ulimit -r -l` shows the limits"


def priority(pc: Pc, realtime: Realtime, user: str) -> PcFinding:
    """May this user have a SCHED_FIFO priority?"""
    topic = "real-time priority"
    if not realtime.priority:
        return PcFinding(
            topic, "[realtime] priority = 0: not asked for", "better", "any other program may hold up the loop"
        )
    throttle = pc.number("proc/sys/kernel/sched_rt_runtime_us")
    if throttle == 0:
        how = ("sudo sysctl kernel.sched_rt_runtime_us=950000",)
        return PcFinding(topic, "kernel.sched_rt_runtime_us is 0: none for anybody", "wrong", commands=how)
    if pc.capable(CAP_SYS_NICE):
        return PcFinding(topic, f"{realtime.priority} allowed (CAP_SYS_NICE)", "good")
    limit = pc.limit("Max realtime priority")
    if limit is None:
        return PcFinding(topic, "/proc/self/limits cannot be read", "unknown")
    if limit == UNLIMITED or limit >= realtime.priority:
        return PcFinding(
            topic, f"{realtime.priority} allowed (limit {limit if limit != UNLIMITED else 'none'})", "good"
        )
    return PcFinding(
        topic,
        f"not allowed: limit {limit}, the loop asks for {realtime.priority}",
        "wrong",
        "any other program may hold up the loop",
        limits=(f"{user} - rtprio {HIGHEST}",),
        unit=(f"LimitRTPRIO={HIGHEST}",),
        commands=(LOG_IN,),
    )


def locked_memory(pc: Pc, realtime: Realtime, user: str) -> PcFinding:
    """May this user keep memory from being swapped?"""
    topic = "locked memory"
    if not realtime.lock_memory:
        why = "a page that is not in memory is fetched in the middle of a cycle"
        return PcFinding(topic, "[realtime] lock_memory = false: not asked for", "better", why)
    if pc.capable(CAP_IPC_LOCK):
        return PcFinding(topic, "allowed (CAP_IPC_LOCK)", "good")
    limit = pc.limit("Max locked memory")
    if limit is None:
        return PcFinding(topic, "/proc/self/limits cannot be read", "unknown")
    if limit == UNLIMITED or limit >= ENOUGH_BYTES:
        return PcFinding(
            topic, "allowed (no limit)" if limit == UNLIMITED else f"allowed up to {limit / 2**30:.1f} GiB", "good"
        )
    return PcFinding(
        topic,
        f"not allowed: limit {limit / 2**20:.0f} MiB, too little for all of the loop's memory",
        "wrong",
        "a page that is not in memory is fetched in the middle of a cycle",
        limits=(f"{user} - memlock unlimited",),
        unit=("LimitMEMLOCK=infinity",),
        commands=(LOG_IN,),
    )


DEFAULT_RATE_HZ = 1000.0
Tell = Callable[[int, int], None]
Measure = Callable[[Realtime, float, float, Tell], WakeUps]


def wanted_of(path: Path | None) -> tuple[Realtime, float]:
    """Real-time settings and cycles a second of a run file; without one the defaults.

    Raises:
        ConfigError: the run file is at fault.
    """
    if path is None:
        return Realtime(), DEFAULT_RATE_HZ
    file = validated(RunFile, read_kind(path, "a run file"), str(path))
    return file.realtime, file.run.rate_hz


def look_at(
    realtime: Realtime,
    rate_hz: float,
    seconds: float,
    tell: Tell = lambda _done, _of: None,
    pc: Pc | None = None,
    measure: Measure = measured,
) -> PcFound:
    """Examine this computer and measure its wake-ups.

    Args:
        realtime: the loop's real-time settings.
        rate_hz: cycles a second.
        seconds: duration of the measurement of wake-ups.
        tell: called with the amount done, and the total.
        pc: this computer's files.
        measure: measures the wake-ups.
    """
    pc = pc or Pc()
    ours = loops_processor(pc, realtime)
    before = None if ours is None else pc.smi_count(ours)
    wake_ups = _wake_ups(measure, realtime, rate_hz, seconds, tell)
    after = None if ours is None else pc.smi_count(ours)
    user = _user()
    locked = locked_memory(pc, realtime, user)
    return PcFound(
        (
            wake_ups,
            priority(pc, realtime, user),
            locked,
            isolation(pc, realtime),
            idle_states(pc, realtime),
            governor(pc, realtime),
            firmware(pc, before, after, seconds),
            kernel(pc),
            host(pc),
            clock_source(pc),
            swap(pc, realtime.lock_memory and locked.state == "good"),
        )
    )


def _wake_ups(measure: Measure, realtime: Realtime, rate_hz: float, seconds: float, tell: Tell) -> PcFinding:
    try:
        return judged(measure(realtime, rate_hz, seconds, tell), rate_hz)
    except DriverUnavailable as e:
        return PcFinding("wake-ups", str(e), "unknown")


def _user() -> str:
    try:
        return pwd.getpwuid(os.geteuid()).pw_name
    except KeyError:  # a container may run as a user without a name
        return str(os.geteuid())
