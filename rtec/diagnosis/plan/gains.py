"""What it takes to tell a finding from what it is confused with: the best test that the machine can take."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rtec.diagnosis.plan.parameters import hours_in_words
from rtec.diagnosis.plan.plan import Extra
from rtec.diagnosis.plan.separating import CLEAR, Pair, separating
from rtec.diagnosis.result import Alike
from rtec.estimation.noise import Whitener
from rtec.model import FittedEffect, Model


def with_gains(
    alikes: Sequence[tuple[Alike, FittedEffect]],
    winner: FittedEffect,
    model: Model,
    whitener: Whitener,
    extras: Sequence[Extra] | None = None,
) -> tuple[Alike, ...]:
    """Name for each confusion the quickest test that settles it, with the expected log Bayes factor that it adds.

    Where no test settles it (20 to 1), the one that comes nearest is named, and that it does not suffice.

    Args:
        alikes: confusions with the effects that they are about, fitted (`separating.fitted_to`).
        winner: what they are confused with.
        model: the current model.
        whitener: readings and noise of the diagnosis.
        extras: tests that might be made; by default those that the machine can take.
    """
    if not alikes:
        return ()
    readings = whitener.readings
    noise = float(np.median([n.sigma for n in whitener.noises]))
    found = separating(
        model, [winner, *(f for _, f in alikes)], readings.measurements, extras, noise=noise, whitener=whitener
    )
    out = []
    for place, (alike, _) in enumerate(alikes):
        # Pairs are in the order of the combinations: those of the winner come first.
        # What the readings say already is in both: only what a test adds can settle what they leave open.
        best = min(found, key=lambda s: _worth(s.test, _added(s.pairs[place])))
        gain = _added(best.pairs[place])
        out.append(replace(alike, gain=gain, separating_test=_words(alike.separating_test, best.test, gain)))
    return tuple(out)


def _added(pair: Pair) -> float:
    return pair.gain - pair.before


def _worth(test: Extra, gain: float) -> tuple[bool, float, float]:
    return (gain < CLEAR, test.hours if gain >= CLEAR else 0.0, -gain)


def _words(known: str, test: Extra, gain: float) -> str:
    made = f"{test.name} ({hours_in_words(test.hours)})"
    if gain >= CLEAR:
        odds = "more than 1000 to 1" if gain > math.log(1000.0) else f"about {math.exp(gain):.0f} to 1"
        said = f"here: {made}, expected odds {odds}"
    elif gain > 0.5:
        said = f"of the usual tests none settles it alone; the best is {made}, expected odds {math.exp(gain):.1f} to 1"
    else:
        said = "none of the usual tests on this machine tells them apart"
    return f"{known}; {said}" if known else said
