"""The first files for a machine that LinuxCNC runs already, from its INI file: `rtec init --controller linuxcnc`."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rtec.errors import ConfigError
from rtec_drivers.linuxcnc.patch import MM_PER_INCH, RtecWiring, patched_copy

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
