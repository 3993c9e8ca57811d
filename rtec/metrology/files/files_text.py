"""How the text of a table is written: hash, encoding, byte order mark; nothing is guessed that could be wrong."""

import codecs
import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from rtec.errors import MeasurementError

BLOCK = 1 << 20
# The longer marks first: that of UTF-32 begins like that of UTF-16.
MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)


@dataclass(frozen=True)
class Text:
    """A text file, looked over once.

    Attributes:
        encoding: Python's name; a byte order mark is part of it.
        digest: running SHA-256 over its bytes.
        notes: what to tell about the encoding.
    """

    encoding: str
    digest: "hashlib._Hash"
    notes: tuple[str, ...]


def look_over(path: Path, declared: str | None, where: str) -> Text:
    """Hash a file and make sure that all of it can be decoded, in one pass.

    Args:
        path: the file.
        declared: encoding that the user gave.
        where: how the user gives one, for messages.

    Raises:
        MeasurementError: cannot be read, or is not text in that encoding; names line and byte.
    """
    try:
        with path.open("rb") as file:
            head = file.read(4096)
            encoding = declared or _by_mark(head, path, where)
            if declared == "utf-8" and head.startswith(codecs.BOM_UTF8):
                encoding = "utf-8-sig"
            file.seek(0)
            digest = _pass(file, encoding, path, where)
    except FileNotFoundError as e:
        raise MeasurementError(f"{path}: no such file") from e
    except OSError as e:
        raise MeasurementError(f"{path}: cannot be read: {e.strerror}") from e
    notes = () if encoding == "utf-8" else (f"text is {encoding}" + ("" if declared else ", by its byte order mark"),)
    return Text(encoding, digest, notes)


def _by_mark(head: bytes, path: Path, where: str) -> str:
    for mark, name in MARKS:
        if head.startswith(mark):
            return name
    if b"\0" in head:
        half = "utf-16-le" if head[1::2].count(0) >= head[::2].count(0) else "utf-16-be"
        raise MeasurementError(
            f"{path}: holds zero bytes and no byte order mark; if it is UTF-16 text, say so: "
            f"{where} encoding = {half!r}"
        )
    return "utf-8"


def _pass(file: BinaryIO, encoding: str, path: Path, where: str) -> "hashlib._Hash":
    digest = hashlib.sha256()
    decoder = codecs.getincrementaldecoder(encoding)()
    plain = encoding in ("utf-8", "utf-8-sig", "latin-1", "cp1252")
    at, lines = 0, 0
    while block := file.read(BLOCK):
        digest.update(block)
        pending = len(decoder.getstate()[0])
        if pending or not (plain and block.isascii()):
            try:
                decoder.decode(block)
            except UnicodeDecodeError as e:
                raise MeasurementError(_undecodable(e, at - pending, lines, path, encoding, where)) from e
        at += len(block)
        lines += block.count(b"\n")
    try:
        decoder.decode(b"", final=True)
    except UnicodeDecodeError as e:
        raise MeasurementError(f"{path}: ends in the middle of a {encoding} character; is it whole?") from e
    return digest


def _undecodable(e: UnicodeDecodeError, at: int, lines: int, path: Path, encoding: str, where: str) -> str:
    data = bytes(e.object)
    line = lines + data[: e.start].count(b"\n") + 1
    start = data.rfind(b"\n", 0, e.start) + 1
    text = data[start : e.start + 12].split(b"\n")[0].decode("latin-1")
    # What Windows programs write for ° and µ; the rest of that range is text in another alphabet.
    likely = "latin-1" if data[e.start] >= 0xA0 else "cp1252"
    other = f"; if it is {likely}, say so: {where} encoding = {likely!r}" if encoding.startswith("utf-8") else ""
    return (
        f"{path}: line {line}: byte 0x{data[e.start]:02X} (byte {at + e.start} of the file, in {text!r}) "
        f"is no {encoding} text{other}"
    )
