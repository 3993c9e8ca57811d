"""Puts rtec into a copy of somebody's HAL files, and shows the difference; the files themselves are not touched.

Each axis' command signal is cut behind LinuxCNC's `motor-pos-cmd`, its feedback signal before `motor-pos-fb`, and HAL's
component `offset` is put in between. Everything else stays to the letter.

    python -m rtec_drivers.linuxcnc.patch mine/mill.ini mine-rtec --joints X=0,Y=1,Z=2 --socket /run/rtec/cnc.sock
"""

import argparse
import difflib
import re
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rtec.errors import ConfigError, RtecError

ARROWS = ("=>", "<=", "<=>")
INI_HALFILE = re.compile(r"^\s*HALFILE\s*=\s*(\S+)\s*$", re.MULTILINE)
THREAD = re.compile(r"^\s*addf\s+motion-controller\s+(\S+)", re.MULTILINE)


@dataclass(frozen=True)
class RtecWiring:
    """What is to be put in.

    Attributes:
        joints: number of the joint by axis name, in the machine's order.
        bridge: path of the bridge's program.
        socket: path of its socket.
        sensors: HAL signal by temperature sensor; a sensor without one gets a pin that is still to be wired ("").
        unit_um: one unit of output, µm.
        most_mm: furthest correction, mm.
        slew_mm_s, acceleration_mm_s2: HAL's own limits.
    """

    joints: Mapping[str, int]
    bridge: Path
    socket: Path
    sensors: Mapping[str, str]
    unit_um: float = 0.01
    most_mm: float = 0.2
    slew_mm_s: float = 0.4
    acceleration_mm_s2: float = 20.0


def patched_copy(ini: Path, folder: Path, wiring: RtecWiring) -> str:
    """Copy the folder of an INI file, put rtec into the copy's HAL files, and give the difference.

    Args:
        ini: the user's INI file.
        folder: of the copy; must not be there yet.
        wiring: what is put in.

    Raises:
        ConfigError: a file is not there or not understood; nothing is then left of the copy.
    """
    if folder.exists():
        raise ConfigError(f"{folder}: is there already; choose another folder for the copy")
    try:
        names = INI_HALFILE.findall(ini.read_text(encoding="utf-8"))
        own = [n for n in names if n.startswith("LIB:") or n.endswith(".tcl")]
        if own:
            raise ConfigError(
                f"{ini}: HALFILE = {own[0]}: copy it beside the INI file as a .hal file first, and name that one"
            )
        there = {name: ini.parent / name for name in names if (ini.parent / name).is_file()}
        files = {name: path.read_text(encoding="utf-8") for name, path in there.items()}
    except (OSError, UnicodeDecodeError) as e:
        raise ConfigError(f"{ini}: cannot be read: {e}") from e
    changed = patched(files, wiring, str(ini))
    shutil.copytree(ini.parent, folder, symlinks=True)
    for name, text in changed.items():
        (folder / name).write_text(text, encoding="utf-8")
    return "".join(
        line
        for name, text in changed.items()
        for line in difflib.unified_diff(
            files[name].splitlines(keepends=True), text.splitlines(keepends=True), f"a/{name}", f"b/{name}"
        )
    )


def patched(files: Mapping[str, str], wiring: RtecWiring, source: str) -> dict[str, str]:
    """Give the HAL files with rtec in them, by name.

    Raises:
        ConfigError: a joint's command or feedback is in none of them, or no line adds the motion controller.
    """
    lines = {name: text.splitlines() for name, text in files.items()}
    for name, text in files.items():
        taken = re.search(r"^\s*loadrt\s+(sampler|offset|limit3)\b|\brtec\b", text, re.MULTILINE)
        if taken:
            raise ConfigError(
                f"{source}: {name} has {taken[0].strip()!r} already: wire rtec by hand (docs/linuxcnc.md)"
            )
    for axis, joint in wiring.joints.items():
        _cut(lines, axis.lower(), joint, source)
    home = next((name for name, text in files.items() if THREAD.search(text)), None)
    if home is None:
        raise ConfigError(f"{source}: no HAL file has `addf motion-controller THREAD`: the thread is not known")
    match = THREAD.search(files[home])
    thread = match[1] if match else ""
    k = next(i for i, line in enumerate(lines[home]) if THREAD.match(line))
    first = next(i for i, line in enumerate(lines[home]) if re.match(r"\s*addf\s+motion-", line))
    lines[home] = [
        *lines[home][:first],
        *_loads(wiring, thread),
        *lines[home][first : k + 1],
        *_after_motion(wiring, thread),
        *lines[home][k + 1 :],
    ]
    last = list(lines)[-1]
    lines[last] += _nets(wiring, thread)
    return {name: "\n".join(text) + "\n" for name, text in lines.items()}


def _cut(lines: dict[str, list[str]], axis: str, joint: int, source: str) -> None:
    """Put `offset` between LinuxCNC's motion and the drive."""
    command, feedback = f"joint.{joint}.motor-pos-cmd", f"joint.{joint}.motor-pos-fb"
    signals = {pin: _signal(lines, pin, source) for pin in (command, feedback)}
    for text in lines.values():
        for i, line in enumerate(text):
            words = line.split("#")[0].split()
            if words[:1] != ["net"] or words[1] not in signals.values():
                continue
            pins = [w for w in words[2:] if w not in ARROWS]
            out = []
            if command in pins:
                out.append(f"net {words[1]} {command} => rtec-offset-{axis}.in")
            rest = [p for p in pins if p not in (command, feedback)]
            if words[1] == signals[command]:
                to = [*rest, *([f"rtec-offset-{axis}.fb-in"] if feedback in pins else [])]
                out += [f"net rtec-{axis}-drive-cmd rtec-offset-{axis}.out => {' '.join(to)}"] if to else []
            else:
                to = [*rest, *([f"rtec-offset-{axis}.fb-in"] if feedback in pins else [])]
                out.append(f"net {words[1]} {' '.join(to)}")
            if feedback in pins:
                out.append(f"net rtec-{axis}-fb rtec-offset-{axis}.fb-out => {feedback}")
            text[i] = "\n".join(out)


def _signal(lines: Mapping[str, Sequence[str]], pin: str, source: str) -> str:
    for text in lines.values():
        for line in text:
            words = line.split("#")[0].split()
            if words[:1] == ["net"] and pin in words[2:]:
                return words[1]
    raise ConfigError(f"{source}: no HAL file has a `net` line with {pin}; wire that axis by hand (docs/linuxcnc.md)")


def _loads(wiring: RtecWiring, thread: str) -> list[str]:
    axes = [a.lower() for a in wiring.joints]
    sensors = f" --sensors {','.join(wiring.sensors)}" if wiring.sensors else ""
    return [
        "# ---- rtec: components, and what is done before LinuxCNC's motion",
        f"loadrt limit3 names={','.join(f'rtec-limit-{a}' for a in axes)}",
        f"loadrt offset names={','.join(f'rtec-offset-{a}' for a in axes)}",
        f"loadrt sampler depth=4000 cfg={'f' * len(axes)}bb",
        f"loadusr -Wn rtec /usr/bin/python3 {wiring.bridge} --socket {wiring.socket} --axes {','.join(wiring.joints)}"
        f"{sensors} --unit-um {wiring.unit_um:g} --max-um {1e3 * wiring.most_mm:g}",
        *(f"addf rtec-offset-{a}.update-feedback {thread}" for a in axes),
        "# ---- end of rtec",
    ]


def _after_motion(wiring: RtecWiring, thread: str) -> list[str]:
    return [
        "# ---- rtec: what is done after LinuxCNC's motion",
        *(
            line
            for a in (axis.lower() for axis in wiring.joints)
            for line in (f"addf rtec-limit-{a} {thread}", f"addf rtec-offset-{a}.update-output {thread}")
        ),
        f"addf sampler.0 {thread}",
        "# ---- end of rtec",
    ]


def _nets(wiring: RtecWiring, thread: str) -> list[str]:
    del thread
    out = ["# ---- rtec: its pins"]
    for k, (axis, joint) in enumerate(wiring.joints.items()):
        a = axis.lower()
        out += [
            f"setp rtec-limit-{a}.maxv {wiring.slew_mm_s:g}",
            f"setp rtec-limit-{a}.maxa {wiring.acceleration_mm_s2:g}",
            f"setp rtec-limit-{a}.min {-wiring.most_mm:g}",
            f"setp rtec-limit-{a}.max {wiring.most_mm:g}",
            f"net rtec-{a}-correction rtec.offset-{a} => rtec-limit-{a}.in",
            f"net rtec-{a}-correction-limited rtec-limit-{a}.out => rtec-offset-{a}.offset",
            f"net rtec-{a}-pos joint.{joint}.pos-fb => sampler.0.pin.{k}",
        ]
    n = len(wiring.joints)
    out += [
        f"net rtec-homed motion.is-all-homed => sampler.0.pin.{n}",
        f"net rtec-on motion.motion-enabled => sampler.0.pin.{n + 1}",
        "net rtec-rpm spindle.0.speed-out => rtec.spindle-rpm",
    ]
    for sensor, signal in wiring.sensors.items():
        out.append(f"net {signal} => rtec.{sensor}" if signal else f"# net YOUR-SIGNAL => rtec.{sensor}   (°C)")
    return [*out, "# ---- end of rtec"]


def main(words: Sequence[str]) -> int:
    """Make the copy and print the difference; 2 where that cannot be."""
    parser = argparse.ArgumentParser(
        prog="python -m rtec_drivers.linuxcnc.patch",
        description="Copies a LinuxCNC configuration, puts rtec into the copy's HAL files, and prints the difference.",
    )
    parser.add_argument("ini", type=Path, help="your INI file; it is not touched")
    parser.add_argument("folder", type=Path, help="folder of the copy")
    parser.add_argument("--joints", required=True, help="axes of the machine file with their joints: X=0,Z=1")
    parser.add_argument("--socket", type=Path, required=True, help="the bridge's socket, as the run file names it")
    parser.add_argument(
        "--sensors", default="", help="sensors with their HAL signals: T_bed=t-bed; T_x= is wired later"
    )
    told = parser.parse_args(words)
    try:
        joints = {a: int(n) for a, _, n in (w.partition("=") for w in told.joints.split(","))}
    except ValueError:
        parser.error("--joints: write AXIS=NUMBER, as X=0,Z=1")
    sensors = {s: pin for s, _, pin in (w.partition("=") for w in told.sensors.split(",") if w)}
    bridge = Path(__file__).with_name("bridge.py")
    try:
        difference = patched_copy(told.ini, told.folder, RtecWiring(joints, bridge, told.socket, sensors))
    except RtecError as e:
        sys.stderr.write(f"{e}\n")
        return 2
    sys.stdout.write(difference)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
