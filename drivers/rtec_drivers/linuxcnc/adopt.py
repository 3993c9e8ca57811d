"""The first files for a machine that LinuxCNC runs already, from its INI file: `rtec init --controller linuxcnc`.

rtec is put into a copy of the user's HAL files; the files themselves are not changed. Each axis' command signal is cut
after LinuxCNC's `motor-pos-cmd`, its feedback signal before `motor-pos-fb`, and HAL's component `offset` is put in
between. Everything else stays unchanged.
"""

import difflib
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rtec.errors import ConfigError

ARROWS = ("=>", "<=", "<=>")
INI_HALFILE = re.compile(r"^\s*HALFILE\s*=\s*(\S+)\s*$", re.MULTILINE)
LIBRARY = Path("/usr/share/linuxcnc/hallib")
"""LinuxCNC's own HAL files; an INI file names them with or without "LIB:"."""
MM_PER_INCH = 25.4
THREAD = re.compile(r"^\s*addf\s+motion-controller\s+(\S+)", re.MULTILINE)


@dataclass(frozen=True)
class RtecWiring:
    """The parts to put in.

    Attributes:
        joints: number of the joint by axis name, in the machine's order.
        bridge: path of the bridge's program.
        socket: path of its socket.
        sensors: HAL signal by temperature sensor; a sensor without one ("") gets a pin that is still to be wired.
        unit_um: one unit of output, µm.
        most_mm: largest correction, mm.
        slew_mm_s, acceleration_mm_s2: HAL's own limits.
        inch: LinuxCNC's LINEAR_UNITS.
    """

    joints: Mapping[str, int]
    bridge: Path
    socket: Path
    sensors: Mapping[str, str]
    unit_um: float = 0.01
    most_mm: float = 0.2
    slew_mm_s: float = 0.4
    acceleration_mm_s2: float = 20.0
    inch: bool = False


def patched_copy(ini: Path, folder: Path, wiring: RtecWiring) -> str:
    """Copy the folder of an INI file, put rtec into the copy's HAL files, and give the difference.

    Args:
        ini: the user's INI file.
        folder: path of the copy; must not exist yet.
        wiring: parts to put in.

    Raises:
        ConfigError: a file is missing or not understood; the copy is then removed.
    """
    if folder.exists():
        raise ConfigError(f"{folder}: is there already; choose another folder for the copy")
    try:
        ini_text = ini.read_text(encoding="utf-8")
        files = {p.name: p.read_text(encoding="utf-8") for p in _hal_files(ini, INI_HALFILE.findall(ini_text))}
    except (OSError, UnicodeDecodeError) as e:
        raise ConfigError(f"{ini}: cannot be read: {e}") from e
    changed = patched(files, wiring, str(ini))
    shutil.copytree(ini.parent, folder, symlinks=True)
    _own_links(ini.parent.resolve(), folder)
    for name, text in changed.items():
        if text != files[name]:
            (folder / name).write_text(text, encoding="utf-8")
            ini_text = re.sub(
                rf"^(\s*HALFILE\s*=\s*)LIB:{re.escape(name)}\s*$", rf"\g<1>{name}", ini_text, flags=re.MULTILINE
            )
    (folder / ini.name).write_text(ini_text, encoding="utf-8")
    return "".join(
        line
        for name, text in changed.items()
        for line in difflib.unified_diff(
            files[name].splitlines(keepends=True), text.splitlines(keepends=True), f"a/{name}", f"b/{name}"
        )
    )


def _own_links(source: Path, folder: Path) -> None:
    """Replace links to files by copies, so that nothing is written through them; other links stay."""
    for link in [p for p in folder.rglob("*") if p.is_symlink()]:
        target = (source / link.relative_to(folder)).resolve()
        link.unlink()
        if target.is_file():
            shutil.copy(target, link)
        elif target.exists():
            link.symlink_to(target)


def _hal_files(ini: Path, names: Sequence[str]) -> list[Path]:
    """The HAL files of an INI file, its own or LinuxCNC's, in their order.

    Raises:
        ConfigError: one of them cannot be changed in a copy.
    """
    out = []
    for name in names:
        plain = name.removeprefix("LIB:")
        if name.endswith(".tcl"):
            raise ConfigError(
                f"{ini}: HALFILE = {name}: a Tcl script; wire rtec by hand behind it (docs/linuxcnc.md, Wire it)"
            )
        if Path(plain).name != plain:
            raise ConfigError(f"{ini}: HALFILE = {name}: it is in another folder; put it beside the INI file first")
        places = [p / plain for p in (*([] if plain != name else [ini.parent]), LIBRARY) if (p / plain).is_file()]
        if not places:
            raise ConfigError(f"{ini}: HALFILE = {name}: neither beside the INI file nor in {LIBRARY}")
        out.append(places[0])
    return out


def patched(files: Mapping[str, str], wiring: RtecWiring, source: str) -> dict[str, str]:
    """The HAL files with rtec in them, by name.

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
    lines[last] += _nets(wiring, lines)
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
    known = _known_signal(lines, pin)
    if known is None:
        raise ConfigError(
            f"{source}: no HAL file has a `net` line with {pin}; wire that axis by hand (docs/linuxcnc.md)"
        )
    return known


def _known_signal(lines: Mapping[str, Sequence[str]], pin: str) -> str | None:
    """Signal of a pin that is already wired; None where it is not."""
    for text in lines.values():
        for line in text:
            words = line.split("#")[0].split()
            if words[:1] == ["net"] and pin in words[2:]:
                return words[1]
    return None


def _tapped(lines: Mapping[str, Sequence[str]], pin: str, name: str, to: str) -> str:
    """Wire a pin to one more reader: HAL allows one signal a pin."""
    known = _known_signal(lines, pin)
    return f"net {known} => {to}" if known else f"net {name} {pin} => {to}"


def _loads(wiring: RtecWiring, thread: str) -> list[str]:
    axes = [a.lower() for a in wiring.joints]
    sensors = f" --sensors {','.join(wiring.sensors)}" if wiring.sensors else ""
    return [
        "# ---- rtec: components, and what is done before LinuxCNC's motion",
        f"loadrt limit3 names={','.join(f'rtec-limit-{a}' for a in axes)}",
        f"loadrt offset names={','.join(f'rtec-offset-{a}' for a in axes)}",
        f"loadrt sampler depth=4000 cfg={'f' * len(axes)}bb",
        f"loadusr -Wn rtec /usr/bin/python3 {wiring.bridge} --socket {wiring.socket} --axes {','.join(wiring.joints)}"
        f"{sensors}{' --inch' if wiring.inch else ''} --unit-um {wiring.unit_um:g} --max-um {1e3 * wiring.most_mm:g}",
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


def _nets(wiring: RtecWiring, lines: Mapping[str, Sequence[str]]) -> list[str]:
    out = ["# ---- rtec: its pins"]
    unit = MM_PER_INCH if wiring.inch else 1.0
    slew, acceleration, most = (v / unit for v in (wiring.slew_mm_s, wiring.acceleration_mm_s2, wiring.most_mm))
    for k, (axis, joint) in enumerate(wiring.joints.items()):
        a = axis.lower()
        out += [
            f"setp rtec-limit-{a}.maxv {slew:g}",
            f"setp rtec-limit-{a}.maxa {acceleration:g}",
            f"setp rtec-limit-{a}.min {-most:g}",
            f"setp rtec-limit-{a}.max {most:g}",
            f"net rtec-{a}-correction rtec.offset-{a} => rtec-limit-{a}.in",
            f"net rtec-{a}-correction-limited rtec-limit-{a}.out => rtec-offset-{a}.offset",
            _tapped(lines, f"joint.{joint}.pos-fb", f"rtec-{a}-pos", f"sampler.0.pin.{k}"),
        ]
    n = len(wiring.joints)
    out += [
        _tapped(lines, "motion.is-all-homed", "rtec-homed", f"sampler.0.pin.{n}"),
        _tapped(lines, "motion.motion-enabled", "rtec-on", f"sampler.0.pin.{n + 1}"),
        _tapped(lines, "spindle.0.speed-out", "rtec-rpm", "rtec.spindle-rpm"),
    ]
    for sensor, signal in wiring.sensors.items():
        out.append(f"net {signal} => rtec.{sensor}" if signal else f"# net YOUR-SIGNAL => rtec.{sensor}   (°C)")
    return [*out, "# ---- end of rtec"]


SOCKET = "rtec.sock"
SECTION = re.compile(r"\s*\[(\w+)\]")
UNIT_UM = 0.01


@dataclass(frozen=True)
class AdoptedMachine:
    """An INI file's description of its machine.

    Attributes:
        ini: the file.
        answers: tables for `rtec init`.
        joints: number of the joint by axis name.
        inch: LINEAR_UNITS.
    """

    ini: Path
    answers: dict[str, Any]
    joints: dict[str, int]
    inch: bool

    def copy(self, folder: Path, sensors: list[str]) -> str:
        """Copy the INI file's folder, put rtec into the copy's HAL files; give the difference.

        Raises:
            ConfigError: the HAL files are not understood, or the folder exists already.
        """
        bridge = Path(__file__).with_name("bridge.py")
        wiring = RtecWiring(self.joints, bridge, Path(SOCKET), dict.fromkeys(sensors, ""), UNIT_UM, inch=self.inch)
        return patched_copy(self.ini, folder, wiring)


def adopt(ini: Path) -> AdoptedMachine:
    """Read an INI file.

    Raises:
        ConfigError: it cannot be read, or rtec has no template for the kind of machine.
    """
    try:
        values = _sections(ini.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as e:
        raise ConfigError(f"{ini}: cannot be read: {e}") from e
    words = values.get(("KINS", "KINEMATICS"), "").split()
    if words[:1] != ["trivkins"]:
        raise ConfigError(f"{ini}: [KINS] KINEMATICS is not trivkins: joints are no axes; rtec cannot correct them so")
    letters = next((w.partition("=")[2] for w in words if w.startswith("coordinates=")), "XYZABCUVW").upper()
    joints = {a: k for k, a in enumerate(letters) if a in "XYZ" and f"AXIS_{a}" in {s for s, _ in values}}
    twice = [a for a in joints if letters.count(a) > 1]
    if twice:
        raise ConfigError(f"{ini}: axis {twice[0]} has two joints: wire rtec by hand (docs/linuxcnc.md, Wire it)")
    if set(joints) not in ({"X", "Y", "Z"}, {"X", "Z"}):
        raise ConfigError(f"{ini}: axes {', '.join(joints) or 'none'}; rtec has templates for X, Y, Z and for X, Z")
    inch = values.get(("TRAJ", "LINEAR_UNITS"), "mm").lower() in ("inch", "in", "imperial")
    axes = {a: {"travel_mm": _travel(values, a, inch, ini), "counts_per_mm": 100000.0} for a in joints}
    return AdoptedMachine(ini, _answers(values, axes), joints, inch)


def _answers(values: dict[tuple[str, str], str], axes: dict[str, Any]) -> dict[str, Any]:
    """Answers with LinuxCNC as every device; the user wires the temperature pins."""
    kind = "following_error"
    return {
        "template": "mill" if "Y" in axes else "lathe",
        "name": values.get(("EMC", "MACHINE"), "linuxcnc"),
        "axis": axes,
        "sensors": [],
        "role": {"counts": "cnc", "spindle": "cnc", "actuator": "cnc"},
        "device": {"cnc": {"driver": "linuxcnc", "socket": SOCKET, "actuator": kind, "unit_um": UNIT_UM}},
        "limits": {"stop_um": 150.0, "warning_um": 120.0, "slew_um_s": 200.0, "acceleration_um_s2": 10000.0},
        "output": {"kind": kind, "resolution_um": UNIT_UM, "period_s": 0.001},
        "counts_max_age_s": 0.01,
    }


def _travel(values: dict[tuple[str, str], str], axis: str, inch: bool, ini: Path) -> list[float]:
    unit = MM_PER_INCH if inch else 1.0
    try:
        return [round(unit * float(values[f"AXIS_{axis}", key]), 4) for key in ("MIN_LIMIT", "MAX_LIMIT")]
    except (KeyError, ValueError):
        raise ConfigError(f"{ini}: [AXIS_{axis}] has no MIN_LIMIT and MAX_LIMIT that are numbers") from None


def _sections(text: str) -> dict[tuple[str, str], str]:
    """First value by section and key, as LinuxCNC reads an INI file."""
    out: dict[tuple[str, str], str] = {}
    section = ""
    for line in text.splitlines():
        if match := SECTION.match(line):
            section = match[1]
        elif not line.lstrip().startswith(("#", ";")) and "=" in line:
            key, _, value = line.partition("=")
            out.setdefault((section, key.strip()), value.partition("#")[0].strip())
    return out
