"""Recordings of a gantry's frame that grows while its bed heats and cools, as measurements; see the data's README."""

from collections.abc import Sequence
from datetime import datetime

import numpy as np

from rtec.machine import Machine, machine_from
from rtec.metrology.measurement import Measurement
from tests.support.characterise_examples import Probe, ProbeSetup
from tests.support.real_data import real_file

UM_PER_STEP = 2.5
COMPONENT = "EZ0nozzle"
SENSORS = {"T_frame": "frame_t", "T_chamber": "chamber_t", "T_bed": "bed_t"}
STRETCHES = 12


def gantry(sensors: Sequence[str]) -> Machine:
    """A machine with some temperature sensors."""
    return machine_from(
        {
            "machine": {"name": "gantry", "tool_chain": ["Z"], "work_chain": ["nozzle"]},
            "axis": {"Z": {"direction": "Z", "travel_mm": [0.0, 340.0], "counts_per_mm": 400.0}},
            "link": {"nozzle": {}},
            "temperature": {s: {} for s in sensors},
        },
        "test",
    )


def recorded(
    name: str, sensors: Sequence[str] = ("T_frame", "T_bed"), *, hot: bool = False, part: str = ""
) -> Measurement:
    """One recording.

    Args:
        name: of the file, without its ending.
        sensors: that the machine has.
        hot: only while the bed is at 105 °C, after the first ten samples.
        part: "given" and "unseen" are the stretches of twelve that are fitted and judged; all where empty.
    """
    path = real_file("frame_thermal", f"{name}.csv")
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line and not line.startswith("#")]
    rows = [dict(zip(lines[0].split(","), line.split(","), strict=True)) for line in lines[1:]]
    at = [datetime.strptime(r["time"], "%Y/%m/%d-%H:%M:%S") for r in rows]
    time = np.array([(t - at[0]).total_seconds() for t in at])
    keep = np.ones(len(rows), dtype=bool)
    if hot:
        keep &= np.array([float(r["bed_target"]) == 105.0 and int(r["sample"]) > 10 for r in rows])
    if part:
        stretch = np.arange(len(rows)) * STRETCHES // len(rows)
        keep &= (stretch % 3 == 2) == (part == "unseen")
    table = {s: np.array([float(r[SENSORS[s]]) for r in rows]) for s in sensors}
    return Measurement(
        name=name,
        instrument=Probe(ProbeSetup(zero="setup"), component=COMPONENT),
        machine=gantry(sensors),
        run=np.ones(int(keep.sum()), dtype=np.int64),
        time_s=time[keep],
        channels={s: v[keep] for s, v in table.items()},
        readings={"reading_um": UM_PER_STEP * np.array([float(r["mcu_pos_z"]) for r in rows])[keep]},
    )
