"""Turns each number of each file into numbers that no machine has: `python -m tests.extremes [KIND …]`.

Run files with every kind of output, machine, model, truth, import map, campaign, measurements of every instrument, and
the table of every driver. What may come of it: the file is read and does what it is for, or it is refused with an
error of rtec. What may not: any other error, or a warning of numpy.
"""

import copy
import sys
import tempfile
import tomllib
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import tomli_w

from rtec.correction.flags import MODE_ON
from rtec.correction.sinks import UNLIMITED
from rtec.errors import RtecError
from rtec.loop.clock import VirtualClock
from rtec.loop.devices import make_device, make_devices, open_ports
from rtec.loop.driver_info import installed
from rtec.loop.loop import Loop, bind_rows
from rtec.loop.records import Commands, Samples
from rtec.loop.run_file import load_setup
from rtec.loop.step import Step
from rtec.machine import Machine, load_machine
from rtec.metrology.files.toml import read_measurement_toml
from rtec.metrology.importing import import_table, load_map
from rtec.metrology.instruments.registry import make_instrument
from rtec.model import load_model, save_model
from rtec.sim.campaign.campaign import simulate
from rtec.sim.campaign.settings import Settings
from rtec.sim.machine import SimulatedMachine
from rtec.sim.truth import Truth, check_truth, load_truth
from rtec.tomlfile import read_toml, validated
from tests.support import setups
from tests.support.effect_examples import MACHINE, everything
from tests.support.setups import CONFIGS, small_model

EXTREMES: Final[tuple[object, ...]] = (
    *(
        0,
        -1,
        1e-300,
        5e-324,
        1e-9,
        1e-6,
        1e-3,
        1e3,
        1e5,
        1e6,
        1e7,
        1e12,
        1e22,
        1e308,
        -1e308,
        -(10**6),
        2**31,
        2**63 - 1,
        2**63,
        -(2**63),
    ),
    *(10**400, float("nan"), float("inf"), -float("inf"), True, "1", 1.5),
)
CYCLES: Final = 5
Place = tuple[str | int, ...]


def places(value: object, at: Place = ()) -> Iterator[Place]:
    """Where numbers are in the tables of a file."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from places(item, (*at, key))
    elif isinstance(value, list | tuple):
        for i, item in enumerate(value):
            yield from places(item, (*at, i))
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield at


def put(tables: dict[str, Any], place: Place, value: object) -> dict[str, Any]:
    """The tables with one value in the place of another."""
    out: Any = copy.deepcopy(tables)
    here = out
    for key in place[:-1]:
        here = here[key]
    here[place[-1]] = value
    return dict(out)


@dataclass(frozen=True)
class Kind:
    """Files of one kind.

    Attributes:
        tables: of a good file that names every number that it may.
        use: reads the file at a path and does with it what it is for.
    """

    tables: dict[str, Any]
    use: Callable[[Path], object]


_SETUPS: Final[tuple[tuple[str, str | None, dict[str, Any]], ...]] = (
    ("laser_linear", "X", {"beam_offset_mm": [0.0, 150.0, 80.0], "air_sensor": "T_air", "interferometer_mm": -300.0}),
    ("laser_diagonal", None, {"direction": [0.4, 0.0, 0.9], "beam_offset_mm": [0.0, 150.0, 80.0]}),
    ("laser_angular", "X", {"about": "B", "sign": 1}),
    ("level", "Z", {"about": "A", "vertical": "Y", "sign": 1}),
    (
        "straightness", "Z",
        {"direction": "X", "probe_offset_mm": [1.0, 2.0, 3.0], "reversed_runs": [2], "artefact_degree": 3, "sign": -1},
    ),
    ("squareness", "X", {"reference_axis": "Z", "probe_offset_mm": [1.0, 2.0, 3.0], "reversed_runs": [2]}),
    ("spindle_drift", None, {"probe": {"radial1": {"direction": "X", "offset_mm": [0.0, 0.0, 9.0], "sign": 1}}}),
    ("tool_tip", None, {"offset_mm": [1.0, 2.0, 3.0], "directions": ["X", "Z"]}),
    ("work_piece", "X", {"feature": "diameter", "sign": 1}),
    (
        "ball_bar", None,
        {
            "plane": "ZX", "centre_mm": [100.0, 0.0, 200.0], "radius_mm": 50.0, "height_mm": 3.0, "feed_mm_min": 500.0,
            "direction": "ccw", "start_deg": 10.0, "arc_deg": 180.0, "overshoot_deg": 0.0, "offset_mm": [0.0, 0.0, 9.0],
        },
    ),
    ("grid_encoder", None, {"plane": "XZ", "origin_mm": [100.0, 0.0, 200.0], "offset_mm": [0.0, 1.0, 0.0],
      "accuracy_um": 1.0}),
)  # fmt: skip
_CAMPAIGN: Final[dict[str, Any]] = {
    "cycles": 2,
    "log_every_s": 60.0,
    "nuisance": {"zero": 3.0},
    "targets": {
        "range_mm": [10.0, 150.0], "step_mm": 30.0, "dwell_s": 3.0, "readings": 2, "feed_mm_min": 3000.0,
        "at_mm": {"Z": [100.0, 300.0]},
    },
    "path": {"step_deg": 5.0, "travel_mm": 100.0, "feeds_mm_min": [1000.0], "step_mm": 10.0},
    "phase": [
        {"name": "cold", "cycles": 1},
        {"name": "warm", "hours": 0.5, "rpm": 1000.0, "moving": 0.3, "read_every_s": 300.0},
        {"name": "hot", "cycles": 2, "rpm": 1000.0},
    ],
    "thermal": {
        "air_degc": 20.0, "swing_degc": 1.0, "walk_degc": 0.3, "walk_tau_s": 7200.0,
        "body": {
            "T_bed": {"tau_s": 3600.0, "on_degc": 2.0, "axis_degc": {"Z": 1.0}, "spindle_degc": 1.0},
            "T_carriage": {"follows": "T_bed", "share": 0.5},
        },
        "sensors": {"offset_degc": 0.1, "noise_degc": 0.02, "lag_s": 10.0, "resolution_degc": 0.01},
    },
    "noise": {
        "white_um": 0.3, "drift_um": 0.2, "drift_tau_s": 1800.0, "run_offset_um": 0.1, "resolution_um": 0.1,
        "outliers": 0.01, "outlier_um": 20.0, "lost": 0.01,
    },
}  # fmt: skip
_IMPORT: Final[dict[str, Any]] = {
    "source": {"skip_rows": 0},
    "measurement": {"instrument": "laser_linear", "axis": "X", "component": "EXX", "machine": "turning-centre"},
    "time": {"column": "t", "unit": "s", "restarts": True, "restart_gap_s": 1.0},
    "run": {"direction_of": "x_mm", "dead_band_mm": 0.1},
    "column": {
        "x_mm": {"from": "x", "unit": "mm", "scale": 1.0, "sign": 1, "offset": 0.0},
        "reading_um": {"from": "e", "unit": "um", "missing_codes": [9999.0], "values": {"up": 1.0}},
    },
}


def kinds(folder: Path) -> dict[str, Kind]:
    """The files that rtec reads, by what they are."""
    machine = load_machine(CONFIGS / "machines" / "turning-centre.toml")
    machine_file = read_toml(CONFIGS / "machines" / "turning-centre.toml")
    machine_file["axis"]["X"] |= {"offset_mm": [0.0, 0.0, 0.0], "dead_band_counts": 2}
    save_model(small_model(machine), folder / "model.toml")
    save_model(everything(), folder / "every.toml")
    run = _run_file(folder)
    truth = read_toml(CONFIGS / "sim" / "turning-centre.toml")
    truth["axis"]["X"]["drive"]["feed_forward"] = 1.0
    (folder / "table.csv").write_text("t,x,e\n0,0,1\n1,10,2\n2,20,3\n3,10,4\n4,0,5\n", encoding="utf-8")
    every = read_toml(folder / "every.toml")
    every["history"] = [{"rms_um": 2.0, "n": 7}]
    out = {
        "run file": Kind(run, run_briefly),
        "machine file": Kind(machine_file, lambda path: _machine_on_its_way(path, truth)),
        "truth": Kind(truth, lambda path: _simulated(load_truth(path), machine)),
        "import map": Kind(_IMPORT, lambda path: _imported(path, folder / "table.csv")),
        "campaign": Kind(_CAMPAIGN, lambda path: _campaign(path, machine)),
        "model": Kind(every, lambda path: load_model(path, MACHINE).dead_bands_mm),
    }
    for kind, more in (
        ("following_error", {"resolution_um": 0.1, "period_s": 0.02, "max_um": 500.0}),
        ("origin_offset", {"resolution_um": 0.1, "period_s": 0.02, "max_um": 500.0}),
        ("phase", {"bits": 11, "range_mm": 0.1024, "period_s": 0.02}),
    ):
        other = copy.deepcopy(run)
        other["output"] = {"X": {"kind": kind, **more}, "Z": {"kind": kind, **more}}
        other["device"]["box"] |= {"actuator": kind, "unit_um": 0.1}
        out[f"run file, {kind}"] = Kind(other, run_briefly)
    for name, axis, setup in _SETUPS:
        head = {"instrument": name, "machine": machine.name, **({"axis": axis} if axis else {})}
        accepted = {"missing_codes": [9999.0], "accept_values": [99.0], "hold_temperature_s": 5.0}
        tables = {"measurement": head, "setup": setup, "table": accepted}
        out[f"measurement, {name}"] = Kind(tables, lambda path: _measurement(path, machine))
    return out | _drivers()


def _drivers() -> dict[str, Kind]:
    """The table of every driver that is installed, as its own example has it; constructed, not opened."""
    machine, where = load_machine(CONFIGS / "machines" / "turning-centre.toml"), CONFIGS / "run.toml"

    def made(name: str) -> Callable[[Path], object]:
        return lambda path: make_device(name, read_toml(path), machine, VirtualClock(1), where)

    out = {}
    for driver in installed().values():
        text = driver.load().EXAMPLE.replace("T_column", "T_headstock").replace(".T_spindle]", ".T_spindle_rear]")
        ((name, table),) = tomllib.loads(text)["device"].items()
        out[f"driver {driver.name}"] = Kind(table, made(name))
    return out


def _run_file(folder: Path) -> dict[str, Any]:
    run = setups.tables(folder, warm_up_s=10.0, unit_um=1.0)
    run["run"] |= {"rate_hz": 1000.0, "flush_s": 0.5}
    run["guard"] = {"counts_max_age_s": 0.005, "temperature_max_age_s": 30.0, "fade_after_s": 60.0}
    run["inputs"] = {"load_kg": 10.0, "force_n": 100.0, "motion_filter_s": 0.02}
    run["output"] = {"X": {"kind": "pulse", "quantum_counts": 1, "max_counts_per_s": 20000.0}}
    run["realtime"] = {"priority": 80, "cpu": 1}
    run["log"] = {"segment_mb": 512.0, "segment_s": 3600.0, "disk_share": 0.5}
    run["control"] = {"status_hz": 10.0}
    run["capture"] = {
        "axis": {"X": {"a": "A", "b": "B", "start_mm": 1.0, "min_edge_separation_us": 1.0}},
        "degc": {"T_bed": 21.0},
        "spindle_rpm": 100.0,
    }
    return run


def run_briefly(path: Path) -> None:
    """A few cycles of a run file, on a clock of its own."""
    made, clock = load_setup(path), VirtualClock(10**9)
    step = Step(made.step_settings())
    samples, commands = Samples.empty(step.layout, CYCLES), Commands.empty(step.layout, CYCLES)
    rows = bind_rows(step, list(zip(samples.singles(), commands.singles(), strict=True)))
    with ExitStack() as stack:
        ports = open_ports(made, make_devices(made, clock), stack)
        Loop(step, ports, clock, made.period_ns, rows, MODE_ON).run(CYCLES, lambda _: True)
    if np.abs(commands.output).max() > UNLIMITED or not np.isfinite(commands.applied_um).all():
        raise AssertionError(f"{path}: the ledger left what a float counts exactly")


def _machine_on_its_way(path: Path, truth: dict[str, Any]) -> None:
    _simulated(validated(Truth, truth, "truth"), load_machine(path))


def _simulated(truth: Truth, machine: Machine) -> None:
    check_truth(truth, machine)
    made = SimulatedMachine(machine, truth, 1)
    made.work(100.0, 2000.0)
    made.load_program("S2500 M3\nG0 X60 Z320\nG1 X50 F1200\n")
    made.advance_to(10_000_000)
    made.temperatures()


def _imported(path: Path, table: Path) -> None:
    import_table(table, load_map(path))


def _campaign(path: Path, machine: Machine) -> None:
    settings = validated(Settings, read_toml(path), str(path))
    instrument = make_instrument("laser_linear", {"beam_offset_mm": [0.0, 150.0, 80.0]}, "X", None, machine, "setup")
    simulate(small_model(machine), instrument, settings)


def _measurement(path: Path, machine: Machine) -> None:
    file = read_measurement_toml(path, machine.name, path)
    head = file.measurement
    instrument = make_instrument(head.instrument, file.setup, head.axis, head.component, machine, str(path))
    simulate(small_model(machine), instrument, Settings(cycles=1, protocol="cold"))


@dataclass
class Outcome:
    """What came of the files of one kind: how many did their work, how many were refused, and the faults."""

    good: int = 0
    refused: int = 0
    faults: list[str] = field(default_factory=list)


def attack(kind: Kind, folder: Path, trials: Iterable[tuple[Place, object]]) -> Outcome:
    """Write and use a file for each trial; the good file must do its work first."""
    path, out = folder / "trial.toml", Outcome()
    path.write_text(tomli_w.dumps(kind.tables), encoding="utf-8")
    kind.use(path)
    for place, value in trials:
        path.write_text(tomli_w.dumps(put(kind.tables, place, value)), encoding="utf-8")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                kind.use(path)
            out.good += 1
        except RtecError:
            out.refused += 1
        except Exception as e:  # noqa: BLE001 (any other error is what is looked for)
            out.faults.append(f"{'.'.join(map(str, place))} = {str(value)[:40]}: {type(e).__name__}: {e}")
    return out


def trials(kind: Kind) -> list[tuple[Place, object]]:
    """Every number of the file with every extreme."""
    return [(place, value) for place in places(kind.tables) for value in EXTREMES]


def main(wanted: Sequence[str]) -> int:
    """Attack all kinds, or those named; give an exit status."""
    wrong = 0
    with tempfile.TemporaryDirectory(prefix="extremes-rtec-") as folder:
        for name, kind in kinds(Path(folder)).items():
            if wanted and name not in wanted:
                continue
            found = attack(kind, Path(folder), trials(kind))
            sys.stdout.write(f"{name}: {found.good} good, {found.refused} refused, {len(found.faults)} faults\n")
            sys.stdout.write("".join(f"  {fault}\n" for fault in found.faults))
            sys.stdout.flush()
            wrong += len(found.faults)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
