"""The kernel, what the computer is, its clock, swap."""

import re

from rtec.doctor.pc_found import Finding
from rtec.doctor.pc_read import Pc

GOOD_CLOCKS = ("tsc", "arch_sys_counter", "kvm-clock", "hyperv_clocksource_tsc_page", "riscv_clocksource")
"""Read within some ten ns without leaving the program."""
RT_PACKAGE = {
    "debian": "sudo apt install linux-image-rt-$(dpkg --print-architecture), then restart with that kernel",
    "ubuntu": "sudo pro enable realtime-kernel, then restart",
    "fedora": "a kernel with PREEMPT_RT of your choice; Fedora has none of its own",
    "rhel": "sudo dnf install kernel-rt, then restart",
}


def kernel(pc: Pc) -> Finding:
    """PREEMPT_RT or not."""
    version = pc.text("proc/version")
    if version is None:
        return Finding("kernel", "/proc/version cannot be read", "unknown")
    release = pc.text("proc/sys/kernel/osrelease") or version.split(" ")[2 if version.count(" ") > 2 else 0]
    if "PREEMPT_RT" in version or pc.text("sys/kernel/realtime") == "1":
        return Finding("kernel", f"{release}, PREEMPT_RT", "good")
    kind = next((k for k in ("PREEMPT_DYNAMIC", "PREEMPT") if k in version), "no PREEMPT_RT")
    why = "an ordinary kernel is good for 1 kHz on most PCs; PREEMPT_RT has the shorter worst case"
    known = re.findall(r"^ID(?:_LIKE)?=\"?([^\"\n]*)", pc.text("etc/os-release") or "", re.MULTILINE)
    names = [name for line in known for name in line.split()]
    how = next((RT_PACKAGE[n] for n in names if n in RT_PACKAGE), "install the PREEMPT_RT kernel of your distribution")
    return Finding("kernel", f"{release}, {kind}", "better", why, commands=(how,))


def host(pc: Pc) -> Finding:
    """A real computer, a virtual one, a container."""
    cpuinfo = pc.text("proc/cpuinfo")
    if cpuinfo is None:
        return Finding("computer", "/proc/cpuinfo cannot be read", "unknown")
    model = re.search(r"^(?:model name|Model|Hardware)\s*:\s*(.+)$", cpuinfo, re.MULTILINE)
    name = model[1].strip() if model else "processor of unknown kind"
    virtual = bool(re.search(r"^flags\s*:.*\bhypervisor\b", cpuinfo, re.MULTILINE))
    inside = (["a container"] if _container(pc) else []) + (["a virtual machine"] if virtual else [])
    if not inside:
        return Finding("computer", name, "good")
    why = "a virtual machine runs when its host lets it" if virtual else "limits and devices are what it was given"
    return Finding("computer", f"{name}; {' in '.join(inside)}", "better", why)


def clock_source(pc: Pc) -> Finding:
    """Which counter the kernel's clock reads."""
    place = "sys/devices/system/clocksource/clocksource0"
    current = pc.text(f"{place}/current_clocksource")
    if current is None:
        return Finding("clock source", "not to be read here", "unknown")
    if current in GOOD_CLOCKS:
        return Finding("clock source", current, "good")
    why = f"reading {current} takes microseconds each time; the kernel prefers tsc where it trusts it"
    return Finding("clock source", current, "better", why, commands=("sudo dmesg | grep -i tsc   # why not tsc?",))


def swap(pc: Pc, memory_is_locked: bool) -> Finding:
    """Memory on a disk is late."""
    text = pc.text("proc/swaps")
    if text is None:
        return Finding("swap", "/proc/swaps cannot be read", "unknown")
    places = [line.split()[0] for line in text.splitlines()[1:] if line.strip()]
    if not places:
        return Finding("swap", "none", "good")
    if memory_is_locked:
        return Finding("swap", f"{', '.join(places)}; the loop's memory is locked, so it is not swapped", "good")
    why = "memory that was swapped out is read back from the disk in the middle of a cycle"
    off = ("sudo swapoff -a   # and its lines out of /etc/fstab",)
    return Finding("swap", ", ".join(places), "better", why, commands=off)


def _container(pc: Pc) -> bool:
    groups = pc.text("proc/1/cgroup") or ""
    marks = (pc.root / ".dockerenv", pc.root / "run/.containerenv", pc.root / "run/systemd/container")
    return any(m.exists() for m in marks) or bool(re.search(r"docker|lxc|kubepods|containerd", groups))
