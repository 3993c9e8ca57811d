"""The rows of a log as a flat table, one column a number: what both an export and a packed log hold."""

from collections.abc import Iterator
from typing import Any, Final

from numpy.typing import NDArray

from rtec.errors import LogError
from rtec.log.format import columns_of, entry_names
from rtec.log.log_open import Log
from rtec.loop.records import Commands, Layout, Samples

CHUNK_ROWS: Final = 131_072
Block = tuple[Samples, Commands]
Columns = list[NDArray[Any]]


def flat_names(layout: Layout) -> list[str]:
    """Column names of the table: `counts_X`, `degc_T_spindle`, `applied_um_X`, …; scalars keep their name.

    Raises:
        LogError: two columns would have the same name.
    """
    names: list[str] = []
    for f in columns_of(layout):
        names += [f.name] if f.width is None else [f"{f.name}_{entry}" for entry in entry_names(f, layout)]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise LogError(f"log: the names of axes and sensors give two columns {twice[0]!r}; it cannot be exported")
    return names


def flatten(samples: Samples, commands: Commands) -> Columns:
    """Every column by itself, in the order of `flat_names`."""
    flat: Columns = []
    for array in (*samples.arrays().values(), *commands.arrays().values()):
        flat += [array] if array.ndim == 1 else list(array.T)
    return flat


def chunks(log: Log) -> Iterator[list[Block]]:
    """Blocks of a log in lists of some `CHUNK_ROWS` rows, so that a table does not depend on the flushes of the log."""
    waiting: list[Block] = []
    n = 0
    for block in log.blocks(CHUNK_ROWS):
        waiting.append(block)
        n += len(block[0])
        if n >= CHUNK_ROWS:
            yield waiting
            waiting, n = [], 0
    if waiting:
        yield waiting
