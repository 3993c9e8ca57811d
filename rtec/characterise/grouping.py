"""Groups chosen columns into the fewest effects with the same columns."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from rtec.effects import Effect
from rtec.estimation.gram.stream import Term


def joined(terms: Sequence[Term]) -> list[Term]:
    """Join polynomials, backlashes, cross-talk and harmonics of one component and axis; the columns stay the same."""
    out: list[Term] = []
    for term in terms:
        place = next((i for i, t in enumerate(out) if _join(t, term) is not None), None)
        if place is None:
            out.append(term)
        else:
            whole = _join(out[place], term)
            out[place] = whole if whole is not None else out[place]
    return out


def apart(term: Term) -> list[Term]:
    """The terms that `joined` combined into this one, each with its own column."""
    effect = term.effect
    if effect.effect == "polynomial_position":
        return [replace(term, effect=_with(effect, degrees=(k,))) for k in _get(effect, "degrees")]
    if effect.effect in ("backlash_position", "cross_talk") and term.only is not None:
        return [replace(term, only=(k,)) for k in term.only]
    return [term]


def _join(one: Term, other: Term) -> Term | None:
    a, b = one.effect, other.effect
    if a == b and a.effect == "guide_lift":
        return one  # the fit estimates its power
    if (
        a.component != b.component
        or getattr(a, "axis", None) != getattr(b, "axis", 0)
        or dict(one.theta) != dict(other.theta)
    ):
        return None
    names = {a.effect, b.effect}
    if names == {"polynomial_position"}:
        degrees = tuple(sorted({*_get(a, "degrees"), *_get(b, "degrees")}))
        return replace(one, effect=_with(a, degrees=degrees))
    if names == {"backlash_position"} and one.only is not None and other.only is not None:
        wider = a if _get(a, "degree") >= _get(b, "degree") else b
        return Term(wider, one.theta, tuple(sorted({*one.only, *other.only})))
    if names == {"cross_talk"} and _get(a, "other") == _get(b, "other"):
        if one.only is None or other.only is None:
            return replace(one, only=None)
        return replace(one, only=tuple(sorted({*one.only, *other.only})))
    if names == {"cyclic_screw"}:
        wider = a if _get(a, "harmonics") >= _get(b, "harmonics") else b
        only = sorted({*_columns(one), *_columns(other)})
        return Term(wider, one.theta, None if len(only) == 2 * _get(wider, "harmonics") else tuple(only))
    return None


def _columns(term: Term) -> tuple[int, ...]:
    return term.only if term.only is not None else tuple(range(2 * _get(term.effect, "harmonics")))


def _get(effect: Effect, name: str) -> Any:
    return getattr(effect, name)


def _with(effect: Effect, **changes: Any) -> Effect:
    return type(effect).model_validate({**effect.model_dump(), **changes})
