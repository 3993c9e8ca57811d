"""The methods of every result: plain data, a table, a frame, figures, a page, and its view in a notebook.

Frames are of pandas and polars where these are installed, and of Arrow in any case.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from html import escape
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self, get_args

import numpy as np

from rtec.errors import RtecError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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


DRAWN = "_drawn"
"""Attribute in which a result keeps its page once it is drawn."""


def plain(value: Any) -> Any:
    """A result in JSON types: arrays become lists; numbers that are not finite become null."""
    if is_dataclass(value) and not isinstance(value, type):
        return plain(asdict(value))
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [plain(v) for v in value]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value


class Shown(ABC):
    """An object that can be shown as plain data, as a table, as figures, as a page."""

    page_maker: ClassVar[str]
    """`module:function` of the report that makes its page; the report is above the results and imports them."""

    @abstractmethod
    def facts(self) -> dict[str, Any]:
        """The result as plain data; keys as in the documented JSON."""

    def rows(self) -> Sequence[Mapping[str, Any]]:
        """The rows of `to_frame`."""
        return [self.facts()]

    def to_dict(self) -> dict[str, Any]:
        """The result as `--json` prints it: arrays are lists, numbers that are not finite are None."""
        return dict(plain(self.facts()))

    def to_frame(self, kind: Kind | None = None) -> Any:
        """The result's table, one number or text a cell.

        Args:
            kind: "pandas", "polars" or "arrow"; by default the first of them that is installed.

        Raises:
            RtecError: the package that `kind` names is not installed.
        """
        rows = [{k: v for k, v in row.items() if _is_cell(v)} for row in plain(self.rows())]
        names = dict.fromkeys(name for row in rows for name in row)
        return frame({name: [row.get(name) for row in rows] for name in names}, kind)

    def page(self, figures: bool = True) -> Any:
        """The page of the report (`rtec.report.page.Page`), with figures or without; drawn once."""
        if DRAWN in self.__dict__:
            return self.__dict__[DRAWN]
        module, _, name = self.page_maker.partition(":")
        page = getattr(import_module(module), name)(self, figures)
        if figures:
            self.__dict__[DRAWN] = page
        return page

    def plot(self, name: str | None = None) -> "Figure":
        """One figure of the report, as a matplotlib figure: change it, `savefig` it, or let a notebook show it.

        Args:
            name: name of the figure, as in the report's folder without `.png`; None: the most informative one.

        Raises:
            RtecError: no figure has that name.
        """
        figures = {s.figure.name.removesuffix(".png"): s.figure for s in self.page().sections if s.figure}
        if not figures or (name is not None and name not in figures):
            what = f"no figure {name!r}" if name else "no figure"
            raise RtecError(f"{type(self).__name__}: {what}; there are: {', '.join(figures) or 'none'}")
        chosen: Figure = figures[name or next(iter(figures))].png.figure
        return chosen

    def __str__(self) -> str:
        lead, table = self._first()
        return f"{lead}\n\n{_text(table)}" if table else lead

    def _repr_html_(self) -> str:
        lead, table = self._first()
        return f"<p><b>{escape(lead)}</b></p>{_html(table) if table else ''}"

    def _first(self) -> tuple[str, Any]:
        """The verdict, and the first table of the page, if any."""
        page = self.page(figures=False)
        sections = [page.brief] if page.brief else page.sections
        return page.lead, next((s.table for s in sections if s.table), None)


@dataclass(frozen=True, kw_only=True)
class Result(Shown):
    """Base of the results of `rtec.fit`, `rtec.compare`, `rtec.diagnose` and the others.

    Attributes:
        files: its model file (the new one where one was written) and the measurements, for commands that can be typed
            as they are; empty where one of them was in memory only.
        machine_file: the machine's file, where it is known.
        machine_option: what commands need to find it, as they are typed; empty where the model leads to it.
        written: written files, by their keys in `to_dict`; None for one that was not written.
    """

    files: tuple[Path, ...] = field(default=(), repr=False, compare=False)
    machine_file: Path | None = field(default=None, repr=False, compare=False)
    machine_option: tuple[str, ...] = field(default=(), repr=False, compare=False)
    written: Mapping[str, Path | None] = field(default_factory=dict, repr=False, compare=False)

    def own(self) -> dict[str, Any]:
        """Its fields by name, without those that every result has."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name not in Result.__dataclass_fields__}

    def to_dict(self) -> dict[str, Any]:
        """The result as `--json` prints it: arrays are lists, numbers that are not finite are None, paths are texts."""
        return super().to_dict() | {name: str(path) if path else None for name, path in self.written.items()}

    def save_report(self, folder: str | Path) -> Self:
        """Write `report.html`, `result.json` and the figures into a folder; return the result with their paths.

        Raises:
            RtecError: the folder cannot be written.
        """
        write, page = import_module("rtec.report.page").write_page, self.page()
        path: Path = write(page, self.to_dict(), Path(folder))
        saved = replace(self, written={**self.written, "report": path})
        saved.__dict__[DRAWN] = page
        return saved


def _is_cell(value: object) -> bool:
    return value is None or isinstance(value, str | int | float | bool)


def _text(table: Any) -> str:
    """A table of a page as text, its columns in line."""
    rows = [table.head, *table.rows]
    widths = [max(len(row[k]) for row in rows) for k in range(len(table.head))]
    cells = (
        (c.ljust(w) if k in table.words else c.rjust(w) for k, (c, w) in enumerate(zip(row, widths, strict=True)))
        for row in rows
    )
    return "\n".join("   ".join(row) for row in cells)


def _html(table: Any) -> str:
    """A table of a page as HTML; every text is escaped."""
    sides = ["left" if k in table.words else "right" for k in range(len(table.head))]

    def line(tag: str, cells: Any) -> str:
        texts = (f'<{tag} style="text-align:{s}">{escape(c)}</{tag}>' for s, c in zip(sides, cells, strict=True))
        return f"<tr>{''.join(texts)}</tr>"

    body = "".join(line("td", row) for row in table.rows)
    return f"<table><thead>{line('th', table.head)}</thead><tbody>{body}</tbody></table>"
