"""Characterisation: from measurements to a geometric-thermal model, with warnings in words."""

from rtec.characterise.result import Characterisation
from rtec.characterise.run import characterise, fitted_model
from rtec.effects.effect_list import AskedEffects, read_wanted

__all__ = ["AskedEffects", "Characterisation", "characterise", "fitted_model", "read_wanted"]
