"""Instruments: each a linear functional of the model (seam 5 of the architecture)."""
