"""The tutorial does what it says. Oracle: a shell that runs its commands, and the file of what was hidden."""

import re
from pathlib import Path

import numpy as np
import pytest

from rtec.machine import load_machine
from rtec.model import Model, load_model
from rtec.report.history import WHY_ENDED
from tests.tutorial.tutorial import FIGURES, ROOT, TUTORIAL, commands, run_all, take_figures

TEXT = TUTORIAL.read_text(encoding="utf-8")
MACHINE = ROOT / "configs" / "machines" / "turning-centre.toml"
LARGEST = 150_000


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[tuple[str, str]]]:
    """Every command run in a folder of its own."""
    folder = tmp_path_factory.mktemp("tutorial")
    return folder, run_all(folder)


def plain(text: str) -> str:
    """Without digits and line ends: what a machine's linear algebra may change, and the width of a terminal."""
    return re.sub(r"\d+", "#", " ".join(text.split()))


def test_every_command_ends_well(done: tuple[Path, list[tuple[str, str]]]) -> None:
    """Oracle: exit status, in `run_all`; the commands are those that a reader copies."""
    assert len(done[1]) == len(commands(TEXT)) == 13
    assert "ready to run" in done[1][-1][1]


def test_it_prints_what_the_page_quotes(done: tuple[Path, list[tuple[str, str]]]) -> None:
    """Oracle: the output itself."""
    printed = plain("\n".join(out for _, out in done[1]))
    quotes = re.findall(r"^```text\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL)
    assert len(quotes) == 7
    for quote in quotes:
        assert plain(quote) in printed, quote


def numbers(model: Model) -> dict[str, float]:
    return {f"{f.label} {n}": v for f in model.effects for n, v in f.values.items()}


def test_what_was_hidden_is_found(done: tuple[Path, list[tuple[str, str]]]) -> None:
    """Oracle: the file that the reader was not to open."""
    machine = load_machine(MACHINE)
    true = numbers(load_model(ROOT / "configs" / "tutorial" / "hidden.toml", machine))
    best = load_model(done[0] / "out" / "tutorial" / "best.toml", machine)
    found = numbers(best)
    assert set(found) == set(true)
    errors = {f"{f.label} {n}": f.errors[n] for f in best.effects for n in f.values}
    off = np.array([(found[n] - true[n]) / errors[n] for n in true])
    assert np.abs(off).max() < 4.0, off
    # What the page says of them, and why it ended.
    assert (np.abs(off) < 1.0).sum() == 3
    assert f"{found['scale(EXX, X) k']:.1f} ± {errors['scale(EXX, X) k']:.1f} µm/m instead of 14.0" in TEXT
    (ended,) = [out for command, out in done[1] if command.startswith("rtec improve")]
    (why,) = [words for words in WHY_ENDED.values() if words in " ".join(ended.split())]
    assert why in " ".join(TEXT.split())


def test_error_falls_to_the_noise(done: tuple[Path, list[tuple[str, str]]]) -> None:
    """Oracle: the noise that was simulated, 0.25 µm white and 0.15 µm of drift."""
    last = load_model(done[0] / "out" / "tutorial" / "best.toml", load_machine(MACHINE)).history[-1]
    assert last["rms_after"] == pytest.approx(np.hypot(0.25, 0.15), rel=0.1)


def test_figures(done: tuple[Path, list[tuple[str, str]]], tmp_path: Path) -> None:
    """Oracle: the page's own links; the shipped ones are small, and pictures of the same size as those made now."""
    from matplotlib.image import imread

    take_figures(done[0], tmp_path)
    shown = set(re.findall(r"\(figures/(.*?)\)", TEXT))
    assert shown == set(FIGURES)
    for name in FIGURES:
        shipped = ROOT / "docs" / "figures" / name
        assert shipped.stat().st_size < LARGEST
        assert imread(shipped).shape[1] == imread(tmp_path / name).shape[1]
