"""The pseudo terminal behind which simulated devices are. Oracle: the bytes that were written."""

import os
from pathlib import Path

from rtec.loop.clock import RealClock
from rtec_drivers.pty_peer import PtyPeer


class Listener:
    """Counts bytes, and works for a while on each block."""

    def __init__(self) -> None:
        self.heard = 0

    def receive(self, data: bytes, now_ns: int) -> bytes:
        del now_ns
        for _ in range(2000):
            sum(data)
        self.heard += len(data)
        return b""

    def idle(self, now_ns: int) -> bytes:
        del now_ns
        return b""


def test_it_settles_when_all_that_was_sent_is_worked_on(tmp_path: Path) -> None:
    """The writer is gone before the device has read its last bytes, as a loop that has ended."""
    listener = Listener()
    with PtyPeer(listener, RealClock(), tmp_path / "port") as peer:
        for block in range(1, 21):
            port = os.open(peer.link, os.O_WRONLY | os.O_NOCTTY)
            os.write(port, bytes(100))
            os.close(port)
            peer.settle()
            assert listener.heard == 100 * block
        peer.settle()
    peer.settle()
