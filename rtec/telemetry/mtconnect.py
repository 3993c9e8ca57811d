"""MTConnect: the adapter that an agent reads (SHDR over TCP), and the device file for the agent (`docs/mtconnect.md`).

The agent connects to the adapter. A line is `time|key|value`, followed by more pairs; a message is
`time|key|code|text`; a condition is `time|key|level|code|severity|qualifier|text`. NORMAL with a code ends the
condition of that code, and NORMAL alone ends all. A newly connected agent gets everything, then changes only.
`* PING` is answered.
"""

import asyncio
import itertools
import re
import socket
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final
from uuid import NAMESPACE_URL, uuid5

from rtec.errors import RtecError
from rtec.loop.clock import wall_clock_iso
from rtec.loop.telemetry_tables import MtconnectTable, host_and_port
from rtec.telemetry.values import Follower, StatusCondition, axes, conditions, instant, machine, sensors, steady

HEARTBEAT_MS: Final = 10_000
"""Period, ms, that the agent is given: it asks at least this often. Each side gives up the other after twice that."""
MOST_AGENTS: Final = 16
"""One more closes the oldest connection."""
LARGEST_BUFFER: Final = 32768
"""Bytes that may wait for an agent that does not read: it gets nothing newer until it has read them."""
LONGEST_LINE: Final = 256
REST_S: Final = 0.01
"""Wait, s, after each line that an agent sends: a flood of lines gets at most a hundred answers a second."""
UNAVAILABLE: Final = "UNAVAILABLE"
SCHEMA: Final = "urn:mtconnect.org:MTConnectDevices:1.4"
KINDS: Final = ("SYSTEM", "HARDWARE", "COMMUNICATIONS", "ACTUATOR")
"""StatusCondition types of the standard; each is one data item of the device."""
_KIND_OF: Final = {
    "STALE_COUNTS": "COMMUNICATIONS",
    "STALE_TEMPERATURE": "COMMUNICATIONS",
    "SENSOR_FAULT": "HARDWARE",
    "OUTPUT_SATURATED": "ACTUATOR",
    "OUTPUT_TROUBLE": "ACTUATOR",
}
_NOT_IN_NAMES: Final = re.compile(r"[^A-Za-z0-9_.-]")

Values = dict[str, tuple[str, ...]]
"""The fields after each data item's key."""


def prepare(table: MtconnectTable, base: Path) -> None:
    """Do nothing: it needs no file and no package."""
    del table, base


def server(task: Any, say: Callable[[str], None]) -> "Adapter":
    """The adapter of a task of `rtec.telemetry.processes`."""
    return Adapter(task.table, say)


def key_of(*parts: str) -> str:
    """Key and name of a data item."""
    return "_".join(_NOT_IN_NAMES.sub("-", part) for part in parts)


def known_keys(axis_names: Sequence[str], sensor_names: Sequence[str]) -> list[str]:
    """Keys of all samples and events but the availability."""
    of_axes = [key_of(axis, what) for axis in axis_names for what in ("position", "requested", "applied", "residual")]
    return [*of_axes, *(key_of(name, "temperature") for name in sensor_names), "spindle", "mode"]


def values(report: Mapping[str, Any]) -> Values:
    """Values of a status, by key; lengths in millimetres, as in the standard."""
    out: Values = {}
    for axis, of in axes(report).items():
        out[key_of(axis, "position")] = (_number(of["position_mm"], 1.0),)
        for what in ("requested", "applied", "residual"):
            out[key_of(axis, what)] = (_number(of[f"{what}_um"], 1e-3),)
    for name, of in sensors(report).items():
        out[key_of(name, "temperature")] = (_number(of["temperature_degc"], 1.0),)
    whole = machine(report)
    out["spindle"] = (_number(whole["spindle_rpm"], 1.0),)
    mode = whole["mode"]
    out["mode"] = (UNAVAILABLE,) if mode is None else (str(mode), f"the correction is ordered to be {mode}")
    return out


def _number(value: Any, scale: float) -> str:
    """Plain decimals, to a nanometre."""
    if value is None:
        return UNAVAILABLE
    text = f"{value * scale:.6f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def kind_of(condition: StatusCondition) -> str:
    """Type of the condition in the standard."""
    return "HARDWARE" if condition.code.startswith("device ") else _KIND_OF.get(condition.code, "SYSTEM")


def _text(text: str) -> str:
    """Text of a field: SHDR cannot escape its own separator."""
    return text.replace("|", "/").strip()


@dataclass
class SentToAgent:
    """Values that one agent has been sent."""

    available: bool | None = None
    values: Values = field(default_factory=dict)
    conditions: dict[str, StatusCondition] = field(default_factory=dict)

    def lines(self, report: Mapping[str, Any] | None, everything: Sequence[str]) -> Iterator[str]:
        """Changes, as lines; they then count as sent.

        Args:
            found: newest status; None where there are no current values.
            everything: keys of all values.
        """
        at, available = instant(report), report is not None
        lost: tuple[str, ...] = (UNAVAILABLE,)
        new = values(report) if report is not None else dict.fromkeys(everything, lost)
        active = steady(conditions(report), self.conditions) if report is not None else {}
        began = available is not self.available
        if began:
            yield f"{at}|avail|{'AVAILABLE' if available else UNAVAILABLE}"
        changed = {key: content for key, content in new.items() if self.values.get(key) != content}
        plain = [f"{key}|{content[0]}" for key, content in changed.items() if key != "mode"]
        if plain:
            yield f"{at}|{'|'.join(plain)}"
        if "mode" in changed:
            code, text = changed["mode"] if len(changed["mode"]) > 1 else ("", UNAVAILABLE)
            yield f"{at}|mode|{code}|{_text(text)}"
        if began:
            for kind in KINDS:
                yield f"{at}|{kind.lower()}|{'NORMAL' if available else UNAVAILABLE}||||"
            self.conditions = {}
        for code, condition in self.conditions.items():
            if code not in active:
                yield f"{at}|{kind_of(condition).lower()}|NORMAL|{_text(code)}|||"
        for code, condition in active.items():
            if self.conditions.get(code) != condition:
                level, text = condition.level.upper(), _text(condition.text)
                yield f"{at}|{kind_of(condition).lower()}|{level}|{_text(code)}|||{text}"
        self.available, self.values, self.conditions = available, new, active


@dataclass(eq=False)
class _Agent:
    writer: asyncio.StreamWriter
    heard_s: float
    pings: bool = False
    shown: SentToAgent = field(default_factory=SentToAgent)


class Adapter:
    """Serves agents.

    Args:
        table: table of the run file.
        say: reports a line to people.
    """

    def __init__(self, table: MtconnectTable, say: Callable[[str], None]) -> None:
        self._table, self._say = table, say
        self._agents: list[_Agent] = []
        self._keys: list[str] = []

    async def serve(self, follower: Follower) -> None:
        """Serve until cancelled."""
        host, port = host_and_port(self._table.listen)
        try:
            listening = await asyncio.start_server(self._talk, None if host == "*" else host, port, limit=LONGEST_LINE)
        except OSError as e:
            raise RtecError(f"[telemetry.mtconnect] listen {self._table.listen}: cannot listen there: {e}") from e
        self._say(f"an MTConnect agent can connect to {self._table.listen}")
        async with listening:
            try:
                while True:
                    self._publish(follower)
                    await asyncio.sleep(self._table.period_s)
            finally:
                for agent in self._agents:
                    agent.writer.transport.abort()

    def _publish(self, follower: Follower) -> None:
        report = follower.live
        if report is not None:
            self._keys = known_keys(report["axes"], report["sensors"])
        now_s = asyncio.get_running_loop().time()
        for agent in [*self._agents]:
            if agent.pings and now_s - agent.heard_s > 2e-3 * HEARTBEAT_MS:
                self._say("an agent that asked before is silent now: its connection is closed")
                agent.writer.transport.abort()
            elif agent.writer.transport.get_write_buffer_size() < LARGEST_BUFFER:
                agent.writer.write("".join(f"{line}\n" for line in agent.shown.lines(report, self._keys)).encode())

    async def _talk(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        agent = _Agent(writer, asyncio.get_running_loop().time())
        connection = writer.get_extra_info("socket")
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, LARGEST_BUFFER)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self._agents.append(agent)
        if len(self._agents) > MOST_AGENTS:
            self._agents.pop(0).writer.transport.abort()
        try:
            while line := await reader.readline():
                agent.heard_s = asyncio.get_running_loop().time()
                if line.strip() == b"* PING":
                    agent.pings = True
                    writer.write(f"* PONG {HEARTBEAT_MS}\n".encode())
                    await writer.drain()
                await asyncio.sleep(REST_S)
        except (OSError, ValueError):  # the agent has closed, or sent a line without an end
            return
        finally:
            with suppress(ValueError):
                self._agents.remove(agent)
            writer.transport.abort()


def device_file(name: str, axis_names: Sequence[str], sensor_names: Sequence[str], identity: str) -> str:
    """The device file of an agent: all data items of the adapter, and no other.

    Args:
        name: name of the machine.
        axis_names, sensor_names: those of the machine.
        identity: constant name of the device, which gives its UUID.
    """
    ET.register_namespace("", SCHEMA)
    numbers, uuid = itertools.count(1), str(uuid5(NAMESPACE_URL, f"urn:rtec:{identity}"))

    def item(under: ET.Element, name: str, category: str, kind: str, **more: str) -> None:
        content = {"id": name, "name": name, "category": category, "type": kind, **more}
        ET.SubElement(under, f"{{{SCHEMA}}}DataItem", content)

    def part(under: ET.Element, kind: str, name: str, items: bool = True) -> ET.Element:
        """Add a component; give the element for its data items, or for its components."""
        made = ET.SubElement(under, f"{{{SCHEMA}}}{kind}", {"id": f"c{next(numbers)}", "name": name})
        return ET.SubElement(made, f"{{{SCHEMA}}}{'DataItems' if items else 'Components'}")

    root = ET.Element(f"{{{SCHEMA}}}MTConnectDevices")
    about = {"version": "1.4", "creationTime": wall_clock_iso(), "instanceId": "1", "sender": "rtec"}
    ET.SubElement(
        root, f"{{{SCHEMA}}}Header", {**about, "bufferSize": "131072", "assetBufferSize": "1024", "assetCount": "0"}
    )
    devices = ET.SubElement(root, f"{{{SCHEMA}}}Devices")
    device = ET.SubElement(devices, f"{{{SCHEMA}}}Device", {"id": "d", "name": key_of(name), "uuid": uuid})
    about_it = ET.SubElement(device, f"{{{SCHEMA}}}Description")
    about_it.text = "Error correction of a machine tool by rtec; read-only"
    items = ET.SubElement(device, f"{{{SCHEMA}}}DataItems")
    item(items, "avail", "EVENT", "AVAILABILITY")
    item(items, "mode", "EVENT", "MESSAGE")
    for kind in KINDS:
        item(items, kind.lower(), "CONDITION", kind)
    parts = ET.SubElement(device, f"{{{SCHEMA}}}Components")
    linear = part(parts, "Axes", "axes", items=False)
    for axis in axis_names:
        of = part(linear, "Linear", key_of(axis))
        more = {"units": "MILLIMETER"}
        item(of, key_of(axis, "position"), "SAMPLE", "POSITION", subType="ACTUAL", coordinateSystem="MACHINE", **more)
        item(of, key_of(axis, "requested"), "SAMPLE", "DISPLACEMENT", **more)
        item(of, key_of(axis, "applied"), "SAMPLE", "DISPLACEMENT", **more)
        item(of, key_of(axis, "residual"), "SAMPLE", "DISPLACEMENT", statistic="ROOT_MEAN_SQUARE", **more)
    spindle = part(linear, "Rotary", "S")
    item(spindle, "spindle", "SAMPLE", "ROTARY_VELOCITY", subType="ACTUAL", units="REVOLUTION/MINUTE")
    for sensor in sensor_names:
        of, key = part(parts, "Sensor", key_of(sensor)), key_of(sensor, "temperature")
        item(of, key, "SAMPLE", "TEMPERATURE", units="CELSIUS")
    ET.indent(root)
    return "<?xml version='1.0' encoding='UTF-8'?>\n" + ET.tostring(root, encoding="unicode") + "\n"
