"""Positioning tests in the text form of ecmc (`*_ISO230.dat`) as visits of targets."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtec.errors import MeasurementError
from rtec.metrology.procedures.iso230_2 import Visits
from rtec.metrology.readers.base import Source
from rtec.metrology.readers.ecmc_iso230 import read
from rtec.metrology.units import UNITS

Floats = NDArray[np.float64]


def read_dat(path: Path, swap: bool = False) -> Visits:
    """Read one file.

    Args:
        path: of the `.dat`.
        swap: take FWD for backward, as the published reports of its makers do.

    Raises:
        MeasurementError: as the reader tells it by line, or an axis that is not linear.
    """
    if not path.is_file():
        raise MeasurementError(f"{path}: no such file")
    table = read(path, Source(swap_directions=swap))[0]
    unit = UNITS[table.units["target"]]
    if unit.kind != "length":
        raise MeasurementError(f"{path}: UNIT={table.units['target']}: only linear axes are known here")
    column = {n: np.asarray(v, dtype=np.float64) for n, v in table.columns.items()}
    target, place = np.unique(column["target"], return_inverse=True)
    cycle = column["cycle"].astype(np.int64) - 1
    grids = {way: np.full((len(target), int(cycle.max()) + 1), np.nan) for way in (1, -1)}
    for way, grid in grids.items():
        rows = column["direction"] == way
        grid[place[rows], cycle[rows]] = column["deviation"][rows] * unit.factor * 1e3
    return Visits(path.name, target * unit.factor, grids[1], grids[-1])
