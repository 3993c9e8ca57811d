"""Far sides of every actuator driver, in memory and on a virtual clock, with everything that can become of a command.

Each rig is a driver and, behind it, a machine that somebody moves: its counts are fresh whatever happens to the
commands. The rig notes every command that reaches the machine beside what the machine had before.
"""

import json
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtec.errors import DriverError, DriverFault, DriverTimeout
from rtec.loop.clock import VirtualClock
from rtec.tomlfile import validated
from rtec_drivers.box import driver as serial_box
from rtec_drivers.box import protocol
from rtec_drivers.box.simulator import BoxSimulator, StillPlant
from rtec_drivers.can import box as can_box
from rtec_drivers.pty_peer import WireFaults
from rtec_drivers.reopen import Reopener
from rtec_drivers.sim import SimDriver, SimOptions
from rtec_drivers.zmq import driver as zmq_link
from rtec_drivers.zmq.link import ZmqOptions
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
        fault: what becomes of commands now: one of `FAULTS`, or "".
        taken: commands that the machine took: what it had before, and what it was told.
    """

    def __init__(self) -> None:
        self.clock = VirtualClock(START_NS)
        self.driver: Any = None
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
                    super().apply(np.array(told, np.int64))

            def lose(self) -> None:
                self._output[:] = 0

        self.position = [0, 0]
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


RIGS = {"sim": SimRig, "serial_box": SerialBoxRig, "can_box": CanBoxRig, "zmq_link": ZmqRig}
