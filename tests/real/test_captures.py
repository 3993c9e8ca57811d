"""Real encoder signals, captured by others with a logic analyser, through the decoder and the inserter.

Oracles: two decoders devised here, that share nothing with the project's (a walk from edge to edge over a table of
line levels, and phase unwrapping with numpy), and sigrok's own command line for the files.
"""

import shutil
import subprocess
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.correction.insertion import InsertionSettings, correct_capture
from rtec.correction.quadrature import counts_at, decode, decode_edges
from rtec.playback.sigrok import Capture, read, write
from tests.support.real_data import real_file

Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]

X, Y, ROTARY = ("MODE/XA", "RB/XB"), ("LB/YA", "MB/YB"), ("0", "1")
MOUSE = [f"agilent_hdns_2000_move_mouse_{how}.sr" for how in ("fast", "left_right", "up_down")]
PAIRS = [(name, *pair) for name in MOUSE for pair in (X, Y)]
PAIRS += [(name, *ROTARY) for name in ("rotary-ramp.sr", "rotary-sin.sr")]

every_pair = pytest.mark.parametrize(("name", "a", "b"), PAIRS, ids=[f"{n[-12:-3]} {a}" for n, a, _ in PAIRS])
every_mode = pytest.mark.parametrize(
    "limits", [InsertionSettings(10, 50, "count"), InsertionSettings(10, 50, "cycle")], ids=["count", "cycle"]
)


@cache
def lines(name: str, a: str, b: str) -> tuple[Bytes, Bytes]:
    capture = read(real_file("quadrature", name))
    return capture.line(a), capture.line(b)


def edge_walk(a: Bytes, b: Bytes) -> tuple[Ints, list[int]]:
    """First oracle: go from change to change in plain Python; count at every sample, and the illegal samples."""
    follows = {(0, 0): (1, 0), (1, 0): (1, 1), (1, 1): (0, 1), (0, 1): (0, 0)}  # A leads B: up
    at = np.flatnonzero((a[1:] != a[:-1]) | (b[1:] != b[:-1])) + 1
    level, step, illegal = (int(a[0]), int(b[0])), np.zeros(len(a), np.int64), []
    for i, new in zip(at.tolist(), zip(a[at].tolist(), b[at].tolist(), strict=True), strict=True):
        if follows[level] == new:
            step[i] = 1
        elif follows[new] == level:
            step[i] = -1
        else:
            illegal.append(i)
        level = new
    return np.cumsum(step), illegal


def unwrapped(a: Bytes, b: Bytes) -> tuple[Ints, list[int]]:
    """Second oracle: how the angle of the two lines, in quarter turns, changes; half turns are illegal."""
    angle = np.array([[0, 3], [1, 2]], np.int8)[a, b]
    step = (np.diff(angle, prepend=angle[:1]) + 1) % 4 - 1
    half = step == 2
    return np.cumsum(np.where(half, 0, step), dtype=np.int64), np.flatnonzero(half).tolist()


DECODERS = (edge_walk, unwrapped)


@cache
def by_both(name: str, a: str, b: str) -> tuple[tuple[Ints, list[int]], ...]:
    """A capture as it is, by each oracle."""
    return tuple(decoder(*lines(name, a, b)) for decoder in DECODERS)


def wandering_target(n: int, seed: int) -> tuple[Ints, Ints]:
    """A target that goes up and down by some tens of counts over the record; it rests for the last tenth."""
    rng = np.random.default_rng(seed)
    at = np.sort(rng.integers(0, n * 9 // 10, 60))
    return at, np.cumsum(rng.integers(-12, 13, 60))


@every_pair
def test_three_decoders_agree(name: str, a: str, b: str) -> None:
    capture = read(real_file("quadrature", name))
    (walk, walk_illegal), (angle, angle_illegal) = by_both(name, a, b)
    edges = decode_edges(*capture.pair(a, b))
    np.testing.assert_array_equal(walk, angle)
    np.testing.assert_array_equal(walk, counts_at(edges, np.arange(len(walk))))
    assert walk_illegal == angle_illegal == edges.illegal_index.tolist()
    total = decode(*capture.pair(a, b))
    assert (total.counts, total.illegal) == (walk[-1], len(walk_illegal))
    assert total.edges > 0, "a capture without an edge would prove nothing"


@every_mode
@every_pair
def test_corrected_is_raw_plus_inserted(name: str, a: str, b: str, limits: InsertionSettings) -> None:
    """At every sample, by both oracles; and no illegal transition that was not in the input."""
    raw = lines(name, a, b)
    at, counts = wandering_target(len(raw[0]), seed=len(name))
    out, ledger = correct_capture(*raw, None, limits, target_at=at, target_counts=counts)
    inserted = np.zeros(len(raw[0]), np.int64)
    inserted[out.insertion_at] = out.insertion_delta
    for decoder, (before, before_illegal) in zip(DECODERS, by_both(name, a, b), strict=True):
        after, after_illegal = decoder(out.a, out.b)
        np.testing.assert_array_equal(before + np.cumsum(inserted), after)
        assert after_illegal == before_illegal
        assert (ledger.raw_counts, ledger.corrected_counts) == (before[-1], after[-1])
    assert np.abs(inserted).sum() > 20, "the target wanders; a corrector that does nothing proves nothing"
    assert np.diff(out.insertion_at).min() >= limits.min_insertion_interval_samples
    if limits.mode == "cycle":
        assert ledger.waiting_counts == 0
        assert ledger.inserted_counts % 4 == 0
    else:
        assert ledger.inserted_counts + ledger.waiting_counts == counts[-1]


@every_mode
def test_an_under_sampled_capture_keeps_its_illegal_transitions(limits: InsertionSettings) -> None:
    """Every 100th sample of the fastest capture: edges 78 samples apart now fall together. Oracles as above."""
    a, b = (line[::100].copy() for line in lines(MOUSE[0], *X))
    at, counts = wandering_target(len(a), seed=3)
    out, ledger = correct_capture(a, b, None, limits, target_at=at, target_counts=counts)
    walk, illegal = edge_walk(a, b)
    after, after_illegal = edge_walk(out.a, out.b)
    assert len(illegal) > 10
    assert after_illegal == illegal == unwrapped(out.a, out.b)[1]
    assert ledger.illegal_transitions == len(illegal)
    assert after[-1] == walk[-1] + ledger.inserted_counts


def test_the_index_line_of_a_capture_is_bit_identical() -> None:
    """A line of the other axis stands in for an index: it moves often, and when it likes."""
    capture = read(real_file("quadrature", MOUSE[0]))
    z = capture.line("MB/YB")
    limits = InsertionSettings(10, 50)
    out, _ = correct_capture(*lines(MOUSE[0], *X), z, limits, target_at=[0], target_counts=[500])
    assert np.count_nonzero(np.diff(z)) > 100
    np.testing.assert_array_equal(out.z, z)


@every_pair
def test_sigrok_opens_what_was_written(name: str, a: str, b: str, tmp_path: Path) -> None:
    """Oracle: sigrok-cli's own reading of rate, channels, and every sample."""
    if shutil.which("sigrok-cli") is None:
        pytest.skip("sigrok-cli is not installed (apt-get install sigrok-cli)")
    source = read(real_file("quadrature", name))
    raw = lines(name, a, b)
    limits = InsertionSettings(10, 50)
    out, _ = correct_capture(*raw, None, limits, target_at=[1000], target_counts=[40])
    samples = raw[0] | (raw[1] << 1) | (out.a << 2) | (out.b << 3)
    path = tmp_path / "corrected.sr"
    names = ("A", "B", "A corrected", "B corrected")
    write(path, Capture(source.samplerate_hz, names, samples.astype(np.uint8)))
    shown = subprocess.run(
        ["sigrok-cli", "-i", str(path), "--show"], capture_output=True, text=True, timeout=60, check=True
    ).stdout
    assert f"Samplerate: {source.samplerate_hz}\n" in shown
    assert f"Logic sample count: {len(samples)}\n" in shown
    assert [line[2 : line.index(":")] for line in shown.splitlines() if line.startswith("- ")] == list(names)
    export = ["sigrok-cli", "-i", str(path), "-O", "binary"]
    binary = subprocess.run(export, capture_output=True, timeout=60, check=True).stdout
    np.testing.assert_array_equal(np.frombuffer(binary, np.uint8), samples)


@pytest.mark.parametrize("name", [*MOUSE, "rotary-ramp.sr", "rotary-sin.sr"])
def test_reads_what_sigrok_reads(name: str) -> None:
    """Oracle: sigrok-cli's export of the captures as they are."""
    if shutil.which("sigrok-cli") is None:
        pytest.skip("sigrok-cli is not installed (apt-get install sigrok-cli)")
    path = real_file("quadrature", name)
    export = ["sigrok-cli", "-i", str(path), "-O", "binary"]
    binary = subprocess.run(export, capture_output=True, timeout=60, check=True).stdout
    np.testing.assert_array_equal(np.frombuffer(binary, np.uint8), read(path).samples)
