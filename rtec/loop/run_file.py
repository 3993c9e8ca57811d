"""The run file: which machine, model, devices and limits, and the daemon's control, log and real-time tables.

The file and every file that it names are read and checked whole; all faults are reported at once.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from rtec.correction.flags import GuardSettings, Limits
from rtec.correction.sinks import PulseSink, Sink
from rtec.correction.tables import FORMATS
from rtec.correction.tables.predict import grids_mm, table_axes
from rtec.correction.tables.table import CompensationTable, TableFormat
from rtec.errors import ConfigError, RtecError
from rtec.loop.step import Inputs, StepSettings, loop_faults
from rtec.loop.telemetry_tables import LOOPBACK, TelemetryTable, is_place
from rtec.machine import Axis, Machine, load_machine
from rtec.model import Model, load_model
from rtec.quantities import DegreesCelsius, MicrometresPositive, Millimetres, MillimetresPositive, RevolutionsPerMinute
from rtec.tomlfile import Strict, digest, nearest, read_kind, validated

NO_DEVICES: Final = {"role": {"counts": "none", "actuator": "none"}, "device": {}}


class ControlTable(Strict):
    """Sockets of the daemon. None of them is on the network; remote users come by ssh.

    Attributes:
        local: open a socket on this computer, guarded by file permissions.
        access: who may use it: "user" (the one that the daemon runs as, and root) or "group" (its group, too).
        status_access: who may use the socket that only reads the status, as `rtec telemetry` does; as `access`.
        status_hz: how often the status is sent to clients that watch it.
        prometheus: "host:port" of this computer at which Prometheus reads figures; not given: nothing listens.
        compared: file with the output of `rtec compare --json`; the status shows its residual.
    """

    local: bool = True
    access: Literal["user", "group"] = "user"
    status_access: Literal["user", "group"] = "group"
    status_hz: Annotated[float, Field(ge=0.1, le=50)] = 10.0
    prometheus: str | None = None
    compared: Path | None = None

    @model_validator(mode="before")
    @classmethod
    def _gone(cls, data: Any) -> Any:
        gone = sorted({"tcp", "tcp_status", "keys"} & set(data)) if isinstance(data, dict) else []
        if gone:
            raise ValueError(
                f"{', '.join(gone)}: the daemon itself is not on the network any more; clients come by ssh: "
                "take this out, and see docs/control.md"
            )
        return data

    @model_validator(mode="after")
    def _places(self) -> Self:
        if self.prometheus is not None and not is_place(self.prometheus):
            raise ValueError(f'prometheus: {self.prometheus!r} is not "host:port"')
        if self.prometheus is not None and not LOOPBACK.fullmatch(self.prometheus):
            raise ValueError(
                f'prometheus: {self.prometheus!r} is not "127.0.0.1:PORT" or "localhost:PORT": it asks for no key, '
                "so it stays on the loopback"
            )
        return self


class LogTable(Strict):
    """Rules for the logs in `[run] log_folder`. A log that `--log` puts elsewhere is one file, never split or packed.

    Attributes:
        segment_mb: a file of this size is closed, and the next one begins; 10^6 bytes.
        segment_s: a file of this age is closed, too.
        disk_share: share of the disk that all logs in the folder may take; the oldest are removed first.
        pack: turn closed files into zstd Parquet, about a tenth of the size.
    """

    segment_mb: Annotated[float, Field(ge=1e-3, le=1e6)] = 512.0
    segment_s: Annotated[float, Field(ge=1, le=1e7)] = 3600.0
    disk_share: Annotated[float, Field(ge=1e-6, le=1)] = 0.5
    pack: bool = True


class RunTable(Strict):
    """`[run]`: what runs, how fast, where the log goes. Relative paths start at the run file's folder.

    Attributes:
        machine: path of the machine file.
        model: path of the model file. Without one nothing is corrected: `mode` is then "hold" or "off".
        rate_hz: cycles per second.
        mode: "on", "off" or "hold" at the start.
        zero: "counts": count 0 of the device is position 0 of the machine; "ordered", for incremental encoders: the
            correction holds until `rtec ctl home` gives the positions, once each time the device got its supply.
        log_folder: every run writes a log there; not given: no log.
        state_folder: folder for ledger and mode, which survive a power cut there; not given: the log_folder.
        flush_s: a power cut loses at most this much of the log.
    """

    machine: Path
    model: Path | None = None
    rate_hz: Annotated[float, Field(ge=1, le=4000)] = 1000.0
    mode: Literal["on", "off", "hold"] = "on"
    zero: Literal["counts", "ordered"] = "counts"
    log_folder: Path | None = None
    state_folder: Path | None = None
    flush_s: Annotated[float, Field(ge=1e-3, le=1)] = 0.5


class Roles(Strict):
    """`[role]`: the device that reads or writes each quantity, by the device's name.

    Attributes:
        counts: reads the axes' encoder counts.
        temperatures: read the temperature sensors; each gives its own.
        spindle: reads the spindle speed.
        actuator: puts the correction into the machine; not given: `[table]` alone corrects.
    """

    counts: str
    temperatures: tuple[str, ...] = ()
    spindle: str | None = None
    actuator: str | None = None


class TableRewrites(Strict):
    """`[table]`: compensation tables that the daemon rewrites while the machine warms up.

    Attributes:
        files: by axis, by component as EYX for a table between two axes, or as EZXY for a plane; relative paths start
            at the run file.
        format: of all files; `rtec table formats` lists them.
        grid_mm: distance of the points.
        interval_s: period after which each file is rewritten, where the prediction differs from it by `hysteresis_um`.
        change_um: a file is rewritten earlier, but not within ten seconds of the last time, where the prediction
            differs from it by this; not given: at the interval only.
        hysteresis_um: a smaller difference than this rewrites nothing.
        most_change_um: largest change of a value in one rewrite.
    """

    files: Annotated[dict[str, Path], Field(min_length=1)]
    format: str = "linuxcnc"
    grid_mm: MillimetresPositive = 10.0
    interval_s: Annotated[float, Field(ge=1, le=86400)] = 300.0
    change_um: MicrometresPositive | None = None
    hysteresis_um: MicrometresPositive = 0.2
    most_change_um: MicrometresPositive = 5.0

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.hysteresis_um > min(self.change_um or self.most_change_um, self.most_change_um):
            raise ValueError("hysteresis_um: must not be above change_um or most_change_um: nothing would be rewritten")
        return self


class Realtime(Strict):
    """`[realtime]`: scheduling and memory of the loop's process.

    Attributes:
        priority: SCHED_FIFO priority; 0: an ordinary process.
        cpu: processor to stay on; not given: the last one where there are several.
        lock_memory: lock its memory, so that it is never swapped.
    """

    priority: Annotated[int, Field(ge=0, le=98)] = 80
    cpu: Annotated[int, Field(ge=0, le=4095)] | None = None
    lock_memory: bool = True


class CaptureAxis(Strict):
    """`[capture.axis.X]`: channels of one axis in a logic-analyser capture, and what the controller can follow.

    Attributes:
        a, b: names of the lines; every other line, the index too, is copied unchanged.
        start_mm: position at the first sample.
        min_edge_separation_us: least time between an inserted edge and any other.
    """

    a: str
    b: str
    start_mm: Millimetres = 0.0
    min_edge_separation_us: Annotated[float, Field(ge=1e-3, le=1e6)] = 1.0


class CaptureTable(Strict):
    """`[capture]`: how `rtec replay` reads a `.sr` file with this run file.

    Attributes:
        axis: channels by axis name; an axis that is not named stands still at zero.
        degc: temperatures during the capture; a sensor that is not named is at the model's reference.
        spindle_rpm: spindle speed during the capture.
    """

    axis: dict[str, CaptureAxis]
    degc: dict[str, DegreesCelsius] = Field(default_factory=dict)
    spindle_rpm: RevolutionsPerMinute = 0.0


class RunFile(Strict):
    """The whole run file.

    Attributes:
        run: what runs, how fast, where the log goes.
        role: which device does what.
        device: the devices by name; the key `driver` names the driver, the other keys are the driver's own.
        limits: of each axis' correction; every compensated axis needs them.
        guard: when inputs are too old.
        inputs: quantities that no device reads.
        output: how the correction of an axis goes into the machine; not given: as pulses.
        realtime: scheduling and memory of the loop's process.
        log: rules for the logs in `log_folder`.
        control: sockets of the daemon.
        table: compensation tables that the daemon rewrites.
        telemetry: what `rtec telemetry` publishes.
        capture: how `rtec replay` reads a logic-analyser capture.
        hil: the simulated machine behind the buses; `rtec hil` alone reads it.
    """

    run: RunTable
    role: Roles
    device: dict[str, dict[str, Any]]
    limits: dict[str, Limits] = Field(default_factory=dict)
    guard: GuardSettings = Field(default_factory=GuardSettings)
    inputs: Inputs = Field(default_factory=Inputs)
    output: dict[str, Sink] = Field(default_factory=dict)
    realtime: Realtime = Field(default_factory=Realtime)
    log: LogTable = Field(default_factory=LogTable)
    control: ControlTable = Field(default_factory=ControlTable)
    table: TableRewrites | None = None
    telemetry: TelemetryTable = Field(default_factory=TelemetryTable)
    capture: CaptureTable | None = None
    hil: dict[str, Any] | None = None


@dataclass(frozen=True)
class Setup:
    """A run file with everything that it names.

    Attributes:
        path: the run file.
        file: its content.
        machine, model: read and checked.
        hash: SHA-256 of its content.
        step_um: by axis, the deliberate step that the model of a sign check makes; empty in ordinary runs.
    """

    path: Path
    file: RunFile
    machine: Machine
    model: Model
    hash: str
    step_um: Mapping[str, float] = field(default_factory=dict)

    @property
    def base(self) -> Path:
        """Folder that relative paths start at."""
        return self.path.parent

    @property
    def period_ns(self) -> int:
        """Length of a cycle."""
        return round(1e9 / self.file.run.rate_hz)

    @property
    def inserts(self) -> bool:
        """Whether counts of an axis are inserted."""
        sinks = [self.file.output.get(a.name, PulseSink()) for a in self.machine.axes if a.compensate]
        return any(isinstance(s, PulseSink) for s in sinks)

    @property
    def state_folder(self) -> Path | None:
        """Folder of the state's copy on disk; None: none is named."""
        folder = self.file.run.state_folder or self.file.run.log_folder
        return None if folder is None else (self.base / folder).resolve()

    def step_settings(self) -> StepSettings:
        """Settings of the step."""
        sinks = {a.name: self.file.output.get(a.name, PulseSink()).scale(a) for a in self.machine.axes}
        longest_s = 1.0 / self.file.run.rate_hz
        return StepSettings(self.model, self.file.limits, sinks, self.file.guard, longest_s, self.file.inputs)

    def log_header(self) -> dict[str, str]:
        """Entries of the log's header: where the log comes from."""
        from rtec.version import __version__

        return {
            "rtec_version": __version__,
            "config_file": self.path.name,
            "config_sha256": self.hash,
            "machine": self.machine.name,
            "machine_sha256": self.machine.hash,
            "model": self.model.name,
            "model_sha256": self.model.hash,
            "rate_hz": f"{self.file.run.rate_hz:g}",
            "longest_cycle_s": f"{1.0 / self.file.run.rate_hz!r}",
            **{name: f"{value!r}" for name, value in self.file.inputs.model_dump().items()},
        }


def load_setup(path: Path, *, needs_model: bool = True, needs_devices: bool = True) -> Setup:
    """Read a run file, its machine and its model.

    Args:
        path: of the run file.
        needs_model: False: do not read its model; a model without effects replaces it.
        needs_devices: False: `[role]` and `[device]` may be missing, as for the replay of a log or a capture.

    Raises:
        RtecError: all faults of all these files.
    """
    data = read_kind(path, "a run file")
    file = validated(RunFile, data if needs_devices else {**NO_DEVICES, **data}, str(path))
    base = path.parent
    machine = load_machine(base / file.run.machine)
    faults = [*_faults(file, machine, str(path)), *(_role_faults(file, str(path)) if needs_devices else ())]
    if needs_devices:
        faults += _output_faults(file, str(path))
    if needs_devices and file.table is not None:
        faults += _table_faults(file, file.table, machine, path)
    model = Model(machine, name="none")
    if needs_model and file.run.model is None and file.run.mode == "on":
        faults.append(
            f"{path}: [run] key 'model' is missing; without a model nothing is corrected: set mode = \"hold\", or "
            "fit one (`rtec fit`)"
        )
    if needs_model and file.run.model is not None:
        try:
            model = load_model(base / file.run.model, machine)
            faults += [f"{base / file.run.model}: {fault}" for fault in loop_faults(model)]
        except RtecError as e:
            faults.append(str(e))
    if faults:
        raise ConfigError("\n".join(faults))
    return Setup(path, file, machine, model, digest(_jsonable(data)))


def setup_of(data: Mapping[str, Any], path: Path, machine: Machine, model: Model) -> Setup:
    """The setup of a run file that is not written yet.

    Args:
        data: its tables.
        path: where it will be.
        machine, model: those that it will name.

    Raises:
        ConfigError: all faults of the tables.
    """
    file = validated(RunFile, data, str(path))
    if faults := [*_faults(file, machine, str(path)), *_role_faults(file, str(path)), *_output_faults(file, str(path))]:
        raise ConfigError("\n".join(faults))
    return Setup(path, file, machine, model, digest(_jsonable(data)))


def _faults(file: RunFile, machine: Machine, source: str) -> list[str]:
    out = []
    for section, axes in (("limits", tuple(file.limits)), ("output", tuple(file.output))):
        out += [
            f"{source}: [{section}.{n}] machine {machine.name!r} has no axis {n!r}{nearest(n, machine.axis_names)}"
            for n in axes
            if n not in machine.axis_names
        ]
    out += [
        f"{source}: [limits.{a.name}] is missing: axis {a.name} is compensated and needs warning_um, stop_um, "
        "slew_um_s and acceleration_um_s2; nothing runs without limits"
        for a in machine.axes
        if a.compensate and a.name not in file.limits
    ]
    return out + _capture_faults(file, machine, source)


def _output_faults(file: RunFile, source: str) -> list[str]:
    """Outputs that take less than the correction may become: the machine would have less than rtec goes by."""
    out = []
    for name, sink in file.output.items():
        limits = file.limits.get(name)
        if limits is None or limits.stop_um <= sink.most_um:
            continue
        key = "range_mm" if sink.kind == "phase" else "max_um"
        out.append(
            f"{source}: [output.{name}] {key} allows {sink.most_um:g} µm, and stop_um of [limits.{name}] is "
            f"{limits.stop_um:g}: the machine would have less than is corrected. Lower stop_um to {sink.most_um:g}, or "
            f"raise {key} if the controller takes more"
        )
    return out


def _role_faults(file: RunFile, source: str) -> list[str]:
    roles = {"counts": (file.role.counts,), "temperatures": file.role.temperatures}
    roles |= {k: (v,) if v else () for k, v in (("actuator", file.role.actuator), ("spindle", file.role.spindle))}
    missing = (
        [] if file.role.actuator or file.table else [f"{source}: [role] actuator is missing, and there is no [table]"]
    )
    return missing + [
        f"{source}: [role] {role}: no [device.{name}]{nearest(name, file.device)}"
        for role, names in roles.items()
        for name in names
        if name not in file.device
    ]


def _table_faults(file: RunFile, table: TableRewrites, machine: Machine, path: Path) -> list[str]:
    """Every fault that shows before there is a prediction."""
    where, out, key_of = f"{path}: [table]", list[str](), dict[Path, str]()
    form = FORMATS.get(table.format)
    if form is None:
        out.append(f"{where} format: no format {table.format!r}{nearest(table.format, FORMATS)}")
    if file.run.model is None:
        out.append(f"{where}: needs a model: [run] key 'model' is missing")
    for key, name in table.files.items():
        target = (path.parent / name).resolve()
        if target in key_of:
            out.append(f"{where} files.{key}: {name} is the file of {key_of[target]} already")
        key_of[target] = key
        if not target.parent.is_dir():
            out.append(f"{where} files.{key}: the folder {target.parent} is not there")
        try:
            axis, corrects, second = table_axes(machine, key)
        except ConfigError as e:
            out.append(f"{where} files.{key}: {e}")
            continue
        if file.role.actuator and corrects.compensate:
            out.append(
                f"{where} files.{key}: [role] actuator corrects {corrects.name}, too, and the error would be taken out "
                f"twice: take one of them away, or write compensate = false in [axis.{corrects.name}] of the machine"
            )
        if corrects.name not in file.limits:
            out.append(f"{where} files.{key}: [limits.{corrects.name}] is missing; no table is written without limits")
        out += [f"{where} files.{key}: {why}" for why in (_unfit(form, axis, corrects, second, table) if form else ())]
    return out


def _unfit(form: TableFormat, axis: Axis, corrects: Axis, second: Axis | None, table: TableRewrites) -> Iterator[str]:
    """Reasons why a format cannot hold a table of these axes."""
    if form.limits.typed:
        yield f"{table.format} is a list to type in; the daemon cannot put it into the control"
        return
    try:
        grid, across = grids_mm(form, axis, second, table.grid_mm)
    except ConfigError as e:
        yield str(e)
        return
    zero = np.zeros((len(across), len(grid)) if second else len(grid))
    name = second.name if second else ""
    if why := form.refuses(CompensationTable(axis.name, corrects.name, grid, zero, zero, {}, name, across)):
        yield f"{table.format} {why}"


def _capture_faults(file: RunFile, machine: Machine, source: str) -> list[str]:
    if file.capture is None:
        return []
    out = []
    for section, names, allowed in (
        ("capture.axis", file.capture.axis, machine.axis_names),
        ("capture.degc", file.capture.degc, machine.sensor_names),
    ):
        out += [
            f"{source}: [{section}] {n!r} is not of this machine{nearest(n, allowed)}"
            for n in names
            if n not in allowed
        ]
    return out


def _jsonable(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(k): _jsonable(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_jsonable(v) for v in value]
    return value if isinstance(value, str | int | float | bool) else str(value)
