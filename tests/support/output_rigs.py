"""Far sides of every actuator driver, in memory and on a virtual clock, with everything that can become of a command.

Each rig is a driver and, behind it, a machine that somebody moves: its counts are fresh whatever happens to the
commands. The rig notes every command that reaches the machine beside what the machine had before.
"""

import importlib
import json
import sys
import threading
import types
from collections import deque
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from rtec.errors import DriverError, DriverFault, DriverTimeout, DriverUnavailable
from rtec.loop.clock import VirtualClock
from rtec.tomlfile import validated
from rtec_drivers.ascii import offset
from rtec_drivers.ascii.offset_options import OffsetOptions
from rtec_drivers.box import driver as serial_box
from rtec_drivers.box import protocol
from rtec_drivers.box.simulator import BoxSimulator
from rtec_drivers.can import box as can_box
from rtec_drivers.linuxcnc import driver as linuxcnc
from rtec_drivers.linuxcnc.link import BridgeLink
from rtec_drivers.pty_peer import WireFaults
from rtec_drivers.reopen import Reopener, Worker
from rtec_drivers.sim import SimDriver, SimOptions
from rtec_drivers.zmq import driver as zmq_link
from rtec_drivers.zmq.link import ZmqOptions
from tests.support.box_peer import StillPlant
from tests.support.box_rig import SPEED, START_NS, MemoryLine, options
from tests.support.can_peer import FakeBox
from tests.support.conformance import CONFIGS, MACHINE
from tests.support.zmq_rig import Cell

Ints = NDArray[np.int64]
MS = 1_000_000
FAULTS = ("half_open", "deaf", "refuse", "write_error", "late", "reset")


class OutputRig:
    """One driver and its far side.

    Attributes:
        clock: of both.
        driver: open.
        encoders: who gives the counts: the driver, or another one.
        fault: what becomes of commands now: one of `FAULTS`, or "".
        taken: commands that the machine took: what it had before, and what it was told.
    """

    def __init__(self) -> None:
        self.clock = VirtualClock(START_NS)
        self.driver: Any = None
        self.encoders: Any = None
        self.fault = ""
        self.taken: list[tuple[list[int], list[int]]] = []

    def move(self, counts: list[int]) -> None:
        """The axes are there now."""
        raise NotImplementedError

    def has(self) -> list[int]:
        """What the machine has, by its own account."""
        raise NotImplementedError

    def begin(self, fault: str) -> None:
        """From now on this happens to commands; a reset happens at once."""
        self.fault = fault

    def end(self) -> None:
        """All is well again."""
        self.fault = ""

    def close(self) -> None:
        """Give back what the far side holds."""

    def still(self, degc: NDArray[np.float64], time_ns: Ints) -> None:
        """Temperatures that are always fresh."""
        degc[:] = 27.0
        time_ns[:] = self.clock.now_ns()


class SimRig(OutputRig):
    """The simulated machine; faults are between loop and driver, since there is no line."""

    def __init__(self, monkeypatch: Any) -> None:
        super().__init__()
        del monkeypatch
        table = {"truth": "sim/turning-centre.toml", "seed": 1}
        rig, self._late = self, deque[tuple[int, list[int]]]()

        class Driver(SimDriver):
            def read_counts(self, counts: Ints) -> int:
                counts[:] = rig.position
                return rig.clock.now_ns()

            def apply(self, output: Ints) -> None:
                match rig.fault:
                    case "half_open" | "deaf":
                        return
                    case "refuse":
                        raise DriverFault("refused")
                    case "write_error":
                        raise DriverTimeout("the port takes no bytes")
                rig._late.append((rig.clock.now_ns() + (20 * MS if rig.fault == "late" else 0), output.tolist()))
                self.arrive()

            def read_output(self, output: Ints) -> None:
                self.arrive()
                super().read_output(output)

            def arrive(self) -> None:
                while rig._late and rig._late[0][0] <= rig.clock.now_ns():
                    told = rig._late.popleft()[1]
                    rig.taken.append((self._output.tolist(), told))
                    super().apply(np.array(rig.answer(told), np.int64))

            def lose(self) -> None:
                self._output[:] = 0

        self.position = [0, 0]
        self.answer: Callable[[list[int]], list[int]] = list
        """What the machine has after a command, by its own account."""
        self.driver = Driver(validated(SimOptions, table, "run.toml"), MACHINE, self.clock, CONFIGS)

    def move(self, counts: list[int]) -> None:
        self.position = counts

    def has(self) -> list[int]:
        out = np.zeros(2, np.int64)
        self.driver.read_output(out)
        return [int(n) for n in out]

    def begin(self, fault: str) -> None:
        super().begin(fault)
        if fault == "reset":
            self.driver.lose()


def reopen_at_once(monkeypatch: Any) -> None:
    """What was lost is opened in the cycle in which it is due: the thread that does it knows no virtual clock."""

    def order(self: Reopener[Any]) -> None:
        self.attempts += 1
        self._busy = True
        try:
            self._results.put(self._attempt())
        except DriverError as e:
            self._results.put(str(e))

    monkeypatch.setattr(Reopener, "_order", order)


class SerialBoxRig(OutputRig):
    """The encoder box on a line in memory."""

    def __init__(self, monkeypatch: Any) -> None:
        super().__init__()
        reopen_at_once(monkeypatch)
        rig, self.plant = self, StillPlant(2)

        class Box(BoxSimulator):
            def receive(self, data: bytes, now_ns: int) -> bytes:
                before, commands = list(self._ledger), self.commands
                answer = super().receive(data, now_ns)
                if self.commands > commands:
                    rig.taken.append((before, list(self._target)))
                return answer

        class Line(MemoryLine):
            def write(self, data: bytes) -> None:
                frame = protocol.decode(data.strip(b"\0"))
                command = frame is not None and frame.kind == protocol.COMMAND
                if rig.fault == "write_error":
                    raise DriverTimeout("memory: takes no bytes")
                if not (rig.fault == "half_open" and command):
                    super().write(data)

        self.box, self.faults = Box(self.plant, 2), WireFaults()
        monkeypatch.setattr(serial_box, "SerialLine", lambda *_: Line(self.box, self.clock, self.faults))
        self.driver = serial_box.SerialBoxDriver(options(), MACHINE, self.clock, ports=list)

    def move(self, counts: list[int]) -> None:
        self.plant.position = counts

    def has(self) -> list[int]:
        return list(self.plant.inserted)

    def begin(self, fault: str) -> None:
        super().begin(fault)
        self.faults.silent = fault == "deaf"
        self.faults.late_ns = 3 * MS if fault == "late" else 0
        self.box.encoder_fault = fault == "refuse"
        if fault == "reset":
            self.box.reset()

    def end(self) -> None:
        super().end()
        self.faults.silent, self.faults.late_ns, self.box.encoder_fault = False, 0, False


class _Port:
    """In place of a CAN interface and its thread: frames in memory."""

    trouble = warning = ""

    def __init__(self, rig: "CanBoxRig", hear: Callable[[int, bool, bytes, int], None]) -> None:
        self._rig, self._hear, self.came = rig, hear, deque[tuple[int, int, bytes]]()

    def open(self) -> None:
        pass

    def close(self) -> None:
        pass

    def check(self) -> None:
        while self.came and self.came[0][0] <= self._rig.clock.now_ns():
            _, identifier, data = self.came.popleft()
            self._hear(identifier, False, data, self._rig.clock.now_ns())

    def send(self, identifier: int, data: bytes) -> None:
        if self._rig.fault == "write_error":
            raise DriverTimeout("memory: takes no frames")
        self._rig.box.take(identifier, data)
        self.check()


class CanBoxRig(OutputRig):
    """The encoder box on a CAN bus in memory; it answers a cycle later, as a bus with a thread behind it does."""

    def __init__(self, monkeypatch: Any) -> None:
        super().__init__()
        rig = self

        class Box(FakeBox):
            def __init__(self) -> None:
                self.counts, self.ledger, self.boot, self.resumed = [0, 0], [0, 0], 7, False
                self.spoil, self.on_latch, self.deaf = lambda _, data: data, lambda: None, lambda _: False
                self.silent, self.version, self._orders, self._sent = False, 1, 0, 0
                self.commands, self._taken, self.bus = [], [0, 0], self  # type: ignore[assignment]

            def send(self, message: Any) -> None:
                # Entering waits for the answer in real time, in which this clock does not move.
                late_ns = 5 * MS if rig.fault == "late" else MS // 2 if rig.clock.now_ns() > START_NS else 0
                rig.port.came.append((rig.clock.now_ns() + late_ns, message.arbitration_id, bytes(message.data)))

            def take(self, identifier: int, data: bytes) -> None:
                before, commands = list(self.ledger), len(self.commands)
                if rig.fault != "deaf":
                    self._take(identifier, data)
                if len(self.commands) > commands:
                    rig.taken.append((before, list(self.ledger)))

        def port(_options: Any, _clock: Any, _hears: Any, hear: Any) -> _Port:
            self.port = _Port(self, hear)
            return self.port

        self.box = Box()
        self.box.deaf = lambda _: self.fault in ("half_open", "refuse")
        monkeypatch.setattr(can_box, "CanPort", port)
        table = {"interface": "virtual", "channel": "memory", "max_speed_mm_s": SPEED, "open_timeout_s": 0.1}
        checked = validated(can_box.CanBoxOptions, {**table, "at_start": "later"}, "run.toml")
        self.driver = can_box.CanBoxDriver(checked, MACHINE, self.clock)

    def move(self, counts: list[int]) -> None:
        self.box.counts = counts

    def has(self) -> list[int]:
        return list(self.box.ledger)

    def begin(self, fault: str) -> None:
        super().begin(fault)
        if fault == "reset":
            self.box.restart()


class ZmqRig(OutputRig):
    """Another process behind sockets in memory; it publishes before every cycle, and answers a cycle later."""

    def __init__(self, monkeypatch: Any) -> None:
        super().__init__()
        rig = self

        class Router:
            def send_multipart(self, frames: list[bytes]) -> None:
                if rig.fault not in ("half_open", "deaf"):
                    late_ns = 5 * MS if rig.fault == "late" else MS // 2
                    rig.answered.append((rig.clock.now_ns() + late_ns, frames[1]))

        class Sockets:
            def __init__(self, *_: Any) -> None:
                pass

            def states(self) -> list[bytes]:
                now_ns = rig.clock.now_ns()
                if rig.fault != "deaf" and now_ns > rig.said_ns:
                    rig.said_ns = now_ns
                    late_ns = 3 * MS if rig.fault == "late" else 0
                    rig.said.append((now_ns + late_ns, json.dumps(rig.cell.message()).encode()))
                return rig.due(rig.said)

            def answers(self) -> list[bytes]:
                return rig.due(rig.answered)

            def send(self, message: bytes) -> None:
                rig.hear(json.loads(message))

            def wait(self, timeout_s: float) -> bool:
                rig.clock.sleep_until_ns(rig.clock.now_ns() + round(timeout_s * 1e9))
                return True

            def close(self) -> None:
                pass

        self.said: deque[tuple[int, bytes]] = deque()
        self.answered: deque[tuple[int, bytes]] = deque()
        self.said_ns = 0
        self.cell = Cell("", "")
        self.cell._clock, self.cell._router = self.clock, Router()  # type: ignore[assignment]
        monkeypatch.setattr(zmq_link, "Sockets", Sockets)
        table = {"state": "ipc://state", "command": "ipc://command", "clock": "shared", "max_speed_mm_s": SPEED}
        self.driver = zmq_link.ZmqLinkDriver(validated(ZmqOptions, table, "run.toml"), MACHINE, self.clock)

    def due(self, queue: deque[tuple[int, bytes]]) -> list[bytes]:
        """What has come by now."""
        out = []
        while queue and queue[0][0] <= self.clock.now_ns():
            out.append(queue.popleft()[1])
        return out

    def hear(self, said: dict[str, Any]) -> None:
        """The other process takes a command, or does not."""
        if self.fault == "write_error":
            raise DriverTimeout("nobody takes commands")
        if self.fault in ("half_open", "deaf"):
            return
        before = self.has()
        if self.fault == "refuse":
            answer = {"schema": 1, "boot": self.cell.boot, "seq": said["seq"], "refused": "the door is open"}
            self.cell._router.send_multipart([b"", json.dumps(answer).encode()])
            return
        self.cell._take(b"", said)
        if said["boot"] == self.cell.boot:
            self.taken.append((before, self.has()))

    def move(self, counts: list[int]) -> None:
        self.cell.position = dict(zip("XZ", counts, strict=True))

    def has(self) -> list[int]:
        return list(self.cell.output.values())

    def begin(self, fault: str) -> None:
        super().begin(fault)
        if fault == "reset":
            self.cell.boot, self.cell.output = "b2", {"X": 0, "Z": 0}


class Turns:
    """Lets a driver's own thread and the test run in turns, so that both live in virtual time.

    The thread waits only here; whoever turns it waits until it waits again.
    """

    def __init__(self, clock: VirtualClock) -> None:
        self._clock, self._thread, self._test = clock, threading.Semaphore(0), threading.Semaphore(0)
        self.free = False

    def turn(self) -> None:
        """Let the thread do what it can do now."""
        self._thread.release()
        self._test.acquire()

    def wait(self, until_ns: int, met: Callable[[], bool] = lambda: False) -> bool:
        """In the thread: wait until an instant, or until something holds; say whether it does."""
        while not met() and self._clock.now_ns() < until_ns:
            if self.free:
                self._clock.sleep_until_ns(until_ns)
            else:
                self.rest()
        return met()

    def rest(self) -> None:
        """In the thread: until the next turn."""
        self._test.release()
        self._thread.acquire()

    def end(self) -> None:
        """The thread goes on by itself; its waiting takes no time."""
        self.free = True
        self._thread.release()


class _Controller:
    """Takes a line that sets the offsets, in units of half a micrometre, and one that asks for them."""

    def __init__(self, rig: "AsciiOffsetRig") -> None:
        self._rig, self.has, self.came = rig, [0, 0], deque[tuple[int, bytes]]()
        self._orders: deque[tuple[int, list[int]]] = deque()

    def send(self, data: bytes) -> None:
        rig = self._rig
        if rig.fault == "write_error":
            raise DriverUnavailable("memory: takes no bytes")
        if rig.fault == "deaf":
            return
        word, *values = data.decode("ascii").split()
        now_ns = rig.clock.now_ns()
        late_ns = 20 * MS if rig.fault == "late" else 0
        if word == "OFS?":
            self.say(f"OFS {self.has[0]} {self.has[1]}", late_ns)
        elif rig.fault == "refuse":
            self.say("ERR 12", 0)
        elif rig.fault != "half_open":
            self._orders.append((now_ns + late_ns, [round(float(v)) for v in values]))
            self.carry_out()
            self.say("OK", late_ns)

    def carry_out(self) -> None:
        """Take the commands that are due."""
        while self._orders and self._orders[0][0] <= self._rig.clock.now_ns():
            told = self._orders.popleft()[1]
            self._rig.taken.append((self.has, told))
            self.has = told

    def say(self, text: str, late_ns: int) -> None:
        self.came.append((self._rig.clock.now_ns() + late_ns, text.encode() + b"\n"))

    def receive(self, until_ns: int) -> bytes:
        self._rig.turns.wait(until_ns, self._due)
        return self.came.popleft()[1] if self._due() else b""

    def _due(self) -> bool:
        self.carry_out()
        return bool(self.came) and self.came[0][0] <= self._rig.clock.now_ns()

    def close(self) -> None:
        pass


class AsciiOffsetRig(OutputRig):
    """A controller that takes offsets as lines, on a line in memory; the driver's thread has a turn every cycle."""

    MORE: ClassVar[dict[str, Any]] = {"ask": "OFS?", "answer": r"OFS (?P<X>\S+) (?P<Z>\S+)"}

    def __init__(self, monkeypatch: Any) -> None:
        super().__init__()
        rig, self.turns, self.position = self, Turns(self.clock), [0, 0]
        self.controller, turns = _Controller(self), self.turns

        class Turned(Worker[Any]):
            def start(self, link: Any = None) -> None:
                super().start(link)
                turns.turn()

            def stop(self) -> None:
                turns.end()
                super().stop()

            def wait_until_ns(self, instant_ns: int) -> None:
                turns.wait(instant_ns, lambda: self.stopping)

            def _run(self, link: Any) -> None:
                turns._thread.acquire()
                super()._run(link)

        class Wake(threading.Event):
            def wait(self, timeout: float | None = None) -> bool:
                return turns.wait(rig.clock.now_ns() + round((timeout or 0.0) * 1e9), self.is_set)

        def connect() -> _Controller:
            if rig.fault == "write_error":
                raise DriverUnavailable("memory: gone")
            return rig.controller

        def way(*_: Any) -> Any:
            return connect, checked.serial

        monkeypatch.setattr(offset, "Worker", Turned)
        monkeypatch.setattr(offset, "way_of", way)
        table = {
            "serial": {
                "port": "/dev/memory",
                "baud": 9600,
                "at_start": "later",
                "first_retry_s": 0.01,
                "longest_retry_s": 0.05,
            },
            "command": ["SET {X} {Z}"],
            "unit": "um",
            "factor": {"X": 2, "Z": 2},
            "resolution_um": 0.5,
            "acknowledge": "OK",
            "refuse": "ERR.*",
            "restarted": "READY",
            "timeout_s": 0.02,
            **self.MORE,
        }
        checked = validated(OffsetOptions, table, "run.toml")
        self.driver = offset.AsciiOffsetDriver(checked, MACHINE, self.clock)
        self.driver._account.wake = Wake()
        self.encoders = self

    def read_counts(self, counts: Ints) -> int:
        """Encoders of their own, whatever becomes of the line."""
        counts[:] = self.position
        return self.clock.now_ns()

    def move(self, counts: list[int]) -> None:
        self.position = counts
        if self.driver._worker is not None:
            self.turns.turn()

    def has(self) -> list[int]:
        return list(self.controller.has)

    def begin(self, fault: str) -> None:
        super().begin(fault)
        if fault == "reset":
            self.controller.has = [0, 0]
            self.controller.say("READY", 0)


class AsciiOneWayRig(AsciiOffsetRig):
    """The same, of a controller that cannot say which offsets it has."""

    MORE: ClassVar[dict[str, Any]] = {}


class _Hal(types.ModuleType):
    """LinuxCNC's module `hal` for the bridge: one component, its pins, and the sampler's rows."""

    HAL_FLOAT, HAL_OUT, HAL_IN, HAL_BIT = range(4)
    sampler_base = 0

    def __init__(self) -> None:
        super().__init__("hal")
        self.pins: dict[str, Any] = {}
        self.rows: deque[list[Any]] = deque()

    def component(self, _name: str) -> Any:
        hal = self

        class Component(dict[str, Any]):
            def newpin(self, name: str, *_: Any) -> None:
                self.setdefault(name, 0.0)

            def ready(self) -> None:
                pass

            def getprefix(self) -> str:
                return "rtec"

        self.pins = Component(hal.pins)
        return self.pins

    def stream(self, *_: Any) -> Any:
        rows = self.rows

        class Stream:
            @property
            def readable(self) -> bool:
                return bool(rows)

            def read(self) -> list[Any]:
                return rows.popleft()

        return Stream()

    def get_value(self, name: str) -> float:
        """No pin but its own: there is no limit3."""
        raise RuntimeError(f"{name} not found")

    def pin_has_writer(self, _name: str) -> bool:
        return False


class LinuxCncRig(OutputRig):
    """The real bridge, on a local socket, above a HAL in memory; it looks once a cycle."""

    def __init__(self, monkeypatch: Any) -> None:
        super().__init__()
        reopen_at_once(monkeypatch)
        self._folder = TemporaryDirectory(prefix="rtec-hal-")
        self.hal, self.position, self.life = _Hal(), [0, 0], 1
        monkeypatch.setitem(sys.modules, "hal", self.hal)
        bridge = importlib.reload(importlib.import_module("rtec_drivers.linuxcnc.bridge"))
        monkeypatch.setattr(bridge, "time", types.SimpleNamespace(monotonic_ns=self.clock.now_ns))
        monkeypatch.setattr(bridge, "take_over", lambda _: None)
        monkeypatch.setattr(bridge, "session", lambda: f"life {self.life}")
        self._make = bridge.HalBridge
        self._path = Path(self._folder.name) / "bridge.sock"
        self._told = bridge.arguments(["--socket", str(self._path), "--axes", "X,Z", "--unit-um", "0.5"])
        self.bridge, rig, greeting = self._make(self._told), self, BridgeLink._greeting

        def greeted(link: BridgeLink) -> Any:
            rig.bridge.accept()
            return greeting(link)

        monkeypatch.setattr(BridgeLink, "_greeting", greeted)
        monkeypatch.setattr(linuxcnc, "LONGEST_S", 0.1)
        options = {"socket": str(self._path), "unit_um": 0.5}
        checked = validated(linuxcnc.LinuxCncOptions, options, "run.toml")
        self.driver = linuxcnc.LinuxCncDriver(checked, MACHINE, self.clock)
        self._waits: deque[int] = deque()

    def move(self, counts: list[int]) -> None:
        self.position = counts
        per_mm = [axis.counts_per_mm for axis in MACHINE.axes]
        self.hal.rows.append([*(n / k for n, k in zip(counts, per_mm, strict=True)), True, True])
        if self.fault == "write_error":
            return
        if self.fault == "late" and len(self.hal.rows) < 5:
            return
        before = self.has()
        while self.fault not in ("half_open", "deaf") and self.bridge.take():
            if self.has() != before:
                self.taken.append((before, self.has()))
                before = self.has()
        self.bridge.look()
        if self.fault != "deaf":
            self.bridge.send(self.bridge.state())

    def has(self) -> list[int]:
        return [int(n) for n in self.bridge.outputs.read()]

    def begin(self, fault: str) -> None:
        super().begin(fault)
        if fault == "refuse":
            self._told.max_um = 0.0
        if fault in ("write_error", "reset"):
            self._kill()
        if fault == "reset":
            self.life, self.hal.pins = 2, {}
            self.bridge = self._make(self._told)

    def _kill(self) -> None:
        for end in (self.bridge.client, self.bridge.listener):
            if end is not None:
                end.close()

    def close(self) -> None:
        self._kill()
        self._folder.cleanup()

    def end(self) -> None:
        killed = self.fault == "write_error"
        super().end()
        self._told.max_um = 1000.0
        if killed:
            self.bridge = self._make(self._told)
            self.move(self.position)


RIGS = {
    "sim": SimRig,
    "serial_box": SerialBoxRig,
    "can_box": CanBoxRig,
    "zmq_link": ZmqRig,
    "ascii_offset": AsciiOffsetRig,
    "ascii_one_way": AsciiOneWayRig,
    "linuxcnc": LinuxCncRig,
}
