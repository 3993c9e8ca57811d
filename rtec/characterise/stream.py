"""Walks through the measurements once and gathers the normal equations, block by block.

Chunks of a few thousand readings stay in the processor's cache while their columns are worked out; what is kept of
them is one small square matrix a block.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from rtec.characterise.normal import Normal
from rtec.characterise.project import Carry
from rtec.characterise.seen import reads
from rtec.characterise.source import Explicit, Source, flat
from rtec.characterise.walk import Walk
from rtec.effects import Effect
from rtec.machine import Machine
from rtec.parallel import one_blas_thread

Floats = NDArray[np.float64]
Progress = Callable[[int, int], None]

CHUNK = 8192
"""Readings worked on at a time."""
LITTLE = 200_000
"""A chunk with fewer numbers is summed up at once."""


@dataclass(frozen=True)
class Term:
    """An effect at chosen non-linear parameters: one column a coefficient.

    Attributes:
        effect: the effect.
        theta: its non-linear parameters.
        only: which of its coefficients, where not all; the others are zero.
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
    """How a term with known coefficients changes with one of its non-linear parameters: one column."""

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


def gather(sources: Sequence[Source], terms: Columns, progress: Progress | None = None) -> Normal:
    """Give the normal equations of all sources, block by block, columns in the order of the terms."""
    with one_blas_thread():
        return _Gatherer(sources, terms, progress).gather()


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


class _Gatherer:
    """Buffers and sums of one walk."""

    def __init__(self, sources: Sequence[Source], terms: Columns, progress: Progress | None) -> None:
        self.sources, self.terms, self.progress = sources, terms, progress
        machine = sources[0].measurement.machine
        self.machine = machine
        self.owner = [i for i, t in enumerate(terms) for _ in t.names(machine)]
        self.extra: list[tuple[int, Explicit]] = [(s, e) for s, src in enumerate(sources) for e in src.explicit]
        self.width = len(self.owner) + len(self.extra) + 1
        # A term of a component that a measurement does not read is nothing there, whatever channels it lacks.
        fed = {t.effect.component for t in terms}
        self.blind = {(s, name) for s, src in enumerate(sources) for name in fed if not reads(src, name)}
        self.components = sorted({machine.components.index(t.effect.component) for t in terms})
        self.total = sum(len(s.weight) for s in sources)
        self.raw = np.zeros(self.width)
        self.done = 0
        self._behind: Future[None] | None = None

    def gather(self) -> Normal:
        """Walk through every source; columns of a chunk are worked out while those of the last are summed up."""
        grams, fold, source_of, readings, lost = [], [], [], [], []
        with ThreadPoolExecutor(1) as summing:
            for s, source in enumerate(self.sources):
                walk, spent = Walk(source.state), source.lost()
                edges, runs = source.blocks.edges, source.blocks.run_edges
                for b in range(len(edges) - 1):
                    start, stop = int(edges[b]), int(edges[b + 1])
                    grams.append(self._block(s, walk, start, stop, summing))
                    fold.append(int(source.blocks.fold[b]))
                    source_of.append(s)
                    readings.append(int(np.count_nonzero(source.weight[start * source.count : stop * source.count])))
                    inside = (runs[:-1] >= start) & (runs[:-1] < stop)
                    lost.append(float(spent[inside].sum()))
            self._wait()
        return Normal(
            gram=np.stack(grams),
            fold=np.array(fold),
            source=np.array(source_of),
            readings=np.array(readings),
            lost=np.array(lost),
            owner=np.array(self.owner, dtype=np.int64),
            raw=self.raw,
            extra=tuple(e.name for _, e in self.extra),
        )

    def _block(self, s: int, walk: Walk, start: int, stop: int, summing: ThreadPoolExecutor) -> Floats:
        source = self.sources[s]
        gram, carry = np.zeros((self.width, self.width)), Carry(source)
        step = max(CHUNK // source.count, 1)
        for a in range(start, stop, step):
            b = min(a + step, stop)
            buffer = self._columns(s, walk, a, b)
            self._wait()  # one chunk in hand, one behind: the order of the sums stays the same
            if (b - a) * source.count * self.width < LITTLE:
                self._absorb(gram, carry, buffer, a * source.count)
            else:
                self._behind = summing.submit(self._absorb, gram, carry, buffer, a * source.count)
            self.done += (b - a) * source.count
            if self.progress:
                self.progress(self.done, self.total)
        return gram

    def _wait(self) -> None:
        if self._behind is not None:
            self._behind.result()
            self._behind = None

    def _absorb(self, gram: Floats, carry: Carry, buffer: Floats, start: int) -> None:
        """Take the nuisances out of a chunk and add it to the sums."""
        self.raw += np.einsum("ij,ij->i", buffer, buffer)
        gram += carry.project(buffer, start, start + buffer.shape[1])
        gram += buffer @ buffer.T

    def _columns(self, s: int, walk: Walk, start: int, stop: int) -> Floats:
        source, r = self.sources[s], self.sources[s].count
        out = np.zeros((self.width, (stop - start) * r))
        walk.move(start, stop)
        arms = source.arms(start, stop, self.components)
        k = 0
        for slot, term in enumerate(self.terms):
            if (s, term.effect.component) in self.blind:
                k += len(term.names(self.machine))
                continue
            arm = arms[self.components.index(self.machine.components.index(term.effect.component))].reshape(-1, r)
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
