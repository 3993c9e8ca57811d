"""Makes run files for the bench: with its ports in place of the real ones, and for the all-simulated run."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tomli_w
from pydantic import Field

from rtec.errors import ConfigError
from rtec.loop.clock import RealClock
from rtec.loop.devices import make_devices
from rtec.loop.run_file import RunFile, load_setup
from rtec.machine import load_machine
from rtec.tomlfile import nearest, read_toml, validated
from rtec_drivers.box.gateware import Chip
from rtec_drivers.hil.faults import BUS_OF_DRIVER, Bus
from rtec_drivers.sim import SimDriver, SimOptions

SENSED, TRACK = "sensed", "track.npz"


class HilOptions(SimOptions):
    """`[hil]` of a run file: the simulated machine behind the buses (options of the driver `sim`), and durations.

    Attributes:
        off_s, on_s: duration without and with correction.
        settle_s: time at the beginning that does not count, because the correction is still on its way.
        hold_after_ms, counts_per_s: settings of the simulated encoder box.
    """

    off_s: Annotated[float, Field(ge=1, le=1e6)] = 30.0
    on_s: Annotated[float, Field(ge=1, le=1e6)] = 30.0
    settle_s: Annotated[float, Field(ge=0, le=1e5)] = 4.0
    hold_after_ms: Annotated[int, Field(ge=10, le=60_000)] = 100
    counts_per_s: Annotated[int, Field(ge=100, le=10_000_000)] = 20_000

    def sim(self) -> dict[str, Any]:
        """The options of the driver `sim` among them."""
        return {
            k: v for k, v in self.model_dump(mode="json", exclude_none=True).items() if k in SimOptions.model_fields
        }


@dataclass(frozen=True)
class Wiring:
    """A run file as the bench uses it.

    Attributes:
        path: the run file.
        tables: its content; paths are absolute.
        options: its section `[hil]`.
        buses: the bus of each device, by name.
        gateware: a library of simulated gateware, which replaces the box in software.
    """

    path: Path
    tables: Mapping[str, Any]
    options: HilOptions
    buses: Mapping[str, Bus]
    gateware: Path | None = None

    def link(self, folder: Path, device: str) -> Path:
        """Name of the port behind which a device's far side is."""
        return folder / f"port-{device}"

    def with_ports(self, folder: Path, mode: str) -> Path:
        """Write the run file with the bench's ports in place of its own; give its path."""
        device = {name: dict(table) for name, table in self.tables["device"].items()}
        for name, bus in self.buses.items():
            _rewire(device[name], bus, str(self.link(folder, name)))
        run = {**self.tables["run"], "mode": mode}
        return _write(folder / f"{mode}.toml", {**self.tables, "run": run, "device": device})

    def simulated(self, folder: Path) -> Path:
        """Write the run file of the all-simulated run; give its path."""
        roles = self.tables["role"]
        role: dict[str, Any] = {"counts": "machine", "actuator": "machine", "temperatures": ["machine"]}
        if "spindle" in roles:
            role["spindle"] = "machine"
        kept = {k: v for k, v in self.tables.items() if k != "hil"}
        device = {"machine": {"driver": "sim", **self.options.sim()}}
        return _write(folder / "simulated.toml", {**kept, "role": role, "device": device})


def read_wiring(path: Path, gateware: Path | None = None) -> Wiring:
    """Read a run file for the bench.

    Raises:
        ConfigError: it has no section `[hil]`, a device cannot be simulated here, the gateware does not fit, or
            `rtec run` refuses it.
    """
    tables = read_toml(path)
    if "hil" not in tables:
        raise ConfigError(
            f"{path}: [hil] is missing; it names the simulated machine behind the buses: see configs/hil.toml"
        )
    validated(RunFile, tables, str(path))
    base = path.parent.resolve()
    tables = _absolute(tables, base)
    options = validated(HilOptions, tables["hil"], f"{path}: [hil]")
    if options.actuator != "pulse":
        raise ConfigError(f"{path}: [hil] actuator: the encoder box inserts counts: 'pulse'")
    buses = _buses(tables["device"], str(path))
    setup = load_setup(path)
    make_devices(setup, RealClock())
    try:
        SimDriver(options.model_copy(update={"warm_up_s": 0.0}), setup.machine, RealClock())
    except ConfigError as e:
        raise ConfigError(f"{path}: [hil] {e}") from e
    if gateware is not None:
        with Chip(gateware) as chip:
            chip.check_axes(len(load_machine(Path(tables["run"]["machine"])).axes))
    return Wiring(path, tables, options, buses, gateware)


def _buses(devices: Mapping[str, Mapping[str, Any]], source: str) -> dict[str, Bus]:
    faults, out = [], dict[str, Bus]()
    for name, table in devices.items():
        driver = str(table.get("driver"))
        if driver in BUS_OF_DRIVER:
            out[name] = BUS_OF_DRIVER[driver]
        else:
            faults.append(
                f"{source}: [device.{name}] driver {driver!r} has no far side in the bench"
                f"{nearest(driver, BUS_OF_DRIVER)}"
            )
    boxes = [name for name, bus in out.items() if bus == "box"]
    if not faults and len(boxes) != 1:
        faults.append(f"{source}: the bench needs one encoder box (driver 'serial_box'); the run file has {len(boxes)}")
    if faults:
        raise ConfigError("\n".join(faults))
    return out


def _absolute(tables: dict[str, Any], base: Path) -> dict[str, Any]:
    """Make paths that start at the run file's folder absolute. The bench sets the log's folder; its box counts from the
    machine's zero.
    """
    run = {k: v for k, v in tables["run"].items() if k not in ("log_folder", "zero")}
    run |= {key: str(base / run[key]) for key in ("machine", "model") if key in run}
    hil = {k: str(base / v) if k in ("truth", "program_file") else v for k, v in tables["hil"].items()}
    device = {
        name: {k: str(base / v) if k == "dbc" else v for k, v in table.items()}
        for name, table in tables["device"].items()
    }
    return {**tables, "run": run, "hil": hil, "device": device}


def _rewire(table: dict[str, Any], bus: Bus, port: str) -> None:
    """Put the bench's port in place of the real one; all else stays."""
    if bus == "box":
        table.pop("usb_serial", None)
        table["port"] = port
    elif bus == "modbus":
        serial = {k: v for k, v in table.get("serial", {}).items() if k != "usb_serial"}
        table["serial"] = {**serial, "port": port}
        table.pop("tcp", None)
    else:
        # An adapter on a pty needs no time to start; every other kind of interface is replaced by slcan.
        table |= {"interface": "slcan", "channel": port, "settings": {"sleep_after_open": 0.0}}
        table.setdefault("bitrate", 500_000)


def _write(path: Path, tables: Mapping[str, Any]) -> Path:
    path.write_text(tomli_w.dumps(dict(tables)), encoding="utf-8")
    return path
