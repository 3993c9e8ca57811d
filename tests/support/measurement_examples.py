"""Measurement files for the tests: a good one, and ways to spoil it."""

from collections.abc import Sequence
from pathlib import Path

from rtec.machine import Machine
from tests.support import machines

TOML = """[measurement]
instrument = "laser_linear"
axis = "X"
component = "EXX"
machine = "turning-centre"
[setup]
beam_offset_mm = [0.0, 150.0, 80.0]
"""
HEADER = "run,time_s,x_mm,z_mm,dir_x,spindle_rpm,T_bed_degc,T_spindle_degc,reading_um"


def machine() -> Machine:
    return machines.turning_centre()


def rows(n: int = 12) -> list[str]:
    """Two runs, there and back; line k of the file is row k - 2."""
    out = []
    for i in range(n):
        run, x = (1, 10.0 * i) if i < n // 2 else (2, 10.0 * (n - 1 - i))
        side = 1 if run == 1 else -1
        out.append(f"{run},{i * 2.5},{x},300.0,{side},1500,{20 + 0.01 * i:.2f},{25 + 0.05 * i:.2f},{0.3 * i - 1.1:.3f}")
    return out


def text(lines: Sequence[str] | None = None, header: str = HEADER) -> str:
    return "\n".join([header, *(rows() if lines is None else lines)]) + "\n"


def write(folder: Path, content: str | bytes, more: str = "", stem: str = "laser-x") -> Path:
    """Write a table and its TOML; `more` is added to the TOML."""
    table = folder / f"{stem}.csv"
    table.write_bytes(content if isinstance(content, bytes) else content.encode())
    table.with_suffix(".toml").write_text(TOML + more, encoding="utf-8")
    return table


def spoilt(line: int, column: str, cell: str) -> str:
    """The good table with one cell replaced; `line` as an editor counts."""
    lines = rows()
    cells = lines[line - 2].split(",")
    cells[HEADER.split(",").index(column)] = cell
    lines[line - 2] = ",".join(cells)
    return text(lines)
