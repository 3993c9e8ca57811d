"""OPC UA: a read-only server that accepts SignAndEncrypt with certificates only (`docs/opcua.md`)."""

import asyncio
import socket
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rtec.errors import ConfigError, RtecError
from rtec.loop.telemetry_tables import OpcuaTable, host_and_port
from rtec.telemetry.values import (
    OF_AXIS,
    OF_MACHINE,
    OF_SENSOR,
    Follower,
    Quantity,
    StatusCondition,
    axes,
    conditions,
    instant,
    machine,
    sensors,
    steady,
)

if TYPE_CHECKING:
    from cryptography.x509 import Certificate

OURS: Final = "urn:rtec:telemetry:1"
DI: Final = "http://opcfoundation.org/UA/DI/"
MACHINERY: Final = "http://opcfoundation.org/UA/Machinery/"
MACHINE_TOOL: Final = "http://opcfoundation.org/UA/MachineTool/"
"""OPC 10000-100, 40001-1 and 40501-1: rtec uses their names, where there is one, but not their types."""
UNITS: Final = {
    "mm": ("MMT", "mm"),
    "um": ("4H", "µm"),
    "degc": ("CEL", "°C"),
    "s": ("SEC", "s"),
    "rpm": ("RPM", "r/min"),
}
"""UN/CEFACT code and sign, by rtec's unit."""
NORMAL, FAILURE, OFF_SPEC = 0, 1, 3
"""Values of DeviceHealth, OPC 10000-100."""
MOST_CONNECTIONS: Final = 32
ACTIVATION_S: Final = 5.0
"""A connection without a session for this time, s, is closed."""
SHORTEST_SESSION_S: Final = 5.0
LONGEST_SESSION_S: Final = 120.0
"""Limits, s, of the silence that a client may request; after that its session ends."""
LARGEST_MESSAGE: Final = 1 << 20
LARGEST_BUFFER: Final = 1 << 20
"""Bytes that may wait for a client; a client that requests more without reading is cut off."""
SLOW_S: Final = 10.0
"""A client that reads nothing for this time, s, while data wait for it, is cut off, too."""
LOOK_S: Final = 0.1
ANALOG_UNIT_TYPE: Final = 17497
BASE_VARIABLE_TYPE: Final = 63

Values = dict[str, Any]


def prepare(table: OpcuaTable, base: Path) -> tuple["Certificate", str]:
    """The server's certificate and the application URI in it.

    Raises:
        ConfigError: `asyncua` is not installed, or a file cannot be used.
    """
    try:
        import asyncua  # noqa: F401 (is it installed?)
        from cryptography import x509
        from cryptography.hazmat.primitives.serialization import load_pem_private_key
    except ImportError as error:
        raise ConfigError("[telemetry.opcua] needs the package asyncua: pip install 'rtec[opcua]'") from error
    try:
        certificate = x509.load_pem_x509_certificate((base / table.certificate_file).read_bytes())
        key = load_pem_private_key((base / table.key_file).read_bytes(), None)
    except (OSError, ValueError, TypeError) as error:
        raise ConfigError(f"[telemetry.opcua] certificate_file or key_file: {error}") from error
    if key.public_key() != certificate.public_key():
        raise ConfigError("[telemetry.opcua] key_file: is not the key of certificate_file")
    uris: list[str] = []
    with suppress(x509.ExtensionNotFound):
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        uris = names.get_values_for_type(x509.UniformResourceIdentifier)
    if not uris:
        raise ConfigError("[telemetry.opcua] certificate_file: names no application URI (subjectAltName = URI:urn:…)")
    if not (base / table.trusted_folder).is_dir():
        raise ConfigError(f"[telemetry.opcua] trusted_folder: {base / table.trusted_folder} is no folder")
    return certificate, uris[0]


def server(task: Any, say: Callable[[str], None]) -> "UaPublisher":
    """The publisher of a task of `rtec.telemetry.processes`."""
    return UaPublisher(task.table, task.config.parent, task.machine, say)


def values(report: Mapping[str, Any], active: Sequence[StatusCondition]) -> Values:
    """Values of a status with its conditions, by node such as `Axes.X.position_mm`; None where unknown."""
    out: Values = {f"Axes.{axis}.{key}": v for axis, of in axes(report).items() for key, v in of.items()}
    out |= {f"Temperatures.{name}.{key}": v for name, of in sensors(report).items() for key, v in of.items()}
    out |= machine(report)
    out["Conditions"] = [f"{c.level}: {c.code}: {c.text}" for c in active]
    out["DeviceHealth"] = FAILURE if any(c.level == "fault" for c in active) else OFF_SPEC if active else NORMAL
    out["SoftwareRevision"] = report["rtec_version"]
    out["ErrorModel"] = report["model"]
    return out


def name_of(quantity: Quantity) -> str:
    """Browse name; that of `applied_um` is Applied."""
    key = quantity.key.removesuffix(f"_{quantity.unit}") if quantity.unit else quantity.key
    return "".join(part.capitalize() for part in key.split("_"))


@dataclass(frozen=True)
class _Trusted:
    """Certificates of trusted clients, from the files of a folder; a new file needs no restart."""

    folder: Path

    async def validate(self, certificate: "Certificate", description: Any) -> None:
        """Refuse a certificate that is not in the folder, not valid at this date, or of another application."""
        from asyncua import ua
        from asyncua.common.utils import ServiceError
        from asyncua.crypto.validator import CertificateValidator

        if certificate not in list(self._known()):
            raise ServiceError(ua.StatusCodes.BadCertificateUntrusted)
        await CertificateValidator().validate(certificate, description)

    def _known(self) -> Iterator["Certificate"]:
        from cryptography import x509

        for path in sorted(self.folder.glob("*")):
            with suppress(OSError, ValueError):
                data = path.read_bytes()
                pem = data.lstrip().startswith(b"-----")
                yield x509.load_pem_x509_certificate(data) if pem else x509.load_der_x509_certificate(data)


class UaPublisher:
    """Serves clients.

    Args:
        table: table of the run file.
        base: the run file's folder.
        machine: name of the machine.
        say: reports a line to people.
    """

    def __init__(self, table: OpcuaTable, base: Path, machine: str, say: Callable[[str], None]) -> None:
        self._table, self._base, self._machine, self._say = table, base, machine, say
        self._nodes: dict[str, Any] = {}
        self._written: Values = {}
        self._conditions: dict[str, StatusCondition] = {}

    async def serve(self, follower: Follower) -> None:
        """Serve until cancelled; the address space is made when the daemon first answers."""
        served = await self._server()
        try:
            async with served:
                self._say(f"OPC UA clients can connect to {served.endpoint.geturl()}")
                await asyncio.gather(
                    self._publish(served, follower),
                    self._cut_off(served.iserver.asyncio_transports),
                    _close_idle(served.bserver.clients),
                )
        except OSError as error:
            raise RtecError(f"[telemetry.opcua] listen {self._table.listen}: cannot listen there: {error}") from error

    async def _publish(self, served: Any, follower: Follower) -> None:
        while True:
            report = follower.live
            if report is not None and not self._nodes:
                await self._make(served, report)
            await self._write(report)
            await asyncio.sleep(self._table.period_s)

    async def _cut_off(self, transports: Sequence[asyncio.WriteTransport]) -> None:
        """Cut off clients that do not read: the library queues their answers in memory without a limit."""
        waits: dict[asyncio.WriteTransport, tuple[int, float]] = {}
        now = asyncio.get_running_loop().time
        while True:
            before, waits = waits, {}
            for transport in list(transports):
                size = transport.get_write_buffer_size()
                last, since_s = before.get(transport, (0, now()))
                waits[transport] = (size, since_s if size and size >= last else now())
                if size > LARGEST_BUFFER or now() - waits[transport][1] > SLOW_S:
                    self._say(f"{transport.get_extra_info('peername')}: cut off: it does not read ({size} bytes wait)")
                    transport.abort()
            await asyncio.sleep(LOOK_S)

    async def _server(self) -> Any:
        from asyncua import Server, ua
        from asyncua.crypto.permission_rules import SimpleRoleRuleset, User, UserRole
        from asyncua.server.user_managers import UserManager

        class Reader(UserManager):  # type: ignore[misc]
            """Every client with a trusted certificate is a user; none is an administrator, whatever name it gives."""

            def get_user(self, *_arguments: Any, **_keys: Any) -> User:
                return User(role=UserRole.User)

        _, uri = prepare(self._table, self._base)
        served = Server(user_manager=Reader())
        await served.init()
        await served.set_application_uri(uri)
        served.set_server_name(f"rtec {self._machine}")
        host, port = host_and_port(self._table.listen)
        served.set_endpoint(f"opc.tcp://{socket.gethostname() if host in ('*', '0.0.0.0') else host}:{port}/rtec")  # noqa: S104
        served.socket_address = (None if host == "*" else host, port)
        served.allow_remote_admin(False)
        served.set_identity_tokens([ua.AnonymousIdentityToken])
        rules = SimpleRoleRuleset()
        changing = (ua.ObjectIds.WriteRequest_Encoding_DefaultBinary, ua.ObjectIds.CallRequest_Encoding_DefaultBinary)
        rules._permission_dict[UserRole.User] -= {ua.NodeId(one) for one in changing}
        served.set_security_policy([ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt], permission_ruleset=rules)
        await served.load_certificate(self._base / self._table.certificate_file, "pem")
        await served.load_private_key(self._base / self._table.key_file, format="pem")
        served.set_certificate_validator(_Trusted(self._base / self._table.trusted_folder).validate)
        limits = served.iserver
        limits.max_connections, limits.max_subscriptions = MOST_CONNECTIONS, 4 * MOST_CONNECTIONS
        limits.max_pending_activation_seconds = 0  # `_close_idle` does that
        limits.min_session_timeout_ms, limits.max_session_timeout_ms = 1e3 * SHORTEST_SESSION_S, 1e3 * LONGEST_SESSION_S
        limits.max_unacked_messages_per_subscription, limits.max_monitored_item_queue_size = 50, 100
        limits.max_pending_messages_per_connection = 50
        served.limits.max_message_size, served.limits.max_chunk_count = LARGEST_MESSAGE, 17
        return served

    async def _make(self, served: Any, report: Mapping[str, Any]) -> None:
        from asyncua import ua

        number = {uri: await served.register_namespace(uri) for uri in (OURS, DI, MACHINERY, MACHINE_TOOL)}
        ours = number[OURS]

        async def part(under: Any, node: str, name: str, of: str = OURS) -> Any:
            return await under.add_object(ua.NodeId(node, ours), ua.QualifiedName(name, number[of]))

        async def variable(under: Any, node: str, name: str, kind: Any, of: str = OURS, unit: str = "") -> None:
            several = node == "Conditions"
            empty = ua.Variant([] if several else "" if kind is kinds.String else 0, kind, is_array=several)
            made = await under.add_variable(
                ua.NodeId(node, ours), ua.QualifiedName(name, number[of]), empty, datatype=ua.NodeId(kind.value)
            )
            if unit:
                about = ua.NodeId(f"{node}.unit", ours)
                await made.add_property(about, ua.QualifiedName("EngineeringUnits"), _unit(unit))
                has_type = ua.ObjectIds.HasTypeDefinition
                await made.delete_reference(ua.NodeId(BASE_VARIABLE_TYPE), has_type, bidirectional=False)
                await made.add_reference(ua.NodeId(ANALOG_UNIT_TYPE), has_type, bidirectional=False)
            self._nodes[node] = made

        kinds, whole = ua.VariantType, {"mode": ua.VariantType.String}
        machines = await part(served.nodes.objects, "Machines", "Machines", MACHINERY)
        top = await part(machines, "Machine", self._machine)
        identification = await part(top, "Identification", "Identification", DI)
        await variable(identification, "SoftwareRevision", "SoftwareRevision", kinds.String, DI)
        await variable(identification, "ErrorModel", "ErrorModel", kinds.String)
        await variable(top, "DeviceHealth", "DeviceHealth", kinds.Int32, DI)
        notification = await part(top, "Notification", "Notification", MACHINE_TOOL)
        await variable(notification, "Conditions", "Conditions", kinds.String)
        monitoring = await part(top, "Monitoring", "Monitoring", MACHINE_TOOL)
        for quantity in OF_MACHINE:
            kind = whole.get(quantity.key, kinds.Double if quantity.unit else kinds.Int64)
            await variable(monitoring, quantity.key, name_of(quantity), kind, unit=quantity.unit)
        for group, names, quantities in (
            ("Axes", report["axes"], OF_AXIS),
            ("Temperatures", report["sensors"], OF_SENSOR),
        ):
            folder = await part(monitoring, group, group)
            for name in names:
                one = await part(folder, f"{group}.{name}", name)
                for q in quantities:
                    await variable(one, f"{group}.{name}.{q.key}", name_of(q), kinds.Double, unit=q.unit)

    async def _write(self, report: Mapping[str, Any] | None) -> None:
        from asyncua import ua

        self._conditions = {} if report is None else steady(conditions(report), self._conditions)
        new = {} if report is None else values(report, list(self._conditions.values()))
        missing = ua.StatusCodes.BadNoCommunication if report is None else ua.StatusCodes.BadDataUnavailable
        at = datetime.fromisoformat(instant(report))
        for node, made in self._nodes.items():
            value = new.get(node)
            state = (value, missing if value is None else 0)
            if self._written.get(node) == state:
                continue
            kind = await made.read_data_type_as_variant_type()
            good = ua.Variant() if value is None else ua.Variant(value, kind, is_array=isinstance(value, list))
            await made.write_value(ua.DataValue(good, ua.StatusCode(state[1]), at, at))
            self._written[node] = state


async def _close_idle(clients: Sequence[Any]) -> None:
    """Close connections without a session: the library ends a silent client's session, but keeps its connection."""
    since_s: dict[Any, float] = {}
    while True:
        since_s = _idle(clients, since_s, asyncio.get_running_loop().time())
        _cut_endless(clients)
        await asyncio.sleep(LOOK_S)


def _cut_endless(clients: Sequence[Any]) -> None:
    """Close connections with an endless message: the library accepts any length that the first bytes give."""
    for one in list(clients):
        if len(one._buffer) > LARGEST_MESSAGE:
            one.transport.abort()


def _idle(clients: Sequence[Any], before_s: dict[Any, float], now_s: float) -> dict[Any, float]:
    """Connections without a session, each with its begin; closes those of too long ago."""
    idle = [one for one in clients if not (one.processor.session and one.processor.session.is_activated())]
    since_s = {one: before_s.get(one, now_s) for one in idle}
    for one, began_s in since_s.items():
        if now_s - began_s > ACTIVATION_S:
            one.transport.abort()
    return since_s


def _unit(unit: str) -> Any:
    """The unit in OPC UA: its number is made of the letters of UN/CEFACT's code."""
    from asyncua import ua

    code, sign = UNITS[unit]
    return ua.EUInformation(
        NamespaceUri="http://www.opcfoundation.org/UA/units/un/cefact",
        UnitId=int.from_bytes(code.encode()),
        DisplayName=ua.LocalizedText(sign),
        Description=ua.LocalizedText(sign),
    )
