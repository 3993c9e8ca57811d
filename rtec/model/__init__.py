"""The model: a machine plus fitted effects; predicts, explains, saves, loads, and compiles into the kernel."""

from rtec.model.file import load_model, save_model
from rtec.model.model import FittedEffect, Model

__all__ = ["FittedEffect", "Model", "load_model", "save_model"]
