"""What happens to bytes on a wire, for tests and hardware in the loop."""

import random
from collections import deque


class WireFaults:
    """Bytes go in as they are sent and come out as they arrive. Every fault may be switched on and off at any time.

    Attributes:
        silent: nothing arrives.
        flip_rate: share of messages in which one bit arrives wrong.
        cut_next: the next message ends after so many bytes; -1: it does not.
        cut_every: one message in so many ends in its middle; 0: none does.
        late_ns: everything arrives so much later.
        babble: these bytes come before every message, and by themselves.
        garbled, passed: messages that arrived wrong, and all that arrived.

    Args:
        seed: of the chance in `flip_rate`.
    """

    def __init__(self, seed: int = 0) -> None:
        self.silent, self.flip_rate, self.cut_next, self.late_ns, self.babble = False, 0.0, -1, 0, b""
        self.cut_every = 0
        self.garbled = self.passed = 0
        self._chance = random.Random(seed)  # noqa: S311 - a test's dice
        self._on_the_way: deque[tuple[int, bytes]] = deque()

    def put(self, message: bytes, now_ns: int) -> None:
        """Send a message."""
        if self.silent:
            return
        data = self.babble + self._spoilt(message)
        if data:
            self._on_the_way.append((now_ns + self.late_ns, data))

    def take(self, now_ns: int) -> bytes:
        """Give what has arrived by now."""
        out = b""
        while self._on_the_way and self._on_the_way[0][0] <= now_ns:
            out += self._on_the_way.popleft()[1]
        return out

    def next_ns(self) -> int | None:
        """When the next bytes arrive; None where none are on the way."""
        return self._on_the_way[0][0] if self._on_the_way else None

    def _spoilt(self, message: bytes) -> bytes:
        if not message:
            return message
        self.passed += 1
        if self.cut_every and self.passed % self.cut_every == 0:
            self.cut_next = len(message) // 2
        if self.cut_next >= 0:
            message, self.cut_next = message[: self.cut_next], -1
            self.garbled += 1
        elif self._chance.random() < self.flip_rate:
            bit = self._chance.randrange(8 * len(message))
            spoilt = bytearray(message)
            spoilt[bit // 8] ^= 1 << bit % 8
            message = bytes(spoilt)
            self.garbled += 1
        return message
