"""MTConnect. Oracles: the lines by the rules of SHDR, each checked by an agent of the tests' own; schema 1.4 of the
device file (its words are below, as in `MTConnectDevices_1.4_1.0.xsd`); the daemon's figures.
"""

import re
import socket
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from rtec.cli.main import status
from rtec.control.server import Control
from rtec.correction.flags import REASONS, Flag
from rtec.errors import ConfigError
from rtec.loop.clock import RealClock
from rtec.loop.run_file import Setup, load_setup
from rtec.loop.telemetry_tables import MtconnectTable
from rtec.telemetry import mtconnect
from rtec.telemetry.mtconnect import device_file
from rtec.telemetry.processes import Task
from rtec.telemetry.values import StatusCondition, steady
from rtec.tomlfile import validated
from tests.support import setups
from tests.support.conformance import soon
from tests.support.control_rig import LONG_S, free_place
from tests.support.telemetry_rig import LivingDaemon, served

pytestmark = pytest.mark.xdist_group("real-clock")

NS = "{urn:mtconnect.org:MTConnectDevices:1.4}"
TIME = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z")
NUMBER = re.compile(r"-?\d+(\.\d+)?|UNAVAILABLE")
NMTOKEN = re.compile(r"[A-Za-z_][A-Za-z0-9_.-]*")
TYPES: dict[str, dict[str, str | None]] = {
    "SAMPLE": {"POSITION": "MILLIMETER", "DISPLACEMENT": "MILLIMETER", "TEMPERATURE": "CELSIUS",
               "ROTARY_VELOCITY": "REVOLUTION/MINUTE"},
    "EVENT": {"AVAILABILITY": None, "MESSAGE": None},
    "CONDITION": {"SYSTEM": None, "HARDWARE": None, "COMMUNICATIONS": None, "ACTUATOR": None},
}  # fmt: skip
"""What the schema has, with the unit that the standard asks for; it has far more than we use."""
LEVELS = {"NORMAL", "WARNING", "FAULT", "UNAVAILABLE"}


def parsed(text: str) -> ET.Element:
    """Of a file that we made ourselves."""
    return ET.fromstring(text)  # noqa: S314


class Agent:
    """Connects, and checks every line as it takes it in.

    Attributes:
        values: by key, of samples and events.
        active: by key of a condition its levels and texts by code; None: unavailable.
        pongs: answers to PING.
    """

    def __init__(self, place: str, items: dict[str, tuple[str, str]], small: bool = False) -> None:
        host, port = place.split(":")
        self.socket = socket.socket()
        if small:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        self.socket.settimeout(LONG_S)
        soon(RealClock(), lambda: self.socket.connect_ex((host, int(port))) == 0)
        self._stream = self.socket.makefile("rb")
        self._items, self._last = items, ""
        self.values: dict[str, str] = {}
        self.active: dict[str, dict[str, tuple[str, str]] | None] = {}
        self.pongs: list[str] = []

    def __enter__(self) -> "Agent":
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()
        self.socket.close()

    def ping(self) -> None:
        self.socket.sendall(b"* PING\n")

    def line(self) -> bool:
        """Take one line in; False where the adapter hung up."""
        try:
            data = self._stream.readline()
        except ConnectionResetError:
            return False
        if not data:
            return False
        assert data.endswith(b"\n")
        text = data[:-1].decode()
        if text.startswith("*"):
            assert re.fullmatch(r"\* PONG \d+", text)
            self.pongs.append(text)
            return True
        at, *fields = text.split("|")
        assert TIME.fullmatch(at)
        assert at >= self._last
        self._last = at
        category, kind = self._items[fields[0]]
        if category == "CONDITION":
            self._condition(fields)
        elif kind == "MESSAGE":
            assert len(fields) == 3
            self.values[fields[0]] = fields[1] or fields[2]
        else:
            assert len(fields) % 2 == 0
            for key, value in zip(fields[::2], fields[1::2], strict=True):
                category, kind = self._items[key]
                assert category == "EVENT" or NUMBER.fullmatch(value), text
                assert kind != "MESSAGE"
                self.values[key] = value
        return True

    def _condition(self, fields: list[str]) -> None:
        key, level, code, severity, qualifier, text = fields
        assert level in LEVELS
        assert (severity, qualifier) == ("", "")
        if level == "UNAVAILABLE":
            self.active[key] = None
        elif level == "NORMAL" and not code:
            self.active[key] = {}
        elif level == "NORMAL":
            (self.active[key] or {}).pop(code)  # one that is not active must not end
        else:
            assert code
            assert text
            of = self.active[key]
            assert of is not None
            of[code] = (level, text)

    def until(self, seen: Callable[["Agent"], Any]) -> None:
        while not seen(self):
            assert self.line(), "the adapter hung up"

    def everything(self) -> bool:
        return set(self.values) | set(self.active) == set(self._items)


@pytest.fixture(scope="module")
def setup(tmp_path_factory: pytest.TempPathFactory) -> Setup:
    folder = tmp_path_factory.mktemp("run")
    return load_setup(setups.write(folder, {**setups.tables(folder), "control": {"status_hz": 50.0}}))


@pytest.fixture(scope="module")
def items(setup: Setup) -> dict[str, tuple[str, str]]:
    """Category and type of each data item of the device file, by key."""
    text = device_file(setup.machine.name, setup.machine.axis_names, setup.machine.sensor_names, "u")
    return {e.attrib["id"]: (e.attrib["category"], e.attrib["type"]) for e in parsed(text).iter(f"{NS}DataItem")}


@pytest.fixture
def daemon(setup: Setup, runtime_folder: Path) -> Iterator[LivingDaemon]:
    del runtime_folder
    daemon = LivingDaemon(setup)
    with Control(setup, daemon, RealClock()):
        yield daemon


@pytest.fixture
def place(setup: Setup, daemon: LivingDaemon) -> Iterator[str]:
    """Where the adapter listens."""
    del daemon
    place = free_place()
    with served(task(setup, place)):
        yield place


def task(setup: Setup, place: str) -> Task:
    table = validated(MtconnectTable, {"listen": place, "period_s": 0.02}, "run")
    return Task("mtconnect", table, setup.path, setup.machine.name)


def ready(agent: Agent) -> bool:
    return agent.values.get("avail") == "AVAILABLE" and agent.everything()


def test_an_agent_gets_every_item_of_the_device_file(
    place: str, items: dict[str, tuple[str, str]], daemon: LivingDaemon
) -> None:
    """And no other; then only what changes."""
    with Agent(place, items) as agent:
        agent.until(ready)
        expected = {"X_position": "0.05", "X_requested": "0.0015", "X_applied": "0.00125", "Z_requested": "-0.0025"}
        expected |= {
            "Z_applied": "UNAVAILABLE",
            "X_residual": "UNAVAILABLE",
            "T_bed_temperature": "21.25",
            "mode": "on",
        }
        assert {key: agent.values[key] for key in expected} == expected
        assert agent.active == {"system": {}, "hardware": {}, "communications": {}, "actuator": {}}
        agent.values.clear()
        daemon._status.mode = "hold"
        agent.until(lambda a: a.values)
        assert agent.values == {"mode": "hold"}


def test_conditions_are_the_reasons_of_the_guard(
    place: str, items: dict[str, tuple[str, str]], daemon: LivingDaemon
) -> None:
    """Several of one type at a time; one that ends leaves the others. A separator in a text does not split a line."""
    with Agent(place, items) as agent:
        agent.until(ready)
        daemon._status.flags = Flag.STALE_COUNTS | Flag.ORDERED_HOLD | Flag.HELD | Flag.OVER_WARNING_LIMIT
        daemon._status.devices = {"box|1": ["silent|1", "dead"]}
        agent.until(lambda a: len(a.active["system"] or ()) == 2 and a.active["hardware"])
        over, hold = REASONS[Flag.OVER_WARNING_LIMIT], REASONS[Flag.ORDERED_HOLD]
        assert agent.active["communications"] == {"STALE_COUNTS": ("FAULT", REASONS[Flag.STALE_COUNTS])}
        assert agent.active["system"] == {"OVER_WARNING_LIMIT": ("WARNING", over), "ORDERED_HOLD": ("WARNING", hold)}
        assert agent.active["hardware"] == {"device box/1": ("FAULT", "silent/1; dead")}
        daemon._status.flags = Flag.ORDERED_HOLD | Flag.HELD
        daemon._status.devices = {}
        agent.until(lambda a: not a.active["hardware"] and len(a.active["system"] or ()) == 1)
        assert agent.active["communications"] == {}
        assert agent.active["system"] == {"ORDERED_HOLD": ("WARNING", hold)}


def test_a_text_whose_durations_alone_change_is_no_news() -> None:
    """By hand: the silence grows, then another device's words, and another level, are news."""
    one = {c.code: c for c in [StatusCondition("device a", "fault", "no message for 1.1 s")]}
    assert steady([StatusCondition("device a", "fault", "no message for 12.3 s")], one) == one
    other = StatusCondition("device a", "fault", "wrong message 12.3")
    assert steady([other], one) == {"device a": other}
    slaves = [StatusCondition("device a", "fault", f"slave {k}: no answer") for k in (3, 4)]
    assert steady(slaves[1:], {"device a": slaves[0]}) == {"device a": slaves[1]}
    milder = StatusCondition("device a", "warning", "no message for 1.1 s")
    assert steady([milder], one) == {"device a": milder}


@pytest.mark.parametrize("flag", REASONS)
def test_every_reason_has_a_type(flag: Flag, items: dict[str, tuple[str, str]]) -> None:
    kind = mtconnect.kind_of(StatusCondition(str(flag.name), "fault", ""))
    assert items[kind.lower()] == ("CONDITION", kind)


def test_unavailable_on_loss(setup: Setup, runtime_folder: Path, items: dict[str, tuple[str, str]]) -> None:
    """Of the daemon, and of its loop: every item says so, none keeps an old value; and all come back."""
    del runtime_folder
    place = free_place()
    with ExitStack() as stack:
        daemon = LivingDaemon(setup)
        stack.enter_context(served(task(setup, place)))
        running = stack.enter_context(ExitStack())
        running.enter_context(Control(setup, daemon, RealClock()))
        agent = stack.enter_context(Agent(place, items))
        agent.until(ready)
        losses: list[tuple[Callable[[], object], Callable[[], object]]] = [
            (lambda: setattr(daemon, "stands", True), lambda: setattr(daemon, "stands", False)),
            (running.close, lambda: running.enter_context(Control(setup, daemon, RealClock()))),
        ]
        for lose, again in losses:
            lose()
            agent.until(lambda a: a.values["avail"] == "UNAVAILABLE" and not any(a.active.values()))
            agent.until(lambda a: set(a.values.values()) == {"UNAVAILABLE"} and [*a.active.values()] == 4 * [None])
            again()
            agent.until(lambda a: ready(a) and None not in a.active.values() and a.values["X_position"] == "0.05")


def test_heartbeat(place: str, items: dict[str, tuple[str, str]], monkeypatch: pytest.MonkeyPatch) -> None:
    """Each PING has its PONG with the interval; who asked and is silent now is dead, who never asked is not."""
    with Agent(place, items) as agent, Agent(place, items) as plain:
        for _ in range(3):
            agent.ping()
        agent.until(lambda a: len(a.pongs) == 3)
        assert set(agent.pongs) == {"* PONG 10000"}
        monkeypatch.setattr(mtconnect, "HEARTBEAT_MS", 50)
        while agent.line():
            pass
        plain.until(ready)


def test_an_agent_that_does_not_read(
    place: str, items: dict[str, tuple[str, str]], daemon: LivingDaemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It gets nothing newer meanwhile, others do; and in the end what is true then. Oracle: the bytes that waited."""
    monkeypatch.setattr(mtconnect, "LARGEST_BUFFER", 4096)
    with Agent(place, items, small=True) as slow, Agent(place, items) as quick:
        slow.until(ready)
        for count in range(60):
            daemon._status.devices = {"box": [f"{count}: {3000 * 'x'}"]}
            quick.until(lambda a, count=count: f"{count}:" in str(a.active.get("hardware")))  # type: ignore[misc]
        daemon._status.devices = {"box": ["the last"]}
        lines = 0
        while slow.active["hardware"] != {"device box": ("FAULT", "the last")}:
            assert slow.line()
            lines += 1
        assert lines < 40


def test_a_flood(place: str, items: dict[str, tuple[str, str]], daemon: LivingDaemon) -> None:
    """Of lines, of a line without an end, of connections: an agent that comes behind them is served."""
    host, port = place.split(":")
    with Agent(place, items) as agent:
        agent.until(ready)
    with ExitStack() as opened:
        for text in (b"* PING\n" * 100_000, b"x" * 1_000_000, b"\0\n\xff\n" * 100_000):
            flood = opened.enter_context(socket.create_connection((host, int(port))))
            flood.setblocking(False)
            try:
                flood.send(text)
            except (BlockingIOError, ConnectionResetError, BrokenPipeError):
                continue
        for _ in range(3 * mtconnect.MOST_AGENTS):
            opened.enter_context(socket.create_connection((host, int(port))))
        with Agent(place, items) as agent:
            agent.until(ready)
            daemon._status.mode = "off"
            agent.until(lambda a: a.values["mode"] == "off")


def test_a_restart(setup: Setup, daemon: LivingDaemon, items: dict[str, tuple[str, str]]) -> None:
    """An agent comes again, and gets everything. A place that is taken is reported."""
    del daemon
    place = free_place()
    for _ in range(2):
        with served(task(setup, place)), Agent(place, items) as agent:
            agent.until(ready)
    taken = socket.create_server(("127.0.0.1", int(place.split(":")[1])))
    with taken, pytest.raises(AssertionError, match="cannot listen there"), served(task(setup, place)) as said:
        soon(RealClock(), lambda: any("cannot listen there" in line for line in said))


def test_the_device_file(tmp_path: Path) -> None:
    """Oracle: schema 1.4: order of elements, names, types and their units; ids are there once."""
    config = setups.write(tmp_path, {**setups.tables(tmp_path), "telemetry": {"mtconnect": {}}})
    out = tmp_path / "devices.xml"
    assert status(["telemetry", str(config), "--devices", str(out)]) == 0
    text = out.read_text(encoding="utf-8")
    root = parsed(text)
    assert [e.tag for e in root] == [f"{NS}Header", f"{NS}Devices"]
    (device,) = root.iter(f"{NS}Device")
    assert [e.tag.removeprefix(NS) for e in device] == ["Description", "DataItems", "Components"]
    assert re.fullmatch(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}", device.attrib["uuid"])
    ids = [e.attrib["id"] for e in root.iter() if "id" in e.attrib]
    assert len(ids) == len(set(ids))
    assert all(NMTOKEN.fullmatch(e.attrib[name]) for e in root.iter() for name in ("id", "name") if name in e.attrib)
    for item in root.iter(f"{NS}DataItem"):
        types = TYPES[item.attrib["category"]]
        assert item.attrib.get("units") == types[item.attrib["type"]]
    assert status(["telemetry", str(config), "--devices", str(out)]) == 0
    again = parsed(out.read_text(encoding="utf-8"))
    assert next(again.iter(f"{NS}Device")).attrib["uuid"] == device.attrib["uuid"]


def test_what_is_refused() -> None:
    with pytest.raises(ConfigError, match="host:port"):
        validated(MtconnectTable, {"listen": "7878"}, "run.toml")
