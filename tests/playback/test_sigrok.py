"""Captures written and read back, and every kind of bad file refused with a message that says what is wrong.

Oracle of the round trips: the samples that went in; sigrok's own reading is in tests/real/test_captures.py.
"""

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtec.errors import LogError
from rtec.playback import sigrok
from rtec.playback.sigrok import Capture, read, write

METADATA = """[global]
sigrok version = 0.2.1
[device 1]
driver = fx2lafw
capturefile = logic-1
unitsize = 1
total probes = 4
samplerate = 1 MHz
probe1 = A=1
probe2 = B [x]
probe4 = Z
"""


def archive(path: Path, **entries: bytes | str) -> Path:
    """A zip with these entries; `logic_1_2` stands for `logic-1-2`."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as made:
        for name, data in entries.items():
            made.writestr(name.replace("_", "-"), data)
    return path


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.uint32, np.uint64])
def test_what_was_written_is_read(dtype: type[np.unsignedinteger[Any]], tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    bits = 8 * np.dtype(dtype).itemsize
    samples = rng.integers(0, np.iinfo(dtype).max, 3_000_000 // bits, dtype=dtype, endpoint=True)
    names = tuple(f"line {bit}" for bit in range(bits - 1))
    write(tmp_path / "a.sr", Capture(24_000_000, names, samples))
    got = read(tmp_path / "a.sr")
    assert (got.samplerate_hz, got.channels, got.samples.dtype) == (24_000_000, names, samples.dtype)
    np.testing.assert_array_equal(got.samples, samples)
    last = bits - 2
    np.testing.assert_array_equal(got.line(names[last]), (samples >> dtype(last)).astype(np.uint64) & 1)
    both, a_bit, b_bit = got.pair(names[last], names[0])
    np.testing.assert_array_equal((both >> a_bit) & 1, got.line(names[last]))
    np.testing.assert_array_equal((both >> b_bit) & 1, got.line(names[0]))


def test_many_parts_are_joined_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Twelve parts: part 10 comes after part 9, not after part 1."""
    monkeypatch.setattr(sigrok, "PART_BYTES", 10)
    samples = np.arange(115, dtype=np.uint8)
    write(tmp_path / "a.sr", Capture(1000, ("A", "B"), samples))
    with zipfile.ZipFile(tmp_path / "a.sr") as made:
        assert "logic-1-12" in made.namelist()
    np.testing.assert_array_equal(read(tmp_path / "a.sr").samples, samples)


def test_the_same_capture_gives_the_same_bytes(tmp_path: Path) -> None:
    capture = Capture(1000, ("A", "B"), np.arange(100, dtype=np.uint8))
    write(tmp_path / "a.sr", capture)
    write(tmp_path / "b.sr", capture)
    assert (tmp_path / "a.sr").read_bytes() == (tmp_path / "b.sr").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.sr", "b.sr"]


@pytest.mark.parametrize("version", ["1", "2"])
def test_old_and_new_layout(version: str, tmp_path: Path) -> None:
    """Oracle: the metadata above by hand; a name may hold any character, a bit may have no name."""
    capture = read(archive(tmp_path / "a.sr", version=version, metadata=METADATA, logic_1=b"\x00\x01\x0b"))
    assert capture.samplerate_hz == 1_000_000
    assert capture.channels == ("A=1", "B [x]", "", "Z")
    assert capture.line("Z").tolist() == [0, 0, 1]


@pytest.mark.parametrize(
    ("text", "hz"),
    [("200 kHz", 200_000), ("1.5 MHz", 1_500_000), ("48000", 48_000), ("12 Hz", 12), ("1GHz", 10**9)],
)
def test_sample_rates(text: str, hz: int, tmp_path: Path) -> None:
    path = archive(tmp_path / "a.sr", version="2", metadata=METADATA.replace("1 MHz", text), logic_1=b"\x00")
    assert read(path).samplerate_hz == hz


def test_three_byte_samples(tmp_path: Path) -> None:
    metadata = METADATA.replace("unitsize = 1", "unitsize = 3").replace("probe4", "probe20")
    capture = read(archive(tmp_path / "a.sr", version="2", metadata=metadata, logic_1=b"\x01\x00\x08\x02\x00\x00"))
    assert capture.samples.tolist() == [0x080001, 2]
    assert capture.line("Z").tolist() == [1, 0]


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "no version": ({"metadata": METADATA, "logic_1": b"0"}, "no 'version' in it"),
    "future version": ({"version": "3", "metadata": METADATA, "logic_1": b"0"}, "version '3'; known: 1 and 2"),
    "no metadata": ({"version": "2", "logic_1": b"0"}, "no 'metadata' in it"),
    "not text": ({"version": "2", "metadata": b"\xff\xfe", "logic_1": b"0"}, "damaged"),
    "no device": ({"version": "2", "metadata": "[global]\na=1\n", "logic_1": b"0"}, r"no section \[device 1\]"),
    "no logic": ({"version": "2", "metadata": METADATA}, "logic data 'logic-1'.*missing"),
    "a part missing": ({"version": "2", "metadata": METADATA, "logic_1_1": b"0", "logic_1_3": b"0"}, r"\[1, 3\]"),
    "half a sample": (
        {"version": "2", "metadata": METADATA.replace("unitsize = 1", "unitsize = 2"), "logic_1": b"123"},
        "3 bytes of logic data are not whole samples of 2 bytes",
    ),
    "unitsize": ({"version": "2", "metadata": METADATA.replace("size = 1", "size = 9"), "logic_1": b"0"}, "1 to 8"),
    "no unitsize": ({"version": "2", "metadata": METADATA.replace("unit", "u"), "logic_1": b"0"}, "unitsize = ''"),
    "probe": ({"version": "2", "metadata": METADATA.replace("probe4", "probe9"), "logic_1": b"0"}, "probe9; .*8 bits"),
    "probe 0": ({"version": "2", "metadata": METADATA.replace("probe4", "probe0"), "logic_1": b"0"}, "8 bits"),
    "no probes": ({"version": "2", "metadata": METADATA.replace("probe", "p"), "logic_1": b"0"}, "names no channel"),
    "rate": ({"version": "2", "metadata": METADATA.replace("1 MHz", "fast"), "logic_1": b"0"}, "'fast'; needed"),
    "no rate": ({"version": "2", "metadata": METADATA.replace("1 MHz", "0 Hz"), "logic_1": b"0"}, "1 or more"),
    "bomb": (
        {"version": "2", "metadata": METADATA, "logic_1": bytes(2_000_001)},
        "2000001 bytes; the limit is 2000000",
    ),
    "bomb of parts": (
        {"version": "2", "metadata": METADATA, "logic_1_1": bytes(1_500_000), "logic_1_2": bytes(1_500_000)},
        "3000000 bytes; the limit is 2000000",
    ),
    "metadata bomb": ({"version": "2", "metadata": bytes(1 << 21), "logic_1": b"0"}, "metadata unpacks to 2097152"),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_files_are_refused_by_name(what: str, tmp_path: Path) -> None:
    entries, message = BAD[what]
    path = archive(tmp_path / "bad.sr", **entries)
    with pytest.raises(LogError, match=message) as caught:
        read(path, max_logic_bytes=2_000_000)
    assert str(path) in str(caught.value)


def test_not_a_zip_and_not_there(tmp_path: Path) -> None:
    (tmp_path / "a.sr").write_text("[device 1]")
    with pytest.raises(LogError, match="not a sigrok capture"):
        read(tmp_path / "a.sr")
    with pytest.raises(LogError, match="cannot be read"):
        read(tmp_path / "none.sr")


def reads_as(path: Path, samples: Any) -> bool:
    """Whether a file is read, and then rightly, or refused with its name in the message."""
    try:
        capture = read(path)
    except LogError as error:
        if str(path) not in str(error):
            raise
        return False
    np.testing.assert_array_equal(capture.samples, samples)
    return True


def test_cut_or_changed_files_are_refused(tmp_path: Path) -> None:
    """Cut anywhere, or with any byte of the samples changed: an error that names the file, or the same samples."""
    samples = np.random.default_rng(2).integers(0, 256, 500, dtype=np.uint8)
    write(tmp_path / "a.sr", Capture(1000, ("A", "B"), samples))
    good = (tmp_path / "a.sr").read_bytes()
    bad, refused = tmp_path / "bad.sr", 0
    for i in range(0, len(good), 3):
        bad.write_bytes(good[:i])
        with pytest.raises(LogError, match=r"bad\.sr"):
            read(bad)
        bad.write_bytes(good[:i] + bytes([good[i] ^ 0x10]) + good[i + 1 :])
        refused += not reads_as(bad, samples)
    assert refused > 150


def test_a_length_that_lies_is_found_out(tmp_path: Path) -> None:
    """A header that says 10 bytes for a million: never unpacked beyond 10, and refused by its checksum."""
    path = archive(tmp_path / "a.sr", version="2", metadata=METADATA, logic_1=bytes(1_000_000))
    lying = path.read_bytes().replace((1_000_000).to_bytes(4, "little"), (10).to_bytes(4, "little"))
    path.write_bytes(lying)
    with pytest.raises(LogError, match="damaged"):
        read(path)


def test_a_missing_channel_is_named_with_those_that_are_there() -> None:
    capture = Capture(1000, ("A", "", "Z", "Z"), np.zeros(1, np.uint8), "x.sr")
    with pytest.raises(LogError, match=r"x\.sr: no channel named 'B'; the channels are 'A', 'Z', 'Z'"):
        capture.pair("A", "B")
    with pytest.raises(LogError, match="no channel named ''"):
        capture.bit("")
    with pytest.raises(LogError, match="2 channels named 'Z'"):
        capture.line("Z")


@pytest.mark.parametrize(
    ("names", "dtype"),
    [(("A\nunitsize=9",), np.uint8), ((" A",), np.uint8), (("A",) * 9, np.uint8), (("A",), np.int8)],
)
def test_what_cannot_be_written_is_refused(names: tuple[str, ...], dtype: type, tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"cannot be written|do not fit"):
        write(tmp_path / "a.sr", Capture(1000, names, np.zeros(3, dtype)))
    with pytest.raises(LogError, match="cannot be written"):
        write(tmp_path / "none" / "a.sr", Capture(1000, ("A",), np.zeros(3, np.uint8)))
    assert list(tmp_path.iterdir()) == []
