"""What sshd runs for a client on the network: hands its bytes on to the daemon's local socket, and back.

The first line to the daemon is the relay's own: it names the client and lowers its rights, for good.
"""

import os
import selectors
import socket
from pathlib import Path
from typing import Final

from rtec.control.messages import RequestError, Role, read_answer, request
from rtec.errors import RtecError

AT_ONCE: Final = 65536


def relay(path: Path, name: str, role: Role, source: int = 0, sink: int = 1) -> None:
    """Hand on until one of the two ends.

    Args:
        path: of the daemon's socket.
        name: of the client, as the events are to show it.
        role: what the client may.
        source, sink: file descriptors of the client's bytes, and of those to it.

    Raises:
        RtecError: nobody listens at `path`, or does not take the name.
    """
    with socket.socket(socket.AF_UNIX) as daemon, selectors.DefaultSelector() as ready:
        try:
            daemon.connect(str(path))
            daemon.sendall(request("as", 0, name=name, role=role) + b"\n")
            heard = b""
            while not heard.endswith(b"\n"):  # whoever asks does not see this answer
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
                        if data := os.read(source, AT_ONCE):
                            daemon.sendall(data)
                        else:  # it has asked all that it wants; its answers are still to come
                            ready.unregister(source)
                            daemon.shutdown(socket.SHUT_WR)
                    elif data := daemon.recv(AT_ONCE):
                        while data:
                            data = data[os.write(sink, data) :]
                    else:
                        return
        except (OSError, RequestError) as e:
            raise RtecError(f"{path}: {e}") from e
