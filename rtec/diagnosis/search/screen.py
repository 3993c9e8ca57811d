"""Evidence for every candidate at once: whitened, the current model taken out, Zellner's g-prior.

For a candidate with k columns of which the base leaves the orthonormal directions D, and the whitened readings r that
the base leaves: `R² = |Dᵀr|² / |r|²`, and with g = n the log evidence over the base alone is
`½ (n - k_B - k) ln(1 + n) - ½ (n - k_B) ln(1 + n (1 - R²))`  (Liang et al. 2008); over the values of its non-linear
parameters that are tried it is the mean, which is what a search costs: much for a period, little for a time constant
that the readings hardly decide.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rtec.errors import ModelError
from rtec.estimation.candidates import EffectCandidate
from rtec.estimation.noise import Whitener
from rtec.estimation.readings import Readings
from rtec.parallel import MANY

Floats = NDArray[np.float64]
Single = NDArray[np.float32]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Tell = Callable[[int, int], None]
Memory = dict[tuple[int, int], Floats | None]
"""Columns by the number of the candidate and of the values of its parameters; None where there are none."""

ABSORBED = 2e-3
"""A direction of which the base leaves less than this share of its norm is absorbed."""
UNMOVED = 1e-3
"""Readings that an effect of its usual size moves by less than this, µm or µrad, say nothing of it."""
SKETCH = 8192
"""Rows that stand for all where there are many, when chance is drawn."""
CHUNK = 96
"""Columns that are whitened together."""


@dataclass(frozen=True)
class Projected:
    """The whitened base, taken out of everything.

    Attributes:
        whitener: the noise.
        q: orthonormal basis of the whitened base, (m, k_B).
        left: whitened readings less the base, (m,).
    """

    whitener: Whitener
    q: Floats
    left: Floats

    @classmethod
    def of(cls, whitener: Whitener, base: Floats, values: Floats) -> "Projected":
        """Whiten and project."""
        q = orthonormal(whitener(base))
        white = whitener(values)
        return cls(whitener, q, white - q @ (q.T @ white))

    def take_out(self, white: Floats) -> Floats:
        """Whitened columns less the base, (m, p)."""
        return np.asarray(white - self.q @ (self.q.T @ white))

    @cached_property
    def squares(self) -> float:
        """Sum of squares of what is left."""
        return float(self.left @ self.left)

    @cached_property
    def freedom(self) -> float:
        """Readings less everything found from them."""
        readings = self.whitener.readings
        lost = sum(s.nuisance.shape[1] * (int(s.run[-1]) + 1) for s in readings.series)
        return float(max(len(readings) - self.q.shape[1] - lost, 4))


@dataclass(frozen=True)
class Variant:
    """A candidate at one value of its non-linear parameters.

    Attributes:
        candidate: its number.
        theta: number among the candidate's values.
        first, count: its directions in `Screen.directions`.
        size: norm of each of its whitened columns before and after the base is taken out, (k, 2).
    """

    candidate: int
    theta: int
    first: int
    count: int
    size: Floats


@dataclass(frozen=True)
class Screen:
    """What the readings say for every candidate.

    Attributes:
        projected: readings, whitened, less the base.
        candidates: as given.
        variants: those that the base does not absorb.
        directions: orthonormal directions of all, (m, columns).
        log_evidence: of each variant, (variants,).
        absorbed: candidates of which the base leaves nothing.
    """

    projected: Projected
    candidates: tuple[EffectCandidate, ...]
    variants: tuple[Variant, ...]
    directions: Single
    log_evidence: Floats
    absorbed: tuple[int, ...]

    @cached_property
    def counts(self) -> Ints:
        """Directions of each variant."""
        return np.array([v.count for v in self.variants], dtype=np.int64)

    @cached_property
    def starts(self) -> Ints:
        """First variant of each candidate that has any."""
        owner = np.array([v.candidate for v in self.variants], dtype=np.int64)
        return np.concatenate([[0], np.flatnonzero(np.diff(owner)) + 1]) if len(owner) else owner

    @cached_property
    def score(self) -> dict[int, float]:
        """Log evidence of each candidate: the mean over what was tried of its non-linear parameters."""
        if not self.variants:
            return {}
        means = mean_evidence(self.log_evidence[:, None], self.starts)[:, 0]
        return {self.variants[first].candidate: float(v) for first, v in zip(self.starts, means, strict=True)}

    def search_cost(self, candidate: int) -> float:
        """What the search for non-linear parameters takes off the evidence of the best of them."""
        return float(self.log_evidence[self.best[candidate]] - self.score[candidate])

    @cached_property
    def best(self) -> dict[int, int]:
        """Best variant of each candidate."""
        out: dict[int, int] = {}
        for i, v in enumerate(self.variants):
            if v.candidate not in out or self.log_evidence[i] > self.log_evidence[out[v.candidate]]:
                out[v.candidate] = i
        return out

    @cached_property
    def order(self) -> list[int]:
        """Candidates by evidence, best first."""
        return sorted(self.score, key=lambda c: -self.score[c])

    def contribution(self, candidate: int) -> Floats:
        """Whitened part of what is left that a candidate explains, (m,)."""
        v = self.variants[self.best[candidate]]
        d = self.directions[:, v.first : v.first + v.count].astype(np.float64)
        return np.asarray(d @ (d.T @ self.projected.left))

    def explained(self, candidate: int) -> float:
        """Sum of squares that a candidate explains beyond chance, in units of the noise variance."""
        v = self.variants[self.best[candidate]]
        d = self.directions[:, v.first : v.first + v.count].astype(np.float64)
        t = d.T @ self.projected.left
        return float(t @ t) - v.count * self.projected.squares / self.projected.freedom

    def family_p(self, draws: int, rng: np.random.Generator) -> tuple[float, Floats]:
        """Probability that chance alone makes the best of all look as good, and the evidences that chance made.

        Draws white noise, takes the base out, and takes the best evidence over the whole library each time.
        """
        if not self.variants:
            return 1.0, np.zeros(0)
        tops = []
        directions = sketched(self.directions, rng)
        rest = max(len(self.projected.left) - len(directions) - self.projected.q.shape[1], 0)
        whole_base = self.projected.q.astype(np.float32) if directions is self.directions else None
        for start in range(0, draws, 100):
            noise = rng.standard_normal((len(directions), min(100, draws - start)), dtype=np.float32)
            t2 = (directions.T @ noise) ** 2
            whole = (noise**2).sum(axis=0)
            if whole_base is not None:
                whole -= ((whole_base.T @ noise) ** 2).sum(axis=0)
            elif rest:
                whole += rng.chisquare(rest, len(whole)).astype(np.float32)
            r2 = _sums(t2, self.variants) / whole
            made = evidence(r2, self.counts[:, None], self.projected)
            tops.append(mean_evidence(made, self.starts).max(axis=0))
        chance = np.concatenate(tops).astype(np.float64)
        return float((1 + np.sum(chance >= max(self.score.values()))) / (draws + 1)), chance


def screen(
    readings: Readings,
    candidates: Sequence[EffectCandidate],
    projected: Projected,
    tell: Tell | None = None,
    memory: Memory | None = None,
    keep: Bools | None = None,
) -> Screen:
    """Weigh every candidate.

    Args:
        readings: the readings.
        candidates: what is weighed.
        projected: the noise, and the current model to be taken out.
        tell: told how many are done, and of how many.
        memory: columns of these readings, kept from one weighing to the next.
        keep: which readings' columns are kept, (m,), where the next weighing takes only some.
    """
    made = _Columns(readings, projected, candidates, {} if memory is None else memory, memory is not None, keep)
    total = sum(len(c.thetas) for c in candidates)
    done = 0
    for i, candidate in enumerate(candidates):
        for j, theta in enumerate(candidate.thetas):
            made.add(i, j, candidate, theta)
            done += 1
            if tell and done % 50 == 0:
                tell(done, total)
    made.finish()
    if tell:
        tell(total, total)
    directions = made.directions[:, : made.width]
    variants = tuple(made.variants)
    t = np.concatenate(
        [
            np.zeros(0),
            *(directions[:, i : i + CHUNK].T.astype(np.float64) @ projected.left for i in range(0, made.width, CHUNK)),
        ]
    )
    out = Screen(projected, tuple(candidates), variants, directions, np.zeros(len(variants)), ())
    r2 = _sums((t**2)[:, None], variants)[:, 0] / max(projected.squares, 1e-300)
    found = evidence(r2, out.counts, projected)
    there = {v.candidate for v in variants}
    absorbed = tuple(i for i in range(len(candidates)) if i not in there)
    return Screen(projected, tuple(candidates), variants, directions, found, absorbed)


def mean_evidence(values: Floats, starts: Ints) -> Floats:
    """Logarithm of the mean evidence over stretches of rows that begin at `starts`, (rows, k) to (stretches, k)."""
    top = np.maximum.reduceat(values, starts, axis=0)
    sizes = np.diff(np.append(starts, len(values)))
    total = np.add.reduceat(np.exp(np.maximum(values - np.repeat(top, sizes, axis=0), -60.0)), starts, axis=0)
    return np.asarray(top + np.log(total / sizes[:, None]))


def evidence(r2: Floats, columns: Ints, projected: Projected) -> Floats:
    """Log evidence over the base alone, Zellner's g-prior with g = n."""
    n, free = float(len(projected.left)), projected.freedom
    left = np.maximum(1.0 - r2, 1e-12)
    return np.asarray(0.5 * (free - columns) * np.log1p(n) - 0.5 * free * np.log1p(n * left))


def orthonormal(columns: Floats) -> Floats:
    """An orthonormal basis of columns, (m, rank)."""
    size = np.linalg.norm(columns, axis=0)
    kept = columns[:, size > 0] / size[size > 0]
    if not kept.shape[1]:
        return np.asarray(kept)
    gram = kept.T @ kept
    value, vector = np.linalg.eigh(gram)
    good = value > 1e-9 * value[-1]
    q = kept @ (vector[:, good] / np.sqrt(value[good]))
    # Once more: what the Gram matrix lost in precision comes back.
    return np.asarray(np.linalg.qr(q)[0], dtype=np.float64)


def sketched(directions: Single, rng: np.random.Generator) -> Single:
    """Fewer rows with the same inner products, near enough: rows drawn together with random signs, (SKETCH, columns).

    What chance does to many directions at once depends on nothing but their inner products.
    """
    n = len(directions)
    if n <= 2 * SKETCH:
        return directions
    out = np.zeros((SKETCH, directions.shape[1]), dtype=np.float32)
    for start in range(0, n, SKETCH):
        part = directions[start : start + SKETCH]
        sign = (1 - 2 * rng.integers(0, 2, len(part))).astype(np.float32)
        out[rng.permutation(SKETCH)[: len(part)]] += part * sign[:, None]
    return np.asarray(out / np.maximum(np.linalg.norm(out, axis=0), 1e-12), dtype=np.float32)


class _Columns:
    """Makes, whitens and projects columns chunk by chunk; equal basis functions are worked out once."""

    def __init__(
        self,
        readings: Readings,
        projected: Projected,
        candidates: Sequence[EffectCandidate],
        memory: Memory,
        remember: bool,
        keep: Bools | None,
    ) -> None:
        self.readings, self.projected, self.candidates = readings, projected, candidates
        self.variants: list[Variant] = []
        machine = readings.machine
        most = sum(len(c.thetas) * len(c.effect.coefficients(machine)) for c in candidates)
        # Column by column in memory, filled as they come: two copies of these would be most of what a search takes.
        self.directions: Single = np.empty((len(readings), most), dtype=np.float32, order="F")
        self.width = 0
        self._memory, self._remember = memory, remember
        self._keep = keep if keep is not None and not keep.all() else None
        self._waiting: list[tuple[int, int, Floats]] = []
        # Of many readings, columns are made while those before them are whitened.
        self._worker = ThreadPoolExecutor(1) if len(readings) > MANY else None
        self._working: Future[None] | None = None

    def add(self, number: int, theta_number: int, candidate: EffectCandidate, theta: Mapping[str, float]) -> None:
        """Take one variant."""
        key = number, theta_number
        known = key in self._memory and self._keep is None
        columns = self._memory[key] if known else self._made(candidate, theta)
        if self._remember:
            self._memory[key] = columns if columns is None or self._keep is None else columns[self._keep]
        if columns is None:
            return
        self._waiting.append((number, theta_number, columns))
        if sum(c.shape[1] for _, _, c in self._waiting) >= CHUNK:
            self._flush()

    def finish(self) -> None:
        """Whiten and project what waits still."""
        self._flush()
        if self._worker is not None:
            self._wait()
            self._worker.shutdown()

    def _made(self, candidate: EffectCandidate, theta: Mapping[str, float]) -> Floats | None:
        try:
            columns = self.readings.columns(candidate.effect, theta)
        except ModelError:
            return None  # a measurement that sees the component lacks a channel: told by `library`
        return columns if np.isfinite(columns).all() else None

    def _flush(self) -> None:
        waiting, self._waiting = self._waiting, []
        if not waiting:
            return
        if self._worker is None:
            self._take(waiting)
        else:
            self._wait()
            self._working = self._worker.submit(self._take, waiting)

    def _wait(self) -> None:
        if self._working is not None:
            self._working.result()

    def _take(self, waiting: Sequence[tuple[int, int, Floats]]) -> None:
        columns = np.concatenate([c for _, _, c in waiting], axis=1)
        moves = _norms(columns) / np.sqrt(len(columns))
        white = self.projected.whitener(columns)
        before = _norms(white)
        left = self.projected.take_out(white)
        after = _norms(left)
        at = 0
        for number, theta, one in waiting:
            part = slice(at, at + one.shape[1])
            if self._moved(number, moves[part]):
                self._add(number, theta, left[:, part], before[part], after[part])
            at += one.shape[1]

    def _moved(self, number: int, moves: Floats) -> bool:
        """Whether a usual size of the effect would move the readings at all."""
        usual = [p.typical for p in self.candidates[number].effect.coefficients(self.readings.machine)]
        return bool((moves * usual).max() > UNMOVED)

    def _add(self, number: int, theta: int, left: Floats, before: Floats, after: Floats) -> None:
        seen = before > 0
        if not (after[seen] > 0).any():
            return
        if left.shape[1] == 1:
            if after[0] <= ABSORBED * before[0]:
                return
            found = left / after
        else:
            scaled = left[:, seen] / before[seen]
            value, vector = np.linalg.eigh(scaled.T @ scaled)
            good = value > ABSORBED**2
            if not good.any():
                return
            found = scaled @ (vector[:, good] / np.sqrt(value[good]))
        count = found.shape[1]
        self.variants.append(Variant(number, theta, self.width, count, np.stack([before, after], axis=1)))
        self.directions[:, self.width : self.width + count] = found
        self.width += count


def _norms(columns: Floats) -> Floats:
    """Norm of each column, (p,)."""
    return np.asarray(np.sqrt(np.einsum("ij,ij->j", columns, columns)))


def _sums(squares: NDArray[np.floating], variants: Sequence[Variant]) -> Floats:
    """Sum of squares over the directions of each variant, (columns, draws) to (variants, draws)."""
    first = np.array([v.first for v in variants], dtype=np.int64)
    return np.asarray(np.add.reduceat(squares, first, axis=0)) if len(first) else np.zeros((0, squares.shape[1]))
