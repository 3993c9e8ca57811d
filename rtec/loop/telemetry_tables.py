"""`[telemetry]` of a run file: what `rtec telemetry` publishes in a shop's network, and to which peers.

The daemon checks these keys with the rest of its file, but does not use them: it is never on the network.
"""

import re
from pathlib import Path
from typing import Annotated, Final, Self

from pydantic import Field, model_validator

from rtec.tomlfile import Strict

PLACE: Final = re.compile(r"(?P<host>\[[0-9a-fA-F:.]+\]|\*|[^:/\[\]\s]+):(?P<port>\d{1,5})")
LOOPBACK: Final = re.compile(r"(127\.\d{1,3}\.\d{1,3}\.\d{1,3}|localhost):\d{1,5}")
_TOPIC: Final = re.compile(r"[^\s+#/$][^\s+#/]*(/[^\s+#/]+)*")


def is_place(text: str) -> bool:
    """Is it "host:port"?"""
    match = PLACE.fullmatch(text)
    return match is not None and 0 < int(match["port"]) < 65536


def host_and_port(place: str) -> tuple[str, int]:
    """Split "host:port"."""
    host, _, port = place.rpartition(":")
    return host.strip("[]"), int(port)


class MqttTable(Strict):
    """`[telemetry.mqtt]`: the broker that gets values and events.

    Attributes:
        broker: "host:port" of the broker.
        topic: first part of every topic; not given: "rtec/NAME" with the run file's name.
        period_s: time from one message with values to the next.
        tls: use TLS, and check the broker's certificate.
        ca_file: CA certificate for the broker's; not given: the certificates that this computer trusts.
        certificate_file: certificate of this client, where the broker requires one.
        key_file: its private key.
        user: user name at the broker.
        password_file: file that holds that user's password and nothing else.
    """

    broker: str
    topic: str | None = None
    period_s: Annotated[float, Field(ge=0.1, le=3600)] = 1.0
    tls: bool = True
    ca_file: Path | None = None
    certificate_file: Path | None = None
    key_file: Path | None = None
    user: str | None = None
    password_file: Path | None = None

    @model_validator(mode="after")
    def _safe(self) -> Self:
        if not is_place(self.broker):
            raise ValueError(f'broker: {self.broker!r} is not "host:port"')
        if self.topic is not None and not _TOPIC.fullmatch(self.topic):
            raise ValueError(f"topic: {self.topic!r}: names with '/' between them, without blanks, '+', '#', '$' first")
        if (self.certificate_file is None) != (self.key_file is None):
            raise ValueError("certificate_file and key_file go together: give both or none")
        if (self.user is None) != (self.password_file is None):
            raise ValueError("user and password_file go together: give both or none")
        if not self.tls and (self.ca_file or self.certificate_file):
            raise ValueError("ca_file and certificate_file are of TLS: take out `tls = false`")
        if not self.tls and self.password_file and not LOOPBACK.fullmatch(self.broker):
            raise ValueError(
                "password_file: without TLS everybody on the network reads the password: take out `tls = false`"
            )
        return self


class _Listening(Strict):
    listen: str

    @model_validator(mode="after")
    def _place(self) -> Self:
        if not is_place(self.listen):
            raise ValueError(f'listen: {self.listen!r} is not "host:port"')
        return self


class MtconnectTable(_Listening):
    """`[telemetry.mtconnect]`: the address at which an MTConnect agent connects to the adapter.

    Attributes:
        listen: "host:port" that the agent connects to; "*:7878": on every network of this computer.
        period_s: period of reading the daemon's status; only changed values are sent.
    """

    listen: str = "127.0.0.1:7878"
    period_s: Annotated[float, Field(ge=0.01, le=3600)] = 0.1


class OpcuaTable(_Listening):
    """`[telemetry.opcua]`: a read-only OPC UA server; it accepts SignAndEncrypt only.

    Attributes:
        listen: "host:port" that clients connect to; "*:4840": on every network of this computer.
        period_s: period of reading the daemon's status.
        certificate_file: the server's certificate (PEM), with its application URI.
        key_file: its private key (PEM, not encrypted).
        trusted_folder: folder with the certificates of the clients that may connect (PEM or DER), and nothing else.
    """

    listen: str = "127.0.0.1:4840"
    period_s: Annotated[float, Field(ge=0.05, le=3600)] = 0.1
    certificate_file: Path
    key_file: Path
    trusted_folder: Path


class TelemetryTable(Strict):
    """`[telemetry]`: what `rtec telemetry` publishes; not given: nothing. All of it is read-only.

    Attributes:
        mqtt: values and events to an MQTT broker.
        mtconnect: an adapter for an MTConnect agent.
        opcua: a server for OPC UA clients.
    """

    mqtt: MqttTable | None = None
    mtconnect: MtconnectTable | None = None
    opcua: OpcuaTable | None = None
