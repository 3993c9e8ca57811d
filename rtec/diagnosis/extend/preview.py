"""Shows what an expression would explain, before it is added: one linear least squares, its parameters as they are."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtec.arrays import Floats
from rtec.diagnosis.result import Picture
from rtec.diagnosis.search.picture import of_effect
from rtec.effects.expression import expression_from_text
from rtec.errors import ModelError
from rtec.estimation import floor
from rtec.estimation.given import given_to
from rtec.estimation.gls import solve
from rtec.estimation.judge import Judgement
from rtec.metrology.measurement import Measurement
from rtec.model import Model


@dataclass(frozen=True)
class Preview:
    """What an expression explains.

    Attributes:
        picture: the residual and the explained part, in the reading column that the expression moves most.
        columns: number of reading columns.
        removed: share of the mean square of all readings that it removes from the residual of the refitted model.
    """

    picture: Picture
    columns: int
    removed: float


def preview(
    model: Model, measurements: Sequence[Measurement], expression: str, params: Sequence[str], component: str
) -> Preview:
    """Fit an expression to the residual of a model.

    Args:
        model: the model, without the expression.
        measurements: of its machine.
        expression, params: as `rtec add --expr` and `--param` take them; a parameter with a range is at its start.
        component: component error that it feeds.

    Raises:
        ModelError: the expression is invalid, or no reading shows it.
    """
    if not component:
        raise ModelError("name the component error that the expression feeds, for example EXX")
    effect = expression_from_text(expression, list(params), component, model.machine)
    effect.check(model.machine, "expression")
    theta = {p.name: p.start for p in effect.nonlinear(model.machine)}
    judged = Judgement(model, given_to(model, measurements))
    shown = of_effect(judged.readings, judged.base.columns, judged.flexible, expression, effect, theta)
    if shown is None or not shown.drivers:
        raise ModelError(f"no reading shows {expression}; nothing that it depends on was moved")
    return Preview(shown, len(judged.readings.series), _removed(judged, judged.readings.columns(effect, theta)))


def _removed(judged: Judgement, columns: Floats) -> float:
    """Share of the residual's mean square that columns, (m, k), remove beside those of the model."""
    base = judged.base.columns
    before, after = _residual(judged, base), _residual(judged, np.concatenate([base, columns], axis=1))
    return 1.0 - (after / max(before, 1e-15)) ** 2


def _residual(judged: Judgement, columns: Floats) -> float:
    """Root mean square that a fit of columns, (m, p), leaves of all readings."""
    white, values = judged.flexible, judged.readings.values
    left = values - columns @ solve(white(columns), white(values))
    return judged.pooled(floor.cleaned(judged.readings, left))
