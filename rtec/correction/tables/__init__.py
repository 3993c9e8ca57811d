"""Compensation tables: for controllers that take a file and no signals [G 4.1]. One module a maker."""

from rtec.correction.tables.fanuc import PitchErrorList
from rtec.correction.tables.heidenhain import ComTable, OldTable
from rtec.correction.tables.isg import CrossList, LeadscrewList, PlaneList
from rtec.correction.tables.linuxcnc import CompFile
from rtec.correction.tables.siemens import CrossErrorCompensation, EncoderCompensation
from rtec.correction.tables.table import TableFormat
from rtec.errors import ConfigError
from rtec.tomlfile import nearest

FORMATS: dict[str, TableFormat] = {
    "linuxcnc": CompFile(0),
    "linuxcnc-type-1": CompFile(1),
    "siemens": EncoderCompensation(),
    "siemens-cec": CrossErrorCompensation(),
    "isg": LeadscrewList(),
    "isg-crosscomp": CrossList(),
    "isg-crosscomp2": PlaneList(),
    "heidenhain": ComTable(),
    "heidenhain-old": OldTable(),
    "fanuc": PitchErrorList(both=False),
    "fanuc-both": PitchErrorList(both=True),
}
"""The formats by the name that commands and run files use."""


def table_format(name: str, where: str) -> TableFormat:
    """The format of that name.

    Raises:
        ConfigError: no format has that name.
    """
    if name not in FORMATS:
        raise ConfigError(f"{where}: no format {name!r}{nearest(name, FORMATS)}")
    return FORMATS[name]
