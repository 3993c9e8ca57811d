"""Ways to mend what is wrong with a device, from its options and from what this computer says of its ports.

The driver says what is wrong; what can be done about it is the same for every driver on the same kind of line, so it
is found here, from the options that such drivers share: `port`, `usb_serial`, `baud`, `host`, `interface`, `channel`.
"""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from rtec.doctor.ports import (
    ROOT,
    can_interfaces,
    can_state,
    group_of,
    holders,
    latency_ms,
    sees_all_processes,
    serial_ports,
)
from rtec.errors import DriverFault

LINE_KEYS = ("baud", "bytesize", "parity", "stopbits")
SILENT_WORDS = ("no answer", "not answer", "silent", "no connection", "no reading", "no such port", "no port")
NUISANCE = {
    "rtec": "that is `rtec run`: `rtec status` shows its devices; to look at them here stop it first",
    "ModemManager": "it tries every new serial port: sudo systemctl disable --now ModemManager",
    "brltty": "it takes some USB adapters for Braille displays: sudo apt remove brltty",
}


@dataclass(frozen=True)
class SerialPlace:
    """A serial port in a device's options.

    Attributes:
        port: device file, or "" where only the adapter's number is given.
        usb_serial: number of the adapter, or "".
        settings: of the line, as in the run file.
    """

    port: str
    usb_serial: str
    settings: str

    def device(self, root: Path = ROOT) -> str:
        """The device file as it is called now; "" where there is none."""
        if self.usb_serial:
            return next((p.device for p in serial_ports(root) if p.serial == self.usb_serial), "")
        return self.port


def ways(options: BaseModel | None, error: Exception, heard: bool, root: Path = ROOT) -> tuple[str, ...]:
    """What can be done about an error of a device.

    Args:
        options: what the run file says of it; None where that could not be read.
        error: what its driver raised.
        heard: has it given anything? Then its line is well.
        root: where this computer's files are.
    """
    if options is None:
        return ()
    out: list[str] = []
    for place in serial_places(options):
        out += _serial_ways(place, error, heard, root)
    for table in _tables(options):
        out += _can_ways(table, root) + ([] if heard else _network_ways(table, error))
    return tuple(dict.fromkeys(out))


def serial_places(options: BaseModel) -> list[SerialPlace]:
    """Every serial port that the options name."""
    out = []
    for table in _tables(options):
        port, number = _text(table, "port"), _text(table, "usb_serial")
        if _text(table, "interface") == "slcan":
            port = _text(table, "channel").partition("@")[0]
        if number or port.startswith("/"):
            settings = ", ".join(f"{k} {getattr(table, k)}" for k in LINE_KEYS if hasattr(table, k))
            out.append(SerialPlace(port, number, settings))
    return out


def shared_ports(options: BaseModel, root: Path = ROOT) -> list[str]:
    """Warnings about ports that are open: others that read them too, adapters that keep bytes back."""
    out = []
    for place in serial_places(options):
        device = place.device(root)
        out += [f"{device} is open in process {h.pid} ({h.name}) too: each gets a part of the bytes"
                for h in holders(device, root)]  # fmt: skip
        late_ms = latency_ms(device, root) if device else None
        if late_ms is not None and late_ms > 1:
            name = Path(os.path.realpath(device)).name
            out.append(
                f"the USB adapter keeps bytes back for {late_ms} ms: "
                f"echo 1 | sudo tee /sys/bus/usb-serial/devices/{name}/latency_timer"
            )
    return out


def _serial_ways(place: SerialPlace, error: Exception, heard: bool, root: Path) -> list[str]:
    device = place.device(root)
    if not device or not os.path.lexists(device) or not Path(device).exists():
        return _missing(place, root)
    if not os.access(device, os.R_OK | os.W_OK):
        return [_no_access(device)]
    busy = "in use" in str(error)
    if heard or not (busy or _silent(error)):
        return []
    out = [f"process {h.pid} ({h.name}) has {device} open: {_end(h.name, h.pid)}" for h in holders(device, root)]
    if busy:
        hidden = not out and not sees_all_processes()
        return [f"sudo fuser -v {device} tells which program has it open"] if hidden else out
    out.append("is the device switched on, and its cable in (A and B, RX and TX not swapped)?")
    if place.settings:
        out.append(f"the line is set to {place.settings} here: the device must be, too")
    return out


def _silent(error: Exception) -> bool:
    """Does nothing come at all? A driver that reads several devices may tell that as a fault of some."""
    return not isinstance(error, DriverFault) or any(word in str(error) for word in SILENT_WORDS)


def _missing(place: SerialPlace, root: Path) -> list[str]:
    ports = serial_ports(root)
    if not ports:
        return ["this computer has no serial port now: plug the adapter in; `sudo dmesg | tail` shows what it becomes"]
    out = [f"serial ports here: {'; '.join(p.words() for p in ports)}"]
    known = [p for p in ports if p.serial]
    if known and not place.usb_serial:
        out.append(f'found whatever its name is today: usb_serial = "{known[0].serial}" instead of port')
    return out


def _no_access(device: str) -> str:
    group = group_of(device)
    if not group:
        return f'no group may open {device}: a udev rule must give it one (GROUP="dialout", MODE="0660")'
    return f"members of group {group!r} may open {device}: sudo usermod -aG {group} $USER, then log in again"


def _end(name: str, pid: int) -> str:
    return NUISANCE.get(name, f"end it (kill {pid})")


def _can_ways(table: BaseModel, root: Path) -> list[str]:
    channel = _text(table, "channel")
    if _text(table, "interface") != "socketcan" or not channel:
        return []
    state = can_state(channel, root)
    rate = getattr(table, "bitrate", None) or 500_000
    if not state:
        there = ", ".join(can_interfaces(root)) or "none: is the adapter plugged in, and its kernel module loaded?"
        return [f"no interface {channel}; CAN interfaces here: {there}"]
    if state == "down":
        return [f"{channel} is down: sudo ip link set {channel} up type can bitrate {rate} restart-ms 100"]
    return [f"{channel} is up; ip -details -statistics link show {channel} tells its bit rate and errors"]


def _network_ways(table: BaseModel, error: Exception) -> list[str]:
    host = _text(table, "host")
    if not host or not _silent(error):
        return []
    if isinstance(error.__cause__, ConnectionRefusedError):
        return [f"{host} is there, but nothing listens on port {getattr(table, 'port', '?')}: is that the right port?"]
    return [f"does `ping {host}` answer? If not: power, network cable, address of the device"]


def _tables(options: BaseModel) -> Iterator[BaseModel]:
    """The options and every table within them."""
    yield options
    for value in dict(options).values():
        within: list[Any] = list(value.values()) if isinstance(value, dict) else [value]
        for item in within:
            if isinstance(item, BaseModel):
                yield from _tables(item)


def _text(table: BaseModel, key: str) -> str:
    value = getattr(table, key, None)
    return value if isinstance(value, str) else ""
