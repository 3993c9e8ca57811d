"""ISG kernel and Beckhoff TwinCAT CNC: leadscrew error compensation, `kw.ssfk.*` of a compensation value list.

Beckhoff TF5200, axis compensation, "Example: non-equidistant bilateral SSFK": value = actual - setpoint in 0.1 µm, one
for each direction; P-COMP-00023 and 24: 16 bits with sign; P-COMP-00059: 1500 entries. No control has read our files.
"""

import re
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtec.correction.tables.table import CompensationTable, TableLimits, rising
from rtec.errors import ConfigError

MOST_POINTS: Final = 1500
QUANTUM_UM: Final = 0.1
LARGEST_UM: Final = 3276.7

_LINE = re.compile(r"(\w+)\.(?:(\w+)\.)?(?:table\[(\d+)\]\.)?(\w+)\s+(\S+.*)$")


@dataclass(frozen=True)
class LeadscrewList:
    """`achskw*.lis` with positions of every point and both directions."""

    title: str = "ISG and Beckhoff TwinCAT CNC, kw.ssfk"
    sign: str = "actual minus setpoint, 0.1 µm; pos: arriving in positive direction, neg: in negative direction"
    use: str = "lr_param.ssfk 1 in the axis' list (P-AXIS-00175); kopf.achs_nr must be the axis' number"

    @property
    def limits(self) -> TableLimits:
        """Both directions, any distances."""
        return TableLimits(MOST_POINTS, True, False, False, QUANTUM_UM, LARGEST_UM)

    def text(self, table: CompensationTable) -> str:
        """The logical number of the axis is not known here; its line is for the user to complete."""
        at = ", ".join(f"{name} = {value:g}" for name, value in table.at.items())
        points = [
            (round(1e4 * p), round(10 * f), round(10 * b))
            for p, f, b in zip(
                table.positions_mm.tolist(), table.forward_um.tolist(), table.backward_um.tolist(), strict=True
            )
        ]
        lines = [
            f"# {self.title}, axis {table.axis}; not tried on a control",
            f"# {self.sign}",
            *([f"# made for: {at}"] if at else []),
            "# kopf.achs_nr: write the axis' logical number here",
            f"kopf.log_achs_name {table.axis}",
            "kw.ssfk.interval 0",
            f"kw.ssfk.kw_startpos {points[0][0]}",
            f"kw.ssfk.kw_nr_max {len(points)}",
            "kw.ssfk.unit 1",
            "kw.ssfk.bilateral 1",
            *(f"kw.ssfk.table[{i}].setpoint {p}" for i, (p, _, _) in enumerate(points)),
            *(f"kw.ssfk.table[{i}].pos {f}" for i, (_, f, _) in enumerate(points)),
            *(f"kw.ssfk.table[{i}].neg {b}" for i, (_, _, b) in enumerate(points)),
        ]
        return "\n".join(lines) + "\n"

    def read(self, text: str, source: str, axis: str) -> CompensationTable:
        """Read one- or two-sided lists, with points at even distances or each with its position."""
        keys: dict[str, int] = {}
        columns: dict[str, dict[int, int]] = {"setpoint": {}, "pos": {}, "neg": {}}
        for number, line in enumerate(text.splitlines(), 1):
            content = line.partition("#")[0].strip()
            found = _LINE.match(content)
            if not content or (found and found[1] == "kopf"):
                continue
            try:
                if not found or (found[1], found[2]) != ("kw", "ssfk"):
                    raise ValueError
                of = columns[found[4]] if found[3] else None
                if of is None:
                    keys[found[4]] = int(found[5])
                else:
                    of[int(found[3])] = int(found[5])
            except (ValueError, KeyError):
                raise ConfigError(f"{source}: line {number}: {content[:60]!r} is no entry of kw.ssfk") from None
        if keys.get("unit") != 1:
            raise ConfigError(f"{source}: kw.ssfk.unit is not 1: in encoder increments, which rtec does not know")
        if keys.get("modulo"):
            raise ConfigError(f"{source}: kw.ssfk.modulo: a rotary axis")
        if not keys.get("bilateral"):
            columns["neg"] = columns["pos"]
        n, step = keys.get("kw_nr_max", 0), keys.get("interval", 0)
        if step:
            columns["setpoint"] = {i: keys.get("kw_startpos", 0) + step * i for i in range(min(n, MOST_POINTS))}
        if not 0 < n <= MOST_POINTS or any(sorted(of) != list(range(n)) for of in columns.values()):
            raise ConfigError(
                f"{source}: kw.ssfk.kw_nr_max is {n}, with {len(columns['setpoint'])} positions, {len(columns['pos'])} "
                f"values pos and {len(columns['neg'])} neg; each point needs its own, {MOST_POINTS} at most"
            )
        found_um = {name: 0.1 * np.array([of[i] for i in range(n)], dtype=np.float64) for name, of in columns.items()}
        positions = rising(1e-3 * found_um["setpoint"], source)
        return CompensationTable(axis, axis, positions, found_um["pos"], found_um["neg"])
