"""Takes the nuisances that each run has anew out of the columns, chunk by chunk."""

import numpy as np
from numpy.typing import NDArray

from rtec.characterise.source import Source

Floats = NDArray[np.float64]


class Carry:
    """Takes the nuisances of each run out of the columns, also where a run is longer than a chunk.

    Of a run that goes on, what its first chunk shows of the nuisances is taken out of all its chunks: that changes
    nothing but the size of the numbers, and so keeps their digits. What is left of them is summed up and leaves the
    normal equations when the run ends.
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self._guess: Floats | None = None
        self._left: Floats | None = None

    def project(self, buffer: Floats, start: int, stop: int) -> Floats | float:
        """Project readings start … stop - 1, (columns, readings), in place; give what the equations still need."""
        directions, edges = self._source.projected, self._source.run_starts
        if not directions:
            return 0.0
        first, last = np.searchsorted(edges, start, "right") - 1, np.searchsorted(edges, stop, "left")
        runs = np.clip(edges[first : last + 1], start, stop)
        gone: Floats | float = 0.0
        begins, ends = edges[first] >= start, edges[last] <= stop
        inner = slice(0 if begins else 1, len(runs) if ends else len(runs) - 1)
        whole = runs[inner]
        if len(whole) > 1:
            self._whole(buffer, whole, start)
        for a, b, opens, closes in _pieces(runs, begins, ends):
            gone = gone + self._piece(buffer[:, a - start : b - start], [q[a:b] for q in directions], opens, closes)
        return gone

    def _whole(self, buffer: Floats, runs: NDArray[np.int64], start: int) -> None:
        """Runs that lie in the chunk; a nuisance of one reading among several touches that reading only."""
        source = self._source
        for q, lane in zip(source.projected, source.lanes, strict=True):
            step = 1 if lane is None else source.count
            first = int(runs[0]) + (lane or 0)
            part = np.ascontiguousarray(q[first : runs[-1] : step])
            starts, lengths = (runs[:-1] - runs[0]) // step, np.diff(runs) // step
            for row in buffer[:, first - start : runs[-1] - start : step]:
                np.subtract(row, np.repeat(np.add.reduceat(row * part, starts), lengths) * part, out=row)

    def _piece(self, part: Floats, directions: list[Floats], opens: bool, closes: bool) -> Floats | float:
        q = np.stack(directions)
        if opens:
            self._guess = np.linalg.pinv(q @ q.T) @ (q @ part.T)
            self._left = np.zeros_like(self._guess)
        if self._guess is None or self._left is None:
            return 0.0
        part -= self._guess.T @ q
        self._left += q @ part.T
        return -self._left.T @ self._left if closes else 0.0


def _pieces(runs: NDArray[np.int64], begins: bool, ends: bool) -> list[tuple[int, int, bool, bool]]:
    """Runs of a chunk that go on beyond it: first and last reading, does it begin here, does it end here."""
    out = []
    only = len(runs) == 2
    if not begins or (only and not ends):
        out.append((int(runs[0]), int(runs[1]), begins, ends or not only))
    if not only and not ends:
        out.append((int(runs[-2]), int(runs[-1]), True, False))
    return out
