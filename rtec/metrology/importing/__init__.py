"""Turns tables of other programs into measurements by a column map, which rtec proposes from the file itself."""

from rtec.metrology.importing.apply import Imported, import_measurement, import_table, import_to_files
from rtec.metrology.importing.map import ImportMap, load_map
from rtec.metrology.importing.propose import ForeignColumn, ImportProposal, ImportQuestion, propose, save_map
from rtec.metrology.importing.temperature_log import beside
from rtec.metrology.readers.layout import Guess

__all__ = [
    "ForeignColumn",
    "Guess",
    "ImportMap",
    "ImportProposal",
    "ImportQuestion",
    "Imported",
    "beside",
    "import_measurement",
    "import_table",
    "import_to_files",
    "load_map",
    "propose",
    "save_map",
]
