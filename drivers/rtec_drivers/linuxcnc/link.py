"""rtec's end of the bridge's socket: one JSON message a packet, the newest state, LinuxCNC's faults."""

import json
import select
import socket
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import Field, ValidationError

from rtec.errors import DriverFault, DriverTimeout, DriverUnavailable
from rtec.quantities import MicrometresNotNegative, MicrometresPositive
from rtec.tomlfile import Strict

MAX_BYTES = 1 << 16
HELLO_S = 1.0
MAX_MM = 1e6
LOADS: Final = "`halcmd loadusr`, then what follows `loadusr -Wn rtec` in its HAL file"


class BridgeHello(Strict):
    """First message of the bridge: its options from LinuxCNC's HAL file, and the largest output of each axis, µm."""

    hello: Annotated[int, Field(ge=0, le=1000)]
    session: str
    axes: tuple[str, ...]
    sensors: tuple[str, ...]
    wired: tuple[str, ...]
    actuator: str
    unit_um: MicrometresPositive
    component: str
    max_um: tuple[MicrometresNotNegative, ...] = ()


@dataclass(frozen=True, slots=True)
class HalState:
    """The bridge's message of one servo period.

    Attributes:
        time_ns: not after the servo period that latched the positions; CLOCK_MONOTONIC.
        mm: positions of the axes, mm, without the correction.
        homed, on: all joints are homed; the machine is on.
        rpm: spindle speed, 1/min; None where it is not wired.
        degc: temperature by sensor, °C; None where it is not wired.
        out: the pins' output, units.
        cleared_um: external offsets that LinuxCNC has cleared, by axis; None where it has not.
    """

    time_ns: int
    mm: tuple[float, ...]
    homed: bool
    on: bool
    rpm: float | None
    degc: tuple[float | None, ...]
    out: tuple[int, ...]
    cleared_um: tuple[float, ...] | None


class BridgeLink:
    """A connected bridge.

    Attributes:
        hello: its first message.
        state: its newest state; None before the first.
        refused: why it refused the last command; "" where it did not.

    Args:
        path: path of the bridge's socket.

    Raises:
        DriverUnavailable: nothing listens there, or another client is connected.
        DriverFault: it is no bridge.
        DriverTimeout: it sends nothing.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.state: HalState | None = None
        self.refused = ""
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            self._socket.connect(str(path))
            self._socket.setblocking(False)
            self.hello = self._greeting()
        except OSError as e:
            self.close()
            raise DriverUnavailable(
                f"{path}: no bridge listens there ({e.strerror or e}): start LinuxCNC; its HAL file starts the bridge. "
                f"If LinuxCNC runs and the bridge does not come back: {LOADS}"
            ) from e
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the socket; LinuxCNC keeps its output."""
        self._socket.close()

    def listen(self) -> None:
        """Process all received messages.

        Raises:
            DriverUnavailable: the bridge has gone.
            DriverFault: an impossible message.
        """
        while True:
            try:
                text = self._socket.recv(MAX_BYTES)
            except BlockingIOError:
                return
            except OSError:
                text = b""
            if not text:
                raise DriverUnavailable(f"{self._path}: the bridge has gone; it comes back by itself, or with LinuxCNC")
            self._take(text)

    def send(self, out: list[int] | None) -> None:
        """Send a command; None: the order to resume. The next cycle repeats one that does not fit into the socket."""
        order = {"resume": True} if out is None else {"out": out}
        with suppress(BlockingIOError):
            try:
                self._socket.send(json.dumps(order).encode())
            except OSError as e:
                if isinstance(e, BlockingIOError):
                    raise
                raise DriverUnavailable(f"{self._path}: the bridge has gone ({e.strerror})") from e

    def _greeting(self) -> BridgeHello:
        if not select.select([self._socket], [], [], HELLO_S)[0]:
            raise DriverTimeout(f"{self._path}: connected, and no answer within {HELLO_S:g} s")
        text = self._socket.recv(MAX_BYTES)
        data = _parsed(text, self._path)
        if "refused" in data:
            raise DriverUnavailable(f"{self._path}: {data['refused']}")
        try:
            return BridgeHello.model_validate_json(text)
        except ValidationError as e:
            raise DriverFault(f"{self._path}: what listens there is no bridge of this version of rtec") from e

    def _take(self, text: bytes) -> None:
        data = _parsed(text, self._path)
        if "refused" in data:
            self.refused = str(data["refused"])
            return
        try:
            self.state = self._state(data)
        except (KeyError, TypeError, ValueError) as e:
            raise DriverFault(f"{self._path}: a message of the bridge cannot be ({e}): {text[:80]!r}") from e

    def _state(self, data: dict[str, object]) -> HalState | None:
        if "mm" not in data:  # the servo thread has not run yet
            return self.state
        axes, sensors = len(self.hello.axes), len(self.hello.sensors)
        mm, out, degc = _row(data["mm"], axes), _row(data["out"], axes), _row(data["degc"], sensors)
        cleared = data["cleared_um"]
        if not all(isinstance(p, float) and abs(p) <= MAX_MM for p in mm):
            raise ValueError("a position")
        if not all(isinstance(n, int) and abs(n) < 2**53 for n in out):
            raise ValueError("an output")
        if not all(t is None or isinstance(t, float) for t in degc):
            raise ValueError("a temperature")
        rpm, time_ns = data["rpm"], data["time_ns"]
        if not (rpm is None or isinstance(rpm, float)) or not isinstance(time_ns, int):
            raise ValueError("a spindle speed or an instant")
        return HalState(
            time_ns,
            mm,
            data["homed"] is True,
            data["on"] is True,
            rpm,
            degc,
            out,
            None if cleared is None else _row(cleared, axes),
        )


def _row(value: object, length: int) -> tuple[Any, ...]:
    if not isinstance(value, list) or len(value) != length:
        raise ValueError(f"not {length} values")
    return tuple(value)


def _parsed(text: bytes, path: Path) -> dict[str, object]:
    try:
        data = json.loads(text)
        if isinstance(data, dict):
            return data
    except (ValueError, RecursionError):
        pass
    raise DriverFault(f"{path}: a message of the bridge is no JSON table: {text[:80]!r}") from None
