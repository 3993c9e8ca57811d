"""What tests of telemetry share: a protocol served in a thread beside a fake daemon; certificates; a broker."""

import asyncio
import json
import queue
import shutil
import signal
import subprocess
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import rsa
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from rtec.daemon.status import Status
from rtec.loop.clock import RealClock
from rtec.telemetry.processes import Task, serve
from tests.support.control_rig import LONG_S, FakeDaemon, free_place

START_S = 90.0
"""A process that starts imports much, at a low priority: on a busy PC it takes its time."""
BEGIN, END = datetime(2020, 1, 1, tzinfo=UTC), timedelta(days=36500)


class LivingDaemon(FakeDaemon):
    """Its newest row is always that of now, unless it `stands`; it counts how often it was asked."""

    stands, asked = False, 0

    @property
    def status(self) -> Status:
        """Of now."""
        self.asked += 1
        self._status.cycles += 1
        self._status.time_ns = RealClock().now_ns() - (10**10 if self.stands else 0)
        return self._status

    @status.setter
    def status(self, value: Status) -> None:
        self._status = value


@contextmanager
def served(task: Task) -> Iterator[list[str]]:
    """The protocol of a task in a thread of this process; gives what it says."""
    said: list[str] = []
    loops: queue.SimpleQueue[tuple[asyncio.AbstractEventLoop, asyncio.Event]] = queue.SimpleQueue()
    failed: list[BaseException] = []

    async def run() -> None:
        ended = asyncio.Event()
        loops.put((asyncio.get_running_loop(), ended))
        await serve(task, said.append, ended.wait())

    def work() -> None:
        try:
            asyncio.run(run())
        except BaseException as error:  # noqa: BLE001 (shown by the test)
            failed.append(error)
            said.append(str(error))

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    loop, ended = loops.get(timeout=LONG_S)
    try:
        yield said
    finally:
        if thread.is_alive():
            loop.call_soon_threadsafe(ended.set)
        thread.join(LONG_S)
    assert failed == [], failed


class Broker:
    """Debian's mosquitto on the loopback.

    Args:
        folder: for its files.
        lines: of its configuration; PLACE is its port.
    """

    def __init__(self, folder: Path, *lines: str) -> None:
        tool = shutil.which("mosquitto", path="/usr/sbin:/usr/bin")
        if tool is None or shutil.which("mosquitto_sub") is None:
            pytest.skip("mosquitto, mosquitto_sub are not installed (Debian: mosquitto, mosquitto-clients)")
        self.tool, self.folder, self.place = tool, folder, free_place()
        self.port = self.place.rpartition(":")[2]
        self.config = folder / "mosquitto.conf"
        content = [f"listener {self.port} 127.0.0.1", "user root", *(lines or ("allow_anonymous true",))]
        self.config.write_text("\n".join(content) + "\n", encoding="utf-8")
        self._process: subprocess.Popen[str] | None = None
        self.log: list[str] = []

    def __enter__(self) -> "Broker":
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self, **more: Any) -> None:
        """Start it; ready when this returns."""
        command = [self.tool, "-v", "-c", str(self.config)]
        self._process = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, errors="replace", **more
        )
        ready = threading.Event()
        self._reader = threading.Thread(target=self._read, args=(self._process, ready), daemon=True)
        self._reader.start()
        assert ready.wait(LONG_S), self.log

    def _read(self, process: "subprocess.Popen[str]", ready: threading.Event) -> None:
        assert process.stderr is not None
        with process.stderr:
            for line in process.stderr:
                self.log.append(line.strip())
                if "running" in line:
                    ready.set()

    def stop(self) -> None:
        """End it."""
        if self._process is not None:
            self._process.send_signal(signal.SIGCONT)
            self._process.kill()
            self._process.wait()
            self._reader.join(LONG_S)

    def send(self, number: signal.Signals) -> None:
        """Send it a signal."""
        assert self._process is not None
        self._process.send_signal(number)


class Subscriber:
    """`mosquitto_sub`, a client with no code of ours: every message with its topic and whether it was retained."""

    def __init__(self, broker: Broker, *options: str) -> None:
        command = [
            "mosquitto_sub",
            "-h",
            "localhost",
            "-p",
            broker.port,
            "-t",
            "#",
            "-q",
            "1",
            "-F",
            "%t %r %p",
            *options,
        ]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def __enter__(self) -> "Subscriber":
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()
        self._reader.join(LONG_S)

    def _read(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as lines:
            for line in lines:
                self._lines.put(line)

    def until(self, wanted: Callable[[str, Mapping[str, Any]], bool]) -> tuple[bool, dict[str, Any]]:
        """The next message that is wanted: was it retained, and its content."""
        while True:
            topic, retained, text = self._lines.get(timeout=START_S).split(" ", 2)
            content = json.loads(text)
            if wanted(topic, content):
                return retained == "1", content


def certificates(folder: Path, *names: str, linked: bool = False) -> Path:
    """An authority, and a certificate with its key for each name, as NAME.pem and NAME.key; for the loopback.

    Args:
        folder: for the files.
        names: of the certificates, beside that of the authority, `ca`.
        linked: each names the key that signed it. Python insists on that from 3.13 on; a client of OPC UA that trusts
            a certificate itself would then want the authority's, too.
    """
    keys = {name: rsa.generate_private_key(public_exponent=65537, key_size=2048) for name in ("ca", *names)}
    for name, key in keys.items():
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        issuer = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "ca")])
        builder = x509.CertificateBuilder(
            issuer, subject, key.public_key(), x509.random_serial_number(), BEGIN, BEGIN + END
        )
        builder = builder.add_extension(x509.BasicConstraints(name == "ca", None), critical=True)
        if linked:
            key_of = x509.AuthorityKeyIdentifier.from_issuer_public_key(keys["ca"].public_key())
            builder = builder.add_extension(key_of, critical=False)
        own = x509.SubjectKeyIdentifier.from_public_key(key.public_key())
        builder = builder.add_extension(own, critical=False)
        allowed = (True, True, True, True, False, name == "ca", False, False, False)
        builder = builder.add_extension(x509.KeyUsage(*allowed), critical=True)
        if name != "ca":
            names_of: list[x509.GeneralName] = [x509.DNSName("localhost"), x509.IPAddress(ip_address("127.0.0.1"))]
            names_of.append(x509.UniformResourceIdentifier(f"urn:{name}"))
            builder = builder.add_extension(x509.SubjectAlternativeName(names_of), critical=False)
            usage = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
            builder = builder.add_extension(x509.ExtendedKeyUsage(usage), critical=False)
        pem = serialization.Encoding.PEM
        certificate = builder.sign(keys["ca"], hashes.SHA256())
        (folder / f"{name}.pem").write_bytes(certificate.public_bytes(pem))
        plain = key.private_bytes(pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
        (folder / f"{name}.key").write_bytes(plain)
    return folder
