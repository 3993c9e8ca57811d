"""The encoder box on a real pseudo terminal, real clock: what happens to cables and ports."""

import os
import threading
import tty
from bisect import bisect_right
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtec.correction.sinks import FollowingErrorSink, PhaseSink
from rtec.errors import DriverError, DriverTimeout, DriverUnavailable
from rtec.loop.clock import RealClock
from rtec_drivers.box.driver import SerialBoxDriver
from rtec_drivers.box.simulator import BoxSimulator
from rtec_drivers.pty_peer import PtyPeer
from rtec_drivers.serial_line import Ports, SerialLine
from tests.support import box_rig, gateware
from tests.support.box_rig import SPEED, box_on_pty, options
from tests.support.conformance import MACHINE, DriverLaws, Rig, open_files, soon

pytestmark = pytest.mark.xdist_group("real-clock")
CLOCK = RealClock()
each_box = box_rig.each_box


class TestSerialBox(DriverLaws):
    @pytest.fixture
    def rig(self, tmp_path: Path) -> Iterator[Rig]:
        with box_on_pty(tmp_path):
            yield Rig(
                SerialBoxDriver,
                {"port": str(tmp_path / "box"), "max_speed_mm_s": SPEED, "timeout_ms": 20.0},
                misspelt="timeout",
                nearest="timeout_ms",
                wrong_sinks=[FollowingErrorSink(resolution_um=1.0), PhaseSink()],
                missing={"port": str(tmp_path / "nothing")},
            )


def counts_of(box: SerialBoxDriver) -> list[int]:
    counts = np.zeros(2, np.int64)
    box.read_counts(counts)
    return [int(n) for n in counts]


def carried_out(box: SerialBoxDriver, *output: int) -> bool:
    """Does the box say that it has this? It is commanded again in each cycle."""
    has = np.zeros(2, np.int64)
    box.read_counts(has)
    box.apply(np.array(output, np.int64))
    box.read_output(has)
    return has.tolist() == list(output)


def told(box: SerialBoxDriver, words: str) -> None:
    """Soon a reading fails with these words."""

    def fails() -> bool:
        try:
            counts_of(box)
        except DriverError as e:
            return words in str(e)
        return False

    assert soon(CLOCK, fails)


def on(folder: Path, ports: Ports | None = None, **more: Any) -> SerialBoxDriver:
    table = {"port": str(folder / "box"), "timeout_ms": 20.0, "first_retry_s": 0.002, "longest_retry_s": 0.02, **more}
    return SerialBoxDriver(options(**table), MACHINE, CLOCK, ports=ports)


def usb(device: object, serial: str | None, location: str = "1-2:1.0") -> Any:
    return SimpleNamespace(device=str(device), serial_number=serial, location=location)


def test_cable_pulled_in_the_middle_of_a_frame_and_put_back(tmp_path: Path) -> None:
    """The port is gone and another one comes: counts that moved meanwhile are right, and nobody need order anything."""
    with box_on_pty(tmp_path) as (peer, box, plant), on(tmp_path) as driver:
        plant.position = [100, 200]
        driver.resume()
        soon(CLOCK, lambda: carried_out(driver, 5, -5))
        for k in range(5):
            with peer.lock:
                peer.faults.cut_next = 9 + k
            with suppress(DriverError):
                counts_of(driver)
            peer.pull()
            told(driver, "trying again")
            with pytest.raises(DriverUnavailable):
                driver.apply(np.array([5, -5]))
            plant.position = [100 + k, 200 - k]
            peer.plug()
            assert soon(CLOCK, lambda: counts_of(driver)) == plant.position
            assert soon(CLOCK, partial(carried_out, driver, 6 + k, -5))
        assert not driver.must_resume
        assert plant.inserted == [10, -5]
        assert box._boot == 1


def test_it_comes_back_under_another_name(tmp_path: Path) -> None:
    """Opened by its name, the adapter's number is remembered; the old name then belongs to another adapter."""
    listed: list[Any] = []
    with box_on_pty(tmp_path) as (peer, _, plant), on(tmp_path, lambda: listed, port=peer.device) as driver:
        assert soon(CLOCK, lambda: counts_of(driver)) == [0, 0]
    first, second = tmp_path / "first", tmp_path / "second"
    first.mkdir()
    second.mkdir()
    with box_on_pty(first) as (peer, box, plant):
        listed[:] = [usb(peer.device, "A1"), usb("/dev/ttyS0", None)]
        driver = on(tmp_path, lambda: listed, port=peer.device)
        with driver:
            soon(CLOCK, lambda: counts_of(driver))
            peer.pull()
            listed[:] = [usb("/dev/ttyUSB7", "B2")]
            told(driver, "no port with the USB serial number 'A1'; USB ports here: /dev/ttyUSB7 (B2)")
            with PtyPeer(box, CLOCK, second / "box") as other:
                listed[:] = [usb("/dev/ttyUSB7", "B2"), usb(other.device, "A1")]
                plant.position = [3, 4]
                assert soon(CLOCK, lambda: counts_of(driver)) == [3, 4]


def test_two_ports_of_one_adapter(tmp_path: Path) -> None:
    """An adapter with several ports has one number for all: the interface tells them apart, or the user must."""
    with box_on_pty(tmp_path) as (peer, _, _):
        listed = [usb(peer.device, "A1", "1-2:1.1"), usb("/dev/none", "A1", "1-2:1.0")]
        with on(tmp_path, lambda: listed, port=peer.device, usb_serial="A1") as driver:
            soon(CLOCK, lambda: counts_of(driver))
            listed[:] = [usb("/dev/none", "A1", "3-1:1.0"), usb(peer.device, "A1", "3-1:1.1")]
            peer.pull()
            told(driver, "trying again")
            peer.plug()
            listed[1] = usb(peer.device, "A1", "3-1:1.1")
            assert soon(CLOCK, lambda: counts_of(driver)) == [0, 0]
        with (
            pytest.raises(DriverUnavailable, match="several ports have the USB serial number 'A1'; name one"),
            on(tmp_path, lambda: listed, port=None, usb_serial="A1"),
        ):
            pass


def test_a_port_that_appears_later(tmp_path: Path) -> None:
    """The run began without it. Nothing is known until it is there; then it goes on by itself."""
    with on(tmp_path, at_start="later") as driver:
        told(driver, "no such port; plug it in, or name another; trying again")
        with pytest.raises(DriverUnavailable, match="has not told its ledger yet"):
            driver.read_output(np.zeros(2, np.int64))
        with box_on_pty(tmp_path) as (_, _, plant):
            plant.position = [9, 9]
            assert soon(CLOCK, lambda: counts_of(driver)) == [9, 9]
            assert soon(CLOCK, lambda: carried_out(driver, 2, 2))


def test_a_port_that_another_program_uses(tmp_path: Path) -> None:
    """Oracle: a second driver on the same port; when the first one leaves, it goes on."""
    with box_on_pty(tmp_path):
        first, second = on(tmp_path), on(tmp_path)
        with first, pytest.raises(DriverUnavailable, match="in use by another program"), second:
            pass
        with on(tmp_path, at_start="later") as waiting:
            soon(CLOCK, lambda: counts_of(waiting))
        with first, on(tmp_path, at_start="later") as waiting:
            told(waiting, "in use by another program")
            first.__exit__(None, None, None)
            assert soon(CLOCK, lambda: counts_of(waiting)) == [0, 0]


def test_another_box_on_the_port(tmp_path: Path) -> None:
    """Two boxes changed places: the wrong one is not spoken to, and not commanded."""
    driver = on(tmp_path)
    with box_on_pty(tmp_path, box_serial=1) as (peer, _, _), driver:
        soon(CLOCK, lambda: carried_out(driver, 1, 1))
        peer.pull()
        with box_on_pty(tmp_path, box_serial=2) as (_, wrong, _):
            told(driver, "box number 2 answers, not 1")
            assert wrong.commands == 0
        peer.plug()
        assert soon(CLOCK, lambda: counts_of(driver)) == [0, 0]


def test_a_silent_box_is_opened_again(tmp_path: Path) -> None:
    """The port is there and nobody answers, for longer than `silent_reopen_s`; then somebody does."""
    with box_on_pty(tmp_path) as (peer, _, _), on(tmp_path, silent_reopen_s=0.5, open_timeout_s=0.5) as driver:
        soon(CLOCK, lambda: counts_of(driver))
        with peer.lock:
            peer.faults.silent = True
        told(driver, "was silent for 0.5 s")
        told(driver, "no encoder box answers within 0.5 s; trying again")
        with peer.lock:
            peer.faults.silent = False
        assert soon(CLOCK, lambda: counts_of(driver)) == [0, 0]


def test_a_box_reset_while_the_cable_was_out(tmp_path: Path) -> None:
    """It comes back with another start: hold, tell, resume only when ordered."""
    with box_on_pty(tmp_path) as (peer, box, plant), on(tmp_path) as driver:
        soon(CLOCK, lambda: carried_out(driver, 8, 8))
        peer.pull()
        told(driver, "trying again")
        box.reset()
        peer.plug()
        told(driver, "restarted (start 2, before 1): its ledger is zero again; the correction holds until it is")
        assert plant.inserted == [0, 0]
        driver.resume()
        assert soon(CLOCK, lambda: carried_out(driver, 1, 0))


def test_wrong_bits_and_garbage_on_a_real_port(tmp_path: Path) -> None:
    """One frame in a hundred is wrong, garbage goes before each: what is read is right, what is commanded arrives.

    Each wrong frame costs a reading; on a busy computer some more come too late, and then count as the older readings
    that they are. Oracle: where the plant stood at the instant of the reading, or later.
    """
    with box_on_pty(tmp_path) as (peer, _, plant), on(tmp_path) as driver:
        soon(CLOCK, lambda: counts_of(driver))
        with peer.lock:
            peer.faults.flip_rate, peer.faults.babble = 0.01, b"\xaa\x00\x03\x01"
        failed, moved_ns, counts = 0, [], np.zeros(2, np.int64)
        for k in range(40_000):
            if k >= 400 and peer.faults.garbled:  # a slow computer needs more of them
                break
            plant.position = [k, -k]
            moved_ns.append(CLOCK.now_ns())
            try:
                asked_ns = driver.read_counts(counts)
                first = max(bisect_right(moved_ns, asked_ns) - 1, 0)
                assert counts.tolist() in [[n, -n] for n in range(first, k + 1)]
            except DriverTimeout:
                failed += 1
            with suppress(DriverTimeout):  # the loop orders it again, too
                driver.apply(np.array([k // 30, 0]))
        assert 0 < peer.faults.garbled <= failed < len(moved_ns)
        assert soon(CLOCK, lambda: carried_out(driver, (len(moved_ns) - 1) // 30, 0))


def test_a_full_port_does_not_block() -> None:
    """Nobody takes the bytes: writing fails at once, and never half a frame is left out. Oracle: what a reader gets."""
    master, slave = os.openpty()
    tty.setraw(slave)
    line = SerialLine(options(port=os.ttyname(slave)), os.ttyname(slave))
    frames = [bytes([1 + k % 200]) * 100 for k in range(2000)]
    sent = []
    for frame in frames:
        try:
            line.write(frame)
        except DriverTimeout:
            break
        sent.append(frame)
    assert 10 < len(sent) < 2000
    os.set_blocking(master, False)
    received = b""
    while len(received) < 100 * len(sent):
        with suppress(BlockingIOError):
            received += os.read(master, 4096)
        with suppress(DriverTimeout):
            line.write(b"")
    assert received == b"".join(sent)
    line.close()
    os.close(master)
    os.close(slave)


def test_1000_reconnections_leak_nothing(tmp_path: Path) -> None:
    """The cable is really pulled a thousand times. Oracle: files and threads of this process before and after."""
    with box_on_pty(tmp_path) as (peer, box, _), on(tmp_path, first_retry_s=0.0002, longest_retry_s=0.001) as driver:
        times = 1000 if gateware.WHOLE or isinstance(box, BoxSimulator) else 100

        def pull_and_put_back() -> None:
            peer.pull()
            told(driver, "trying again")
            peer.plug()
            assert soon(CLOCK, lambda: counts_of(driver)) == [0, 0]

        pull_and_put_back()
        files, threads = open_files(), threading.active_count()
        for _ in range(times):
            pull_and_put_back()
        assert (open_files(), threading.active_count()) == (files, threads)
