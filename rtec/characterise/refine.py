"""Estimates time constants between those of the candidates.

For a large expansion the nearest one of a few time constants has a large residual. A search would then add the same
temperature with another delay, or another temperature, and their sum would be wrong on another day.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rtec.characterise.candidates import Drive, TermCandidate, at_constant_temperature, drive
from rtec.errors import ModelError
from rtec.estimation.gram.identifiable import tellable
from rtec.estimation.gram.projection import polish
from rtec.estimation.gram.source import Source, thinned
from rtec.estimation.gram.stream import gather

READINGS = 5_000
"""Approximate number of instants of each measurement in a search."""
AS_GOOD, EXPLAINS = 1.2, 0.8
"""Another sensor is refined, too, where it leaves at most this many times the squares that the best sensor leaves, and
explains at least this share of what that explains."""


def refined(
    sources: Sequence[Source], chosen: Sequence[TermCandidate], candidates: Sequence[TermCandidate]
) -> list[TermCandidate]:
    """Each lagged temperature of a choice, with the time constant at which it alone explains most.

    Alone means: instead of all temperatures of the choice in its component and form, and beside the same shape at
    constant temperature. The right sensor may be missing in the choice for want of its time constant: the other sensors
    that explain as much are among the results.

    Args:
        sources: the measurements.
        chosen: the chosen candidates.
        candidates: all candidates.
    """
    few = [thinned(s, READINGS) for s in sources]
    out: dict[Drive, TermCandidate] = {}
    for one in chosen:
        if one.feature and "tau" in one.term.theta:
            beside = [c for c in chosen if not (c.feature and _form(c) == _form(one))]
            shape = at_constant_temperature(one, candidates)
            beside += [shape] if shape is not None and shape not in beside else []
            tried = [_polished(few, c, beside) for c in (one, *_by_other_sensors(one, candidates))]
            least, without = min((left for _, left in filter(None, tried)), default=0.0), _left(few, beside, one)
            most = min(AS_GOOD * least, without - EXPLAINS * (without - least))
            for i, found in enumerate(tried):
                if found is not None and (i == 0 or found[1] <= most):
                    out.setdefault(drive(found[0].term.effect), found[0])
    return list(out.values())


def _by_other_sensors(one: TermCandidate, candidates: Sequence[TermCandidate]) -> list[TermCandidate]:
    """The same effect with the same time constant by each other sensor, where it may be chosen."""
    tau = one.term.theta["tau"]
    alike = [c for c in candidates if _form(c) == _form(one) and c.offered and c.channels != one.channels]
    return list({c.channels: c for c in alike if c.term.theta.get("tau") == tau}.values())


def _form(candidate: TermCandidate) -> tuple[str, str]:
    return candidate.component, candidate.effect


def _left(sources: Sequence[Source], terms: Sequence[TermCandidate], without: TermCandidate) -> float:
    """Sum of squares that terms leave, without one that is none of them."""
    normal = gather(sources, [without.term, *(c.term for c in terms)])
    rest = normal.pick(np.flatnonzero(normal.owner[: normal.width] != 0))
    return rest.squares(rest.values())


def _polished(
    sources: Sequence[Source], one: TermCandidate, beside: Sequence[TermCandidate]
) -> tuple[TermCandidate, float] | None:
    """A candidate with the parameters that fit best beside others, and the squares that all leave.

    None where the readings do not determine it.
    """
    terms = [one.term, *(c.term for c in beside)]
    terms = [terms[i] for i in tellable(gather(sources, terms), terms)]
    if one.term not in terms:
        return None
    at = terms.index(one.term)
    try:
        found = polish(sources, terms, only=[at])
    except ModelError:
        return None
    term, sensor = found.terms[at], one.feature.split(" lagged ")[0]
    return replace(one, term=term, feature=f"{sensor} lagged {term.theta['tau']:.3g} s"), found.left
