"""Run files with real parts for the doctor's tests, and a made-up /sys and /proc."""

import os
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from rtec.doctor.devices import examine
from rtec.doctor.found import DeviceFound, Examination
from rtec.errors import DriverFault, DriverTimeout
from rtec.loop import devices
from rtec.loop.clock import Clock
from rtec.tomlfile import Strict
from tests.support import setups

SPEED = {"X": 400.0, "Z": 400.0}


CALM_HZ = 10.0
"""A cycle so long that no reading is too slow for it, however busy this computer is."""


def run_file(
    folder: Path, role: Mapping[str, Any], device: Mapping[str, Any], rate_hz: float | None = None, **more: Any
) -> Path:
    """A run file with these devices; the model reads T_spindle_front and T_bed."""
    tables = setups.tables(folder)
    tables["run"] |= {} if rate_hz is None else {"rate_hz": rate_hz}
    return setups.write(folder, {**tables, "role": dict(role), "device": dict(device), **more})


def sim(folder: Path) -> dict[str, Any]:
    """The table of the simulated machine; no time is lost with its day."""
    table: dict[str, Any] = setups.tables(folder, warm_up_s=0.0)["device"]["box"]
    return table


ALL_SIM = {"counts": "box", "temperatures": ["box"], "spindle": "box", "actuator": "box"}


def seen(path: Path, seconds: float = 0.3, **more: Any) -> tuple[Examination, dict[str, DeviceFound]]:
    """What the doctor finds, and its devices by name."""
    found = examine(path, seconds, **more)
    return found, {d.name: d for d in found.devices}


def texts(device: DeviceFound) -> list[str]:
    """What is wrong with it, in words."""
    return [fault.what for fault in device.wrong]


class Fake:
    """A driver whose device does what a test says; everything that it is asked for is noted."""

    class options_model(Strict):  # noqa: N801 - the name that the registry looks for
        """No options."""

    asked: ClassVar[list[str]] = []
    takes_s = late_s = 0.0
    fails = every = first = 0
    later = (0, 0.0)
    opens: threading.Event | None = None

    def __init__(self, options: object, machine: Any, clock: Clock, base: Path) -> None:
        del options, machine, base
        self.clock, self.n = clock, 0
        self.asked.clear()

    def __enter__(self) -> "Fake":
        if self.opens is not None:
            self.opens.wait(30)
        return self

    def __exit__(self, *error: object) -> None:
        self.asked.append("closed")

    def read_counts(self, counts: NDArray[np.int64]) -> int:
        """Counts that grow by one."""
        self.n += 1
        self.clock.sleep_until_ns(self.clock.now_ns() + round(self.takes_s * 1e9))
        if self.every and self.n % self.every == 0:
            raise DriverTimeout("fake: no answer")
        counts[:] = self.first + self.n
        every, later_s = self.later
        late_s = later_s if every and self.n % every == 0 else self.late_s
        return self.clock.now_ns() - round(late_s * 1e9)

    def read_temperatures(self, degc: NDArray[np.float64], time_ns: NDArray[np.int64]) -> None:
        """Two sensors; the second fails."""
        degc[0], time_ns[0] = 25.0, self.clock.now_ns()
        if self.fails:
            raise DriverFault("fake: T_bed is broken")

    def refuses(self, sink: Any) -> str:
        """Pulses."""
        return "" if sink.kind == "pulse" else "takes pulses"

    def apply(self, output: NDArray[np.int64]) -> None:
        """Must never be called."""
        del output
        self.asked.append("apply")

    def read_output(self, output: NDArray[np.int64]) -> None:
        """As if it had been commanded before."""
        output[:] = [12, -7]

    def hold(self) -> None:
        """Note it."""
        self.asked.append("hold")


def with_fake(monkeypatch: Any, **more: Any) -> type[Fake]:
    """Have every driver named "fake" be a fake one that does these things."""
    kind = type("Fake", (Fake,), {"asked": [], **more})
    real = devices.driver_class
    monkeypatch.setattr(devices, "driver_class", lambda name, where: kind if name == "fake" else real(name, where))
    return kind


def usb_port(root: Path, name: str, serial: str, product: str = "UART") -> None:
    """A USB adapter as Linux shows it: the port's folder leads to a device below the adapter's own."""
    adapter = root / "sys/devices/usb1" / f"1-{name}"
    interface = adapter / "1-1:1.0" / name
    interface.mkdir(parents=True)
    for key, text in (("idVendor", "0403"), ("serial", serial), ("manufacturer", "FTDI"), ("product", product)):
        (adapter / key).write_text(text + "\n", encoding="utf-8")
    place = root / "sys/class/tty" / name
    place.mkdir(parents=True)
    (place / "device").symlink_to(os.path.relpath(interface, place))


def plain_port(root: Path, name: str, kind: str) -> None:
    """A port on the board; kind 0: a place without hardware."""
    place = root / "sys/class/tty" / name
    (place / "device").mkdir(parents=True)
    (place / "type").write_text(kind, encoding="utf-8")
