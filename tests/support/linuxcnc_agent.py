"""LinuxCNC's user interface for tests: takes orders from a local socket, in JSON, and gives them to LinuxCNC's task.

It runs under the system's Python, inside the namespaces of `tests.support.linuxcnc_session`; LinuxCNC starts it as its
DISPLAY, and ends when it ends.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import time
from collections.abc import Callable
from typing import Any

import linuxcnc  # type: ignore[import-not-found]

STATES = {
    "estop": linuxcnc.STATE_ESTOP,
    "estop_reset": linuxcnc.STATE_ESTOP_RESET,
    "on": linuxcnc.STATE_ON,
    "off": linuxcnc.STATE_OFF,
}
MODES = {"manual": linuxcnc.MODE_MANUAL, "auto": linuxcnc.MODE_AUTO, "mdi": linuxcnc.MODE_MDI}
LOOK_S = 0.005
THERE_MM = 1e-4


class Agent:
    """What can be ordered: one method an order, by its name."""

    def __init__(self) -> None:
        self.command, self.stat, self.errors = linuxcnc.command(), linuxcnc.stat(), linuxcnc.error_channel()
        self.started: dict[str, subprocess.Popen[bytes]] = {}

    def wait(self, met: Callable[[], Any], timeout_s: float = 20.0) -> None:
        """Wait until a condition on `stat` is met."""
        end = time.monotonic() + timeout_s
        while True:
            self.stat.poll()
            if met():
                return
            if time.monotonic() > end:
                raise TimeoutError(f"not within {timeout_s:g} s; LinuxCNC said: {self.said()}")
            time.sleep(LOOK_S)

    def said(self) -> list[str]:
        """Errors and messages since the last time."""
        out = []
        while message := self.errors.poll():
            out.append(str(message[1]))
        return out

    def state(self, name: str) -> None:
        """E-stop, off, on."""
        self.command.state(STATES[name])
        wanted = linuxcnc.STATE_ESTOP_RESET if name == "off" else STATES[name]
        self.wait(lambda: self.stat.task_state == wanted)

    def mode(self, name: str) -> None:
        """Manual, auto, MDI; ordered again while LinuxCNC ignores it, as it does before the end of a jog."""

        def taken() -> bool:
            if self.stat.task_mode != MODES[name]:
                self.command.mode(MODES[name])
                self.command.wait_complete(1.0)
                self.stat.poll()
            return bool(self.stat.task_mode == MODES[name])

        self.wait(taken)

    def joints(self, free: bool) -> None:
        """Jog joints (free) or axes (teleop)."""
        self.mode("manual")
        self.command.teleop_enable(0 if free else 1)
        wanted = linuxcnc.TRAJ_MODE_FREE if free else linuxcnc.TRAJ_MODE_TELEOP
        self.wait(lambda: self.stat.motion_mode == wanted)

    def home(self) -> None:
        """Home all joints."""
        self.joints(free=True)
        n = self.stat.joints
        self.command.home(-1)
        self.wait(lambda: all(self.stat.homed[:n]))

    def unhome(self) -> None:
        """Forget where the joints are."""
        self.joints(free=True)
        self.command.unhome(-1)
        self.wait(lambda: not any(self.stat.homed[: self.stat.joints]))

    def mdi(self, text: str, timeout_s: float = 60.0) -> None:
        """Carry out one line of G-code."""
        self.mode("mdi")
        self.command.mdi(text)
        self.command.wait_complete(timeout_s)
        self.idle(timeout_s)

    def run(self, path: str, timeout_s: float = 300.0) -> None:
        """Run a part programme to its end."""
        self.begin(path)
        self.idle(timeout_s)

    def begin(self, path: str) -> None:
        """Start a part programme."""
        self.mode("auto")
        self.command.program_open(path)
        self.command.wait_complete()
        self.command.auto(linuxcnc.AUTO_RUN, 0)
        self.wait(lambda: self.stat.interp_state != linuxcnc.INTERP_IDLE)

    def idle(self, timeout_s: float = 60.0) -> None:
        """Wait until nothing runs."""
        self.wait(lambda: self.stat.interp_state == linuxcnc.INTERP_IDLE and self.stat.inpos, timeout_s)

    def abort(self) -> None:
        """Stop what runs."""
        self.command.abort()
        self.idle()

    def jog(self, axis: int, velocity: float, distance: float) -> None:
        """Jog an axis (teleop) or joint (free) by a distance, and wait until it is there."""
        free = self.stat.motion_mode == linuxcnc.TRAJ_MODE_FREE
        target = self.stat.joint_position[axis] + distance
        self.command.jog(linuxcnc.JOG_INCREMENT, free, axis, velocity, distance)
        self.wait(lambda: self.stat.inpos and abs(self.stat.joint_position[axis] - target) < THERE_MM)

    def hal(self, *args: str) -> str:
        """Run halcmd."""
        done = subprocess.run(["halcmd", "-s", *args], capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"halcmd {' '.join(args)}: {done.stderr}")
        return done.stdout.strip()

    def start(self, name: str, *command: str) -> int:
        """Start a program of the test's beside LinuxCNC; give its process id here."""
        with open(f"{name}.log", "wb") as log:  # noqa: PTH123 - the namespaces' own Python is older
            self.started[name] = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        return self.started[name].pid

    def signal(self, name: str, number: int) -> int:
        """Send a signal to it and wait for its end; give its exit status."""
        process = self.started.pop(name)
        process.send_signal(number)
        return process.wait(20)

    def record(self, channel: int, path: str) -> None:
        """Let halsampler record a channel of the sampler into a file, from now on."""
        self.start("halsampler", "halsampler", "-c", str(channel), "-t", path)
        self.hal("setp", f"sampler.{channel}.enable", "1")

    def stop_record(self, channel: int) -> None:
        """End it, when all rows are written."""
        self.hal("setp", f"sampler.{channel}.enable", "0")
        self.wait(lambda: self.hal("getp", f"sampler.{channel}.curr-depth") == "0")
        self.signal("halsampler", signal.SIGTERM)

    def kill(self, pid: int, number: int) -> None:
        """Send a signal to any process of the session."""
        os.kill(pid, number)

    def parent(self, pid: int) -> int:
        """Process id of the parent of any process of the session."""
        with open(f"/proc/{pid}/stat") as stat:  # noqa: PTH123 - the namespaces' own Python is older
            return int(stat.read().rpartition(")")[2].split()[1])

    def component_pid(self, name: str) -> int:
        """Process id of a component of HAL."""
        for line in self.hal("show", "comp").splitlines():
            words = line.split()
            if len(words) > 3 and words[2] == name:
                return int(words[3])
        raise LookupError(f"no component {name}")

    def position(self) -> list[float]:
        """Joint positions as LinuxCNC has them."""
        self.stat.poll()
        return list(self.stat.joint_actual_position[: self.stat.joints])


def serve(path: str) -> None:
    """Take orders until the last one, "quit"."""
    agent = Agent()
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    listener.bind(path)
    listener.listen(1)
    peer = listener.accept()[0]
    while text := peer.recv(1 << 16):
        order = json.loads(text)
        if order[0] == "quit":
            break
        try:
            answer = [True, getattr(agent, order[0])(*order[1:])]
        except Exception as e:  # noqa: BLE001 - it is the test's to judge
            answer = [False, f"{order}: {type(e).__name__}: {e}"]
        peer.send(json.dumps(answer).encode())
    for name in list(agent.started):
        agent.signal(name, signal.SIGTERM)
    peer.close()


if __name__ == "__main__":
    serve("session.agent")
