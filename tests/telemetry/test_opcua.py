"""OPC UA. Oracles: node-opcua, a client with no code of ours or of the server's library; asyncua's client."""

import asyncio
import gc
import json
import os
import select
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Awaitable, Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any
from weakref import WeakSet

import pytest
from asyncua import Client, ua
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256
from asyncua.crypto.uacrypto import CertProperties
from asyncua.server.binary_server_asyncio import OPCUAProtocol
from asyncua.server.internal_session import InternalSession
from asyncua.server.internal_subscription import InternalSubscription

from rtec.control.server import Control
from rtec.correction.flags import Flag
from rtec.errors import ConfigError
from rtec.loop.clock import RealClock
from rtec.loop.run_file import Setup
from rtec.loop.telemetry_tables import OpcuaTable
from rtec.telemetry import opcua
from rtec.telemetry.processes import Task
from rtec.tomlfile import validated
from tests.support import setups
from tests.support.conformance import soon
from tests.support.control_rig import LONG_S, free_place
from tests.support.telemetry_rig import LivingDaemon, certificates, served

pytestmark = [
    pytest.mark.xdist_group("real-clock"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),  # of the client that is refused
]


@pytest.fixture(scope="module")
def setup(tmp_path_factory: pytest.TempPathFactory) -> Setup:
    return setups.setup(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with certificates; `trusted` has that of the client `office`, not that of `stranger`."""
    folder = certificates(tmp_path_factory.mktemp("keys"), "mill", "office", "stranger")
    (folder / "trusted").mkdir()
    shutil.copy(folder / "office.pem", folder / "trusted")
    return folder


@pytest.fixture(scope="module")
def daemon(setup: Setup) -> Iterator[LivingDaemon]:
    """One for all tests: a server takes seconds to start."""
    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory(prefix="rtec-") as folder:
        patch.setenv("RUNTIME_DIRECTORY", folder)
        with Control(setup, daemon := LivingDaemon(setup), RealClock()):
            yield daemon


def task(setup: Setup, keys: Path, place: str) -> Task:
    files = {"certificate_file": "mill.pem", "key_file": "mill.key", "trusted_folder": "trusted"}
    table = validated(OpcuaTable, {"listen": place, **{key: str(keys / name) for key, name in files.items()}}, "run")
    return Task("opcua", table, setup.path, setup.machine.name)


@pytest.fixture(scope="module")
def running(setup: Setup, keys: Path, daemon: LivingDaemon) -> Iterator[tuple[str, list[str]]]:
    """Where the server listens, and what it says."""
    del daemon
    place = free_place()
    with served(task(setup, keys, place)) as said:
        connectable(said)
        yield place, said


@pytest.fixture
def place(running: tuple[str, list[str]]) -> str:
    return running[0]


def connectable(said: list[str]) -> None:
    """Wait until the server says so: it may take longer than anything else here."""
    for _ in range(5):
        with suppress(AssertionError):
            soon(RealClock(), lambda: any("can connect" in line for line in said))
            return
    raise AssertionError(said)


def asked(place: str, keys: Path, who: str | None, do: Callable[[Client], Awaitable[Any]], user: str = "") -> Any:
    """Connect as somebody, do something, and give what came of it."""

    async def run() -> Any:
        client = await client_of(place, keys, who)
        if user:
            client.set_user(user)
        async with client:
            return await do(client)

    return asyncio.run(run())


async def client_of(place: str, keys: Path, who: str | None = "office") -> Client:
    """Not connected yet."""
    client = Client(f"opc.tcp://{place}/rtec", timeout=LONG_S)
    client.application_uri = f"urn:{who}"
    if who is not None:
        own, key, other = (CertProperties(str(keys / n), "pem") for n in (f"{who}.pem", f"{who}.key", "mill.pem"))
        await client.set_security(SecurityPolicyBasic256Sha256, own, key, server_certificate=other)
    return client


def transport_of(client: Client) -> asyncio.Transport:
    """Of a client that is connected."""
    transport: asyncio.Transport = client.uaclient.protocol.transport
    return transport


def closed(client: Client) -> bool:
    """Has the server closed the connection, whatever the client has read? The kernel says so."""
    look = select.poll()
    look.register(transport_of(client).get_extra_info("socket").fileno(), select.POLLRDHUP)
    return bool(look.poll(0))


IN_MEMORY = (OPCUAProtocol, InternalSession, InternalSubscription)


def held() -> "WeakSet[Any]":
    """Connections, sessions and subscriptions that the servers of this process have in memory."""
    gc.collect()
    return WeakSet(one for one in gc.get_objects() if isinstance(one, IN_MEMORY))


async def status_of(client: Client, node: str) -> ua.DataValue:
    number = await client.get_namespace_index(opcua.OURS)
    return await client.get_node(ua.NodeId(node, number)).read_data_value(raise_on_bad_status=False)


async def reading(client: Client, *nodes: str) -> list[tuple[Any, str]]:
    values = [await status_of(client, node) for node in nodes]
    return [(v.Value.Value if v.Value else None, v.StatusCode.name) for v in values]


def made(place: str, keys: Path) -> None:
    """Wait until the address space is there."""

    async def there(client: Client) -> None:
        while True:
            if opcua.OURS in await client.get_namespace_array():
                status = await status_of(client, "Axes.X.position_mm")
                if status.StatusCode and status.StatusCode.is_good():
                    return
            await asyncio.sleep(0.02)

    asked(place, keys, "office", there)


def test_values_units_and_loss(place: str, keys: Path, daemon: LivingDaemon) -> None:
    """Oracles: the daemon's figures; UN/CEFACT's codes MMT and 4H as numbers, from the OPC foundation's list."""
    made(place, keys)

    async def look(client: Client) -> Any:
        found = await reading(client, "Axes.X.position_mm", "Axes.X.applied_um", "Axes.Z.applied_um", "mode")
        number = await client.get_namespace_index(opcua.OURS)
        units = [
            await client.get_node(ua.NodeId(f"Axes.X.{key}.unit", number)).read_value()
            for key in ("position_mm", "applied_um")
        ]
        daemon._status.flags = Flag.STALE_COUNTS | Flag.HELD
        while (health := await reading(client, "DeviceHealth", "Conditions"))[0][0] != opcua.FAILURE:
            await asyncio.sleep(0.02)
        stale = await reading(client, "Axes.X.position_mm")
        daemon.stands = True
        while (lost := await reading(client, "Axes.X.position_mm"))[0][1] != "BadNoCommunication":
            await asyncio.sleep(0.02)
        daemon._status.flags, daemon.stands = Flag(0), False
        while (await reading(client, "Axes.X.position_mm"))[0][1] != "Good":
            await asyncio.sleep(0.02)
        return found, units, health, stale, lost

    found, units, health, stale, lost = asked(place, keys, "office", look)
    assert found == [(0.05, "Good"), (1.25, "Good"), (None, "BadDataUnavailable"), ("on", "Good")]
    assert [(u.UnitId, u.DisplayName.Text) for u in units] == [(5066068, "mm"), (13384, "µm")]
    assert health[1][0] == ["fault: STALE_COUNTS: counts are stale"]
    assert stale == [(None, "BadDataUnavailable")]
    assert lost == [(None, "BadNoCommunication")]


@pytest.mark.parametrize("user", ["", "admin", "Admin"])
def test_nobody_can_change_anything(place: str, keys: Path, user: str) -> None:
    """Whatever name is given: writes, new nodes and deleted nodes are refused, and nothing has changed."""
    made(place, keys)

    async def change(client: Client) -> list[str]:
        number = await client.get_namespace_index(opcua.OURS)
        node = client.get_node(ua.NodeId("mode", number))
        refused = []
        actions: list[Callable[[], Awaitable[Any]]] = [
            lambda: node.write_value(ua.Variant("off", ua.VariantType.String)),
            lambda: client.nodes.objects.add_variable(ua.NodeId("new", number), "new", 1.0),
            lambda: client.delete_nodes([node]),
        ]
        for action in actions:
            try:
                await action()
            except (ua.UaError, ConnectionError) as error:
                refused.append(type(error).__name__)
        return [*refused, str(await node.read_value())]

    try:
        found = asked(place, keys, "office", change, user)
    except (ua.UaError, ConnectionError):  # a name is no identity that the server takes
        assert user
        return
    assert len(found) == 4
    assert found[-1] == "on"


@pytest.mark.parametrize("who", [None, "stranger"])
def test_who_is_refused(place: str, keys: Path, who: str | None) -> None:
    """No encryption; a certificate that is not in the folder. Then one that is put there, without a restart."""
    with pytest.raises((ua.UaError, ConnectionError, TimeoutError)):
        asked(place, keys, who, lambda client: client.get_namespace_array())
    if who is not None:
        shutil.copy(keys / "stranger.pem", keys / "trusted")
        try:
            assert asked(place, keys, who, lambda client: client.get_namespace_array())
        finally:
            (keys / "trusted" / "stranger.pem").unlink()


def test_a_flood_and_a_restart(setup: Setup, keys: Path, daemon: LivingDaemon, monkeypatch: pytest.MonkeyPatch) -> None:
    """Garbage, half messages, more idle connections than there are places: they go, and a client is served."""
    del daemon
    monkeypatch.setattr(opcua, "ACTIVATION_S", 0.5)
    place = free_place()
    for _ in range(2):
        with served(task(setup, keys, place)) as said, ExitStack() as opened:
            connectable(said)
            host, port = place.split(":")
            for text in (b"\0" * 100_000, b"HELF" + b"\xff" * 1000, b"GET / HTTP/1.1\r\n\r\n", b"OPNF\x10\0\0\0"):
                one = opened.enter_context(socket.create_connection((host, int(port))))
                one.sendall(text)
            for _ in range(2 * opcua.MOST_CONNECTIONS):
                opened.enter_context(socket.create_connection((host, int(port))))

            def served_again() -> bool:
                try:
                    made(place, keys)
                except (OSError, ua.UaError, TimeoutError):
                    return False
                return True

            soon(RealClock(), served_again)


def test_a_message_without_an_end(place: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its first bytes give 2 GB. Oracle: the connection ends far before that, and not for want of a session."""
    monkeypatch.setattr(opcua, "ACTIVATION_S", 1e6)
    host, port = place.split(":")
    with socket.create_connection((host, int(port)), timeout=LONG_S) as flood:
        flood.sendall(b"OPNF" + (2**31 - 1).to_bytes(4, "little"))
        with suppress(ConnectionError):
            flood.sendall(bytes(2 << 20))
            assert flood.recv(1) == b""


@pytest.mark.parametrize("way", ["much waits", "long waits"])
def test_who_does_not_read_is_cut_off(keys: Path, monkeypatch: pytest.MonkeyPatch, way: str) -> None:
    """The library lets answers wait without an end. Oracle: real connections of the loopback: one whose peer reads goes
    on, the other is aborted at the bytes that wait, or after the time."""
    monkeypatch.setattr(opcua, "LARGEST_BUFFER", 1 << 20 if way == "much waits" else 1 << 40)
    monkeypatch.setattr(opcua, "SLOW_S", 60.0 if way == "much waits" else 0.3)
    monkeypatch.setattr(opcua, "LOOK_S", 0.01)
    said: list[str] = []

    async def run() -> None:
        table = validated(OpcuaTable, {"certificate_file": "c", "key_file": "k", "trusted_folder": "t"}, "run")
        publisher = opcua.UaPublisher(table, keys, "mill", said.append)
        accepted: list[asyncio.StreamWriter] = []
        server = await asyncio.start_server(lambda _, writer: accepted.append(writer), "127.0.0.1", 0)
        address = server.sockets[0].getsockname()
        peers = [await asyncio.open_connection(*address) for _ in range(2)]
        while len(accepted) < 2:
            await asyncio.sleep(0.01)
        by_name = {writer.get_extra_info("peername"): writer for writer in accepted}
        slow, quick = (by_name[writer.get_extra_info("sockname")] for _, writer in peers)
        peers[0][1].transport.pause_reading()  # type: ignore[attr-defined]
        watch = asyncio.create_task(publisher._cut_off([slow.transport, quick.transport]))
        slow.write(bytes(16 << 20))
        taken = 0
        while not slow.transport.is_closing():
            quick.write(bytes(1 << 16))
            taken += len(await peers[1][0].readexactly(1 << 16))
            await asyncio.sleep(0.01)
        assert taken > 0
        assert not quick.transport.is_closing()
        watch.cancel()
        server.close()
        for writer in (*accepted, *(writer for _, writer in peers)):
            writer.transport.abort()
        ended = (writer.wait_closed() for writer in (*accepted, *(writer for _, writer in peers)))
        await asyncio.gather(*ended, return_exceptions=True)

    asyncio.run(run())
    assert len(said) == 1
    assert "cut off: it does not read" in said[0]


def test_a_dead_client(setup: Setup, keys: Path, daemon: LivingDaemon, monkeypatch: pytest.MonkeyPatch) -> None:
    """It has a session and a subscription and falls silent: its connection is closed, its memory is free. Oracles: the
    objects of this process; the kernel. One that goes on to ask keeps its connection meanwhile."""
    del daemon
    monkeypatch.setattr(opcua, "SHORTEST_SESSION_S", 1.0)
    monkeypatch.setattr(opcua, "ACTIVATION_S", 0.5)
    place = free_place()

    async def run() -> None:
        async with await client_of(place, keys) as living:
            others = held()
            dead = await client_of(place, keys)
            dead.session_timeout = 1000
            await dead.connect()
            await dead.create_subscription(50, object())
            of_dead = held() - others
            assert {type(one) for one in of_dead} == set(IN_MEMORY)
            for job in (dead._supervisor_task, dead._stale_watchdog_task, dead._renew_channel_task):
                job.cancel()
            transport_of(dead).pause_reading()
            while not closed(dead):
                assert await living.get_namespace_array()
                await asyncio.sleep(0.05)
            while of_dead:
                gc.collect()
                assert await living.get_namespace_array()
            transport_of(dead).abort()

    with served(task(setup, keys, place)) as said:
        connectable(said)
        made(place, keys)
        asyncio.run(asyncio.wait_for(run(), LONG_S))


def test_a_client_that_asks_and_does_not_read(
    running: tuple[str, list[str]], keys: Path, daemon: LivingDaemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    """asyncua's client sends questions whose answers are long, reads none, and is cut off at the bytes that wait, not
    by a time. Another client is answered all the while. Oracles: what the server says; the kernel."""
    place, said = running
    monkeypatch.setattr(opcua, "SLOW_S", 1e6)
    made(place, keys)
    daemon._status.devices = {"box": [30_000 * "x"]}

    async def run() -> int:
        async with await client_of(place, keys) as quick:
            while len(str(await reading(quick, "Conditions"))) < 30_000:
                await asyncio.sleep(0.02)
            slow = await client_of(place, keys)
            await slow.connect()
            number = await slow.get_namespace_index(opcua.OURS)
            one = ua.ReadValueId(ua.NodeId("Conditions", number), ua.AttributeIds.Value)
            question = ua.ReadRequest()
            question.Parameters.NodesToRead = 30 * [one]
            transport_of(slow).pause_reading()
            answered = 0
            while not cut(said):
                slow.uaclient.protocol._send_request(question)
                assert await reading(quick, "mode") == [("on", "Good")]
                answered += 1
            assert await reading(quick, "mode") == [("on", "Good")]
            while not closed(slow):
                await asyncio.sleep(0.01)
            await slow.disconnect()
            return answered

    try:
        assert asyncio.run(asyncio.wait_for(run(), LONG_S)) > 1
    finally:
        daemon._status.devices = {}
    assert len(cut(said)) == 1


def cut(said: list[str]) -> list[str]:
    return [line for line in said if "cut off: it does not read" in line]


def node_modules() -> str:
    """Folder of node-opcua-client; RTEC_NODE_MODULES names it where it is not installed for all."""
    if shutil.which("node") is None:
        pytest.skip("node is not installed (Debian: nodejs)")
    folder = os.environ.get("RTEC_NODE_MODULES") or "/usr/local/lib/node_modules"
    if not (Path(folder) / "node-opcua-client").is_dir():
        pytest.skip(
            "node-opcua-client is not installed (npm ci in tests/telemetry/node, as .ci/run; RTEC_NODE_MODULES)"
        )
    return folder


def test_an_independent_client(place: str, keys: Path) -> None:
    """node-opcua: browses, subscribes at 10 Hz, is refused a write, and a connection without encryption."""
    folder = node_modules()
    made(place, keys)
    script = Path(__file__).with_name("node") / "opcua_client.js"
    done = subprocess.run(
        ["node", str(script), f"opc.tcp://{place}/rtec", str(keys)],
        capture_output=True, text=True, timeout=40, check=False, env={**os.environ, "NODE_PATH": folder},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    found = json.loads(done.stdout.splitlines()[-1])
    assert {"Machines", "turning-centre", "Identification", "Monitoring", "Axes", "X", "Applied"} <= set(found["names"])
    assert found["applied"] == 1.25
    assert found["unit"] == "µm"
    assert len(found["ages"]) >= 10
    assert found["write"].startswith("Bad")
    assert found["plain"].startswith("refused")


def test_what_must_be_there(keys: Path, tmp_path: Path) -> None:
    """No certificate, no server: before anything is started, with the key that names the file."""
    with pytest.raises(ConfigError, match="certificate_file"):
        validated(OpcuaTable, {}, "run.toml")
    good = {"certificate_file": "mill.pem", "key_file": "mill.key", "trusted_folder": "trusted"}
    for changed, why in (
        ({"certificate_file": "none.pem"}, "certificate_file or key_file"),
        ({"key_file": "office.key"}, "is not the key of"),
        ({"certificate_file": "ca.pem", "key_file": "ca.key"}, "application URI"),
        ({"trusted_folder": "none"}, "is no folder"),
    ):
        table = validated(OpcuaTable, {**good, **changed}, "run.toml")
        with pytest.raises(ConfigError, match=why):
            opcua.prepare(table, keys)
    del tmp_path
