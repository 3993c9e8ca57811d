"""MQTT. Oracles: Debian's mosquitto and mosquitto_sub, of no code of ours; the figures of the daemon; MQTT 3.1.1.

Two peers of the tests' own break what a broker must do: one confirms late, one sends what nobody asked for.
"""

import resource
import signal
import socket
import struct
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rtec.control.server import Control
from rtec.correction.flags import Flag
from rtec.errors import ConfigError
from rtec.loop.clock import RealClock
from rtec.loop.run_file import Setup
from rtec.loop.telemetry_tables import MqttTable
from rtec.telemetry import mqtt
from rtec.telemetry.processes import Task
from rtec.tomlfile import validated
from tests.support import setups
from tests.support.conformance import soon
from tests.support.telemetry_rig import Broker, LivingDaemon, Subscriber, certificates, served

pytestmark = pytest.mark.xdist_group("real-clock")


@pytest.fixture(scope="module")
def setup(tmp_path_factory: pytest.TempPathFactory) -> Setup:
    return setups.setup(tmp_path_factory.mktemp("run"))


@pytest.fixture
def daemon(setup: Setup, runtime_folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[LivingDaemon]:
    """A daemon without a loop, whose rows are those of now; waits are short."""
    del runtime_folder
    monkeypatch.setattr(mqtt, "FIRST_WAIT_S", 0.05)
    monkeypatch.setattr(mqtt, "LONGEST_WAIT_S", 0.05)
    daemon = LivingDaemon(setup)
    with Control(setup, daemon, RealClock()):
        yield daemon


def task(setup: Setup, place: str, **keys: Any) -> Task:
    table = validated(MqttTable, {"broker": place, "period_s": 0.1, "tls": False, "topic": "rtec/mill", **keys}, "run")
    return Task("mqtt", table, setup.path, setup.machine.name)


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    with Broker(tmp_path) as broker:
        yield broker


def test_what_a_subscriber_gets(setup: Setup, daemon: LivingDaemon, broker: Broker) -> None:
    """Oracle: the daemon's figures; whoever comes later gets the state at once, retained, and no old values."""
    daemon.status.devices = {'box "1"': ["silent"]}
    with served(task(setup, broker.place)), Subscriber(broker) as first:
        first.until(lambda topic, content: topic == "rtec/mill/state" and content["state"] == "running")
        first.until(lambda topic, _: topic == "rtec/mill/values")
        with Subscriber(broker) as late:
            retained, state = late.until(lambda _topic, _content: True)
            assert retained
            assert (state["schema"], state["state"], state["machine"]) == (1, "running", "turning-centre")
            assert state["units"]["applied_um"] == "um"
            retained, values = late.until(lambda topic, _: topic == "rtec/mill/values")
    assert not retained
    x = {"position_mm": 100 / 2000, "requested_um": 1.5, "applied_um": 1.25, "residual_um": None}
    assert values["axes"]["X"] == x
    assert values["machine"] == "turning-centre"
    assert values["axes"]["Z"]["applied_um"] is None
    assert values["temperatures"]["T_bed"] == {"temperature_degc": 21.25, "age_s": 0.5}
    assert values["temperatures"]["T_air"] == {"temperature_degc": None, "age_s": None}
    assert values["mode"] == "on"
    assert values["conditions"] == [{"code": 'device box "1"', "level": "fault", "text": "silent"}]


def test_what_is_stale_is_not_known_and_has_its_age(setup: Setup, daemon: LivingDaemon, broker: Broker) -> None:
    """By hand: `temperature_max_age_s` of this run file is 30; the counts are stale by the guard's own flag."""
    assert setup.file.guard.temperature_max_age_s == 30.0
    daemon.status.flags = Flag.STALE_COUNTS | Flag.HELD
    daemon.status.degc_age_s = {"T_bed": 30.1}
    with served(task(setup, broker.place)), Subscriber(broker) as sub:
        _, values = sub.until(lambda topic, _: topic == "rtec/mill/values")
    assert values["axes"]["X"]["position_mm"] is None
    assert values["axes"]["X"]["applied_um"] == 1.25
    assert values["temperatures"]["T_bed"] == {"temperature_degc": None, "age_s": 30.1}


def test_two_machines_with_one_topic_are_told_and_do_not_cut_each_other_off(
    setup: Setup, daemon: LivingDaemon, broker: Broker, tmp_path: Path
) -> None:
    """Oracle: the broker's own log has no client that another one has taken over."""
    del daemon
    other = setups.setup(tmp_path)
    two = Task("mqtt", task(setup, broker.place).table, other.path, "another")
    with served(task(setup, broker.place)) as said, served(two) as told:
        soon(RealClock(), lambda: any("give each machine a topic of its own" in line for line in (*said, *told)))
    assert not any("already connected" in line for line in broker.log)
    assert not any("tried again" in line for line in (*said, *told))


def test_the_end_in_order_is_offline(setup: Setup, daemon: LivingDaemon, broker: Broker) -> None:
    """Retained: whoever comes afterwards knows it, too."""
    del daemon
    with Subscriber(broker) as sub:
        with served(task(setup, broker.place)):
            sub.until(lambda _, content: content.get("state") == "running")
        sub.until(lambda _, content: content.get("state") == "offline")
    with Subscriber(broker) as late:
        assert late.until(lambda _topic, _content: True) == (True, {"schema": 1, "state": "offline"})


def test_the_last_will(setup: Setup, daemon: LivingDaemon, broker: Broker) -> None:
    """A client that is cut off without a word. Oracle: the broker sends the will, and then the new state."""
    del daemon
    with served(task(setup, broker.place)), Subscriber(broker) as sub:
        sub.until(lambda _, content: content.get("state") == "running")
        usurper = Subscriber(broker, "-i", mqtt.client_name("rtec/mill", setup.path.parent))
        with usurper:  # the same name at the broker: the first is cut off
            sub.until(lambda _, content: content.get("state") == "offline")
        sub.until(lambda _, content: content.get("state") == "running")


def test_events(setup: Setup, daemon: LivingDaemon, broker: Broker) -> None:
    """Each once, those only that happen while it follows."""
    daemon.note("alarm", "an old one")
    with served(task(setup, broker.place)), Subscriber(broker) as sub:
        sub.until(lambda topic, _: topic == "rtec/mill/values")
        for number in range(3):
            daemon.note("alarm", f"number {number}")
        found = [sub.until(lambda topic, _: topic == "rtec/mill/events")[1] for _ in range(3)]
    assert [(one["schema"], one["what"], one["text"]) for one in found] == [
        (1, "alarm", f"number {number}") for number in range(3)
    ]


def test_a_loop_that_stands_and_a_daemon_that_ends(setup: Setup, runtime_folder: Path, broker: Broker) -> None:
    """Its state says so, no values are sent that are not of now; a daemon that starts again is followed again."""
    del runtime_folder
    with served(task(setup, broker.place)), Subscriber(broker) as sub:
        sub.until(lambda _, content: content.get("state") == "no daemon")
        for _ in range(2):
            with Control(setup, daemon := LivingDaemon(setup), RealClock()):
                sub.until(lambda topic, _: topic == "rtec/mill/values")
                daemon.stands = True
                sub.until(lambda _, content: content.get("state") == "loop stands")
            sub.until(lambda topic, content: topic != "rtec/mill/values" and content["state"] == "no daemon")


def test_the_broker_restarts(setup: Setup, daemon: LivingDaemon, broker: Broker) -> None:
    """It has lost all that was retained. Oracle: a subscriber that comes afterwards."""
    del daemon
    with served(task(setup, broker.place)) as said:
        with Subscriber(broker) as sub:
            sub.until(lambda topic, _: topic == "rtec/mill/values")
        broker.stop()
        soon(RealClock(), lambda: any("tried again" in line for line in said))
        broker.start()
        with Subscriber(broker) as sub:
            sub.until(lambda _, content: content.get("state") == "running")
            sub.until(lambda topic, _: topic == "rtec/mill/values")


def test_a_broker_that_stands(
    setup: Setup, daemon: LivingDaemon, broker: Broker, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It takes connections (the kernel does) and answers nothing, then goes on: the state ends as running.

    It sends the wills of all connections that were tried meanwhile, also behind the new state.
    """
    del daemon
    monkeypatch.setattr(mqtt, "PATIENCE_S", 0.3)
    with served(task(setup, broker.place)) as said, Subscriber(broker) as sub:
        sub.until(lambda topic, _: topic == "rtec/mill/values")
        broker.send(signal.SIGSTOP)
        soon(RealClock(), lambda: sum("tried again" in line for line in said) > 2)
        broker.send(signal.SIGCONT)
        sub.until(lambda topic, _: topic == "rtec/mill/values")
        with Subscriber(broker) as late:
            late.until(lambda _, content: content.get("state") == "running")


def test_a_full_disk_at_the_broker(setup: Setup, daemon: LivingDaemon, tmp_path: Path) -> None:
    """The broker cannot write what it retains: EFBIG by its limit on files. Oracle: its log says so, values come."""
    del daemon
    lines = ("allow_anonymous true", "persistence true", f"persistence_location {tmp_path}/", "autosave_interval 1")
    broker = Broker(tmp_path, *lines, "autosave_on_changes true")
    broker.start(
        restore_signals=False, preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    )  # Python ignores SIGXFSZ, and so does what it starts
    try:
        with served(task(setup, broker.place)), Subscriber(broker) as sub:
            large = ["mosquitto_pub", "-p", broker.port, "-t", "large", "-m", '"' + 9000 * "x" + '"', "-r", "-q", "1"]
            subprocess.run(large, check=True)
            soon(RealClock(), lambda: any("File too large" in line for line in broker.log))
            sub.until(lambda topic, _: topic == "rtec/mill/values")
    finally:
        broker.stop()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # paho leaves a refused socket to Python
def test_tls_and_password(setup: Setup, daemon: LivingDaemon, tmp_path: Path) -> None:
    """Certificates of both sides, a name and a password; a broker of another authority is refused."""
    del daemon
    certificates(tmp_path, "broker", "client", linked=True)
    (tmp_path / "other").mkdir()
    certificates(tmp_path / "other", linked=True)
    (tmp_path / "password").write_text("secret\n", encoding="utf-8")
    (tmp_path / "users").write_text("mill:secret\n", encoding="utf-8")
    subprocess.run(["mosquitto_passwd", "-U", str(tmp_path / "users")], check=True)
    files = {"cafile": "ca.pem", "certfile": "broker.pem", "keyfile": "broker.key"}
    lines = [f"{key} {tmp_path / name}" for key, name in files.items()]
    own = {"ca_file": "ca.pem", "certificate_file": "client.pem", "key_file": "client.key", "password_file": "password"}
    keys: dict[str, Any] = {"tls": True, "user": "mill", **{key: str(tmp_path / name) for key, name in own.items()}}
    with Broker(tmp_path, *lines, "require_certificate true", f"password_file {tmp_path / 'users'}") as broker:
        options = ["--cafile", str(tmp_path / "ca.pem"), "--cert", str(tmp_path / "client.pem")]
        options += ["--key", str(tmp_path / "client.key"), "-u", "mill", "-P", "secret"]
        with Subscriber(broker, *options) as sub:
            with served(task(setup, broker.place, **keys)):
                sub.until(lambda topic, _: topic == "rtec/mill/values")
            with served(task(setup, broker.place, **{**keys, "ca_file": str(tmp_path / "other" / "ca.pem")})) as said:
                soon(RealClock(), lambda: any("certificate verify failed" in line for line in said))
            (tmp_path / "password").write_text("wrong\n", encoding="utf-8")
            with served(task(setup, broker.place, **keys)) as said:
                soon(RealClock(), lambda: any("ot authori" in line for line in said))


class Peer:
    """A broker of the tests' own for one client after the other: CONNACK, then what a subclass does with a PUBLISH."""

    sent = 0

    def __init__(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.place = f"127.0.0.1:{self._listener.getsockname()[1]}"
        self.packets: list[tuple[int, bytes]] = []
        self.socket: socket.socket | None = None
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def __enter__(self) -> "Peer":
        return self

    def __exit__(self, *_: object) -> None:
        self._listener.close()
        if self.socket is not None:
            self.socket.close()

    def _work(self) -> None:
        while True:
            try:
                self.socket, _ = self._listener.accept()
                self._serve(self.socket)
            except OSError:
                if self._listener.fileno() < 0:
                    return

    def _serve(self, one: socket.socket) -> None:
        with one.makefile("rb") as stream:
            while head := stream.read(1):
                length, shift = 0, 0
                while True:
                    byte = stream.read(1)[0]
                    length, shift = length | (byte & 127) << shift, shift + 7
                    if byte < 128:
                        break
                self._packet(one, head[0], stream.read(length))

    def _packet(self, one: socket.socket, head: int, body: bytes) -> None:
        if head >> 4 == 1:
            one.sendall(b"\x20\x02\x00\x00")  # CONNACK, accepted
            self.connected(one)
        elif head >> 4 == 8:
            one.sendall(b"\x90\x03" + body[:2] + b"\x01")  # SUBACK
        elif head >> 4 == 3:
            self.packets.append((head, body))
            self.published(one, head, body)

    def connected(self, one: socket.socket) -> None:
        """Of a client that has come."""

    def published(self, one: socket.socket, head: int, body: bytes) -> None:
        """Of a PUBLISH."""
        del head
        one.sendall(b"\x40\x02" + self.number(body))

    @staticmethod
    def number(body: bytes) -> bytes:
        """Packet identifier of a PUBLISH."""
        (length,) = struct.unpack_from(">H", body)
        return body[2 + length : 4 + length]


def test_a_slow_broker_gets_the_newest(setup: Setup, daemon: LivingDaemon) -> None:
    """It confirms when the test says so: meanwhile nothing more is sent, and what comes next is of then."""
    go = threading.Semaphore(0)

    class Slow(Peer):
        def published(self, one: socket.socket, head: int, body: bytes) -> None:
            go.acquire()
            super().published(one, head, body)

    with Slow() as peer, served(task(setup, peer.place)):
        soon(RealClock(), lambda: len(peer.packets) == 1)
        for count in range(2, 5):
            before = daemon.asked
            soon(RealClock(), lambda before=before: daemon.asked > before + 3)  # type: ignore[misc]
            assert len(peer.packets) == count - 1
            go.release()
            soon(RealClock(), lambda count=count: len(peer.packets) == count)  # type: ignore[misc]
        for _ in range(100):
            go.release()
    heads = [head for head, _ in peer.packets]
    assert all(head & 0b0110 == 0b0010 for head in heads)  # QoS 1: it is confirmed


def test_a_flood_from_the_broker(setup: Setup, daemon: LivingDaemon) -> None:
    """Messages that nobody asked for, 10 MB of them: they are thrown away, and values go on to come."""
    del daemon
    flood = b"\x30\xe8\x07" + b"\x00\x01a" + bytes(1000 - 3)

    class Flooding(Peer):
        def published(self, one: socket.socket, head: int, body: bytes) -> None:
            super().published(one, head, body)
            if b'"mode"' in body and self.sent < 10_000_000:
                for _ in range(10):
                    one.sendall(flood * 500)
                    self.sent += 500 * len(flood)

    with Flooding() as peer, served(task(setup, peer.place)) as said:
        soon(RealClock(), lambda: peer.sent >= 10_000_000 and len(peer.packets) > 10)
    assert len(said) == 1


@pytest.mark.parametrize(
    ("keys", "why"),
    [
        ({"broker": "mill"}, "host:port"),
        ({"broker": "b:1883", "topic": "rtec/#"}, "topic"),
        ({"broker": "b:1883", "topic": "$SYS/x"}, "topic"),
        ({"broker": "b:1883", "tls": False, "user": "u", "password_file": "p"}, "everybody on the network"),
        ({"broker": "b:1883", "user": "u"}, "go together"),
        ({"broker": "b:1883", "key_file": "k"}, "go together"),
        ({"broker": "b:1883", "tls": False, "ca_file": "k"}, "take out"),
    ],
)
def test_what_is_refused(keys: dict[str, Any], why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        validated(MqttTable, keys, "run.toml")


def test_files_that_are_not_there(tmp_path: Path) -> None:
    """Before anything is started, with the key that names the file."""
    for keys in ({"ca_file": "ca.pem"}, {"tls": False, "user": "u", "password_file": "p"}):
        table = validated(MqttTable, {"broker": "localhost:8883", **keys}, "run.toml")
        with pytest.raises(ConfigError, match=r"telemetry\.mqtt.*file"):
            mqtt.prepare(table, tmp_path)
