"""What was passed over when one of several effects was taken that the readings cannot tell apart."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rtec.diagnosis.result import Alike, Diagnosis, Finding
from rtec.diagnosis.words import labels

TOLD = 4


@dataclass(frozen=True)
class Rival:
    """An effect that would have done as well.

    Attributes:
        label: short name.
        confidence: its posterior probability; None where it was not fitted.
        test: the measurement that tells it from what was taken; empty where none is known.
    """

    label: str
    confidence: float | None
    test: str

    def facts(self) -> dict[str, Any]:
        """As plain data, without what is not known."""
        out: dict[str, Any] = {"effect": self.label}
        if self.confidence is not None:
            out["confidence"] = self.confidence
        return out | ({"separating_test": self.test} if self.test else {})


def rivals_of(found: Diagnosis, taken: Finding) -> tuple[Rival, ...]:
    """Everything that these readings cannot tell from what was taken, likeliest first.

    What explains another part of the readings is no rival of it: it is looked for again once this one is in the model.

    Args:
        found: the diagnosis that proposed it.
        taken: one of its findings.
    """
    if not found.findings or not found.findings[0].accepted:
        return ()
    known = {(a.effect, a.component): a for a in found.findings[0].confused_with}
    apart = {key for key, a in known.items() if a.apart} if taken is found.findings[0] else set()
    partner = taken.partner.effect if taken.partner else None
    group = [
        (f, label)
        for f, label in zip(found.findings, labels(found.findings), strict=True)
        if f.group and f is not taken and f.effect != partner and _key(f) not in apart
    ]
    out = [Rival(label, f.confidence, _test(known.get(_key(f)))) for f, label in group]
    there = {_key(taken), *(_key(f) for f, _ in group)} | apart
    others = [a for key, a in known.items() if key not in there]
    out += [Rival(a.label or f"{a.effect}({a.component})", None, _test(a)) for a in others]
    return tuple(out)


def _key(finding: Finding) -> tuple[str, str]:
    return finding.effect.effect, finding.effect.component


def _test(alike: Alike | None) -> str:
    return alike.separating_test if alike is not None else ""


def said(taken: Finding, rivals: Sequence[Rival]) -> tuple[str, ...]:
    """That the readings did not decide, which rivals there were, and what tells each apart."""
    named = ", ".join(r.label + (f" ({r.confidence:.0%})" if r.confidence is not None else "") for r in rivals[:TOLD])
    more = f" and {len(rivals) - TOLD} more" if len(rivals) > TOLD else ""
    first = f"{taken.label} ({taken.confidence:.0%}) was taken, but these readings cannot tell it from {named}{more}"
    return (first, *(f"to tell it from {r.label}: {r.test}" for r in rivals[:TOLD] if r.test))
