"""Is a computer fit for real time? Oracles: made-up /proc and /sys trees."""

import json
from pathlib import Path

import pytest

from rtec.doctor.found import PcFinding, PcFound
from rtec.doctor.pc import UNLIMITED, Pc, as_list, look_at, processor_list, wanted_of
from rtec.doctor.wakeup import WakeUps
from rtec.errors import DriverUnavailable
from rtec.loop.run_file import Realtime
from rtec.report.devices import pc_page
from tests.support import setups

PROCESSOR = "sys/devices/system/cpu"
LIMITS = """\
Limit                     Soft Limit           Hard Limit           Units
Max open files            1024                 1048576              files
Max locked memory         {memory:<20} {memory:<20} bytes
Max realtime priority     {priority:<20} {priority:<20}
"""
GOOD = {
    "proc/version": "Linux version 6.12.9-rt-amd64 (x@y) (gcc) #1 SMP PREEMPT_RT Debian 6.12.9-1",
    "proc/sys/kernel/osrelease": "6.12.9-rt-amd64",
    "proc/sys/kernel/sched_rt_runtime_us": "950000",
    "proc/cpuinfo": "vendor_id\t: GenuineIntel\nmodel name\t: Intel(R) Core(TM) i5-6500TE\nflags\t\t: fpu tsc msr",
    "proc/self/status": "Name:\tx\nCapEff:\t0000000000000000\nCpus_allowed_list:\t0-3",
    "proc/self/limits": LIMITS.format(memory="unlimited", priority=98),
    "proc/swaps": "Filename\tType\tSize\tUsed\tPriority",
    "etc/os-release": 'PRETTY_NAME="Debian GNU/Linux 12"\nID=debian\n',
    f"{PROCESSOR}/online": "0-3",
    f"{PROCESSOR}/isolated": "3",
    f"{PROCESSOR}/cpu3/cpuidle/state0/name": "POLL",
    f"{PROCESSOR}/cpu3/cpuidle/state0/latency": "0",
    f"{PROCESSOR}/cpu3/cpuidle/state0/disable": "0",
    f"{PROCESSOR}/cpu3/cpuidle/state1/name": "C1",
    f"{PROCESSOR}/cpu3/cpuidle/state1/latency": "2",
    f"{PROCESSOR}/cpu3/cpuidle/state1/disable": "0",
    f"{PROCESSOR}/cpu3/cpuidle/state2/name": "C6",
    f"{PROCESSOR}/cpu3/cpuidle/state2/latency": "890",
    f"{PROCESSOR}/cpu3/cpuidle/state2/disable": "1",
    f"{PROCESSOR}/cpu3/cpufreq/scaling_governor": "performance",
    "sys/devices/system/clocksource/clocksource0/current_clocksource": "tsc",
}
POOR = {
    **GOOD,
    "proc/version": "Linux version 6.1.0-18-amd64 (x@y) (gcc) #1 SMP PREEMPT_DYNAMIC Debian 6.1.76-1",
    "proc/sys/kernel/osrelease": "6.1.0-18-amd64",
    "proc/self/limits": LIMITS.format(memory=8388608, priority=0),
    "proc/swaps": "Filename\tType\tSize\tUsed\tPriority\n/dev/sda3 partition 1000 0 -2",
    f"{PROCESSOR}/isolated": "",
    f"{PROCESSOR}/cpu3/cpuidle/state2/disable": "0",
    f"{PROCESSOR}/cpu3/cpufreq/scaling_governor": "powersave",
    "sys/devices/system/clocksource/clocksource0/current_clocksource": "hpet",
}
WELL = WakeUps(3000, 5.0, 9.0, 14.0, 31.0, 0, "")


def tree(root: Path, files: dict[str, str]) -> Pc:
    """A computer with these files."""
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n", encoding="utf-8")
    return Pc(root)


def smi_register(root: Path, processor: int, count: int) -> None:
    """A file as the msr module gives it: register n at offset n; the count in the lower 32 bits of 0x34."""
    path = root / f"dev/cpu/{processor}/msr"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(bytes(0x34) + count.to_bytes(4, "little") + b"\xff" * 4)


def found_in(pc: Pc, wanted: Realtime | None = None, wake_ups: WakeUps = WELL) -> PcFound:
    return look_at(wanted or Realtime(), 1000.0, 3.0, pc=pc, measure=lambda *_: wake_ups)


def by_topic(found: PcFound) -> dict[str, PcFinding]:
    return {f.topic: f for f in found.findings}


def test_a_computer_that_is_fit(tmp_path: Path) -> None:
    smi_register(tmp_path, 3, 7)
    found = found_in(tree(tmp_path, GOOD))
    assert {f.topic: f.state for f in found.findings} == dict.fromkeys(by_topic(found), "good")
    assert len(found.findings) == 11
    assert found.well
    assert pc_page(found).lead == "This computer: fit for real time."
    told = {t: f.found for t, f in by_topic(found).items()}
    assert told["own processor"] == "3, isolated"
    assert told["idle states"] == "deepest C1, 2 µs to wake up"  # C6 is there, and switched off
    assert told["kernel"] == "6.12.9-rt-amd64, PREEMPT_RT"
    assert [found.lines(where) for where in ("limits", "unit", "kernel", "commands")] == [[], [], [], []]


def test_a_computer_that_is_not_says_how_it_becomes_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rtec.doctor.pc._user", lambda: "anna")
    found = found_in(tree(tmp_path, POOR))
    states = {t: f.state for t, f in by_topic(found).items()}
    assert states == {
        "wake-ups": "good",
        "real-time priority": "wrong",
        "locked memory": "wrong",
        "own processor": "better",
        "idle states": "better",
        "speed governor": "better",
        "firmware (SMI)": "unknown",
        "kernel": "better",
        "computer": "good",
        "clock source": "better",
        "swap": "better",
    }
    assert not found.well
    assert found.lines("limits") == ["anna - rtprio 98", "anna - memlock unlimited"]
    assert found.lines("unit") == ["LimitRTPRIO=98", "LimitMEMLOCK=infinity"]
    assert found.lines("kernel") == [
        "isolcpus=managed_irq,domain,3",
        "nohz_full=3",
        "rcu_nocbs=3",
        "irqaffinity=0-2",
        "processor.max_cstate=1",
        "intel_idle.max_cstate=1",
    ]
    page = pc_page(found)
    assert page.lead == "This computer: not fit for real time yet: real-time priority, locked memory."
    how = page.sections[-1].text
    assert how[0] == "into /etc/security/limits.d/rtec.conf:\n    anna - rtprio 98\n    anna - memlock unlimited"
    assert "sudo cpupower frequency-set -g performance   # Debian: package linux-cpupower" in how
    assert "sudo modprobe msr, then sudo rtec doctor" in how
    assert how[-1].splitlines()[-1].startswith('    GRUB_CMDLINE_LINUX="isolcpus=managed_irq,domain,3 ')


@pytest.mark.parametrize("files", [{}, dict.fromkeys(GOOD, "\x00garbage"), dict.fromkeys(GOOD, "")])
def test_what_cannot_be_read_is_said_and_does_not_raise(tmp_path: Path, files: dict[str, str]) -> None:
    found = found_in(tree(tmp_path, files))
    assert len(found.findings) == 11
    if not files:
        assert {f.state for f in found.findings if f.topic != "wake-ups"} == {"unknown"}
    pc_page(found)
    json.dumps(found.plain())


@pytest.mark.parametrize(
    ("change", "topic", "state", "part"),
    [
        (
            {"proc/self/status": "CapEff:\t0000000000800000\nCpus_allowed_list:\t0-3"},
            "real-time priority",
            "good",
            "SYS",
        ),
        ({"proc/self/status": "CapEff:\t0000000000004000\nCpus_allowed_list:\t0-3"}, "locked memory", "good", "IPC"),
        ({"proc/sys/kernel/sched_rt_runtime_us": "0"}, "real-time priority", "wrong", "none for anybody"),
        ({"proc/self/status": "Cpus_allowed_list:\t0-1"}, "own processor", "better", "the loop takes 1"),
        ({f"{PROCESSOR}/online": "0-1"}, "own processor", "wrong", "there is no processor 3; there are 0-1"),
        ({f"{PROCESSOR}/isolated": "2-3"}, "own processor", "good", "3, isolated"),
        ({"sys/kernel/realtime": "1", "proc/version": "Linux version 5.4 SMP PREEMPT"}, "kernel", "good", "PREEMPT_RT"),
        ({"proc/1/cgroup": "0::/docker/abc"}, "computer", "better", "a container"),
        ({"proc/cpuinfo": "flags\t: fpu hypervisor"}, "computer", "better", "a virtual machine"),
        ({"proc/swaps": "Filename\n/dev/sda3 partition"}, "swap", "good", "the loop's memory is locked"),
    ],
)
def test_one_thing_changed(tmp_path: Path, change: dict[str, str], topic: str, state: str, part: str) -> None:
    """Against the computer that is fit. Bits of CapEff by capabilities(7): 14 IPC_LOCK, 23 SYS_NICE."""
    rights = LIMITS.format(memory=65536, priority=0) if "CapEff" in change.get("proc/self/status", "") else None
    files = {**GOOD, **({"proc/self/limits": rights} if rights else {}), **change}
    finding = by_topic(found_in(tree(tmp_path, files)))[topic]
    assert finding.state == state
    assert part in finding.found


def test_what_the_run_file_asks_for(tmp_path: Path) -> None:
    pc = tree(tmp_path, POOR)
    found = by_topic(found_in(pc, Realtime(priority=0, lock_memory=False, cpu=7)))
    assert [found[t].state for t in ("real-time priority", "locked memory")] == ["better", "better"]
    assert found["own processor"].found == "there is no processor 7; there are 0-3"
    path = setups.write(tmp_path, {**setups.tables(tmp_path), "realtime": {"priority": 11, "cpu": 2}})
    assert wanted_of(path) == (Realtime(priority=11, cpu=2), 1000.0)
    assert wanted_of(None) == (Realtime(), 1000.0)


def test_firmware_interrupts_while_measuring(tmp_path: Path) -> None:
    """Oracle: the register goes from 7 to 9 in the meantime."""
    pc = tree(tmp_path, GOOD)
    smi_register(tmp_path, 3, 7)

    def meanwhile(*_: object) -> WakeUps:
        smi_register(tmp_path, 3, 9)
        return WELL

    finding = by_topic(look_at(Realtime(), 1000.0, 3.0, pc=pc, measure=meanwhile))["firmware (SMI)"]
    assert (finding.state, finding.found) == ("better", "2 interrupts in 3 s")
    assert pc.smi_count(3) == 9  # the upper half of the register is reserved


def test_a_measurement_that_fails_is_said(tmp_path: Path) -> None:
    def fails(*_: object) -> WakeUps:
        raise DriverUnavailable("the measurement of wake-ups failed (exit status 1)")

    found = look_at(Realtime(), 1000.0, 3.0, pc=tree(tmp_path, GOOD), measure=fails)
    assert (found.findings[0].state, found.well) == ("unknown", True)


@pytest.mark.parametrize(
    ("text", "numbers"), [("0-2,7", [0, 1, 2, 7]), ("", []), ("5", [5]), ("0-x", None), ("a", None)]
)
def test_lists_of_processors(text: str, numbers: list[int] | None) -> None:
    assert processor_list(text) == numbers
    if numbers is not None:
        assert as_list(numbers) == text


def test_limits_are_read_as_the_kernel_writes_them(tmp_path: Path) -> None:
    """Oracle: this process' own limits, by the system call."""
    import resource

    soft = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    assert Pc().limit("Max open files") == (UNLIMITED if soft == resource.RLIM_INFINITY else soft)
    assert Pc(tmp_path).limit("Max open files") is None
    tree(tmp_path, {"proc/self/limits": "Max open files many\nMax locked memory"})
    assert Pc(tmp_path).limit("Max open files") is Pc(tmp_path).limit("Max locked memory") is None
