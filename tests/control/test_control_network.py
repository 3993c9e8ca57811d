"""Control over the network: CURVE keys, the list of clients, roles; by real sockets on the loopback.

Oracles: the orders that the daemon was given; the tally against what was sent; a relay that records the bytes.
"""

import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zmq

from rtec.control.client import Client, Place
from rtec.control.keys import ClientKeys, add_client, make_server, read_client, remove_client
from rtec.control.messages import TOPIC
from rtec.control.server import Control
from rtec.errors import ConfigError, RtecError
from rtec.loop.clock import RealClock
from rtec.loop.orders import Order, OrderRefused
from rtec.loop.run_file import ControlTable, Setup
from rtec.tomlfile import validated
from tests.support import setups
from tests.support.control_rig import SHORT_MS, FakeDaemon, Line, free_place, lock


@pytest.fixture(scope="module")
def setup(tmp_path_factory: pytest.TempPathFactory) -> Setup:
    return setups.setup(tmp_path_factory.mktemp("run"))


class Network:
    """Control on the network with three clients: `office` may read, `cell` may operate, `gone` is taken off."""

    def __init__(self, setup: Setup, folder: Path) -> None:
        make_server(folder)
        self.folder, self.keys = folder, {}
        for name, role in (("office", "read"), ("cell", "operate"), ("gone", "operate")):
            out = add_client(folder, name, role, None, folder / f"{name}.key")  # type: ignore[arg-type]
            assert out is not None
            self.keys[name] = read_client(out)
        remove_client(folder, "gone")
        self.tcp, self.tcp_status = free_place(), free_place()
        table = ControlTable(local=False, tcp=self.tcp, tcp_status=self.tcp_status, keys=folder, status_hz=50)
        file = setup.file.model_copy(update={"control": table})
        self.daemon = FakeDaemon(setup)
        self.setup = Setup(setup.path, file, setup.machine, setup.model, setup.hash)
        self.control = Control(self.setup, self.daemon, RealClock())

    def line(self, name: str) -> Line:
        return Line(f"tcp://{self.tcp}", self.keys[name])

    def stranger(self, **changed: str) -> ClientKeys:
        public, secret = zmq.curve_keypair()
        server = self.keys["cell"].server
        return ClientKeys(public=public.decode(), secret=secret.decode(), server=changed.get("server", server))


@pytest.fixture
def network(setup: Setup, tmp_path: Path) -> Iterator[Network]:
    made = Network(setup, tmp_path / "keys")
    with made.control:
        yield made


def test_roles(network: Network) -> None:
    """`office` sees everything and changes nothing, `cell` operates under its own name."""
    with network.line("office") as office:
        assert (office.ask(ask="status") or {})["machine"] == network.setup.machine.name
        assert (office.ask(ask="session") or {})["refused"] == "office may read, not operate"
        found = office.ask(ask="order", session="0" * 32, seq=1, order="fade")
        assert (found or {})["refused"] == "office may read, not operate"
    with network.line("cell") as cell:
        cell.send(cell.order(order="fade"))
        assert cell.receive() == {"schema": 1, "done": "fade ordered"}
    assert network.daemon.orders == [(Order.FADE, "", "cell")]
    assert network.control.desk.tally.refused == 2
    assert network.daemon.notes[0] == "office: session: office may read, not operate"


@pytest.mark.parametrize("who", ["no key", "another key", "taken off", "wrong server"])
def test_who_is_not_let_in_gets_no_answer(network: Network, who: str) -> None:
    """Not even a refusal; the others go on. It is counted, and stands in the events: oracle, the events' own text."""
    other_server, _ = zmq.curve_keypair()
    keys = {
        "no key": None,
        "another key": network.stranger(),
        "taken off": network.keys["gone"],
        "wrong server": network.stranger(server=other_server.decode()),
    }[who]
    with Line(f"tcp://{network.tcp}", keys) as line:
        assert line.ask(ask="status", wait_ms=SHORT_MS) is None
    with network.line("cell") as cell:
        assert cell.ask(ask="status") is not None
    assert network.daemon.orders == []
    assert network.control.desk.tally.not_let_in > 0
    known = who in ("another key", "taken off")
    why = "its key is not on the list" if known else "without a key, or for another server's key"
    assert why in "\n".join(network.daemon.notes)


def test_whoever_is_taken_off_the_list_is_refused_at_once(network: Network) -> None:
    """With a connection and a session that were good a moment ago."""
    with network.line("cell") as cell:
        order = cell.order(order="enable")
        remove_client(network.folder, "cell")
        cell.send(order)
        assert "not on the list" in (cell.receive() or {})["refused"]
    assert network.daemon.orders == []


def test_a_list_that_cannot_be_read_lets_nobody_in(network: Network) -> None:
    with network.line("cell") as cell:
        assert cell.ask(ask="status") is not None
        (network.folder / "clients.toml").write_text("[client", encoding="utf-8")
        assert "refused" in (cell.ask(ask="status") or {})


class Relay:
    """Stands between client and daemon, hands everything on, and remembers what the client said."""

    def __init__(self, to: str) -> None:
        host, port = to.split(":")
        self._to = (host, int(port))
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.place = f"127.0.0.1:{self._listener.getsockname()[1]}"
        self.said = bytearray()
        threading.Thread(target=self._work, daemon=True).start()

    def _work(self) -> None:
        with self._listener:
            near, _ = self._listener.accept()
        far = socket.create_connection(self._to)
        threading.Thread(target=self._pump, args=(far, near, bytearray()), daemon=True).start()
        self._pump(near, far, self.said)

    @staticmethod
    def _pump(source: socket.socket, to: socket.socket, said: bytearray) -> None:
        with source, to:
            try:
                while data := source.recv(4096):
                    said += data
                    to.sendall(data)
            except OSError:
                return


def test_a_recorded_conversation_says_nothing_a_second_time(network: Network) -> None:
    """Somebody on the network who recorded an order and sends the bytes again has the keys of neither side."""
    relay = Relay(network.tcp)
    with Line(f"tcp://{relay.place}", network.keys["cell"]) as cell:
        cell.send(cell.order())
        assert "done" in (cell.receive() or {})
    host, port = network.tcp.split(":")
    assert b"hold" not in relay.said
    with socket.create_connection((host, int(port))) as again:
        again.settimeout(5)
        again.sendall(relay.said)
        heard = b""
        try:
            while data := again.recv(4096):
                heard += data
        except OSError:
            heard += b""
    assert b"done" not in heard
    assert len(network.daemon.orders) == 1


def test_the_status_on_the_network_needs_a_key_too(network: Network) -> None:
    context: Any = zmq.Context()
    heard, sockets = {}, []
    try:
        for name, keys in (("stranger", network.stranger()), ("nobody", None), ("office", network.keys["office"])):
            made = context.socket(zmq.SUB)
            sockets.append(made)
            lock(made, keys)
            made.subscribe(TOPIC)
            made.connect(f"tcp://{network.tcp_status}")
            heard[name] = bool(made.poll(20_000 if name == "office" else SHORT_MS))
    finally:
        context.destroy(linger=0)
    assert heard == {"stranger": False, "nobody": False, "office": True}


def test_the_client_says_why(network: Network) -> None:
    place = Place(f"tcp://{network.tcp}", network.keys["office"])
    with Client(place) as client, pytest.raises(OrderRefused, match="office may read, not operate"):
        client.order(Order.HOLD)
    with (
        Client(Place(f"tcp://{network.tcp}", network.stranger()), wait_s=0.3) as client,
        pytest.raises(RtecError, match="is this key on its list"),
    ):
        client.status()


def test_a_port_that_is_taken_is_told(network: Network) -> None:
    with pytest.raises(ConfigError, match=r"\[control\] 127.0.0.1:\d+: cannot listen there"), network_again(network):
        pass


def network_again(network: Network) -> Control:
    return Control(network.setup, network.daemon, RealClock())


@pytest.mark.parametrize(
    ("table", "says"),
    [
        ({"tcp": "0.0.0.0:7300"}, "tcp needs keys: make them with `rtec keys server FOLDER`"),
        ({"tcp": "7300", "keys": "k"}, 'is not "host:port"'),
        ({"tcp": "a:0", "keys": "k"}, 'is not "host:port"'),
        ({"tcp": "a:1", "tcp_status": "a:1", "keys": "k"}, "different ports"),
        ({"acess": "user"}, "did you mean 'access'"),
    ],
)
def test_what_the_run_file_may_not_say(table: dict[str, object], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        validated(ControlTable, table, "run.toml")
