"""Collected faults of a table: each kind by row, with a remedy; the first are shown, the rest is counted."""

from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from rtec.arrays import Ints
from rtec.errors import MeasurementError

SHOWN = 20
KEPT = 20  # texts kept for each kind; the rest is only counted


@dataclass
class _Kind:
    """Faults that differ only in their row; `droppable` if dropping the rows removes them."""

    way: str
    droppable: bool
    lines: "array[int]" = field(default_factory=lambda: array("q"))
    texts: list[str] = field(default_factory=list)


class Faults:
    """The faults of one file.

    Args:
        source: name of the file, put before every message.
        word: word for a row: "line" of a text file, "row" of a Parquet file.
    """

    def __init__(self, source: str, word: str = "line") -> None:
        self.source = source
        self.word = word
        self._whole: list[str] = []
        self._kinds: dict[str, _Kind] = {}

    def __len__(self) -> int:
        return len(self._whole) + sum(len(k.lines) for k in self._kinds.values())

    def whole(self, text: str) -> None:
        """Add a fault of the whole file."""
        self._whole.append(text)

    def row(self, kind: str, line: int, text: str, way: str, *, droppable: bool = True) -> None:
        """Add a fault of one row; faults of one `kind` have the same remedy `way`."""
        known = self._kinds.setdefault(kind, _Kind(way, droppable))
        known.lines.append(line)
        if len(known.texts) < KEPT:
            known.texts.append(text)

    def rows(
        self,
        kind: str,
        lines: Ints,
        text: Callable[[int], str],
        way: str,
        *,
        droppable: bool = True,
    ) -> None:
        """Add faults of many rows; `text` is called with the place in `lines`, for the first ones only."""
        if not len(lines):
            return
        known = self._kinds.setdefault(kind, _Kind(way, droppable))
        known.lines.extend(lines.tolist())
        known.texts.extend(text(i) for i in range(min(len(lines), KEPT - len(known.texts))))

    def drop(self) -> list[str]:
        """Remove the faults that dropping rows removes; give them as notes, one a kind."""
        gone = {name: kind for name, kind in self._kinds.items() if kind.droppable}
        for name in gone:
            del self._kinds[name]
        return [f"row left out: {kind.texts[0]} ({self._places(kind.lines)})" for kind in gone.values()]

    def raise_if_any(self) -> None:
        """Raise MeasurementError with all faults, if there are any."""
        if len(self):
            raise MeasurementError("\n".join(self.messages()))

    def messages(self) -> list[str]:
        """One line a fault: those of the whole file, then by row."""
        out = [f"{self.source}: {text}" for text in self._whole[:SHOWN]]
        room = max(SHOWN - len(out), 0)
        each = max(3, room // max(len(self._kinds), 1))
        messages: list[tuple[int, str]] = []
        for kind in self._kinds.values():
            messages += self._messages_of(kind, each)
        out += [text for _, text in sorted(messages)[:room]]
        more = len(self) - len(out)
        return [*out, f"{self.source}: and {more} more"] if more > 0 else out

    def _messages_of(self, kind: _Kind, each: int) -> list[tuple[int, str]]:
        out = []
        for i, (line, text) in enumerate(zip(kind.lines, kind.texts[:each], strict=False)):
            way = f"; {kind.way}" if i == 0 and kind.way else ""
            more = len(kind.lines) - each
            tail = (
                f" (and {more} more like it, the last at {self.word} {kind.lines[-1]})" if i == 0 and more > 0 else ""
            )
            out.append((line, f"{self.source}: {self.word} {line}: {text}{way}{tail}"))
        return out

    def _places(self, lines: Sequence[int]) -> str:
        return places(self.word, lines)


def places(word: str, lines: Sequence[int], most: int = 10) -> str:
    """'lines 3, 7, 9 and 12 more' for a list of row numbers."""
    shown = ", ".join(str(n) for n in lines[:most])
    more = f" and {len(lines) - most} more" if len(lines) > most else ""
    return f"{word}{'s' if len(lines) > 1 else ''} {shown}{more}"
