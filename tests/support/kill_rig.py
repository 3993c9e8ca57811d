"""A simulated machine that outlives its loop: the loop is killed again and again, the machine goes on.

The machine is this process, as real hardware would be: it answers one message at a time, whole or not at all. The loop
is a child, which reads and commands it through a socket, in the machine's own time, as fast as it goes. The parent
kills it at a random instant (after a random message, a random while later) and starts the next.

`python -m tests.support.kill_rig FOLDER KILLS SEED KIND` prints one line of JSON with what happened; `test_kill.py`
judges it. KIND is "box" (has a ledger that can be read) or "register" (keeps what it was told, tells nothing).
"""

import json
import os
import random
import signal
import socket
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtec.correction.flags import MODE_HOLD, MODE_ON
from rtec.correction.sinks import Sink
from rtec.daemon.recover import AtStart, recover
from rtec.loop.clock import RealClock, VirtualClock
from rtec.loop.devices import Ports
from rtec.loop.loop import Loop, Row, bind_rows
from rtec.loop.records import Commands, Samples
from rtec.loop.run_file import Setup
from rtec.loop.state import StateWriter, newest
from rtec.loop.state_files import state_memory
from rtec.loop.step import Step
from rtec.sim.machine import SimulatedMachine
from rtec.tomlfile import validated
from rtec_drivers.sim import SimDriver, SimOptions
from tests.support import setups

Ints = NDArray[np.int64]
START_NS = 10**12
READ, APPLY, OUTPUT, BEGIN = 1, 2, 3, 4
AXES = 2


@dataclass
class Server:
    """The machine's side.

    Attributes:
        machine: the simulated machine.
        applied: every command: instant, raw counts, output.
    """

    machine: SimulatedMachine
    lead_ns: int
    told: Ints = field(default_factory=lambda: np.zeros(AXES, np.int64))
    commands: list[list[int]] = field(default_factory=list)
    begins: list[dict[str, Any]] = field(default_factory=list)
    now_ns: int = START_NS

    def answer(self, words: Ints) -> bytes:
        """Do what one message says; give the answer."""
        kind, now_ns = int(words[0]), int(words[1])
        if kind == BEGIN:
            begin = {"after": len(self.commands), "output": words[3:5].tolist(), "mode": int(words[2])}
            self.begins.append({**begin, "kept_ns": int(words[5])})
            return b"\0"
        self.now_ns = max(self.now_ns, now_ns)
        self.machine.advance_to(self.lead_ns + self.now_ns - START_NS)
        if kind == READ:
            degc, latched_ns = self.machine.temperatures()
            head = np.array([*self.machine.raw_counts, START_NS + latched_ns - self.lead_ns], np.int64)
            return head.tobytes() + np.array([self.machine.spindle_rpm, *degc]).tobytes()
        if kind == APPLY:
            self.told = words[2:4].copy()
            self.machine.apply(self.told)
            self.commands.append([self.now_ns, *self.machine.raw_counts.tolist(), *self.told.tolist()])
            return b"\0"
        return self.told.tobytes()


class Wire:
    """The loop's side: all the capabilities of a device."""

    def __init__(self, line: socket.socket, clock: VirtualClock) -> None:
        self._line, self._clock = line, clock
        self.counts_answer = b""

    def ask(self, kind: int, *more: int) -> bytes:
        """One message, one answer."""
        self._line.send(np.array([kind, self._clock.now_ns(), *more], np.int64).tobytes())
        return self._line.recv(4096)

    def read_counts(self, counts: Ints) -> int:
        self.counts_answer = self.ask(READ)
        counts[:] = np.frombuffer(self.counts_answer, np.int64, AXES)
        return self._clock.now_ns()

    def read_temperatures(self, degc: NDArray[np.float64], time_ns: Ints) -> None:
        degc[:] = np.frombuffer(self.counts_answer, np.float64, -1, 8 * (AXES + 2))
        time_ns[:] = np.frombuffer(self.counts_answer, np.int64, 1, 8 * AXES)

    def read_spindle(self) -> float:
        return float(np.frombuffer(self.counts_answer, np.float64, 1, 8 * (AXES + 1))[0])

    def refuses(self, sink: Sink) -> str:
        del sink
        return ""

    def apply(self, output: Ints) -> None:
        self.ask(APPLY, *output.tolist())

    def read_output(self, output: Ints) -> None:
        output[:] = np.frombuffer(self.ask(OUTPUT), np.int64)

    def hold(self) -> None:
        pass


class Register(Wire):
    """The same, but it cannot say what it has: what it was told last it learns at the start."""

    _told = (0,) * AXES

    def was_told(self, output: Ints) -> None:
        self._told = tuple(output.tolist())

    def read_output(self, output: Ints) -> None:
        output[:] = self._told


def live(setup: Setup, step: Step, line: socket.socket, state: Path, kind: str, now_ns: int) -> None:
    """A loop's whole life, until it is killed."""
    clock = VirtualClock(now_ns)
    wire = Register(line, clock) if kind == "register" else Wire(line, clock)
    with state_memory(state, RealClock()) as image:
        saved = newest(image.tobytes())
        if isinstance(wire, Register) and saved is not None:
            wire.was_told(saved.output)
        output, counts = np.zeros(AXES, np.int64), np.zeros(AXES, np.int64)
        wire.read_output(output)
        wire.read_counts(counts)
        start = recover(step, AtStart(saved, False, 2e-3, output, counts, MODE_ON))
        samples, commands = Samples.empty(step.layout, 64), Commands.empty(step.layout, 64)
        rows = bind_rows(step, list(zip(samples.singles(), commands.singles(), strict=True)))
        loop = Loop(step, Ports(wire, (wire,), wire, wire), clock, setup.period_ns, rows, start.mode)
        if start.waits:
            loop.wait_for_order(start.waits)
        loop.keeper = StateWriter(image, step, MODE_ON, start.sequence)
        kept_ns = 0 if saved is None else saved.time_ns
        wire.ask(BEGIN, MODE_HOLD if start.waits else start.mode, *start.output.tolist(), kept_ns)

        def hold_now_and_then(_: Row) -> bool:
            # An operator's order, so that the mode has something to survive: two seconds on, a tenth held.
            loop.mode = MODE_HOLD if clock.now_ns() // 100_000_000 % 20 == 0 else MODE_ON
            return True

        loop.run(None, hold_now_and_then)


def serve(server: Server, line: socket.socket, pid: int, die: random.Random, most_messages: int) -> bool:
    """Answer until it is time to kill; say whether the child was alive until then."""
    clock = RealClock()
    messages, while_ns, before = die.randint(1, most_messages), die.randrange(200_000), die.random() < 0.5
    for k in range(messages):
        asked = line.recv(4096)
        if not asked:
            return False
        if k == messages - 1 and before:  # the message is lost with the child: it never reached the machine
            break
        line.send(server.answer(np.frombuffer(asked, np.int64)))
    clock.sleep_until_ns(clock.now_ns() + while_ns)
    os.kill(pid, signal.SIGKILL)
    return True


def drain(server: Server, line: socket.socket) -> None:
    """What was on the line already when the child died still reaches the machine."""
    line.setblocking(False)
    while True:
        try:
            asked = line.recv(4096)
        except ConnectionResetError:  # it died with an answer unread; told once, then what it sent can be read
            continue
        except BlockingIOError:
            return
        if not asked:
            return
        server.answer(np.frombuffer(asked, np.int64))


def main(folder: Path, kills: int, seed: int, kind: str) -> None:
    """Kill so often; print what the machine saw."""
    setup = setups.setup(folder)
    step = Step(setup.step_settings())
    step.warm_up()
    options = validated(SimOptions, {k: v for k, v in setup.file.device["box"].items() if k != "driver"}, "run")
    driver = SimDriver(options, setup.machine, VirtualClock(START_NS), setup.base)
    server = Server(driver.machine, driver.machine.time_ns)
    die, state, alive = random.Random(seed), folder / "memory.state", 0
    for _ in range(kills):
        here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        pid = os.fork()
        if pid == 0:
            here.close()
            live(setup, step, there, state, kind, server.now_ns)
            os._exit(1)
        there.close()
        alive += serve(server, here, pid, die, 400)
        os.waitpid(pid, 0)
        drain(server, here)
        here.close()
    saved = newest(state.read_bytes())
    sys.stdout.write(
        json.dumps(
            {
                "alive": alive,
                "commands": server.commands,
                "begins": server.begins,
                "raw": server.machine.raw_counts.tolist(),
                "inserted": server.machine.inserted_counts.tolist(),
                "saved": None if saved is None else saved.output.tolist(),
            }
        )
        + "\n"
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), sys.argv[4])
