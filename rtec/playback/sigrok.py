"""Logic-analyser captures in sigrok's session format (`.sr`), read and written without sigrok.

A `.sr` file is a zip of `version` ("1" or "2"), `metadata` (an ini file) and the samples: one entry `logic-1`, or in
version 2 also parts `logic-1-1`, `logic-1-2`, and so on. A sample is `unitsize` bytes, little-endian; channel N of the
metadata (`probeN`) is bit N-1. Only the first device's logic channels are read. Nothing in a file is ever executed,
and nothing is unpacked that is larger than the limit.
"""

import re
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtec.errors import LogError
from rtec.files import whole

MAX_LOGIC_BYTES = 1 << 30
"""Default limit of the unpacked samples for `read`, bytes."""
MAX_TEXT_BYTES = 1 << 20
PART_BYTES = 4 << 20
"""Largest part that `write` makes, bytes of samples."""

_PACKED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_LONG_AGO = (1980, 1, 1, 0, 0, 0)
_HZ = {"": 1, "k": 10**3, "M": 10**6, "G": 10**9}


@dataclass(frozen=True)
class Capture:
    """Samples of a logic analyser.

    Attributes:
        samplerate_hz: samples a second.
        channels: name of each bit, lowest bit first; "" for a bit that was not recorded.
        samples: one unsigned integer a sample, 1, 2, 4 or 8 bytes wide, (n,).
        source: the file's name, for messages.
    """

    samplerate_hz: int
    channels: tuple[str, ...]
    samples: NDArray[Any]
    source: str = "capture"

    def bit(self, name: str) -> int:
        """Bit of a channel.

        Raises:
            LogError: no channel, or two, have that name; the message lists the channels.
        """
        places = [bit for bit, channel in enumerate(self.channels) if channel == name and name]
        if len(places) != 1:
            there = ", ".join(repr(channel) for channel in self.channels if channel) or "none"
            what = "no channel" if not places else f"{len(places)} channels"
            raise LogError(f"{self.source}: {what} named {name!r}; the channels are {there}")
        return places[0]

    def line(self, name: str) -> NDArray[np.uint8]:
        """One channel, 0 or 1 a sample, (n,); raises as `bit` does."""
        shifted = self.samples >> self.samples.dtype.type(self.bit(name))
        line: NDArray[np.uint8] = (shifted & self.samples.dtype.type(1)).astype(np.uint8)
        return line

    def pair(self, a: str, b: str) -> tuple[NDArray[np.uint8], int, int]:
        """Two channels for the decoder: one-byte samples and the bits of A and B; raises as `bit` does.

        One-byte captures are not copied.
        """
        if self.samples.dtype == np.uint8:
            return self.samples, self.bit(a), self.bit(b)
        both: NDArray[np.uint8] = np.bitwise_or(self.line(a), 2 * self.line(b))
        return both, 0, 1


def read(path: Path, max_logic_bytes: int = MAX_LOGIC_BYTES) -> Capture:
    """Read a capture of version 1 or 2.

    Args:
        path: the `.sr` file.
        max_logic_bytes: largest allowed size of the unpacked samples.

    Raises:
        LogError: the file cannot be read, is no capture, is truncated, or is too large.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return _read_archive(archive, str(path), max_logic_bytes)
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, NotImplementedError, ValueError) as error:
        raise LogError(f"{path}: not a sigrok capture, or damaged: {error}") from error


def write(path: Path, capture: Capture) -> None:
    """Write a capture as a version 2 file that sigrok opens; the same capture gives the same bytes.

    The file appears only when it is complete.

    Raises:
        LogError: a channel name cannot be written, there are more names than bits, or the disk fails.
    """
    width = capture.samples.dtype.itemsize
    if len(capture.channels) > 8 * width or capture.samples.dtype.kind != "u":
        raise LogError(f"{path}: {len(capture.channels)} channels do not fit samples of {capture.samples.dtype}")
    for name in capture.channels:
        if name != name.strip() or not (name.isprintable()):
            raise LogError(f"{path}: channel name {name!r} cannot be written")
    with whole(path, LogError) as out, zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        _write_archive(archive, capture)


def _read_archive(archive: zipfile.ZipFile, source: str, max_logic_bytes: int) -> Capture:
    version = _text(archive, "version", source).strip()
    if version not in ("1", "2"):
        raise LogError(f"{source}: session format version {version!r}; known: 1 and 2")
    device = _device(_text(archive, "metadata", source), source)
    if "capturefile" not in device:
        raise LogError(f"{source}: metadata: [device 1] has no capturefile: there are no logic channels")
    unit = _whole(device, "unitsize", source)
    if not 1 <= unit <= 8:
        raise LogError(f"{source}: metadata: unitsize = {unit}; allowed: 1 to 8 bytes")
    channels = _channels(device, 8 * unit, source)
    data = _logic(archive, device["capturefile"], source, max_logic_bytes)
    if len(data) % unit:
        raise LogError(f"{source}: {len(data)} bytes of logic data are not whole samples of {unit} bytes: cut short?")
    return Capture(_samplerate_hz(device, source), channels, _widened(data, unit), source)


def _unpack(archive: zipfile.ZipFile, info: zipfile.ZipInfo, source: str, limit: int) -> bytes:
    """Unpack one entry, if its header's length is within the limit; a longer entry fails by its checksum."""
    if info.compress_type not in _PACKED:
        raise LogError(f"{source}: {info.filename} is packed in a way that sigrok does not use")
    if info.file_size > limit:
        raise LogError(f"{source}: {info.filename} unpacks to {info.file_size} bytes; the limit is {limit}")
    with archive.open(info) as stream:
        data = stream.read(max(1, info.file_size))  # never more than the header's length, whatever is packed
    if len(data) != info.file_size:
        raise LogError(f"{source}: {info.filename}: {len(data)} of {info.file_size} bytes: cut short")
    return data


def _text(archive: zipfile.ZipFile, name: str, source: str) -> str:
    if name not in archive.namelist():
        raise LogError(f"{source}: no {name!r} in it: not a sigrok capture")
    return _unpack(archive, archive.getinfo(name), source, MAX_TEXT_BYTES).decode("utf-8")


def _device(metadata: str, source: str) -> dict[str, str]:
    """Keys of the section [device 1]; a channel's name may hold any character."""
    sections: dict[str, dict[str, str]] = {}
    keys: dict[str, str] = {}
    for line in (line.strip() for line in metadata.splitlines()):
        if line.startswith("[") and line.endswith("]"):
            keys = sections.setdefault(line[1:-1], {})
        elif "=" in line and not line.startswith(("#", ";")):
            key, _, value = line.partition("=")
            keys[key.strip()] = value.strip()
    if "device 1" not in sections:
        raise LogError(f"{source}: metadata: no section [device 1]; there are {sorted(sections) or 'none'}")
    return sections["device 1"]


def _whole(device: dict[str, str], key: str, source: str) -> int:
    text = device.get(key, "")
    if not re.fullmatch(r"[0-9]{1,9}", text):
        raise LogError(f"{source}: metadata: [device 1] {key} = {text!r}; needed: a whole number")
    return int(text)


def _samplerate_hz(device: dict[str, str], source: str) -> int:
    text = device.get("samplerate", "")
    match = re.fullmatch(r"([0-9]{1,12})(?:\.([0-9]{1,9}))?\s*([kMG]?)(?:Hz)?", text)
    if match is None:
        raise LogError(f"{source}: metadata: [device 1] samplerate = {text!r}; needed: such as '1 MHz'")
    fraction = match[2] or ""
    scale: int = 10 ** len(fraction)
    rate, rest = divmod(int(match[1] + fraction) * _HZ[match[3]], scale)
    if rest or rate == 0:
        raise LogError(f"{source}: metadata: [device 1] samplerate = {text!r}; needed: whole hertz, 1 or more")
    return rate


def _channels(device: dict[str, str], bits: int, source: str) -> tuple[str, ...]:
    names = {int(key[5:]): name for key, name in device.items() if re.fullmatch(r"probe[0-9]{1,4}", key)}
    if not names:
        raise LogError(f"{source}: metadata: [device 1] names no channel (probe1, probe2, ...)")
    if min(names) < 1 or max(names) > bits:
        raise LogError(f"{source}: metadata: probe{max(names)}; samples have {bits} bits")
    return tuple(names.get(number, "") for number in range(1, max(names) + 1))


def _logic(archive: zipfile.ZipFile, stem: str, source: str, limit: int) -> bytes:
    """Unpack the samples: the one entry, or all parts in the order of their numbers."""
    numbered = re.compile(re.escape(stem) + r"-([0-9]{1,6})")
    parts = {int(match[1]): match[0] for match in map(numbered.fullmatch, archive.namelist()) if match}
    if stem in archive.namelist():
        parts = {1: stem}
    if sorted(parts) != list(range(1, len(parts) + 1)) or not parts:
        raise LogError(f"{source}: logic data {stem!r}: parts {sorted(parts)} are there; a part is missing")
    infos = [archive.getinfo(parts[number]) for number in sorted(parts)]
    total = sum(info.file_size for info in infos)
    if total > limit:
        raise LogError(f"{source}: logic data unpack to {total} bytes; the limit is {limit}")
    return b"".join(_unpack(archive, info, source, limit) for info in infos)


def _widened(data: bytes, unit: int) -> NDArray[Any]:
    """Samples as integers of the next larger standard width."""
    width = next(width for width in (1, 2, 4, 8) if width >= unit)
    if width != unit:
        wide = np.zeros((len(data) // unit, width), np.uint8)
        wide[:, :unit] = np.frombuffer(data, np.uint8).reshape(-1, unit)
        data = wide.tobytes()
    return np.frombuffer(data, np.dtype(f"<u{width}"))


def _write_archive(archive: zipfile.ZipFile, capture: Capture) -> None:
    width = capture.samples.dtype.itemsize
    probes = [f"probe{bit + 1}={name}" for bit, name in enumerate(capture.channels) if name]
    device = [
        "[device 1]",
        "capturefile=logic-1",
        f"total probes={len(capture.channels)}",
        f"samplerate={capture.samplerate_hz} Hz",
        "total analog=0",
        *probes,
        f"unitsize={width}",
    ]
    _add(archive, "version", b"2")
    _add(archive, "metadata", "\n".join(["[global]", "sigrok version=0.5.2", "", *device, ""]).encode())
    samples = np.ascontiguousarray(capture.samples, capture.samples.dtype.newbyteorder("<"))
    step = PART_BYTES // width
    for number, start in enumerate(range(0, max(1, len(samples)), step), 1):
        _add(archive, f"logic-1-{number}", samples[start : start + step].tobytes())


def _add(archive: zipfile.ZipFile, name: str, data: bytes) -> None:
    info = zipfile.ZipInfo(name, _LONG_AGO)
    info.compress_type = zipfile.ZIP_DEFLATED
    archive.writestr(info, data)
