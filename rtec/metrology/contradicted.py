"""A direction column that contradicts the order of the positions: its sign is wrong, or that of the positions."""

import numpy as np

from rtec.arrays import Floats, Ints

AGAINST, FEWEST, FEWEST_EACH_WAY = 0.9, 10, 3
"""Least share of the moves that contradict, least number of them, and of each way: all targets of one pass may be
approached from beyond."""
MOVED_MM = 0.1


def contradicted(run: Floats | Ints, places_mm: Floats, ways: Floats) -> tuple[int, int] | None:
    """How many moves within runs contradict the direction after them, of how many; None where that is no fault.

    Args:
        run: of each row, (n,).
        places_mm: of an axis, (n,).
        ways: its directions, (n,).
    """
    with np.errstate(over="ignore"):  # a move beyond all numbers is infinite, and has its sign
        within, by_mm = run[1:] == run[:-1], np.diff(places_mm)
    moved = within & (np.abs(by_mm) > MOVED_MM)
    # Between two readings at one place with other directions there was a move that no row shows.
    unseen = within & ~moved & (ways[1:] != ways[:-1])
    up, down = moved & (by_mm > 0.0) & (ways[1:] < 0.0), moved & (by_mm < 0.0) & (ways[1:] > 0.0)
    moves, against = int(moved.sum()), int(up.sum() + down.sum())
    few = against < FEWEST or min(int(up.sum()), int(down.sum())) < FEWEST_EACH_WAY
    if few or against < AGAINST * moves or int(unseen.sum()) > (1.0 - AGAINST) * moves:
        return None
    return against, moves
