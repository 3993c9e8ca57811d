"""Text from outside (devices, files, clients, libraries) is data: this module makes it safe to show anywhere.

Control characters move a terminal's cursor, line breaks forge lines of a journal, direction marks reverse a name,
half a surrogate cannot be written at all. An unprintable character is shown as its escape, in JSON's notation, so
JSON text keeps its meaning.
"""

import json
import re
import unicodedata
from collections.abc import Iterable
from typing import Final

QUOTED: Final = r"""(?<!\w)'(?:[^'\\]|\\.)*'(?!\w)|(?<!\w)"(?:[^"\\]|\\.)*"(?!\w)"""

NUMBER = r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
"""Pattern of a number with a decimal point, as files hold it."""


def clean(text: str) -> str:
    """A text as one line of printable characters; unchanged if it is one already."""
    return text if text.isprintable() else "".join(map(_shown, text))


def clean_lines(text: str) -> str:
    """A text of several lines, each of them cleaned."""
    return "\n".join(map(clean, text.split("\n")))


def joined(texts: Iterable[str]) -> str:
    """Texts of clauses as one, each clause once: "a; b" and "c; b again" are "a; c; b again"."""
    clauses = list(dict.fromkeys("; ".join(texts).split("; ")))
    return "; ".join(c for c in clauses if not any(o != c and o.startswith(c) for o in clauses))


def without_numbers(text: str) -> str:
    """A text without its values: two that differ by a time or a value alone say the same.

    Numbers that are names stay: T1, node 5, error code 8130h.
    """
    return re.sub(r"(?<![\w.])(?<!node )[-+]?\d+(\.\d+)?(e[-+]?\d+)?(?![\dA-F]*h\b)", "", text)


def gist(text: str) -> list[str]:
    """What the clauses of a text say, without values and without what is quoted, such as bytes that were received."""
    return without_numbers(re.sub(QUOTED, "", text)).split("; ")


def _shown(character: str) -> str:
    if character.isprintable() or unicodedata.category(character) == "Zs":
        return character
    return json.dumps(character)[1:-1]
