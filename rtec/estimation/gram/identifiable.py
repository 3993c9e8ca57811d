"""Names the terms that the readings do not show, or cannot distinguish."""

from collections.abc import Sequence

import numpy as np

from rtec.errors import ModelError
from rtec.estimation.gram.normal import NOTHING, UNSEEN, Normal
from rtec.estimation.gram.stream import Term
from rtec.model import FittedEffect

NAMED = 0.05
"""Terms with at least this share in a direction that no reading sees are named."""


def check_seen(normal: Normal, terms: Sequence[Term]) -> None:
    """Raise ModelError where the readings do not determine the terms' coefficients; the message names the terms."""
    if normal.freedom < 1:
        raise ModelError(
            f"fit: {int(normal.readings.sum())} readings for {normal.width} coefficients and "
            f"{len(normal.extra) + int(normal.lost.sum())} nuisances; take more"
        )
    blind = sorted({int(normal.owner[k]) for k in np.flatnonzero(normal.share_left() < NOTHING)})
    if blind:
        raise ModelError(
            f"fit: no reading shows {names(terms, blind)}; nothing that it depends on was there, "
            "or the instrument takes it up in its own zero"
        )
    sets = []
    for owners, nuisances in blind_sets(normal):
        listed = names(terms, owners)
        sets.append(", ".join([*([listed] if listed else []), *nuisances]))
    if any(sets):
        raise ModelError(
            "\n".join(
                f"fit: these cannot be distinguished by the readings (confounded): {s}" for s in dict.fromkeys(sets)
            )
            + "\nleave one out, or measure where they differ"
        )


def blind_sets(normal: Normal) -> list[tuple[list[int], list[str]]]:
    """Terms, by number, and nuisances that share a direction that no reading sees."""
    scaled, _ = normal.scaled()
    part, directions = np.linalg.eigh(scaled)
    out = []
    for k in np.flatnonzero(part < UNSEEN * part[-1]):
        row = np.abs(directions[:, k])
        share = np.flatnonzero(row >= NAMED * row.max())
        owners = sorted({int(normal.owner[i]) for i in share if i < normal.width})
        out.append((owners, [normal.extra[i - normal.width] for i in share if i >= normal.width]))
    return out


def tellable(normal: Normal, terms: Sequence[Term]) -> list[int]:
    """Numbers of terms that the readings separate from each other and from the nuisances.

    Of a confounded set, the term with the most coefficients is dropped, then the later one.
    """
    left = [i for i in range(len(terms)) if not (normal.share_left()[normal.owner == i] < NOTHING).any()]
    while left:
        rows = np.flatnonzero(np.isin(normal.owner, left))
        sets = [owners for owners, _ in blind_sets(normal.pick(rows)) if owners]
        if not sets:
            break
        left.remove(max(sets[0], key=lambda i: (int(np.count_nonzero(normal.owner == i)), i)))
    return left


def names(terms: Sequence[Term], which: Sequence[int]) -> str:
    """Terms by effect, component and what they depend on, for messages."""
    return ", ".join(dict.fromkeys(label(terms[i]) for i in which))


def label(term: Term) -> str:
    """Short name of a term."""
    return FittedEffect(term.effect, {}).label
