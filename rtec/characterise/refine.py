"""Estimates time constants between those of the candidates.

For a large expansion the nearest one of a few time constants has a large residual. A search would then add the same
temperature with another delay, or another temperature, and their sum would be wrong on another day.
"""

from collections.abc import Sequence
from dataclasses import replace

from rtec.characterise.candidates import Drive, TermCandidate, at_constant_temperature, drive
from rtec.errors import ModelError
from rtec.estimation.gram.identifiable import tellable
from rtec.estimation.gram.projection import polish
from rtec.estimation.gram.source import Source, thinned
from rtec.estimation.gram.stream import gather

READINGS = 5_000
"""Approximate number of instants of each measurement in a search."""


def refined(
    sources: Sequence[Source], chosen: Sequence[TermCandidate], candidates: Sequence[TermCandidate]
) -> list[TermCandidate]:
    """Each lagged temperature of a choice, with the time constant at which it alone explains most.

    Alone means: instead of all temperatures of the choice in its component and form, and beside the same shape at
    constant temperature.

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
            found = _polished(few, one, beside)
            if found is not None:
                out.setdefault(drive(one.term.effect), found)
    return list(out.values())


def _form(candidate: TermCandidate) -> tuple[str, str]:
    return candidate.component, candidate.effect


def _polished(sources: Sequence[Source], one: TermCandidate, beside: Sequence[TermCandidate]) -> TermCandidate | None:
    """A candidate with the parameters that fit best beside others; None where the readings do not determine it."""
    terms = [one.term, *(c.term for c in beside)]
    terms = [terms[i] for i in tellable(gather(sources, terms), terms)]
    if one.term not in terms:
        return None
    try:
        term = polish(sources, terms).terms[terms.index(one.term)]
    except ModelError:
        return None
    sensor = one.feature.split(" lagged ")[0]
    return replace(one, term=term, feature=f"{sensor} lagged {term.theta['tau']:.3g} s")
