"""Readers of other programs' files; each gives plain tables of named columns with their units."""

from rtec.metrology.readers.base import ForeignTable, SourceOptions
from rtec.metrology.readers.registry import READERS, detect, read_tables

__all__ = ["READERS", "ForeignTable", "SourceOptions", "detect", "read_tables"]
