"""Insertion of counts into a live A/B stream: the real-time error corrector between encoder and controller.

    output phase(n) = raw phase(n) + inserted(n)   (mod 4)

A positive inserted count is an edge with A leading B: the controller believes the axis to be further on than it is, so
an axis that moves in positive direction stops sooner. A negative inserted count is an edge with B leading A, or the
removal of a raw edge: the axis goes further [NIST guidelines, section 4.2.1].

Raw edges pass with one fixed latency; their distances from each other never change. The latency is the look-ahead that
keeps an inserted edge at its distance from the next raw edge. An inserted count against the motion may remove a raw
edge, which only increases distances. Where the raw edges leave no room, the count waits.

The compiled kernel works from event to event, not from sample to sample, and allocates nothing; times are sample
indices of the raw stream.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from rtec.arrays import Ints
from rtec.correction.quadrature import Bytes, DecoderState, Deltas, decode, lines_of, pack, phase_of, transitions
from rtec.errors import ConfigError
from rtec.jit import njit

FAR = 1 << 62
"""Later than any sample."""

AT = 0
"""First undecided sample."""
END = 1
"""Decide up to here, exclusive; the caller knows all raw transitions before END + separation - 1."""
INSERTED = 2
"""Counts inserted so far."""
GOAL = 3
"""Counts to reach next: the target, or in cycle mode a whole cycle."""
TARGET = 4
"""Latest target that is due."""
LAST_INSERTION = 5
"""Sample of the last inserted count: an added or a removed edge."""
LAST_INSERTED_EDGE = 6
"""Sample of the last inserted count that added an edge."""
LAST_RAW = 7
"""Sample of the last raw transition before AT."""
STATE_SIZE = 8


@njit
def _sign(x: int) -> int:
    return int(x > 0) - int(x < 0)


@njit
def _take_targets(targets: Any, next_target: int, state: Any) -> int:
    """Make the latest due entry the target."""
    at, counts = targets
    while next_target < len(at) and at[next_target] <= state[AT]:
        state[TARGET] = counts[next_target]
        next_target += 1
    return next_target


@njit
def _pass_edges(edges: Any, next_edge: int, state: Any) -> int:
    """Skip the raw transitions before the undecided sample."""
    at, _ = edges
    while next_edge < len(at) and at[next_edge] < state[AT]:
        state[LAST_RAW] = at[next_edge]
        next_edge += 1
    return next_edge


@njit
def _choose_goal(whole_cycles: int, state: Any) -> None:
    """Set the goal. A cycle that has begun is finished; one begins where more than half a cycle is missing."""
    if whole_cycles == 0:
        state[GOAL] = state[TARGET]
    elif state[INSERTED] == state[GOAL]:
        wanting = state[TARGET] - state[GOAL]
        if wanting > 2 or wanting < -2:
            state[GOAL] += 4 * _sign(wanting)


@njit
def _place(edges: Any, next_edge: int, separation: int, delta: int, state: Any) -> tuple[int, bool]:
    """First place at or before the next raw transition: its sample, and whether it removes that edge; -1: none."""
    at, deltas = edges
    next_raw = at[next_edge] if next_edge < len(at) else FAR
    gap = max(state[AT], state[LAST_RAW] + separation, state[LAST_INSERTED_EDGE] + separation)
    if gap + separation <= next_raw:
        return gap, False
    if deltas[next_edge] == -delta:
        return next_raw, True
    return -1, False


@njit
def _try_to_insert(edges: Any, next_edge: int, limits: tuple[int, int], until: int, state: Any) -> int:
    """Insert one count before `until` where that is allowed, and advance; give the inserted count: 1, 0 or -1."""
    separation, interval = limits
    delta = _sign(state[GOAL] - state[INSERTED])
    if delta == 0:
        state[AT] = until
        return 0
    earliest = state[LAST_INSERTION] + interval
    if earliest > state[AT]:
        state[AT] = min(earliest, until)
        return 0
    place, swallows = _place(edges, next_edge, separation, delta, state)
    if place < 0:
        state[AT] = min(edges[0][next_edge] + 1, until)
        return 0
    if place >= until:
        state[AT] = until
        return 0
    state[INSERTED] += delta
    state[LAST_INSERTION] = place
    if not swallows:
        state[LAST_INSERTED_EDGE] = place
    state[AT] = place + 1
    return delta


@njit
def schedule(edges: Any, targets: Any, limits: tuple[int, int, int], state: Any, out: Any) -> int:
    """Decide all samples up to `state[END]`.

    Args:
        edges: (sample, delta) of every known raw transition from `state[AT]` on; delta 0: illegal.
        targets: (sample, absolute inserted counts from that sample on), ascending.
        limits: minimum edge separation, minimum insertion interval (samples), 1 for whole cycles or 0.
        state: integers as named at the top of this file; changed in place.
        out: (sample, delta) arrays to fill, with room for one element an interval.

    Returns:
        Number of filled elements of `out`.
    """
    next_edge, next_target, made = 0, 0, 0
    while state[AT] < state[END]:
        next_target = _take_targets(targets, next_target, state)
        next_edge = _pass_edges(edges, next_edge, state)
        _choose_goal(limits[2], state)
        until = state[END]
        if next_target < len(targets[0]):
            until = min(until, targets[0][next_target])
        delta = _try_to_insert(edges, next_edge, (limits[0], limits[1]), until, state)
        if delta != 0:
            out[0][made] = state[LAST_INSERTION]
            out[1][made] = delta
            made += 1
    return made


def new_state(inserted_counts: int) -> Ints:
    """State before the first sample, which has no predecessor, so no count can be inserted at it."""
    state = np.zeros(STATE_SIZE, np.int64)
    state[[AT, INSERTED, GOAL, TARGET]] = 1, inserted_counts, inserted_counts, inserted_counts
    state[[LAST_INSERTION, LAST_INSERTED_EDGE, LAST_RAW]] = -FAR
    return state


def add_inserted(phase: Bytes, inserted_before: int, place: Ints, delta: Deltas) -> Bytes:
    """Add inserted counts to a track of phases, each from its place on; the result is valid modulo four."""
    start = np.uint8(inserted_before & 3)
    if len(place) == 0:
        return phase + start
    step = np.zeros(len(phase), np.uint8)
    step[place] = delta.astype(np.uint8)
    return phase + np.cumsum(step, dtype=np.uint8) + start


@dataclass(frozen=True, slots=True)
class InsertionSettings:
    """Limits of the controller's counter.

    Attributes:
        min_edge_separation_samples: least distance of an inserted edge from any other edge, samples, at least 1.
        min_insertion_interval_samples: rate limit: least distance of two inserted counts, samples, at least 1.
        mode: "count" inserts single counts; "cycle" whole A/B cycles of four, as the original corrector did:
            a cycle begins when the target is more than two counts away, and is always finished.
    """

    min_edge_separation_samples: int
    min_insertion_interval_samples: int
    mode: Literal["count", "cycle"] = "count"

    def __post_init__(self) -> None:
        """Check the figures.

        Raises:
            ConfigError: a figure below 1, or another mode.
        """
        for name in ("min_edge_separation_samples", "min_insertion_interval_samples"):
            if getattr(self, name) < 1:
                raise ConfigError(f"insertion: {name} = {getattr(self, name)}; allowed: 1 or more")
        if self.mode not in ("count", "cycle"):
            raise ConfigError(f"insertion: mode = {self.mode!r}; allowed: 'count', 'cycle'")

    @property
    def latency_samples(self) -> int:
        """Delay of the corrected stream against the raw stream, samples."""
        return self.min_edge_separation_samples


@dataclass(frozen=True, slots=True)
class Corrected:
    """One block of the corrected stream.

    Attributes:
        a: line A, 0 or 1, (n,).
        b: line B, (n,).
        z: index line, unchanged, (n,).
        first_sample: raw sample of the first element; negative while the latency fills.
        insertion_at: raw sample of each inserted count, ascending, (k,).
        insertion_delta: +1 or -1 for each, (k,).
    """

    a: Bytes
    b: Bytes
    z: Bytes
    first_sample: int
    insertion_at: Ints
    insertion_delta: Deltas


class PulseInserter:
    """Inserts counts into a stream of A, B and index samples, block by block; the lengths of the blocks do not matter.

    The ledger is `raw_counts + inserted_counts = corrected_counts`, all three at the last output sample.
    `corrected_counts` is decoded from the output lines, not computed from the other two.
    """

    def __init__(self, settings: InsertionSettings, raw_counts: int = 0, inserted_counts: int = 0) -> None:
        """Start, or go on after a stop.

        Args:
            settings: limits and mode.
            raw_counts: count of the first raw sample.
            inserted_counts: counts that the controller already has on top of the raw ones.

        Raises:
            ConfigError: in cycle mode `inserted_counts` is no whole number of cycles.
        """
        if settings.mode == "cycle" and inserted_counts % 4:
            raise ConfigError(f"insertion: inserted_counts = {inserted_counts}; cycle mode needs a multiple of 4")
        self.settings = settings
        self._state = new_state(inserted_counts)
        self._raw_counts = raw_counts
        self._corrected_counts = raw_counts + inserted_counts
        self._illegal = 0
        self._samples_in = 0
        self._late_phase = np.zeros(0, np.uint8)
        self._late_z = np.zeros(0, np.uint8)
        self._raw_state: DecoderState | None = None
        self._out_state: DecoderState | None = None
        self._edges: tuple[Ints, Deltas] = (np.zeros(0, np.int64), np.zeros(0, np.int8))
        self._targets: tuple[Ints, Ints] = (np.zeros(0, np.int64), np.zeros(0, np.int64))

    @property
    def raw_counts(self) -> int:
        """Counts of the raw stream, at the last output sample."""
        return self._raw_counts

    @property
    def inserted_counts(self) -> int:
        """Counts inserted so far."""
        return int(self._state[INSERTED])

    @property
    def corrected_counts(self) -> int:
        """Counts of the output stream: the controller's counts."""
        return self._corrected_counts

    @property
    def illegal_transitions(self) -> int:
        """Raw transitions of both lines at once, up to the last output sample; they pass unchanged."""
        return self._illegal

    @property
    def waiting_counts(self) -> int:
        """Counts still to be inserted, signed: delayed by the rate limit or by a lack of room between edges.

        In cycle mode only whole cycles count; a target within two counts of a whole cycle counts as reached.
        """
        goal, target = int(self._state[GOAL]), int(self._state[TARGET])
        if self.settings.mode == "cycle":
            further = target - goal
            goal += (4 if further > 0 else -4) * ((abs(further) + 1) // 4)
        else:
            goal = target
        return goal - self.inserted_counts

    def push(
        self,
        a: Bytes,
        b: Bytes,
        z: Bytes | None = None,
        target_at: ArrayLike = (),
        target_counts: ArrayLike = (),
    ) -> Corrected:
        """Process the next raw samples; give the same number of corrected samples, `latency_samples` late.

        Until the latency is filled, the output has the level of the first sample.

        Args:
            a: raw line A, 0 or 1, (n,).
            b: raw line B, (n,).
            z: index line, (n,); None: no index; the output is zeros.
            target_at: raw samples, counted from the start of the stream, at which a new target begins, ascending over
                all calls. Targets of later blocks are kept; a target of a sample before the output begins at once.
            target_counts: for each of them, the absolute inserted counts to reach.

        Raises:
            ConfigError: lines of unequal length, not bytes, or with values other than 0 and 1; targets not ascending.
        """
        z = np.zeros_like(a) if z is None else z
        _check_lines(a, b, z)
        self._add_targets(target_at, target_counts)
        if len(a) == 0:
            return Corrected(a, b, z, self._first_sample(), np.zeros(0, np.int64), np.zeros(0, np.int8))
        phase, z = self._delay(phase_of(a, b), z)
        self._add_edges(pack(a, b))
        first = self._first_sample()
        self._samples_in += len(a)
        before = self.inserted_counts
        at, delta = self._schedule()
        out_a, out_b = lines_of(add_inserted(phase, before, at - first, delta))
        self._account(out_a, out_b)
        return Corrected(out_a, out_b, z, first, at, delta)

    def _first_sample(self) -> int:
        """Raw sample of the next output sample."""
        return self._samples_in - self.settings.latency_samples

    def _add_targets(self, at: ArrayLike, counts: ArrayLike) -> None:
        new_at, new_counts = np.asarray(at, np.int64), np.asarray(counts, np.int64)
        if new_at.ndim != 1 or new_at.shape != new_counts.shape:
            raise ConfigError(f"insertion: {new_at.shape} samples and {new_counts.shape} targets; needed: one each")
        all_at = np.concatenate((self._targets[0], new_at))
        if np.any(np.diff(all_at) < 0):
            raise ConfigError("insertion: the targets' samples do not ascend")
        self._targets = (all_at, np.concatenate((self._targets[1], new_counts)))

    def _delay(self, phase: Bytes, z: Bytes) -> tuple[Bytes, Bytes]:
        if self._samples_in == 0:
            self._late_phase = np.full(self.settings.latency_samples, phase[0], np.uint8)
            self._late_z = np.full(self.settings.latency_samples, z[0], np.uint8)
        n = len(phase)
        phase, z = np.concatenate((self._late_phase, phase)), np.concatenate((self._late_z, z))
        self._late_phase, self._late_z = phase[n:].copy(), z[n:].copy()
        return phase[:n], z[:n]

    def _add_edges(self, samples: Bytes) -> None:
        at, delta, self._raw_state = transitions(samples, 0, 1, self._raw_state)
        self._edges = (np.concatenate((self._edges[0], at)), np.concatenate((self._edges[1], delta)))

    def _schedule(self) -> tuple[Ints, Deltas]:
        """Decide all samples that the look-ahead covers; drop targets and edges before them."""
        separation, interval = self.settings.min_edge_separation_samples, self.settings.min_insertion_interval_samples
        limits = (separation, interval, int(self.settings.mode == "cycle"))
        self._state[END] = end = self._first_sample()
        room = max(0, int(end - self._state[AT])) // interval + 1
        out = (np.empty(room, np.int64), np.empty(room, np.int8))
        ran = bool(end > self._state[AT])
        made = schedule(self._edges, self._targets, limits, self._state, out)
        past = int(np.searchsorted(self._edges[0], end))
        self._raw_counts += int(self._edges[1][:past].sum(dtype=np.int64))
        if past:
            self._state[LAST_RAW] = self._edges[0][past - 1]
        self._edges = (self._edges[0][past:], self._edges[1][past:])
        due = int(np.searchsorted(self._targets[0], end)) if ran else 0
        self._targets = (self._targets[0][due:], self._targets[1][due:])
        return out[0][:made], out[1][:made]

    def _account(self, a: Bytes, b: Bytes) -> None:
        went_out = decode(pack(a, b), 0, 1, self._out_state)
        self._out_state = went_out.state
        self._corrected_counts += went_out.counts
        self._illegal += went_out.illegal


def correct_capture(
    a: Bytes,
    b: Bytes,
    z: Bytes | None,
    settings: InsertionSettings,
    *,
    target_at: ArrayLike,
    target_counts: ArrayLike,
) -> tuple[Corrected, PulseInserter]:
    """Correct a whole record, without the latency: element n of every line belongs to raw sample n.

    Arguments and errors as for `PulseInserter.push`. The index line is unchanged, bit for bit.

    Returns:
        The corrected record, and the inserter with its ledger at the record's last sample.
    """
    inserter = PulseInserter(settings)
    late = settings.latency_samples
    z = np.zeros_like(a) if z is None else z
    most = inserter.push(a, b, z, target_at, target_counts)
    rest = inserter.push(*(np.repeat(line[-1:], late) for line in (a, b, z)))

    def joined(name: str) -> Bytes:
        line: Bytes = np.concatenate((getattr(most, name), getattr(rest, name)))
        return line

    at = np.concatenate((most.insertion_at, rest.insertion_at))
    delta = np.concatenate((most.insertion_delta, rest.insertion_delta))
    return Corrected(joined("a")[late:], joined("b")[late:], joined("z")[late:], 0, at, delta), inserter


def _check_lines(*lines: Bytes) -> None:
    if len({line.shape for line in lines}) != 1 or lines[0].ndim != 1:
        raise ConfigError(f"insertion: lines of shapes {[line.shape for line in lines]}; needed: one length for all")
    for line in lines:
        if line.dtype != np.uint8 or (len(line) and line.max() > 1):
            raise ConfigError(f"insertion: a line of {line.dtype}; needed: uint8, 0 or 1")
