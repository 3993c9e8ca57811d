"""The command that sshd runs for a client on the network: copies its bytes to the daemon's local socket, and back.

The relay itself sends the first line to the daemon: it names the client and lowers its rights, for good.
"""

import os
import selectors
import socket
from pathlib import Path
from typing import Final

from rtec.control.messages import RequestError, Role, read_answer, request
from rtec.errors import RtecError

CHUNK_BYTES: Final = 65536


def relay(path: Path, name: str, role: Role, source: int = 0, sink: int = 1) -> None:
    """Copy until one of the two ends.

    Args:
        path: path of the daemon's socket.
        name: name of the client in the events.
        role: rights of the client.
        source, sink: file descriptors from the client, and to it.

    Raises:
        RtecError: nothing listens at `path`, or it refuses the name.
    """
    with socket.socket(socket.AF_UNIX) as daemon, selectors.DefaultSelector() as ready:
        try:
            daemon.connect(str(path))
            daemon.sendall(request("as", 0, name=name, role=role) + b"\n")
            heard = b""
            while not heard.endswith(b"\n"):  # the client does not see this answer
                if not (byte := daemon.recv(1)):
                    raise RtecError(f"{path}: the daemon hung up")
                heard += byte
            answered = read_answer(heard)
            if why := answered.get("error") or answered.get("refused"):
                raise RtecError(f"--name {name!r} --role {role}: {why}")
            ready.register(source, selectors.EVENT_READ)
            ready.register(daemon, selectors.EVENT_READ)
            while True:
                for key, _ in ready.select():
                    if key.fileobj is not daemon:
                        if data := os.read(source, CHUNK_BYTES):
                            daemon.sendall(data)
                        else:  # the client has sent all its requests; the answers are still to come
                            ready.unregister(source)
                            daemon.shutdown(socket.SHUT_WR)
                    elif data := daemon.recv(CHUNK_BYTES):
                        while data:
                            data = data[os.write(sink, data) :]
                    else:
                        return
        except (OSError, RequestError) as e:
            raise RtecError(f"{path}: {e}") from e
