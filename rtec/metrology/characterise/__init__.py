"""Characterisation: measurements in, geometric-thermal model out, with what to beware of in words."""

from rtec.metrology.characterise.result import Characterisation
from rtec.metrology.characterise.run import characterise
from rtec.metrology.characterise.wanted import Wanted, read_wanted

__all__ = ["Characterisation", "Wanted", "characterise", "read_wanted"]
