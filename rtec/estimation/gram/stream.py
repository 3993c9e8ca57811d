"""Passes once through the measurements and sums the normal equations, block by block.

Chunks of a few thousand readings stay in the processor's cache while their columns are computed; all that remains of
them is one small square matrix for each block.

A state is passed window by window, so that a million readings never need their whole design in memory.

The nuisances of each run are projected out of the columns, chunk by chunk.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np

from rtec.arrays import Floats, Ints
from rtec.effects import Effect, State
from rtec.effects.derived import FAR_MM, lag_update
from rtec.effects.state import Value
from rtec.estimation.gram.normal import Normal
from rtec.estimation.gram.source import Explicit, Source, flat, reads
from rtec.jit import njit
from rtec.machine import Machine
from rtec.parallel import one_blas_thread


@njit
def _lag_on(value: Floats, time_s: Floats, tau_s: float, memory: Floats) -> Floats:
    """First-order lag that continues from `memory`: lagged, input, instant, begun; updated to the window's end."""
    out = np.empty(len(value))
    for i in range(len(value)):
        if memory[3] == 0.0:
            memory[0] = value[i]
            memory[3] = 1.0
        else:
            memory[0] = lag_update(memory[0], memory[1], value[i], time_s[i] - memory[2], tau_s)
        memory[1] = value[i]
        memory[2] = time_s[i]
        out[i] = memory[0]
    return out


class Walk:
    """The channels of one state in a moving window, with the methods of a state that effects use.

    Lags equal those of the whole state to the last bit: each continues from the end of the previous window.
    """

    def __init__(self, state: State) -> None:
        self._state = state
        self._memory: dict[tuple[Any, ...], Floats] = {}
        self._seen: dict[tuple[str, bool], Floats] = {}
        self._name_of: dict[int, tuple[str, bool]] = {}
        self._lagged: dict[tuple[Any, ...], Floats] = {}
        self._window = slice(0, 0)
        self._slot, self._call = 0, 0

    def move(self, start: int, stop: int) -> None:
        """Move the window to instants start … stop - 1; windows follow each other without gaps."""
        self._window = slice(start, stop)
        for cache in (self._seen, self._name_of, self._lagged):
            cache.clear()

    def begin(self, slot: int) -> "Walk":
        """Select whose basis functions come next.

        The lag of a channel is computed once for all; other lags are stored by slot and order of request.
        """
        self._slot, self._call = slot, 0
        return self

    def value(self, name: str) -> Floats:
        """A channel in the window."""
        return self._cached(name, False)

    def rise(self, sensor: str) -> Floats:
        """Temperature above the reference in the window, K."""
        return self._cached(sensor, True)

    def lagged(self, value: Value, tau_s: Value) -> Floats:
        """First-order lag of a value in the window."""
        channel, tau = self._name_of.get(id(value)), float(tau_s)
        key: tuple[Any, ...] = (self._slot, self._call) if channel is None else (*channel, tau)
        self._call += 1
        if key in self._lagged:
            return self._lagged[key]
        time_s = self._state.time_s[self._window]
        whole = np.broadcast_to(np.asarray(value, dtype=np.float64), time_s.shape)
        memory = self._memory.setdefault(key, np.zeros(4))
        out = _lag_on(np.ascontiguousarray(whole), np.ascontiguousarray(time_s), tau, memory)
        if channel is not None:
            self._lagged[key] = out
        return out

    def _channel(self, name: str) -> Floats:
        """A whole channel; an axis that was not recorded stands still at zero, as in `State.positions_mm`."""
        state = self._state
        if name in state.channels:
            return state.value(name)
        for axis in state.machine.axes:
            if name in axis.moving_channels and axis.channel not in state.channels:
                return np.full(len(state), FAR_MM if name == axis.since_reversal_channel else 0.0)
        return state.value(name)

    def _cached(self, name: str, rise: bool) -> Floats:
        key = (name, rise)
        if key not in self._seen:
            value = self._channel(name)[self._window]
            self._seen[key] = value - self._state.reference_degc if rise else value
            self._name_of[id(self._seen[key])] = key
        return self._seen[key]


class Carry:
    """Projects the nuisances of each run out of the columns, also where a run is longer than a chunk.

    For a run that continues, the part of the nuisances that its first chunk shows is removed from all its chunks: that
    changes only the size of the numbers, and so preserves their digits. The remainder is summed and removed from the
    normal equations when the run ends.
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self._guess: Floats | None = None
        self._left: Floats | None = None

    def project(self, buffer: Floats, start: int, stop: int) -> Floats | float:
        """Project readings start … stop - 1, (columns, readings), in place; gives what the equations still need."""
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

    def _whole(self, buffer: Floats, runs: Ints, start: int) -> None:
        """Runs within the chunk; a nuisance of one reading among several affects only that reading."""
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


def _pieces(runs: Ints, begins: bool, ends: bool) -> list[tuple[int, int, bool, bool]]:
    """Runs of a chunk that continue beyond it: first and last reading, whether it begins here, whether it ends here."""
    out = []
    only = len(runs) == 2
    if not begins or (only and not ends):
        out.append((int(runs[0]), int(runs[1]), begins, ends or not only))
    if not only and not ends:
        out.append((int(runs[-2]), int(runs[-1]), True, False))
    return out


Progress = Callable[[int, int], None]

CHUNK = 8192
"""Readings in a chunk."""
TOGETHER = 2048
"""Readings of short blocks whose columns are computed at once."""
LITTLE = 200_000
"""A chunk with fewer numbers is summed at once."""


@dataclass(frozen=True)
class Term:
    """An effect at chosen non-linear parameters: one column for each coefficient.

    Attributes:
        effect: the effect.
        theta: its non-linear parameters.
        only: numbers of its coefficients, where not all are used; the others are zero.
    """

    effect: Effect
    theta: Mapping[str, float] = field(default_factory=dict)
    only: tuple[int, ...] | None = None

    def names(self, machine: Machine) -> tuple[str, ...]:
        """Names of its columns."""
        names = tuple(p.name for p in self.effect.coefficients(machine))
        return names if self.only is None else tuple(names[i] for i in self.only)

    def values(self, machine: Machine, walk: Walk) -> list[Floats]:
        """Basis functions in the window."""
        basis = self.effect.basis(machine, walk, self.theta)
        return list(basis) if self.only is None else [basis[i] for i in self.only]


@dataclass(frozen=True)
class Slope:
    """Derivative of a term with known coefficients by one of its non-linear parameters: one column."""

    term: Term
    name: str
    step: float
    coefficients: tuple[float, ...]

    @property
    def effect(self) -> Effect:
        """The term's effect."""
        return self.term.effect

    def names(self, machine: Machine) -> tuple[str, ...]:
        """The parameter's name."""
        del machine
        return (self.name,)

    def values(self, machine: Machine, walk: Walk) -> list[Floats]:
        """Central difference of the effect's sum."""
        ends = []
        for sign in (1.0, -1.0):
            theta = self.term.theta
            moved = {**theta, self.name: theta[self.name] + sign * self.step}
            basis = replace(self.term, theta=moved).values(machine, walk)
            ends.append(np.asarray(sum(c * b for c, b in zip(self.coefficients, basis, strict=True))))
        return [(ends[0] - ends[1]) / (2.0 * self.step)]


Columns = Sequence[Term | Slope]


def gather(
    sources: Sequence[Source], terms: Columns, progress: Progress | None = None, *, by_fold: bool = False
) -> Normal:
    """Normal equations of all sources, block by block, columns in the order of the terms.

    Args:
        sources: measurements.
        terms: give the columns.
        progress: called with the readings done and in total.
        by_fold: join blocks that are held out together, also those of several sources: this suffices for a held-out
            error, and takes a small part of the memory.
    """
    with one_blas_thread():
        made = _Gatherer(sources, terms, progress)
        return made.by_fold() if by_fold else made.gather()


def predict(source: Source, terms: Columns, values: Floats) -> Floats:
    """Weighted prediction of every reading, (n · readings,), without nuisances."""
    machine, walk = source.measurement.machine, Walk(source.state)
    names = sorted({t.effect.component for t in terms}, key=machine.components.index)
    blind = {name for name in names if not reads(source, name)}
    out = np.zeros(len(source.weight))
    r, step = source.count, max(CHUNK // source.count, 1)
    for start in range(0, len(source.measurement), step):
        stop = min(start + step, len(source.measurement))
        walk.move(start, stop)
        errors = np.zeros((len(names), stop - start))
        k = 0
        for slot, term in enumerate(terms):
            row = errors[names.index(term.effect.component)]
            if term.effect.component in blind:
                k += len(term.names(machine))
                continue
            for value in term.values(machine, walk.begin(slot)):
                row += values[k] * value
                k += 1
        arms = source.arms(start, stop, [machine.components.index(n) for n in names])
        out[start * r : stop * r] = np.einsum("cij,ci->ij", arms.reshape(len(names), -1, r), errors).ravel()
    return out


@dataclass(frozen=True)
class _Block:
    """Rows start … stop - 1 of a source, the sums of their block, and what projects its nuisances."""

    start: int
    stop: int
    gram: Floats
    carry: Carry


def _together(blocks: Sequence[_Block], most: int) -> Iterator[list[_Block]]:
    """Blocks that follow each other, as many as `most` rows hold, at least one: their columns are computed at once."""
    part = list[_Block]()
    for block in blocks:
        if part and block.stop - part[0].start > most:
            yield part
            part = []
        part.append(block)
    if part:
        yield part


class _Gatherer:
    """Buffers and sums of one pass."""

    def __init__(self, sources: Sequence[Source], terms: Columns, progress: Progress | None) -> None:
        self.sources, self.terms, self.progress = sources, terms, progress
        machine = sources[0].measurement.machine
        self.machine = machine
        self.widths = [len(t.names(machine)) for t in terms]
        self.owner = [i for i, width in enumerate(self.widths) for _ in range(width)]
        self.extra: list[tuple[int, Explicit]] = [(s, e) for s, src in enumerate(sources) for e in src.explicit]
        self.width = len(self.owner) + len(self.extra) + 1
        # A term of a component that a measurement does not read is zero there, whatever channels it lacks.
        fed = {t.effect.component for t in terms}
        self.blind = {(s, name) for s, src in enumerate(sources) for name in fed if not reads(src, name)}
        places = [machine.components.index(t.effect.component) for t in terms]
        self.components = sorted(set(places))
        self.arm_of = [self.components.index(place) for place in places]
        self.total = sum(len(s.weight) for s in sources)
        self.raw = np.zeros(self.width)
        self.done = 0
        self._behind: Future[None] | None = None

    def gather(self) -> Normal:
        """Pass through every source; columns of a chunk are computed while those of the previous one are summed."""
        fold = [int(f) for source in self.sources for f in source.blocks.fold]
        source_of = [s for s, source in enumerate(self.sources) for _ in source.blocks.fold]
        return self._gathered(range(len(fold)), fold, source_of)

    def by_fold(self) -> Normal:
        """The same, with blocks that are held out together joined."""
        folds, place = np.unique(np.concatenate([source.blocks.fold for source in self.sources]), return_inverse=True)
        return self._gathered(place.tolist(), folds.tolist(), [0] * len(folds))

    def _gathered(self, place: Sequence[int], fold: Sequence[int], source_of: Sequence[int]) -> Normal:
        """Sums of blocks, each at its place."""
        gram = np.zeros((len(fold), self.width, self.width))
        readings, lost = np.zeros(len(fold), dtype=np.int64), np.zeros(len(fold))
        places = iter(place)
        with ThreadPoolExecutor(1) as summing:
            for s, source in enumerate(self.sources):
                runs, spent, blocks = source.blocks.run_edges, source.lost(), list[_Block]()
                for (start, stop), at in zip(pairwise(source.blocks.edges.tolist()), places, strict=False):
                    readings[at] += int(np.count_nonzero(source.weight[start * source.count : stop * source.count]))
                    lost[at] += float(spent[(runs[:-1] >= start) & (runs[:-1] < stop)].sum())
                    blocks.append(_Block(start, stop, gram[at], Carry(source)))
                walk = Walk(source.state)
                for part in _together(blocks, max(TOGETHER // source.count, 1)):
                    self._pass(part, s, walk, summing)
            self._wait()
        return Normal(
            gram=gram,
            fold=np.array(fold),
            source=np.array(source_of),
            readings=readings,
            lost=lost,
            owner=np.array(self.owner, dtype=np.int64),
            raw=self.raw,
            extra=tuple(e.name for _, e in self.extra),
        )

    def _pass(self, blocks: "Sequence[_Block]", s: int, walk: Walk, summing: ThreadPoolExecutor) -> None:
        """Pass through blocks that follow each other."""
        source, start, stop = self.sources[s], blocks[0].start, blocks[-1].stop
        step = max(CHUNK // source.count, 1)
        for a in range(start, stop, step):
            b = min(a + step, stop)
            buffer = self._columns(s, walk, a, b)
            self._wait()  # at most one chunk ahead: the order of the sums stays the same
            if (b - a) * source.count * self.width < LITTLE:
                self._absorb(blocks, buffer, a, source.count)
            else:
                self._behind = summing.submit(self._absorb, blocks, buffer, a, source.count)
            self.done += (b - a) * source.count
            if self.progress:
                self.progress(self.done, self.total)

    def _wait(self) -> None:
        if self._behind is not None:
            self._behind.result()
            self._behind = None

    def _absorb(self, blocks: "Sequence[_Block]", buffer: Floats, start: int, count: int) -> None:
        """Project the nuisances out of a chunk and add its part of each block to the block's sums."""
        self.raw += np.einsum("ij,ij->i", buffer, buffer)
        first, last = start * count, start * count + buffer.shape[1]
        for block in blocks:
            a, b = max(block.start * count, first), min(block.stop * count, last)
            if a < b:
                part = buffer[:, a - first : b - first]
                np.add(block.gram, block.carry.project(part, a, b), out=block.gram)
                np.add(block.gram, part @ part.T, out=block.gram)

    def _columns(self, s: int, walk: Walk, start: int, stop: int) -> Floats:
        source, r = self.sources[s], self.sources[s].count
        out = np.zeros((self.width, (stop - start) * r))
        walk.move(start, stop)
        arms = source.arms(start, stop, self.components)
        k = 0
        for slot, term in enumerate(self.terms):
            if (s, term.effect.component) in self.blind:
                k += self.widths[slot]
                continue
            arm = arms[self.arm_of[slot]].reshape(-1, r)
            for value in term.values(self.machine, walk.begin(slot)):
                column = np.asarray(value, dtype=np.float64)
                np.multiply(arm, column[:, None] if column.ndim else column, out=out[k].reshape(-1, r))
                k += 1
        weight = source.weight[start * r : stop * r]
        for owner, extra in self.extra:
            a, b = max(extra.rows.start, start), min(extra.rows.stop, stop)
            if owner == s and a < b:
                here = slice((a - start) * r, (b - start) * r)
                out[k, here] = flat(extra.nuisance.values[:, a:b]) * weight[here]
            k += 1
        out[k] = source.readings[start * r : stop * r] * weight
        return out
