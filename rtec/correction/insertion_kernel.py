"""Where inserted counts go in a stream of raw transitions: the kernel behind `rtec.correction.insertion`.

Works from event to event, not from sample to sample; times are sample indices of the raw stream. No allocation.
"""

from typing import Any

import numpy as np

from rtec.correction.quadrature import Bytes, Deltas, Ints
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
