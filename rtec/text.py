"""Text from outside (devices, files, clients, libraries) is data: here it becomes text that may be shown anywhere.

Control characters move a terminal's cursor, line breaks forge lines of a journal, direction marks turn a name round,
half a surrogate cannot be written at all. What is not printable is shown as its escape, as JSON writes it: a text of
JSON that is cleaned means the same.
"""

import json
import unicodedata


def clean(text: str) -> str:
    """Give a text as one line of printable characters; the same text where it is that already."""
    return text if text.isprintable() else "".join(map(_shown, text))


def clean_lines(text: str) -> str:
    """Give a text of several lines, each of them cleaned."""
    return "\n".join(map(clean, text.split("\n")))


def _shown(character: str) -> str:
    if character.isprintable() or unicodedata.category(character) == "Zs":
        return character
    return json.dumps(character)[1:-1]
