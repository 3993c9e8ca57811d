"""This computer's data on its serial ports and CAN interfaces: which exist, who may open them, who has them open.

Everything is read from files below a root folder: `/` in use, an artificial tree in tests. A file that cannot be read
counts as missing; nothing raises.
"""

import grp
import os
import stat
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

ROOT = Path("/")


@dataclass(frozen=True)
class PortHere:
    """A serial port.

    Attributes:
        device: such as "/dev/ttyUSB0".
        serial: serial number of the USB adapter, or "".
        product: name of the adapter, or "".
    """

    device: str
    serial: str = ""
    product: str = ""

    def words(self) -> str:
        """The port on one line."""
        about = [text for text in (self.product, f"serial number {self.serial}" if self.serial else "") if text]
        return f"{self.device} ({', '.join(about)})" if about else self.device


@dataclass(frozen=True)
class Holder:
    """A process that has a file open."""

    pid: int
    name: str


def text_of(path: Path) -> str:
    """Content of a small file, without surrounding white space; "" where it cannot be read."""
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""


def serial_ports(root: Path = ROOT) -> list[PortHere]:
    """The serial ports with hardware behind them, USB adapters first."""
    ports = []
    for port in _entries(root / "sys/class/tty"):
        if not (port / "device").exists() or text_of(port / "type") == "0":  # 0: no hardware behind it
            continue
        adapter = _usb_adapter(port / "device", root)
        if adapter is None:
            ports.append(PortHere(f"/dev/{port.name}"))
            continue
        names = [text_of(adapter / "manufacturer"), text_of(adapter / "product")]
        product = " ".join(n for n in names if n)
        ports.append(PortHere(f"/dev/{port.name}", text_of(adapter / "serial"), product))
    return sorted(ports, key=lambda p: (p.serial == "", p.device))


def holders(device: str, root: Path = ROOT) -> list[Holder]:
    """Other processes that have a device open, as far as this user may see."""
    real, out = os.path.realpath(device), []
    for process in _entries(root / "proc"):
        if process.name.isdigit() and int(process.name) != os.getpid() and real in _open_files(process):
            out.append(Holder(int(process.name), text_of(process / "comm") or "?"))
    return out


def sees_all_processes() -> bool:
    """May this user see which files other users' processes have open?"""
    return os.geteuid() == 0


def group_of(device: str) -> str:
    """The group whose members may read and write a device file; "" where no group may."""
    try:
        status = Path(device).stat()
        allowed = status.st_mode & (stat.S_IRGRP | stat.S_IWGRP)
        return grp.getgrgid(status.st_gid).gr_name if allowed == stat.S_IRGRP | stat.S_IWGRP else ""
    except (OSError, KeyError):
        return ""


def latency_ms(device: str, root: Path) -> int | None:
    """Time for which a USB adapter holds bytes to send more at once, ms; None where it is unknown."""
    text = text_of(root / "sys/bus/usb-serial/devices" / Path(os.path.realpath(device)).name / "latency_timer")
    return int(text) if text.isdigit() else None


def can_state(channel: str, root: Path) -> str:
    """State of a CAN interface of the kernel: "up", "down", …; "" where it does not exist."""
    place = root / "sys/class/net" / channel
    if not place.exists():
        return ""
    flags = text_of(place / "flags")
    with suppress(ValueError):
        return "up" if int(flags, 16) & 1 else "down"
    return text_of(place / "operstate") or "unknown"


def can_interfaces(root: Path = ROOT) -> list[str]:
    """Names of the kernel's CAN interfaces (type 280 is ARPHRD_CAN)."""
    return [link.name for link in _entries(root / "sys/class/net") if text_of(link / "type") == "280"]


def _entries(folder: Path) -> Iterator[Path]:
    try:
        yield from sorted(folder.iterdir())
    except OSError:
        return


def _open_files(process: Path) -> set[str]:
    out = set()
    for link in _entries(process / "fd"):
        with suppress(OSError):
            out.add(str(link.readlink()))
    return out


def _usb_adapter(device: Path, root: Path) -> Path | None:
    """The folder of the USB device of a port."""
    try:
        place = device.resolve(strict=True)
    except OSError:
        return None
    top = root.resolve()
    while place not in (top, place.parent):
        if (place / "idVendor").exists():
            return place
        place = place.parent
    return None
