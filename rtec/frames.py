"""Tables in and out: pandas and polars where they are installed, Arrow in any case."""

from collections.abc import Mapping
from importlib.util import find_spec
from typing import Any, Literal, get_args

from rtec.errors import RtecError

Kind = Literal["pandas", "polars", "arrow"]


def frame(columns: Mapping[str, Any], kind: Kind | None = None) -> Any:
    """Columns of one length as a frame.

    Args:
        columns: sequences or arrays of one length, by name.
        kind: "pandas", "polars" or "arrow" (`pyarrow.Table`); by default the first of them that is installed.

    Raises:
        RtecError: the package that `kind` names is not installed, or `kind` is none of the three.
    """
    kinds: tuple[Kind, ...] = get_args(Kind)
    if kind is not None and kind not in kinds:
        raise RtecError(f"frame kind {kind!r}: one of {', '.join(kinds)}")
    chosen: str = kind or next(k for k in kinds if k == "arrow" or find_spec(k))
    if chosen == "arrow":
        import pyarrow as pa

        return pa.table(dict(columns))
    if find_spec(chosen) is None:
        raise RtecError(f"{chosen} is not installed; pip install {chosen}, or ask for to_frame('arrow')")
    if chosen == "pandas":
        import pandas as pd

        return pd.DataFrame(dict(columns))
    import polars as pl

    return pl.DataFrame(dict(columns))


def is_frame(data: object) -> bool:
    """Does it look like a frame of pandas, polars or Arrow, with columns by name?"""
    return hasattr(data, "columns") and hasattr(data, "__getitem__") and not isinstance(data, Mapping)


def columns_of(data: Any) -> dict[str, Any]:
    """The columns of a frame, each as the frame has it."""
    return {str(name): data[name] for name in getattr(data, "column_names", data.columns)}
