"""What the loop cannot read from a device: constants from the run file, and how motion is made from counts."""

from typing import Annotated

from pydantic import Field

from rtec.model import Model
from rtec.tomlfile import Strict


class Inputs(Strict):
    """`[inputs]`: what holds during the whole run.

    Attributes:
        load_kg: weight on the table, the channel `load_kg`.
        force_n: force on the tool or a clamp, the channel `force_n`.
        motion_filter_s: time constant of the low-pass that makes velocity and acceleration from counts
            (`rtec.effects.derived.motion_update`); only models that read these channels use it.
    """

    load_kg: Annotated[float, Field(ge=0)] = 0.0
    force_n: float = 0.0
    motion_filter_s: Annotated[float, Field(ge=0.001, le=10)] = 0.02


def loop_faults(model: Model) -> list[str]:
    """Why the loop cannot run a model, one message an effect; empty where it can."""
    return [
        f"model {model.name!r}: effect {i + 1}, {fitted.label}, reads time_s. Such an effect can be found and its "
        "cause removed, but not corrected by the loop: time since the start of a measurement means nothing on another "
        "day. Fit the model again without it, or delete its [[effect]] from the model file"
        for i, fitted in enumerate(model.effects)
        if "time_s" in fitted.effect.channels(model.machine)
    ]
