"""Threads that keep a line alive outlive whatever a library raises. Oracle: what it raised, and that it goes on."""

import threading
from collections.abc import Iterator

import pytest

from rtec.errors import DriverUnavailable
from rtec.loop.clock import RealClock, VirtualClock
from rtec_drivers.can.bus import CanLink, CanOptions
from rtec_drivers.reopen import Backoff, Reopener, Worker
from rtec_drivers.serial_line import PortFinder, PortOptions
from tests.support.conformance import soon

CLOCK = RealClock()
MS = 1_000_000


class Faulty:
    """Opening, serving and closing fail in turn, each with an error of its own; then all is well."""

    def __init__(self) -> None:
        self.left, self.told, self.served = ["connect", "serve", "closes well", "close"], list[str](), threading.Event()

    def now(self, what: str) -> bool:
        return bool(self.left) and self.left[0] == what and bool(self.left.pop(0))

    def connect(self) -> "Faulty":
        if self.now("connect"):
            raise KeyError("connect")
        return self

    def serve(self, _: "Faulty") -> None:
        if self.now("serve"):
            raise IndexError("serve")
        if not self.left:
            self.served.set()

    def close(self) -> None:
        if not self.now("closes well") and self.now("close"):
            raise ZeroDivisionError("close")


def test_a_worker_tells_what_nobody_foresaw_and_goes_on() -> None:
    """Three faults of a library, each told by its own words; the fourth opening serves, in the same thread."""
    device = Faulty()
    worker = Worker("rtec-test", CLOCK, device.connect, device.serve, device.told.append, Backoff(0.001, 0.002))
    worker.start()
    try:
        assert device.served.wait(10)
    finally:
        worker.stop()
    told = [text for text in device.told if text.startswith("fault in the program or in a library")]
    assert [text.split(": ")[1] for text in told] == ["KeyError", "IndexError", "ZeroDivisionError"]


def test_a_reopener_tries_again_after_what_nobody_foresaw() -> None:
    """The list of USB ports is read while an adapter vanishes: pyserial raises a TypeError. The next attempt opens."""
    results: Iterator[int | Exception] = iter([TypeError("int() argument must be a string"), 7])

    def attempt() -> int:
        result = next(results)
        if isinstance(result, Exception):
            raise result
        return result

    clock = VirtualClock()
    reopener = Reopener(attempt, lambda _: None, clock, 0.1, 0.5)
    reopener.lost("pulled")
    opened: list[int] = []

    def look() -> bool:
        clock.sleep_until_ns(clock.now_ns() + 10 * MS)
        opened.extend(n for n in [reopener.poll()] if n is not None)
        return bool(opened)

    assert soon(CLOCK, look)
    assert opened == [7]
    assert reopener.attempts == 2
    assert (
        reopener.error
        == "fault in the program or in a library that it uses: TypeError: int() argument must be a string"
    )
    reopener.close()


def test_a_list_of_ports_that_is_just_changing(monkeypatch: pytest.MonkeyPatch) -> None:
    """pyserial's list raises a TypeError when an adapter vanishes meanwhile. Told; a port that is open stays so."""
    from serial.tools import list_ports

    def vanished() -> list[object]:
        raise TypeError("int() argument must be a string, not 'NoneType'")

    monkeypatch.setattr(list_ports, "comports", vanished)
    finder = PortFinder(PortOptions(usb_serial="A1"))
    with pytest.raises(DriverUnavailable, match="USB ports are just changing"):
        finder.find()
    finder.remember("/dev/ttyUSB0")


class Usb:
    """A row of pyserial's list."""

    def __init__(self, device: str, serial_number: str, location: str = "1-1") -> None:
        self.device, self.serial_number, self.location = device, serial_number, location


def test_adapters_that_share_one_number_are_told_apart_by_their_names() -> None:
    """Some makers give every adapter the number 0001. While the one of the run file is out, the other is not taken."""
    first, second = Usb("/dev/rtec-1", "0001", "1-1"), Usb("/dev/rtec-2", "0001", "1-2")
    listed = [first, second]
    finder = PortFinder(PortOptions(port="/dev/rtec-1"), lambda: listed)
    finder.remember("/dev/rtec-1")
    listed.remove(first)
    assert finder.find() == "/dev/rtec-1"
    listed.append(first)
    assert finder.find() == "/dev/rtec-1"
    both = PortFinder(PortOptions(port="/dev/rtec-2", usb_serial="0001"), lambda: listed)
    assert both.find() == "/dev/rtec-2"
    with pytest.raises(DriverUnavailable, match="several ports have the USB serial number '0001'; name one with port"):
        PortFinder(PortOptions(usb_serial="0001"), lambda: listed).find()


def test_a_maker_whose_library_is_missing_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """python-can's kvaser back end raises a NameError where Kvaser's library is not installed."""
    import can

    def bus(**_: object) -> None:
        raise NameError("name 'canGetNumberOfChannels' is not defined")

    monkeypatch.setattr(can, "Bus", bus)
    with pytest.raises(DriverUnavailable, match="kvaser 0: cannot be opened: name 'canGetNumberOfChannels'"):
        CanLink(CanOptions(interface="kvaser", channel="0"), [])
