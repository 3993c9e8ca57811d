"""A scale error that seems to have changed where a part is warmer or colder than at the fit: an expansion instead.

A sensor that hardly moves today but is degrees from all that it was at the fit shows by how much its part grew since.
The scale error of the fit contains the expansion up to its own temperature, so either one number explains the day in
much the same way; how the readings follow the temperature within the day decides.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

from rtec.effects.geometry import Scale
from rtec.effects.thermal import AxisExpansion
from rtec.errors import RtecError
from rtec.estimation.joint import ChangedNumber, joint_fit
from rtec.estimation.judge import Judgement
from rtec.estimation.outliers import Clean
from rtec.estimation.warmth import EXPANDS, Warmer, off_the_fit
from rtec.model import FittedEffect, Model

VISIBLE = 0.35
"""The expansion leaves less than the refit by more than this multiple of the noise floor, in squares."""
MOST_RIVALS = 2


def expansions_instead(
    model: Model, given: Clean, changed: Sequence[ChangedNumber], refitted: float
) -> list[tuple[FittedEffect, ChangedNumber]]:
    """Expansions that explain these readings better than a changed scale error, the best first.

    Args:
        model: with its own numbers, of an earlier day.
        given: today's readings.
        changed: numbers that seem to have changed.
        refitted: residual with these refitted.

    Returns:
        Each effect, its coefficient zero; and the number with the sensor, by how much it is warmer, and what it leaves.
    """
    bar = refitted**2 - (VISIBLE * Judgement(model, given).noise_floor) ** 2
    out: list[tuple[float, FittedEffect, ChangedNumber]] = []
    for c, new, by_k in _offered(model, given, changed):
        try:
            fit = joint_fit((*model.effects, new), given.readings, earlier=model)
        except RtecError:
            continue
        k = fit.effects[-1].values["k"]
        size = Judgement(replace(model, effects=fit.effects), given).residual
        if 0.0 < k <= EXPANDS and size**2 < bar:
            warm = Warmer(str(getattr(new.effect, "sensor", "")), by_k, k, new.label, size)
            out.append((size, new, replace(c, warmer=warm)))
    return [(new, c) for _, new, c in sorted(out, key=lambda f: f[0])]


def with_expansions(
    changed: Sequence[ChangedNumber], found: Sequence[tuple[FittedEffect, ChangedNumber]]
) -> tuple[ChangedNumber, ...]:
    """Changed numbers, each with the best expansion in its place and the rivals of that, where there is one."""
    out = []
    for c in changed:
        mine = [(new.label, n.warmer) for new, n in found if n.effect == c.effect]
        best = mine[0][1] if mine else c.warmer
        rivals = tuple(label for label, _ in mine[1 : 1 + MOST_RIVALS])
        out.append(replace(c, warmer=replace(best, rivals=rivals) if best is not None else None))
    return tuple(out)


def _offered(
    model: Model, given: Clean, changed: Sequence[ChangedNumber]
) -> Iterator[tuple[ChangedNumber, FittedEffect, float]]:
    """Expansions in place of each changed scale error: that number, the effect, and how much warmer its sensor is."""
    scales = {f.label: f.effect for f in model.effects if isinstance(f.effect, Scale) and f.errors}
    for c in changed:
        if (scale := scales.get(c.effect)) is None:
            continue
        for sensor, by_k in off_the_fit(model, given.readings, scale.axis).items():
            grows = AxisExpansion(component=scale.component, axis=scale.axis, sensor=sensor)
            yield c, FittedEffect(grows, {"k": 0.0}), by_k
