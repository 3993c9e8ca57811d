"""Residual of the last measurement by axis: the third of the three numbers in every status.

The daemon does not measure. It shows the last result of `rtec compare --json`, in a file that the run file names;
without one, the residual on held-out runs in the model's history.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from rtec.machine import Machine
from rtec.model import Model

LARGEST_BYTES: Final = 16 * 1024 * 1024
_Number = Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)]


class _Item(BaseModel):
    """One reading column of one measurement; other keys of the file are ignored."""

    model_config = ConfigDict(extra="ignore")

    name: str
    column: str = ""
    unit: str
    n: Annotated[int, Field(ge=1, le=2**53)]
    rms_residual_um: _Number
    noise_floor_um: _Number
    components: tuple[str, ...] = ()


class _Compared(BaseModel):
    model_config = ConfigDict(extra="ignore")

    model: str
    measurements: tuple[_Item, ...]


@dataclass(frozen=True)
class _Read:
    """Content of the file at one time: its stamp, the comparison, or its fault."""

    stamp: tuple[int, int, int] | None = None
    compared: _Compared | None = None
    trouble: str = ""


class Residual:
    """Reads the comparison again whenever its file has changed; several threads call it.

    Args:
        path: the JSON of `rtec compare`; None: none.
    """

    def __init__(self, path: Path | None) -> None:
        self._path, self._read = path, _Read()

    def facts(self, model: Model) -> dict[str, Any]:
        """Plain data: `rms_um`, `noise_um`, `from` of each measured axis; the model's residual; the file's fault."""
        read = self._look()
        compared, trouble = read.compared, read.trouble
        if compared is not None and compared.model != model.name:
            trouble = f"{self._path}: compares model {compared.model!r}, and {model.name!r} runs: compare again"
            compared = None
        axes = {} if compared is None else _by_axis(compared.measurements, model.machine)
        return {"axes": axes, "model": _of_history(model), "trouble": trouble}

    def _look(self) -> _Read:
        if self._path is None:
            return self._read
        try:
            status = self._path.stat()
            stamp = (status.st_mtime_ns, status.st_size, status.st_ino)
            if stamp != self._read.stamp:
                self._read = _read(self._path, stamp)
        except FileNotFoundError:
            self._read = _Read(
                trouble=f"{self._path}: no such file yet; `rtec compare MODEL MEASUREMENT --json` makes it"
            )
        except OSError as e:
            self._read = _Read(trouble=f"{self._path}: cannot be read: {e.strerror}")
        return self._read


def _read(path: Path, stamp: tuple[int, int, int]) -> _Read:
    if stamp[1] > LARGEST_BYTES:
        return _Read(stamp, trouble=f"{path}: too large for a comparison")
    try:
        return _Read(stamp, _Compared.model_validate_json(path.read_bytes()))
    except ValidationError:
        return _Read(stamp, trouble=f"{path}: is not what `rtec compare --json` prints")


def _by_axis(items: tuple[_Item, ...], machine: Machine) -> dict[str, dict[str, Any]]:
    """For each corrected axis: root mean square of all readings along its direction."""
    out = {}
    for axis in machine.axes:
        along = [i for i in items if i.unit == "um" and axis.compensate and _direction(i) == axis.direction]
        if along:
            out[axis.name] = {
                "rms_um": _pooled([(i.n, i.rms_residual_um) for i in along]),
                "noise_um": _pooled([(i.n, i.noise_floor_um) for i in along]),
                "from": list(dict.fromkeys(i.name for i in along)),
            }
    return out


def _direction(item: _Item) -> str | None:
    """X, Y or Z: the machine coordinate of a reading; None where a reading mixes several, as a ball bar's does."""
    for letter in "XYZ":
        if item.column == f"reading_{letter.lower()}_um":
            return letter
    # A laser off the axis reads its rotations, too; the direction is that of the one displacement among them.
    directions = {component[1:2] for component in item.components if component.startswith("E")} & set("XYZ")
    return directions.pop() if len(directions) == 1 else None


def _pooled(sizes: list[tuple[int, float]]) -> float:
    return math.sqrt(sum(n * rms**2 for n, rms in sizes) / sum(n for n, _ in sizes))


def _of_history(model: Model) -> dict[str, Any]:
    """Residual on held-out runs, from the newest entry that has one."""
    for entry in reversed(model.history):
        rms = _number(entry, "rms_after", "rms_held_out")
        if rms is not None:
            return {"rms": rms, "unit": str(entry.get("unit", "um"))[:20], "noise_um": model.noise_um}
    return {"rms": None, "unit": "um", "noise_um": model.noise_um}


def _number(entry: Mapping[str, Any], *names: str) -> float | None:
    numbers = [entry[n] for n in names if isinstance(entry.get(n), int | float) and not isinstance(entry[n], bool)]
    return float(numbers[0]) if numbers and math.isfinite(numbers[0]) else None
