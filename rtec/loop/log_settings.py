"""`[log]` of a run file: how long one file of a log grows, and how much of the disk all of them may take."""

from typing import Annotated

from pydantic import Field

from rtec.tomlfile import Strict


class LogTable(Strict):
    """Rules for the logs in `[run] log_folder`. A log that `--log` puts elsewhere is one file, and stays as it is.

    Attributes:
        segment_mb: a file that has grown to this is closed, and the next begun; 10^6 bytes.
        segment_s: so is one that is this old.
        disk_share: all logs in the folder may take this share of its disk; the oldest go first.
        pack: turn closed files into zstd Parquet, about a tenth of the size.
    """

    segment_mb: Annotated[float, Field(gt=0)] = 512.0
    segment_s: Annotated[float, Field(ge=1)] = 3600.0
    disk_share: Annotated[float, Field(gt=0, le=1)] = 0.5
    pack: bool = True
