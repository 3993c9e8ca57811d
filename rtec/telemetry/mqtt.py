"""MQTT: retained state with its last will, values with one message in flight, events (`docs/mqtt.md`)."""

import asyncio
import hashlib
import json
import re
import socket
import ssl
import uuid
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from rtec.errors import ConfigError
from rtec.loop.telemetry_tables import MqttTable, host_and_port
from rtec.telemetry.values import OF_AXIS, OF_MACHINE, OF_SENSOR, Follower, axes, conditions, instant, machine, sensors

SCHEMA: Final = 1
PATIENCE_S: Final = 10.0
"""A broker that does not confirm a message within this time, s, is disconnected and reconnected."""
KEEPALIVE_S: Final = 15
"""s; after one and a half times this without a sign of life, the broker sends the last will."""
FIRST_WAIT_S: Final = 1.0
LONGEST_WAIT_S: Final = 30.0
SENT: Final = 64
"""Number of own states that are remembered, to tell them from those of others."""
AGAIN_S: Final = 60.0
"""Period, s, of repeating an unchanged retained state, which a broker may have lost."""
LONGEST_PASSWORD: Final = 4096
_TOPIC_LEVEL: Final = re.compile(r"[\s+#/$]")

Say = Callable[[str], None]


def prepare(table: MqttTable, base: Path) -> dict[str, Any]:
    """Options of a connection, without its will.

    Args:
        table: table of the run file.
        base: the run file's folder.

    Raises:
        ConfigError: a file cannot be used, or `aiomqtt` is not installed.
    """
    try:
        import aiomqtt  # noqa: F401 (is it installed?)
    except ImportError as error:
        raise ConfigError("[telemetry.mqtt] needs the package aiomqtt: pip install 'rtec[mqtt]'") from error
    host, port = host_and_port(table.broker)
    options: dict[str, Any] = {"hostname": host, "port": port, "keepalive": KEEPALIVE_S, "timeout": PATIENCE_S}
    options["max_queued_incoming_messages"] = 1  # unrequested messages are dropped
    if table.tls:
        options["tls_context"] = _tls(table, base)
    if table.user is not None and table.password_file is not None:
        options |= {"username": table.user, "password": _password(base / table.password_file)}
    return options


def _tls(table: MqttTable, base: Path) -> ssl.SSLContext:
    try:
        context = ssl.create_default_context(cafile=None if table.ca_file is None else base / table.ca_file)
        if table.certificate_file is not None and table.key_file is not None:
            context.load_cert_chain(base / table.certificate_file, base / table.key_file, password=_no_password)
    except (OSError, ValueError) as error:  # SSLError is an OSError
        raise ConfigError(f"[telemetry.mqtt] ca_file, certificate_file or key_file: {error}") from error
    return context


def _no_password() -> str:
    raise ValueError("the private key is encrypted; rtec has nobody to ask for its password: give one that is not")


def _password(path: Path) -> str:
    try:
        with path.open(encoding="utf-8") as file:
            text = file.read(LONGEST_PASSWORD)
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"[telemetry.mqtt] password_file {path}: cannot be read: {error}") from error
    return text.removesuffix("\n").removesuffix("\r")


def units() -> dict[str, str]:
    """The unit of every key that has one."""
    return {q.key: q.unit for q in (*OF_AXIS, *OF_SENSOR, *OF_MACHINE) if q.unit}


def state(follower: Follower) -> dict[str, Any]:
    """The retained state: the daemon's state, and the units of the values."""
    content: dict[str, Any] = {"schema": SCHEMA, "state": follower.state}
    if (report := follower.report) is not None:
        content |= {key: report[key] for key in ("machine", "model", "rtec_version", "axes", "sensors", "started")}
    return {**content, "units": units()}


def values(report: Mapping[str, Any]) -> dict[str, Any]:
    """One message with all values that change."""
    return {
        "schema": SCHEMA,
        "utc": instant(report),
        "machine": report["machine"],
        **machine(report),
        "axes": axes(report),
        "temperatures": sensors(report),
        "conditions": [vars(condition) for condition in conditions(report)],
    }


def _text(content: Mapping[str, Any]) -> str:
    return json.dumps(content, allow_nan=False, ensure_ascii=False, separators=(",", ":"))


OFFLINE: Final = _text({"schema": SCHEMA, "state": "offline"})


def client_name(topic: str, base: Path) -> str:
    """Name of the connection at the broker, which cuts off an earlier one of the same name.

    It is the same whenever this run file is served on this computer, and another one anywhere else. 20 letters and
    digits: every broker takes so many (MQTT 3.1.1, 3.1.3.1).
    """
    place = "\0".join((socket.gethostname(), str(uuid.getnode()), str(base.resolve()), topic))
    return "rtec" + hashlib.sha256(place.encode()).hexdigest()[:16]


def server(task: Any, say: Say) -> "Publisher":
    """The publisher of a task of `rtec.telemetry.processes`."""
    topic = task.table.topic or f"rtec/{_TOPIC_LEVEL.sub('-', task.config.stem)}"
    return Publisher(task.table, task.config.parent, topic, say)


class Publisher:
    """Publishes what a follower reads, and reconnects to the broker whenever needed.

    One message at a time is in flight, until the broker confirms it: a slow broker gets fewer, but no old ones.

    Args:
        table: table of the run file.
        base: the run file's folder.
        topic: first part of the topics.
        say: reports a line to people.
    """

    def __init__(self, table: MqttTable, base: Path, topic: str, say: Say) -> None:
        import aiomqtt

        self._table, self._topic, self._say = table, topic, say
        will = aiomqtt.Will(f"{topic}/state", OFFLINE, qos=1, retain=True)
        self._options = {**prepare(table, base), "identifier": client_name(topic, base), "will": will}
        self._wait_s = FIRST_WAIT_S
        self._heard = ""
        self._sent: deque[str] = deque(maxlen=SENT)
        self._others_told = False
        self._events: tuple[int, int] | None = None

    async def serve(self, follower: Follower) -> None:
        """Publish until cancelled."""
        import aiomqtt

        while True:
            try:
                await self._talk(follower)
            except aiomqtt.MqttError as error:
                self._say(f"broker {self._table.broker}: {error}; tried again in {self._wait_s:g} s")
            await asyncio.sleep(self._wait_s)
            self._wait_s = min(2 * self._wait_s, LONGEST_WAIT_S)

    async def _talk(self, follower: Follower) -> None:
        import aiomqtt

        async with aiomqtt.Client(**self._options) as client:
            self._say(f"connected to the broker {self._table.broker}, topics {self._topic}/…")
            await client.subscribe(f"{self._topic}/state", qos=1)
            listening = asyncio.create_task(self._listen(client))
            try:
                await self._publish(client, follower)
            except asyncio.CancelledError:  # an orderly end: the will is not for this
                await client.publish(f"{self._topic}/state", OFFLINE, qos=1, retain=True, timeout=1.0)
                raise
            finally:
                listening.cancel()

    async def _publish(self, client: Any, follower: Follower) -> None:
        published, now, since_s = "", asyncio.get_running_loop().time, 0.0
        while True:
            text = _text(state(follower))
            if text != published or self._heard != published or now() - since_s > AGAIN_S:
                self._heard = published = text
                self._sent.append(text)
                await client.publish(f"{self._topic}/state", text, qos=1, retain=True)
                since_s, self._wait_s = now(), FIRST_WAIT_S
            if (report := follower.live) is not None:
                await client.publish(f"{self._topic}/values", _text(values(report)), qos=1)
            if (report := follower.report) is not None:
                await self._send_events(client, report)
            await asyncio.sleep(self._table.period_s)

    async def _listen(self, client: Any) -> None:
        """Read the retained state: a broker that was stopped may send an old will after the new state."""
        async for message in client.messages:
            if message.topic.value == f"{self._topic}/state":
                self._heard = bytes(message.payload).decode(errors="replace")
                self._look_for_others(message.retain)

    def _look_for_others(self, retained: bool) -> None:
        """Tell people once of another machine under the same topics; a retained state, or a will, may be our own."""
        if retained or self._others_told or self._heard in self._sent or self._heard == OFFLINE:
            return
        self._others_told = True
        self._say(f"another program publishes {self._topic}/state, too: give each machine a topic of its own")

    async def _send_events(self, client: Any, report: Mapping[str, Any]) -> None:
        for event in self._new_events(report):
            await client.publish(f"{self._topic}/events", _text({"schema": SCHEMA, **event}), qos=1)
        self._events = (report["pid"], report["events_total"])

    def _new_events(self, report: Mapping[str, Any]) -> list[dict[str, Any]]:
        """Events since the last message; no old ones of a daemon that was not followed before."""
        if self._events is None:
            return []
        pid, total = self._events
        new = report["events_total"] - (total if pid == report["pid"] else 0)
        events: list[dict[str, Any]] = report["events"]
        return events[-new:] if new > 0 else []
