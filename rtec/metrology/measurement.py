"""A measurement: one instrument's recording on one machine, in memory."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from rtec.arrays import Floats, Ints
from rtec.effects import State
from rtec.machine import Machine
from rtec.metrology.instruments.base import Instrument
from rtec.result import Kind, Shown, frame


@dataclass(frozen=True)
class Measurement(Shown):
    """n rows in order of time; a run is one uninterrupted traverse or cycle.

    Attributes:
        name: file stem, or another name.
        instrument: the instrument with its set-up.
        machine: the measured machine.
        run: run number of each row, (n,).
        time_s: (n,), not falling.
        channels: by channel name, (n,): positions mm, `d_x` where given, `v_x` mm/s, temperatures °C, `spindle_rpm`,
            `feed_mm_min`, `load_kg`.
        readings: by column name (`reading_um`, `reading_x_um`, …), (n,); NaN where there is none.
        sha256: hash of the file's content; empty where there was no file.
        notes: notes of the reader on the file, in words.
        unread: numbers of the file's own columns that vary and that nothing reads, by name, (n,): the angle of a rotary
            axis above all.
    """

    page_maker: ClassVar[str] = "rtec.report.overview:measurement_page"

    name: str
    instrument: Instrument
    machine: Machine = field(repr=False)
    run: Ints = field(repr=False)
    time_s: Floats = field(repr=False)
    channels: Mapping[str, Floats] = field(repr=False)
    readings: Mapping[str, Floats] = field(repr=False)
    sha256: str = ""
    notes: tuple[str, ...] = field(default=())
    unread: Mapping[str, Floats] = field(default_factory=dict, repr=False)

    def __len__(self) -> int:
        return len(self.time_s)

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of its file, or of its content where there was no file; identifies equal readings."""
        if self.sha256:
            return self.sha256
        whole = hashlib.sha256(self.name.encode())
        held = {"run": self.run, "time_s": self.time_s, **self.channels, **self.readings}
        for name, values in sorted(held.items()):
            whole.update(f"\n{name}\n".encode() + np.ascontiguousarray(values).tobytes())
        return whole.hexdigest()

    def facts(self) -> dict[str, Any]:
        """The measurement as plain data, without its readings."""
        return {
            "name": self.name,
            "instrument": self.instrument.name,
            "axis": self.instrument.axis,
            "machine": self.machine.name,
            "rows": len(self),
            "runs": len(np.unique(self.run)),
            "hours": float(self.time_s[-1] - self.time_s[0]) / 3600.0 if len(self) else 0.0,
            "sha256": self.sha256,
            "notes": list(self.notes),
        }

    def to_frame(self, kind: Kind | None = None) -> Any:
        """Every row, with the columns of its file: `run`, `time_s`, `x_mm`, `T_bed_degc`, `reading_um` and so on.

        Args:
            kind: "pandas", "polars" or "arrow"; by default the first of them that is installed.

        Raises:
            RtecError: the package of `kind` is not installed.
        """
        columns = {v: k for k, v in self.machine.columns.items()}
        channels = {columns.get(c, c): v for c, v in self.channels.items()}
        return frame({"run": self.run, "time_s": self.time_s, **channels, **self.readings}, kind)

    def state(self, reference_degc: float = 20.0, dead_band_mm: Mapping[str, float] | None = None) -> State:
        """The channels as a state; directions that were not recorded follow from the order of positions.

        Velocities and accelerations that were not recorded are zero where the instrument reads at rest.
        """
        at_rest = self.instrument.at_rest
        return State(self.machine, self.time_s, self.channels, reference_degc, dead_band_mm or {}, at_rest)

    def matrix(self) -> Floats:
        """The readings, (readings of the instrument, n), in the order of `instrument.columns()`."""
        return np.stack([self.readings[c] for c in self.instrument.columns()])
