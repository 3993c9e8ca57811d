"""Readers of files that other programs write; each gives plain tables of named columns with their units."""

from rtec.metrology.readers.base import Source, Table
from rtec.metrology.readers.registry import READERS, detect, read_tables

__all__ = ["READERS", "Source", "Table", "detect", "read_tables"]
