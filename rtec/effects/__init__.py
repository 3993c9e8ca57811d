"""Effects: one physical cause each, named by its physics, as basis functions of the state."""

from rtec.effects.base import Effect, Parameter
from rtec.effects.registry import EFFECTS, all_effects, effect_class
from rtec.effects.state import State

__all__ = ["EFFECTS", "Effect", "Parameter", "State", "all_effects", "effect_class"]
