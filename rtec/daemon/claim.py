"""One daemon at a device that takes commands: two run files with the same actuator would move it against each other.

A serial port is opened by one process alone; TCP, CAN, ZeroMQ and a bridge's socket take several. So the daemon takes
names of the places that its actuator's options name: abstract sockets, which the kernel frees with the process, however
that ends, and which any user's process on this computer sees.
"""

import errno
import hashlib
import os
import socket
from collections.abc import Iterator, Mapping
from multiprocessing.util import register_after_fork
from pathlib import Path
from typing import Any, Final

from rtec.errors import RtecError
from rtec.loop.clock import Clock
from rtec.loop.run_file import Setup

TRIES: Final = 40
PERIOD_NS: Final = 50_000_000


def commanded_places(setup: Setup) -> list[str]:
    """The places that the actuator's options name, for people: "192.168.1.60:5000", "/dev/ttyUSB0", "can0"."""
    name = setup.file.role.actuator
    return sorted(set(_places(setup.file.device[name], setup.base))) if name is not None else []


def _places(table: Mapping[str, Any], base: Path) -> Iterator[str]:
    if "host" in table and "port" in table:
        yield _of_host(f"{table['host']}:{table['port']}")
    elif isinstance(port := table.get("port"), str):
        yield os.path.realpath(port)
    if isinstance(path := table.get("socket"), str):
        yield os.path.realpath(base / path)
    if isinstance(address := table.get("command"), str):
        way, _, place = address.partition("://")
        yield f"{way}://{os.path.realpath(place) if way == 'ipc' else _of_host(place)}"
    if "interface" in table and "channel" in table:  # several boxes share a bus
        at = f", identifier {table['base_id']:#x}" if isinstance(table.get("base_id"), int) else ""
        yield f"{table['interface']} {table['channel']}{at}"
    for value in table.values():
        if isinstance(value, Mapping):
            yield from _places(value, base)


def _of_host(place: str) -> str:
    return place.lower().replace("localhost", "127.0.0.1")


class Claim:
    """The places of an actuator, taken for this process.

    Args:
        setup: the run file.
    """

    def __init__(self, setup: Setup) -> None:
        self._places, self._held = commanded_places(setup), list[socket.socket]()
        register_after_fork(self, Claim.free)  # a copy of this process that hangs would keep them

    def take(self, clock: Clock) -> None:
        """Take all places; wait up to two seconds for a daemon that is just ending.

        Raises:
            RtecError: another daemon has one of them.
        """
        for place in self._places:
            held = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._held.append(held)
            name = "\0rtec-commands-" + hashlib.sha256(place.encode()).hexdigest()[:16]
            for _ in range(TRIES):
                try:
                    held.bind(name)
                except OSError as e:
                    if e.errno != errno.EADDRINUSE:
                        raise RtecError(f"{place}: cannot be taken for this run: {e.strerror}") from e
                    clock.sleep_until_ns(clock.now_ns() + PERIOD_NS)
                else:
                    break
            else:
                self.free()
                raise RtecError(
                    f"{place}: another rtec sends its commands there, from another run file: end that one first; the "
                    "two would move the machine against each other"
                )

    def free(self) -> None:
        """Free them."""
        while self._held:
            self._held.pop().close()
