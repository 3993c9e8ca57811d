"""A short text in shared memory that one process writes now and then and another reads, neither waiting.

The writer makes the version odd, writes, and makes it even again; a reader that meets an odd version, or another one
behind its copy than before it, looks again a few times and then keeps what it had.
"""

import json
from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

NOTE_BYTES: Final = 8192
_REASON_CHARACTERS: Final = 400
_TRIES: Final = 5


class Note:
    """What the loop tells in words: by device, what is wrong now.

    Args:
        version: one int64 in shared memory.
        text: `NOTE_BYTES` bytes in shared memory: the length in four bytes, then UTF-8.
        barrier: a memory barrier.
    """

    def __init__(self, version: NDArray[np.int64], text: NDArray[np.uint8], barrier: Callable[[], None]) -> None:
        self._version, self._text, self._barrier = version, text, barrier
        self._written: Mapping[str, list[str]] = {}
        self._seen, self._read = 0, dict[str, list[str]]()

    def write(self, reasons: Mapping[str, list[str]]) -> None:
        """Tell; what was told before is not written again, what is too long is cut."""
        if reasons == self._written:
            return
        self._written = reasons
        data = _encoded(reasons)
        version = int(self._version[0])
        self._version[0] = version + 1
        self._barrier()
        self._text[:4] = np.frombuffer(len(data).to_bytes(4, "little"), np.uint8)
        self._text[4 : 4 + len(data)] = np.frombuffer(data, np.uint8)
        self._barrier()
        self._version[0] = version + 2

    def read(self) -> dict[str, list[str]]:
        """What was told last."""
        for _ in range(_TRIES):
            version = int(self._version[0])
            if version == self._seen:
                break
            self._barrier()
            data = self._text.tobytes()
            self._barrier()
            if version % 2 == 0 and int(self._version[0]) == version:
                self._seen, self._read = version, _decoded(data)
        return self._read


def _encoded(reasons: Mapping[str, list[str]]) -> bytes:
    """JSON that fits; the texts are cut shorter until it does."""
    most = _REASON_CHARACTERS
    while most:
        short = {name: [text[:most] for text in texts] for name, texts in reasons.items()}
        data = json.dumps(short, ensure_ascii=False).encode()
        if len(data) <= NOTE_BYTES - 4:
            return data
        most //= 2
    return b"{}"


def _decoded(data: bytes) -> dict[str, list[str]]:
    found: Any = json.loads(data[4 : 4 + int.from_bytes(data[:4], "little")] or b"{}")
    return {str(name): [str(text) for text in texts] for name, texts in found.items()}
