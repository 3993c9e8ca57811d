"""Warnings about how it was measured, which no residual shows: targets in step with the pitch, an arm nobody uses."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rtec.characterise.result import Warn
from rtec.characterise.seen import moves, reads
from rtec.characterise.source import Source
from rtec.machine import Axis
from rtec.metrology.instruments.base import Instrument
from rtec.metrology.procedures.iso230_2 import hidden_period

Floats = NDArray[np.float64]

SEEN_ALL_ROUND = 0.4
"""Where no larger part of the pitch is without a reading, its error shows (two places leave half, three a third)."""
ARM_WAY = "leave component out where these are the instrument's own readings; leave the offset out where they are not"
PITCH_WAY = "add a dense run over one or two pitches, or take targets that are no multiples of the pitch"


def setup_warnings(sources: Sequence[Source]) -> list[Warn]:
    """What the set-ups keep from the fit."""
    machine = sources[0].measurement.machine
    hidden = [w for axis in machine.axes for w in _in_step_with_pitch(sources, axis)]
    unused = [(s.measurement.name, unused_offset(s.measurement.instrument)) for s in sources]
    return hidden + [Warn("arm_unused", f"{name}: {text}", ARM_WAY) for name, text in unused if text]


def unused_offset(instrument: Instrument) -> str | None:
    """Say that a place in the set-up has no say, because the instrument is said to read its component directly.

    None where there is no such place, or it is zero.
    """
    if instrument.component is None:
        return None
    setup = instrument.setup.model_dump()
    away = {k: v for k, v in setup.items() if k.endswith("offset_mm") and v is not None and np.any(np.asarray(v))}
    if not away:
        return None
    said = " and ".join(f"{k} = [{', '.join(f'{x:g}' for x in v)}]" for k, v in away.items())
    return (
        f'component = "{instrument.component}" says that the readings are that component already, so {said} is not '
        "used and no Abbe arm enters"
    )


def _in_step_with_pitch(sources: Sequence[Source], axis: Axis) -> list[Warn]:
    """One axis' positions in all measurements that see its positioning error, taken together: a dense run is enough."""
    component = f"E{axis.direction}{axis.name}"
    if axis.pitch_mm is None or component not in sources[0].measurement.machine.components:
        return []
    seen = [s for s in sources if moves(s, axis) and reads(s, component)]
    if not seen:
        return []
    places = np.unique(np.concatenate([s.measurement.channels[axis.channel] for s in seen]))
    if _widest_gap(places / axis.pitch_mm) < SEEN_ALL_ROUND:
        return []
    names = ", ".join(s.measurement.name for s in seen)
    return [
        Warn("pitch_multiple", f"axis {axis.name} ({names}): {text[0].lower()}{text.partition('. ')[0][1:]}", PITCH_WAY)
        for text in hidden_period(places, axis.pitch_mm)
    ]


def _widest_gap(turns: Floats) -> float:
    """Largest part of a turn in which nothing lies."""
    phase = np.sort(np.mod(turns, 1.0))
    return float(np.diff(np.append(phase, phase[0] + 1.0)).max())
