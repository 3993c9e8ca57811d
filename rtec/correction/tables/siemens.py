"""Siemens SINUMERIK leadscrew error compensation (LEC), `%_N_AX_EEC_INI`.

Function manual Extended Functions, 03/2013, 6FC5397-1BP40-3BA1, K3: 4.4.2.1 (a positive value moves the machine axis in
the negative direction) and 4.4.2.3 (the printed example, page 242). No control has read our files.
"""

import re
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtec.correction.tables.table import CompensationTable, TableLimits, rising
from rtec.errors import ConfigError

MOST_POINTS: Final = 5000
"""Of ours; a control has what MD38000 $MA_MM_ENC_COMP_MAX_POINTS says, an 808D has 200."""
QUANTUM_UM: Final = 0.001

_NUMBER = r"([-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?)"
_VALUE = re.compile(rf"\$AA_ENC_COMP\[\s*(\d+)\s*,\s*(\d+)\s*,\s*(\w+)\s*\]\s*=\s*{_NUMBER}\s*$")
_KEY = re.compile(rf"\$AA_ENC_COMP_(STEP|MIN|MAX|IS_MODULO)\[\s*(\d+)\s*,\s*(\w+)\s*\]\s*=\s*{_NUMBER}\s*$")
_FRAME = re.compile(r"(%\w+|CHANDATA\(\d+\)|M17|M30|M0?2)$", re.IGNORECASE)


@dataclass(frozen=True)
class EncoderCompensation:
    """One table of one axis, of its first measuring system; mm."""

    title: str = "Siemens SINUMERIK LEC, $AA_ENC_COMP"
    sign: str = "error, actual minus nominal, mm; a positive value moves the axis in the negative direction"
    use: str = "MD32700 $MA_ENC_COMP_ENABLE[0] = 0, load the file, then 1; the axis must be referenced"

    @property
    def limits(self) -> TableLimits:
        """One value for both directions, at even distances."""
        return TableLimits(MOST_POINTS, False, False, True, QUANTUM_UM)

    def text(self, table: CompensationTable) -> str:
        """The channel's name of axis X is taken to be X1."""
        axis, positions = f"{table.axis}1", table.positions_mm
        at = ", ".join(f"{name} = {value:g}" for name, value in table.at.items())
        lines = [
            "%_N_AX_EEC_INI",
            "CHANDATA(1)",
            f"; {self.title}, axis {axis}; not tried on a control",
            f"; {self.sign}",
            *([f"; made for: {at}"] if at else []),
            *(f"$AA_ENC_COMP[0,{n},{axis}]={1e-3 * v + 0.0:.6f}" for n, v in enumerate(table.forward_um.tolist())),
            f"$AA_ENC_COMP_STEP[0,{axis}]={(positions[-1] - positions[0]) / (len(positions) - 1):.9g}",
            f"$AA_ENC_COMP_MIN[0,{axis}]={positions[0]:.9g}",
            f"$AA_ENC_COMP_MAX[0,{axis}]={positions[-1]:.9g}",
            f"$AA_ENC_COMP_IS_MODULO[0,{axis}]=0",
            "M17",
        ]
        return "\n".join(lines) + "\n"

    def read(self, text: str, source: str, axis: str) -> CompensationTable:
        """Read the first measuring system's table of the one axis that the file is about."""
        values: dict[int, float] = {}
        keys: dict[str, float] = {}
        names: set[str] = set()
        for number, line in enumerate(text.splitlines(), 1):
            content = line.partition(";")[0].strip()
            if not content or _FRAME.match(content):
                continue
            if found := _VALUE.match(content):
                values[int(found[2])] = float(found[4])
                names.add(found[3])
            elif found := _KEY.match(content):
                keys[found[1]] = float(found[4])
                names.add(found[3])
            else:
                raise ConfigError(f"{source}: line {number}: {content[:60]!r} is no value of $AA_ENC_COMP")
        if len(names) != 1:
            raise ConfigError(f"{source}: tables of {len(names)} axes ({', '.join(sorted(names))}); one is needed")
        if missing := {"STEP", "MIN"} - keys.keys():
            raise ConfigError(f"{source}: without $AA_ENC_COMP_{min(missing)}")
        if keys.get("IS_MODULO"):
            raise ConfigError(f"{source}: a table with modulo function, of a rotary axis")
        if keys["STEP"] <= 0 or sorted(values) != list(range(len(values))) or len(values) > MOST_POINTS:
            raise ConfigError(
                f"{source}: {len(values)} points at a distance of {keys['STEP']:g} mm; needed are points "
                f"0, 1, 2, … at a distance above 0, {MOST_POINTS} at most"
            )
        positions = rising(keys["MIN"] + keys["STEP"] * np.arange(len(values), dtype=np.float64), source)
        errors = 1e3 * np.array([values[k] for k in range(len(values))])
        return CompensationTable(axis, axis, positions, errors, errors)
