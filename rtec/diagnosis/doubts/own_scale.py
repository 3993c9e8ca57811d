"""Files whose scale contradicts that of the others, which the model meets: a cosine error, or a plate that was warm."""

import itertools
from dataclasses import replace

import numpy as np

from rtec.characterise.own_scale import LEAST_UM_PER_M, OWN, REMEDY, decide, groups_of
from rtec.diagnosis.doubts.doubt import Doubt
from rtec.effects.geometry import Scale
from rtec.estimation import floor
from rtec.estimation.candidates import simple_effects
from rtec.estimation.changed_delay import AS_GOOD
from rtec.estimation.judge import Judgement

MOST = 0.5
"""Least share of the squared residual that the scale of these files takes away."""


def own_scale_of(judged: Judgement) -> Doubt | None:
    """A doubt about files that read longer or shorter than the others; None where an effect explains about as much.

    Where another file was read by the same instrument in the same set-up, the machine may have changed between them.
    """
    readings, left = judged.readings, judged.left
    groups = groups_of(readings.measurements)
    if not groups:
        return None
    scales = [Scale(component=f"E{a.direction}{a.name}", axis=a.name) for a in readings.machine.axes]
    longer = np.sum([readings.columns(s, {}) for s in scales], axis=0)[:, 0]
    source = np.concatenate([np.full(len(s), s.source) for s in readings.series])
    read = np.stack([np.where(np.isin(source, files), longer, 0.0) for files in groups], axis=1)
    columns = floor.cleaned(readings, read)
    own, product = np.sum(columns**2, axis=0), columns.T @ left
    seen = own > OWN * np.maximum(np.sum(read**2, axis=0), 1e-300)
    takes = np.where(seen, product**2 / np.where(seen, own, 1.0), 0.0) / max(float(left @ left), 1e-300)
    if takes.max() < MOST:
        return None
    found = decide(readings.measurements, groups, takes)
    made = [m.instrument for m in readings.measurements]
    if any(made[i] == made[j] for i in found.files for j in set(range(len(made))) - {*found.files}):
        return None
    k = groups.index(found.files)
    found, rest = replace(found, um_per_m=float(product[k] / own[k])), judged.left_by(columns[:, [k]])
    if abs(found.um_per_m) < LEAST_UM_PER_M:
        return None
    effects = itertools.chain(
        ((f.effect, f.theta) for f in judged.model.effects), ((e, None) for e in simple_effects(judged.readings))
    )
    if any(judged.left_by(judged.columns_of(e, theta)) < AS_GOOD * rest for e, theta in effects):
        return None
    step = f"{REMEDY[0].upper()}{REMEDY[1:]}."
    return Doubt("contradiction", f"{found.message(readings.measurements)}.", step, fatal=True)
