"""The bridge: LinuxCNC's HAL on one side, rtec on the other (`docs/linuxcnc.md`).

It runs under the system's own Python, for which LinuxCNC's module `hal` is built, and imports nothing of rtec.
LinuxCNC's HAL file starts it. It serves one client at a time on a local socket: JSON, one message a packet.

    bridge -> rtec   {"hello": 1, "session": ..., "axes": [...], "sensors": [...], "actuator": ..., "unit_um": ...}
    bridge -> rtec   {"seq", "time_ns", "mm", "homed", "on", "rpm", "degc", "out", "cleared_um"} once a servo period
    bridge -> rtec   {"refused": "why"} in answer to a command
    rtec -> bridge   {"out": [...]} absolute, in whole units; or {"resume": true}

One row is what LinuxCNC's `sampler` latched in one servo period: the positions of all joints; then, where a correction
is part of the position (external offsets, pulses), that part; then "all homed" and "machine on".

A watching process restarts the bridge when it is killed; where that process is killed, the bridge becomes a watching
process itself and starts the next bridge. HAL keeps the pins of a dead component, and a signal keeps its
value: the new bridge has another component name, gives its pins the values of the dead ones, and takes over their
signals, so nothing jumps.
"""

from __future__ import annotations

import argparse
import contextlib
import grp
import json
import math
import os
import re
import select
import signal
import socket
import subprocess
import sys
import time
from typing import Any

import hal  # type: ignore[import-not-found]

NAME = "rtec"
LOOK_S = 0.0005
ENDS_NS = 10_000_000_000
LIMITS_NS = 1_000_000_000
AGAIN_S = 0.2
MM_PER_INCH = 25.4
LONGEST_UM = 1e6
SESSION = "rtec-session-"
SHOWN = re.compile(r"^\S+\s+\S+\s+(?:IN|OUT|I/O)\s+\S+\s+(\S+)(?:\s+(?:==>|<==|<=>)\s+(\S+))?\s*$")


def arguments(argv: list[str]) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(prog="rtec bridge", description="joins LinuxCNC's HAL to rtec")
    parser.add_argument("--socket", required=True, help="path of the local socket that rtec connects to")
    parser.add_argument("--axes", required=True, help="axis names in the order of the sampler's pins, such as X,Y,Z")
    parser.add_argument("--sensors", default="", help="temperature sensors, such as T_x,T_air: one pin each, °C")
    parser.add_argument("--actuator", choices=("following_error", "origin_offset", "pulse"), default="following_error")
    parser.add_argument("--unit-um", type=float, default=0.01, help="one unit of output, µm; not for pulses")
    parser.add_argument("--max-um", type=float, default=1000.0, help="refuse outputs beyond this; not for pulses")
    parser.add_argument("--sampler", type=int, default=0, help="channel of LinuxCNC's sampler")
    parser.add_argument("--inch", action="store_true", help="LinuxCNC's LINEAR_UNITS is inch")
    parser.add_argument("--group", default="", help="group that may use the socket, beside the user")
    options = parser.parse_args(argv)
    options.axes = [a for a in options.axes.split(",") if a]
    options.sensors = [s for s in options.sensors.split(",") if s]
    if not (options.unit_um > 0 and math.isfinite(options.unit_um)):
        parser.error("--unit-um must be above zero")
    return options


class HalOffsets:
    """The pins of one kind of correction; units are whole numbers of `unit` (machine units)."""

    cleared: list[int] | None = None

    def __init__(self, component: Any, options: argparse.Namespace, unit: float) -> None:
        self.component, self.unit = component, unit
        self.pins = ["offset-" + a.lower() for a in options.axes]
        for pin in self.pins:
            component.newpin(pin, hal.HAL_FLOAT, hal.HAL_OUT)

    def start(self) -> None:
        """Take the pins' values as they are."""

    def refuses(self, row: dict[str, Any] | None) -> str:
        """Why nothing can be commanded now; "" where it can."""
        return ""

    def write(self, out: list[int]) -> None:
        """Write absolute outputs."""
        for pin, n in zip(self.pins, out):
            self.component[pin] = n * self.unit

    def read(self) -> list[int]:
        """The pins' values."""
        return [round(self.component[pin] / self.unit) for pin in self.pins]

    def look(self, on: bool) -> None:
        """Process one servo period: is the machine on?"""


class ExternalOffsets(HalOffsets):
    """`axis.L.eoffset-counts`: LinuxCNC adds up their changes, and clears the sum when the machine goes off."""

    def __init__(self, component: Any, options: argparse.Namespace, unit: float) -> None:
        self.component, self.unit = component, unit
        self.pins = ["eoffset-counts-" + a.lower() for a in options.axes]
        self.requests = ["eoffset-request-" + a.lower() for a in options.axes]
        for pin in self.pins:
            component.newpin(pin, hal.HAL_S32, hal.HAL_OUT)
        for pin in self.requests:
            component.newpin(pin, hal.HAL_FLOAT, hal.HAL_IN)
        component.newpin("eoffset-scale", hal.HAL_FLOAT, hal.HAL_OUT)
        component.newpin("eoffset-enable", hal.HAL_BIT, hal.HAL_OUT)
        self.base = [0] * len(self.pins)
        self.last = [0] * len(self.pins)
        self.was_on = False

    def start(self) -> None:
        """Enable them, and begin from LinuxCNC's present offsets."""
        self.component["eoffset-scale"] = self.unit
        self.component["eoffset-enable"] = True
        self.base = [self.component[pin] - n for pin, n in zip(self.pins, self.read())]
        self.cleared = None

    def refuses(self, row: dict[str, Any] | None) -> str:
        """Why nothing can be commanded now: LinuxCNC ignores changes while it is off or not homed."""
        if self.cleared is not None:
            return "machine off cleared the external offsets: resume first"
        if row is None or not row["on"]:
            return "the machine is off: LinuxCNC takes no external offsets"
        return "" if row["homed"] else "not all joints are homed: LinuxCNC takes no external offsets"

    def write(self, out: list[int]) -> None:
        """Write absolute outputs, added to the pins' counts that are not in LinuxCNC's offsets."""
        for pin, base, n in zip(self.pins, self.base, out):
            self.component[pin] = base + n
        self.last = list(out)

    def read(self) -> list[int]:
        """The offsets that LinuxCNC itself reports as requested."""
        return [round(self.component[pin] / self.unit) for pin in self.requests]

    def look(self, on: bool) -> None:
        """Notice offsets that "machine off" has cleared."""
        if self.was_on and not on and self.cleared is None and any(self.last):
            self.cleared = list(self.last)
        self.was_on = on


class StepgenPulses(HalOffsets):
    """Counts for a `stepgen` that inserts them; its own counter has the inserted counts."""

    def __init__(self, component: Any, options: argparse.Namespace, unit: float) -> None:
        self.component, self.unit = component, unit
        self.pins = ["pulses-" + a.lower() for a in options.axes]
        self.counted = ["pulses-fb-" + a.lower() for a in options.axes]
        for pin in self.pins:
            component.newpin(pin, hal.HAL_FLOAT, hal.HAL_OUT)
        for pin in self.counted:
            component.newpin(pin, hal.HAL_S32, hal.HAL_IN)

    def write(self, out: list[int]) -> None:
        """Write the counts to insert."""
        for pin, n in zip(self.pins, out):
            self.component[pin] = float(n)

    def read(self) -> list[int]:
        """The inserted counts."""
        return [int(self.component[pin]) for pin in self.counted]


WAYS = {"following_error": HalOffsets, "origin_offset": ExternalOffsets, "pulse": StepgenPulses}


class HalBridge:
    """One component with its pins, the sampler's rows, and the client."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options
        self.mm = MM_PER_INCH if options.inch else 1.0
        self.listener = listen(options.socket, options.group)
        self.component = new_component()
        self.outputs = WAYS[options.actuator](self.component, options, options.unit_um * 1e-3 / self.mm)
        for name in options.sensors:
            self.component.newpin(name, hal.HAL_FLOAT, hal.HAL_IN)
        self.component.newpin("spindle-rpm", hal.HAL_FLOAT, hal.HAL_IN)
        take_over(self.component)
        self.component.ready()
        self.session = session()
        n = len(options.axes)
        self.inside = 0 if options.actuator == "following_error" else n
        key = hal.sampler_base + options.sampler
        self.stream = hal.stream(self.component, key, "f" * (n + self.inside) + "bb")
        self.client: socket.socket | None = None
        self.row: dict[str, Any] | None = None
        self.wired: set[str] = set()
        self.limits_um: list[float] = []
        self.limits_ns = 0
        self.seq = 0
        self.looked_ns = self.moved_ns = time.monotonic_ns()
        self.drain()
        self.outputs.start()

    def run(self, watcher: int) -> bool:
        """Serve until LinuxCNC ends, or its watching process while LinuxCNC goes on: True. A signal ends it, too."""
        while True:
            ready = [self.listener, *([self.client] if self.client else [])]
            readable = select.select(ready, [], [], LOOK_S)[0]
            if self.look():
                self.send(self.state())
                if os.getppid() != watcher:
                    return True
            elif time.monotonic_ns() - self.moved_ns > ENDS_NS and self.seq:
                return False  # the servo thread has ended: so has this LinuxCNC
            while self.take():
                pass
            if self.listener in readable:
                self.accept()

    def drain(self) -> None:
        """Drop rows that were latched earlier, at an unknown time."""
        while self.stream.readable:
            self.stream.read()

    def look(self) -> bool:
        """Read the newest row; its instant is that of the look before, when it was not there yet."""
        values, before_ns = None, self.looked_ns
        self.looked_ns = time.monotonic_ns()
        while self.stream.readable:
            values = self.stream.read()
            self.outputs.look(values[-1])  # off and on again between two looks clears, too
        if values is None:
            return False
        n = len(self.options.axes)
        at = values[:n]
        if self.inside:
            at = [p - c for p, c in zip(at, values[n : 2 * n])]
        self.seq += 1
        self.moved_ns = before_ns
        self.row = {
            "time_ns": before_ns,
            "mm": [p * self.mm for p in at],
            "homed": values[-2],
            "on": values[-1],
        }
        return True

    def state(self) -> dict[str, Any]:
        """Everything that is known now."""
        wired = self.wired
        unit_um = self.outputs.unit * self.mm * 1e3
        cleared = self.outputs.cleared
        return {
            "seq": self.seq,
            **(self.row or {}),
            "rpm": finite(self.component["spindle-rpm"]) if "spindle-rpm" in wired else None,
            "degc": [finite(self.component[s]) if s in wired else None for s in self.options.sensors],
            "out": self.outputs.read(),
            "cleared_um": None if cleared is None else [n * unit_um for n in cleared],
        }

    def accept(self) -> None:
        """Accept a client; refuse a second one while the first is connected."""
        peer = self.listener.accept()[0]
        peer.setblocking(False)
        if self.client is not None:
            with contextlib.suppress(OSError):
                peer.send(packet({"refused": "another rtec is connected to this LinuxCNC"}))
            peer.close()
            return
        self.client = peer
        prefix = self.component.getprefix()
        self.wired = {s for s in [*self.options.sensors, "spindle-rpm"] if hal.pin_has_writer(prefix + "." + s)}
        options = self.options
        self.read_limits()
        self.send(
            {
                "hello": 1,
                "session": self.session,
                "axes": options.axes,
                "sensors": options.sensors,
                "wired": sorted(self.wired),
                "actuator": options.actuator,
                "unit_um": options.unit_um,
                "component": prefix,
                "max_um": self.limits_um,
            }
        )

    def read_limits(self) -> None:
        """Read how much each axis may have."""
        self.limits_ns = time.monotonic_ns()
        self.limits_um = [self.most_um(a) for a in self.options.axes]

    def most_um(self, axis: str) -> float:
        """The largest output of an axis: the option's, or that of its limit3 as docs/linuxcnc.md names it."""
        most = min(self.options.max_um, LONGEST_UM) if self.options.actuator != "pulse" else LONGEST_UM
        for pin, sign in (("max", 1.0), ("min", -1.0)):
            with contextlib.suppress(RuntimeError):  # no such pin: nothing limits it there
                most = min(most, sign * hal.get_value(f"rtec-limit-{axis.lower()}.{pin}") * self.mm * 1e3)
        return max(most, 0.0)

    def take(self) -> bool:
        """Receive one message from the client, if there is one, and answer it at once; return whether there was one."""
        client = self.client
        if client is None:
            return False
        try:
            text = client.recv(65536)
        except BlockingIOError:
            return False
        except OSError:
            text = b""
        if not text:
            client.close()
            self.client = None  # the pins keep their values
            return False
        why = self.command(text)
        if why:
            self.send({"refused": why})
        else:
            self.send(self.state())
        return True

    def command(self, text: bytes) -> str:
        """Carry out a command; give the reason of a refusal, or ""."""
        try:
            order = json.loads(text)
            out = order.get("out")
        except (ValueError, AttributeError):
            return "a message that is not JSON"
        if order.get("resume"):
            self.outputs.start()
            return ""
        if not isinstance(out, list) or len(out) != len(self.options.axes) or any(type(n) is not int for n in out):
            return "a command that is not one whole number an axis"
        if self.options.actuator != "pulse" and any(abs(n) * self.options.unit_um > self.options.max_um for n in out):
            return f"beyond {self.options.max_um:g} µm (the bridge's option --max-um)"
        beyond = self.beyond(out)
        if beyond:
            return beyond
        why = self.outputs.refuses(self.row)
        if not why:
            self.outputs.write(out)
        return why

    def beyond(self, out: list[int]) -> str:
        """Which axis has more than its limit3 lets through, which may have been narrowed since the start; or ""."""
        if time.monotonic_ns() - self.limits_ns > LIMITS_NS:
            self.read_limits()
        if self.options.actuator == "pulse":
            return ""
        unit_um = self.options.unit_um
        for axis, n, most_um in zip(self.options.axes, out, self.limits_um):
            if abs(n) * unit_um > most_um + unit_um:
                pin = f"rtec-limit-{axis.lower()}"
                return (
                    f"axis {axis}: {n * unit_um:+g} µm, and HAL's {pin} lets {most_um:g} µm through: the tool has less "
                    f"than rtec goes by. Set {pin}.min and {pin}.max back, or lower stop_um and start rtec again"
                )
        return ""

    def send(self, message: dict[str, Any]) -> None:
        """Send to a connected client; one that is too slow misses a message."""
        if self.client is None:
            return
        with contextlib.suppress(OSError):
            self.client.send(packet(message))


def packet(message: dict[str, Any]) -> bytes:
    """The bytes of one message."""
    return json.dumps(message, separators=(",", ":")).encode()


def finite(value: float) -> float | None:
    """A number, or None for one that JSON cannot hold."""
    return float(value) if math.isfinite(value) else None


def listen(path: str, group: str) -> socket.socket:
    """Listen on a local socket; replaces that of a dead bridge."""
    with contextlib.suppress(FileNotFoundError):
        os.unlink(path)  # noqa: PTH108
    made = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    made.bind(path)
    os.chmod(path, 0o660)  # noqa: PTH101
    if group:
        os.chown(path, -1, grp.getgrnam(group).gr_gid)
    made.listen(2)
    made.setblocking(False)
    return made


def new_component() -> Any:
    """A component with a free name: that of a killed bridge stays taken."""
    for k in range(1, 1000):
        try:
            return hal.component(NAME if k == 1 else f"{NAME}-{k}")
        except hal.error:
            continue
    raise SystemExit("rtec bridge: no free component name; restart LinuxCNC")


def take_over(component: Any) -> None:
    """Take over the signals, and the values, of the pins of killed bridges."""
    mine = component.getprefix()
    pins = component.getpins()
    shown = subprocess.run(["halcmd", "-s", "show", "pin"], capture_output=True, text=True, check=True)  # noqa: S607
    for match in map(SHOWN.match, shown.stdout.splitlines()):
        if match is None or match[2] is None:
            continue
        owner, _, pin = match[1].partition(".")
        if owner == mine or pin not in pins or not re.fullmatch(NAME + r"(-\d+)?", owner):
            continue
        if hal.pin_has_writer(match[1]):
            component[pin] = hal.get_value(match[1]) if writes(component, pin) else component[pin]
        hal.disconnect(match[1])
        hal.connect(mine + "." + pin, match[2])


def writes(component: Any, pin: str) -> bool:
    """Does the bridge write this pin?"""
    return bool(component.getitem(pin).get_dir() == hal.HAL_OUT)


def session() -> str:
    """Identifier of this run of LinuxCNC: a signal, which ends with HAL itself."""
    for known in hal.get_info_signals():
        if known["NAME"].startswith(SESSION):
            return str(known["NAME"])
    name = SESSION + os.urandom(6).hex()
    hal.new_sig(name, hal.HAL_BIT)
    return name


def watch(argv: list[str]) -> int:
    """Start the bridge, and restart it whenever it is killed; end when it ends in order."""
    while True:
        watcher = str(os.getpid())
        child = os.fork()
        if child == 0:
            os.execv(sys.executable, [sys.executable, __file__, "--served", watcher, *argv])  # noqa: S606
        signal.signal(signal.SIGTERM, lambda *_: os.kill(child, signal.SIGTERM))  # noqa: B023
        status = os.waitpid(child, 0)[1]
        if not os.WIFSIGNALED(status):
            return os.waitstatus_to_exitcode(status)
        time.sleep(AGAIN_S)


def main(argv: list[str]) -> int:
    """Run the bridge, or its watching process."""
    if argv[:1] != ["--served"]:
        arguments(argv)
        return watch(argv)
    watcher, own = int(argv[1]), argv[2:]
    options = arguments(own)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: sys.exit(0))
    bridge = HalBridge(options)
    if bridge.run(watcher):  # without a word to HAL, as if it was killed: its pins stay for the next bridge
        os.execv(sys.executable, [sys.executable, __file__, *own])  # noqa: S606
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
