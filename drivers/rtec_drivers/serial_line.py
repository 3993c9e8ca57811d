"""A serial port that never blocks: options, search by USB serial number, reading and writing bytes."""

import errno
import os
import select
import termios
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from rtec.errors import DriverTimeout, DriverUnavailable
from rtec.tomlfile import Strict
from rtec_drivers.reopen import FirstRetry, LongestRetry

READ_BYTES = 4096
SELECT_LIMIT = 1024
Ports = Callable[[], Sequence[Any]]
PARITIES = {"none": "N", "even": "E", "odd": "O", "mark": "M", "space": "S"}
LOST = (errno.EIO, errno.ENXIO, errno.ENODEV, errno.EBADF, errno.EPIPE, errno.ENOENT)


class PortOptions(Strict):
    """Options of the port of a serial device.

    Attributes:
        port: device file, or a link under /dev/serial/by-id.
        usb_serial: serial number of the USB adapter, by which the port is found whatever its present name. Without
            it, the number of the adapter behind `port` is remembered, and found again after it was pulled.
        baud, bytesize, parity, stopbits: as set on the device.
        at_start: "required": the run does not begin without the port; "later": it may appear any time.
        first_retry_s, longest_retry_s: wait between two attempts to open; doubled from the first up to the longest.
    """

    port: str | None = None
    usb_serial: str | None = None
    baud: Annotated[int, Field(ge=50, le=20_000_000)] = 115200
    bytesize: Literal[5, 6, 7, 8] = 8
    parity: Literal["none", "even", "odd", "mark", "space"] = "none"
    stopbits: Literal[1, 2] = 1
    at_start: Literal["required", "later"] = "required"
    first_retry_s: FirstRetry = 0.1
    longest_retry_s: LongestRetry = 5.0

    @model_validator(mode="after")
    def _some_port(self) -> Self:
        if not self.port and not self.usb_serial:
            raise ValueError("give port (a device file) or usb_serial (serial number of the USB adapter), or both")
        return self

    @property
    def place(self) -> str:
        """Name of the port, for people."""
        return self.port or f"USB adapter {self.usb_serial}"


class PortFinder:
    """Finds the device file to open, even after the adapter came back under another name.

    Args:
        options: port or serial number.
        ports: lists the existing ports; None: pyserial's list.
    """

    def __init__(self, options: PortOptions, ports: Ports | None = None) -> None:
        self._options, self._ports = options, ports or _comports
        self._serial, self._interface = options.usb_serial, ""

    def find(self) -> str:
        """The device file.

        Raises:
            DriverUnavailable: no port, or several, have that serial number.
        """
        if self._serial is None:
            return str(self._options.port)
        there = list(self._ports())
        same = [p for p in there if p.serial_number == self._serial]
        for ours in (same, [p for p in same if self._same_interface(p)], [p for p in same if self._is_named(p)]):
            if len(ours) == 1:
                return str(ours[0].device)
        if same:
            raise DriverUnavailable(f"several ports have the USB serial number {self._serial!r}; name one with port")
        listed = ", ".join(f"{p.device} ({p.serial_number})" for p in there if p.serial_number) or "none"
        raise DriverUnavailable(f"no port with the USB serial number {self._serial!r}; USB ports here: {listed}")

    def remember(self, device: str) -> None:
        """Remember the adapter behind an open port, so that it is found again by its number.

        A number that several adapters here share (some makers give all of them one) is ignored: the port's name is
        used.
        """
        real = os.path.realpath(device)
        try:
            there = [p for p in self._ports() if p.serial_number]
        except DriverUnavailable:  # the port is open all the same, so the number is not needed
            return
        for port in (p for p in there if os.path.realpath(p.device) == real):
            number, interface = port.serial_number, _interface(port)
            if [(p.serial_number, _interface(p)) for p in there].count((number, interface)) == 1:
                self._serial, self._interface = number, interface

    def _same_interface(self, port: Any) -> bool:
        """Of an adapter with several ports: is it the port that was opened before?"""
        return bool(self._interface) and _interface(port) == self._interface

    def _is_named(self, port: Any) -> bool:
        """Is it the port of the run file?"""
        named = self._options.port
        return named is not None and os.path.realpath(port.device) == os.path.realpath(named)


class SerialLine:
    """An open port. Every call but `wait` returns at once.

    Args:
        options: settings.
        device: device file.

    Raises:
        DriverUnavailable: it does not exist, is in use, or may not be opened.
    """

    def __init__(self, options: PortOptions, device: str) -> None:
        self.device = device
        self._serial = _open(options, device)
        self._fd = int(self._serial.fileno())
        self._unsent = b""
        if self._fd >= SELECT_LIMIT:
            self.close()
            raise DriverUnavailable(f"{device}: more than {SELECT_LIMIT} files are open in this process")

    def close(self) -> None:
        """Close the port; a second call does nothing."""
        self._fd = -1
        with suppress(OSError, termios.error):
            self._serial.reset_output_buffer()  # else the system may wait up to 30 s until it is empty
        with suppress(OSError, termios.error):
            self._serial.close()

    def write(self, data: bytes) -> None:
        """Pass bytes on to the system, all or none of them; the next call sends those that its full buffer refused.

        Raises:
            DriverTimeout: the port accepts no bytes now; nothing of `data` was sent.
            DriverUnavailable: the port is gone.
        """
        if self._unsent:
            self._unsent = self._unsent[self._push(self._unsent) :]
        sent = 0 if self._unsent else self._push(data)
        if not sent and data:
            raise DriverTimeout(f"{self.device}: takes no bytes")
        self._unsent += data[sent:]

    def read(self) -> bytes:
        """The bytes that have arrived; may be empty.

        Raises:
            DriverUnavailable: the port is gone.
        """
        if not self.wait(0.0):
            return b""
        try:
            received = os.read(self._fd, READ_BYTES)
        except BlockingIOError:
            return b""
        except OSError as e:
            raise self._gone(e) from e
        if not received:
            raise DriverUnavailable(f"{self.device}: gone (end of file)")
        return received

    def wait(self, timeout_s: float) -> bool:
        """Wait at most so long for bytes, or for the port to vanish; return whether to read.

        Raises:
            DriverUnavailable: the port was closed.
        """
        try:
            return bool(select.select((self._fd,), (), (), max(0.0, timeout_s))[0])
        except (OSError, ValueError) as e:
            raise DriverUnavailable(f"{self.device}: closed") from e

    def _push(self, data: bytes) -> int:
        try:
            return os.write(self._fd, data)
        except BlockingIOError:
            return 0
        except OSError as e:
            raise self._gone(e) from e

    def _gone(self, error: OSError) -> DriverUnavailable:
        reason = "gone" if error.errno in LOST else f"fails: {error.strerror}"
        return DriverUnavailable(f"{self.device}: {reason}")


def _comports() -> Sequence[Any]:
    from serial.tools import list_ports

    try:
        return list_ports.comports()
    except (OSError, TypeError, ValueError) as e:  # an adapter vanished during the listing
        raise DriverUnavailable("the USB ports are just changing") from e


def _interface(port: Any) -> str:
    """Interface of an adapter with several ports: the part of its USB location after the colon."""
    return str(port.location or "").partition(":")[2]


def _open(options: PortOptions, device: str) -> Any:
    try:
        import serial
    except ImportError as e:
        raise DriverUnavailable(f"pyserial is not installed: {e}") from e
    try:
        port = serial.Serial(
            device,
            options.baud,
            options.bytesize,
            PARITIES[options.parity],
            options.stopbits,
            timeout=0,
            write_timeout=0,
            exclusive=True,
        )
    except (OSError, ValueError, termios.error) as e:
        raise DriverUnavailable(f"{device}: {_why_not(e, device)}") from e
    with suppress(OSError, ValueError, NotImplementedError, termios.error):
        port.set_low_latency_mode(True)  # else many USB adapters hold bytes for 16 ms
    with suppress(OSError, termios.error):
        port.reset_input_buffer()
    return port


def _why_not(error: Exception, device: str) -> str:
    number = getattr(error, "errno", None)
    if number in (errno.EAGAIN, errno.EBUSY):
        return "in use by another program"
    if number in (errno.EACCES, errno.EPERM):
        return "may not be opened by this user; members of the group 'dialout' may"
    if not Path(device).exists():
        return "no such port; plug it in, or name another"
    return f"cannot be opened: {error}"
