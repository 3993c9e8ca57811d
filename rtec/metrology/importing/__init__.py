"""Turning tables of other programs into measurements by a column map."""

from rtec.metrology.importing.apply import Imported, import_table, import_to_files
from rtec.metrology.importing.map import ImportMap, load_map, starter_map

__all__ = ["ImportMap", "Imported", "import_table", "import_to_files", "load_map", "starter_map"]
