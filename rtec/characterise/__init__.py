"""Characterisation: from measurements to a geometric-thermal model, with warnings in words."""

from rtec.characterise.effect_list import AskedEffects, read_wanted
from rtec.characterise.result import Characterisation
from rtec.characterise.run import characterise, fitted_model

__all__ = ["AskedEffects", "Characterisation", "characterise", "fitted_model", "read_wanted"]
