"""The demo, a short day through the same code: its numbers, its sums, and what it writes."""

import json
import re
import shutil
from dataclasses import fields, replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.cli import main
from rtec.correction.flags import MODE_OFF
from rtec.demo import figures, page, story, training
from rtec.demo.day import CYLINDER, FACE, SHOULDER, Plan, Track
from rtec.demo.live import RATE_HZ, corrected, uncorrected
from rtec.demo.story import TRUTH_FILE, Story, config_folder, tell_story
from rtec.errors import ConfigError, RtecError
from rtec.model import Model, load_model
from rtec.report import page as report_page
from rtec.report.page import Page
from rtec.sim.truth import Truth, load_truth

Floats = NDArray[np.float64]
SEED = 1
"""That of the shipped model, whose measuring day is then the story's."""
SHORT = Plan(warm_h=1.0, night_h=2.0)
SHORTER = Plan(warm_h=0.5, night_h=0.0)
CONFIGS = config_folder()


@pytest.fixture(scope="module")
def told() -> Story:
    return tell_story(SEED, CONFIGS, lambda *_: None, SHORT)


@pytest.fixture(scope="module")
def truth() -> Truth:
    return load_truth(CONFIGS / TRUTH_FILE)


@pytest.fixture(scope="module")
def day(told: Story, truth: Truth) -> training.MeasuringDay:
    """The measuring day once more, outside of the story."""
    return training.measure(told.model.machine, truth, SEED + 1)


@pytest.fixture(scope="module")
def bare(told: Story, truth: Truth) -> Track:
    """Half an hour without any loop around the machine."""
    return uncorrected(told.model.machine, truth, SEED, SHORTER)


class Made(NamedTuple):
    """The page, drawn once, and what was handed to the figures that show both days."""

    page: Page
    drawn: list[tuple[object, ...]]


@pytest.fixture(scope="module")
def made(told: Story) -> Made:
    drawn: list[tuple[object, ...]] = []
    with pytest.MonkeyPatch.context() as m:
        for name in ("over_time", "straightness_bars", "profiles"):
            draw = getattr(figures, name)

            def spied(*given: Any, draw: Any = draw) -> bytes:
                drawn.extend(next(g for g in given if isinstance(g, list)))
                return bytes(draw(*given))

            m.setattr(figures, name, spied)
        return Made(page.page_of(told), drawn)


@pytest.fixture(scope="module")
def written(told: Story, made: Made, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demo")
    with pytest.MonkeyPatch.context() as m:
        m.setattr(page, "page_of", lambda story: made.page if story is told else pytest.fail("another story"))
        assert page.write_report(told, folder) == folder / "report.html"
    return folder


def binned(track: Track, part: int, surface: int, across: int) -> tuple[Floats, Floats]:
    """Places every 2.5 mm and the mean error there, by a plain loop."""
    rows = (track.part == part) & (track.surface == surface)
    places = track.commanded_mm[rows, 1 if surface == CYLINDER else 0]
    cells: dict[int, list[float]] = {}
    for place, error in zip(places, track.tip_um[rows, across], strict=True):
        cells.setdefault(int(place // 2.5), []).append(error)
    return np.array(sorted(cells)) * 2.5, np.array([np.mean(cells[c]) for c in sorted(cells)])


def straight(place: Floats, error: Floats) -> float:
    design = np.stack([place, np.ones_like(place)], axis=1)
    left = error - design @ np.linalg.lstsq(design, error, rcond=None)[0]
    return float(left.max() - left.min())


def worst(track: Track) -> dict[str, float]:
    """Largest error of each kind from the raw tip errors."""
    parts = range(track.part.max() + 1)
    lines = [binned(track, p, CYLINDER, 0) for p in parts]
    faces, shoulders = ([binned(track, p, s, 2) for p in parts] for s in (FACE, SHOULDER))
    lengths = [float(np.mean(f[1]) - np.mean(s[1])) for f, s in zip(faces, shoulders, strict=True)]
    offset = float(np.mean(lines[0][1]))
    stretches = [
        straight(at[i : i + 29], error[i : i + 29])  # 29 places are 28 steps of 2.5 mm: 70 mm
        for at, error in lines
        for i in range(0, len(at) - 28, 2)
    ]
    return {
        "diameter": max(float(np.abs(2 * (error - offset)).max()) for _, error in lines),
        "length": max(abs(length - lengths[0]) for length in lengths),
        "straightness": max(stretches),
        "face straightness": max(straight(*f) for f in faces),
    }


def test_factors_from_raw_tip_errors(told: Story) -> None:
    """Oracle: the same sizes worked out here, by loops, from the recorded tip errors."""
    off, on = worst(told.off), worst(told.on)
    for row in told.facts()["errors"]:
        assert row["off_largest_um"] == pytest.approx(off[row["error"]], rel=1e-9)
        assert row["on_largest_um"] == pytest.approx(on[row["error"]], rel=1e-9)
        assert row["factor_largest"] == pytest.approx(off[row["error"]] / on[row["error"]], rel=1e-9)


def test_correction_helps(told: Story) -> None:
    """Oracle: an hour of warming up grows the uncorrected diameter by 20 µm and more; NIST's factors are of a day."""
    found = {row["error"]: row for row in told.facts()["errors"]}
    assert found["diameter"]["off_largest_um"] > 20.0
    assert found["diameter"]["factor_largest"] > 4.0
    assert found["straightness"]["factor_largest"] > 1.3
    assert told.held_share == 0.0


def test_raw_and_inserted_are_what_the_controller_sees(told: Story) -> None:
    """Oracle: the simulated controller's own numbers; its following error, which is small only if it uses them."""
    side, track = told.side, told.on
    np.testing.assert_array_equal(side.samples.counts, track.raw_counts)
    np.testing.assert_array_equal(side.samples.counts + side.commands.output, side.seen_counts)
    assert np.abs(side.commands.output).max() > 10
    cutting = track.surface >= 0
    per_mm = np.array([a.counts_per_mm for a in told.model.machine.axes])
    behind_um = 1e3 * (track.commanded_mm - side.seen_counts / per_mm)[cutting]
    assert np.abs(behind_um).max() < 6.0
    assert np.abs(behind_um).mean() < 1.0


def test_the_days_are_the_same_day(told: Story) -> None:
    """Oracle: the correction moves slides by µm, so what heats the machine is the same with and without it."""
    np.testing.assert_array_equal(told.off.time_ns, told.on.time_ns)
    np.testing.assert_array_equal(told.off.part, told.on.part)
    np.testing.assert_allclose(told.off.body_degc, told.on.body_degc, atol=0.01)


def test_loop_with_correction_off_is_the_uncorrected_day(told: Story, bare: Track) -> None:
    """Oracle: the machine without any loop around it."""
    looped, side = corrected(told.model, CONFIGS / TRUTH_FILE, SEED, SHORTER, MODE_OFF)
    assert not side.commands.output.any()
    for name in (f.name for f in fields(Track)):
        if name in ("tip_um", "geometric_um"):  # worked out in blocks of other lengths: the last bits differ
            np.testing.assert_allclose(getattr(looped, name), getattr(bare, name), rtol=0, atol=1e-7)
        else:
            np.testing.assert_array_equal(getattr(looped, name), getattr(bare, name), err_msg=name)


def test_parts_of_the_leftover_sum_to_the_whole(told: Story) -> None:
    """Oracle: the recorded tip error itself, counted from the first part's mean. Servo, counts, ledger and geometry
    come from different records, so the sum holds only if these agree."""
    left, track = told.sources, told.on
    seen = track.surface >= 0
    tip = np.where(track.surface == CYLINDER, track.tip_um[:, 0], track.tip_um[:, 2])[seen]
    cylinder, first = track.surface[seen] == CYLINDER, track.part[seen] == 0
    for group in (cylinder, ~cylinder):
        tip[group] -= tip[group & first].mean()
    np.testing.assert_allclose(left.parts_um.sum(axis=0), tip, atol=1e-6)
    assert {name for name, _, _ in left.sizes()} == {*left.names, "all together"}


def test_drift_of_the_leftover(told: Story, truth: Truth) -> None:
    """Oracle: the truth's sine of time, with the phase taken from two instants."""
    left = told.sources
    drift = left.parts_um[left.names.index("unseen drift")]
    hours, radial = told.on.hours[told.on.surface >= 0], left.surface == CYLINDER
    omega = 2 * np.pi / truth.drift_um[0].period_h
    design = np.stack([np.sin(omega * hours), np.cos(omega * hours), np.ones_like(hours)], axis=1)[radial]
    found, squares, _, _ = np.linalg.lstsq(design, drift[radial], rcond=None)
    assert np.sqrt(squares[0] / radial.sum()) < 1e-3
    assert np.hypot(found[0], found[1]) == pytest.approx(truth.drift_um[0].amplitude, rel=0.02)


def test_model_is_of_the_measuring_day_only(told: Story, day: training.MeasuringDay) -> None:
    """Oracle: the fit made here from the measuring day alone is the same model."""
    assert training.fit_day(day, day.tip_um).hash == told.model.hash
    assert told.measuring_seed != told.seed
    assert day.readings == told.readings


def test_model_finds_the_truth(told: Story, truth: Truth) -> None:
    """Oracle: numbers in the truth file that a coefficient is meant to be."""
    values = {f.label: f.values for f in told.model.effects}
    assert values["backlash(EXX, X)"]["B"] == pytest.approx(-truth.axis["X"].backlash_um, abs=0.05)
    assert values["backlash(EZZ, Z)"]["B"] == pytest.approx(-truth.axis["Z"].backlash_um, abs=0.05)
    screw = values["axis_expansion(EXX, X, T_x_nut)"]["k"]
    assert screw == pytest.approx(truth.axis["X"].screw.um_per_m_degc, rel=0.15)
    once = values["cyclic_screw(EZZ, Z)"]
    assert np.hypot(once["s1"], once["c1"]) == pytest.approx(truth.axis["Z"].screw.cyclic_um, rel=0.25)


def test_shipped_model_is_what_the_command_makes(told: Story, day: training.MeasuringDay) -> None:
    """Oracle: the documented command's own fit; bits may differ with the linear algebra library, predictions not."""
    shipped = load_model(CONFIGS / "models" / "turning-centre.toml", told.model.machine)
    rows = np.flatnonzero(day.session >= 0)[::50]
    difference = shipped.predict(day.state)[rows] - told.model.predict(day.state)[rows]
    assert np.abs(difference).max() < 0.02


def test_same_seed_same_day(told: Story, truth: Truth, bare: Track) -> None:
    """Oracle: the run before; another seed is the check that the seed matters."""
    model: Model = told.model
    once, again = (corrected(model, CONFIGS / TRUTH_FILE, SEED, SHORTER) for _ in range(2))
    for name in (f.name for f in fields(Track)):
        np.testing.assert_array_equal(getattr(once[0], name), getattr(again[0], name))
    np.testing.assert_array_equal(once[1].commands.requested_um, again[1].commands.requested_um)
    other = uncorrected(model.machine, truth, SEED + 7, SHORTER)
    assert np.abs(np.nan_to_num(other.tip_um[-100:] - bare.tip_um[-100:])).max() > 0.1


class References(HTMLParser):
    """Everything that a page would fetch or run."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self.tags: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.found += [v or "" for k, v in attrs if k in ("src", "href", "srcset", "data", "action", "poster")]
        self.found += [k for k, _ in attrs if k.startswith("on")]


def test_page_needs_nothing_else(written: Path) -> None:
    """Oracle: Python's own HTML parser; styles looked through for addresses."""
    text = (written / "report.html").read_text(encoding="utf-8")
    seen = References()
    seen.feed(text)
    assert seen.found
    assert all(r.startswith("data:image/png;base64,") for r in seen.found)
    assert not {"script", "link", "iframe", "object", "embed"} & set(seen.tags)
    styles = "".join(re.findall(r"<style>(.*?)</style>", text, re.S))
    assert "url(" not in styles
    assert "@import" not in styles
    assert "http" not in re.sub(r"data:[^\"]*", "", text)


def test_figures_are_pictures(written: Path) -> None:
    """Oracle: matplotlib's PNG reader, another library than the one that wrote them."""
    from matplotlib.image import imread

    names = sorted(p.name for p in written.iterdir())
    pictures = [n for n in names if n.endswith(".png")]
    assert len(pictures) == 6
    assert set(names) - set(pictures) == {"report.html", "result.json"}
    for name in pictures:
        pixels = imread(written / name)
        assert min(pixels.shape[:2]) > 300
        assert np.ptp(pixels[..., :3]) > 0.5


def test_figures_draw_the_uncorrected_day_as_uncorrected(made: Made) -> None:
    """Oracle: the day without correction is the one with the larger errors, in every panel that has both."""
    assert len(made.drawn) == 8
    for *_, off, on in made.drawn:
        assert np.abs(np.asarray(off)).max() > np.abs(np.asarray(on)).max()


def test_result_file_says_what_the_page_says(told: Story, written: Path) -> None:
    """Oracle: the story itself, read back from JSON and found in the page's text."""
    facts = json.loads((written / "result.json").read_text())
    assert facts == json.loads(json.dumps(told.facts()))
    text = (written / "report.html").read_text(encoding="utf-8")
    for row in facts["errors"]:
        assert f"{row['factor_largest']:.1f}\u00a0×" in text
    for row in facts["left_uncorrected"]:
        assert row["part"] in text


def test_nothing_half_written(
    told: Story, made: Made, written: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Oracle: the folder's listing after Ctrl-C while the page is made, and after a disk error."""
    shutil.copytree(written, tmp_path, dirs_exist_ok=True)
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    monkeypatch.setattr(page, "page_of", lambda _: replace(made.page, title="Another"))

    def interrupted(_: Any) -> str:
        raise KeyboardInterrupt

    other = replace(told, seed=told.seed + 100)
    with monkeypatch.context() as m:
        m.setattr(report_page, "render", interrupted)
        with pytest.raises(KeyboardInterrupt):
            page.write_report(other, tmp_path)
    with monkeypatch.context() as m:
        m.setattr(Path, "write_bytes", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device")))
        with pytest.raises(RtecError, match="No space left"):
            page.write_report(other, tmp_path)
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before


def test_command(
    told: Story, made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Oracle: exit status and output of the command line, with the story already told and drawn."""
    asked: list[int] = []

    def tell(seed: int, configs: Path, stage: Any, plan: Plan, hidden_seed: int | None, hidden: str | None) -> Story:
        asked.append(seed)
        assert plan == Plan(warm_h=1.5, night_h=3.0)
        assert (hidden_seed, hidden) == (None, None)
        stage("measuring day", 1, 2)
        assert configs == CONFIGS
        return told

    monkeypatch.setattr(story, "tell_story", tell)
    monkeypatch.setattr(page, "page_of", lambda _: made.page)
    model_file = tmp_path / "model.toml"
    words = ["demo", "--seed", str(SEED), "--out", str(tmp_path / "out"), "--model-out", str(model_file), "--no-hidden"]
    words += ["--hours", "1.5"]
    assert main.status([*words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["seed"] == SEED
    assert load_model(model_file, told.model.machine).hash == told.model.hash
    assert main.status(words) == 0
    out = capsys.readouterr().out
    assert f"Seed {SEED}" in out
    assert "What stays uncorrected" in out
    assert asked == [SEED, SEED]


def test_configs_that_are_not_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="without --configs"):
        config_folder(tmp_path)


def test_rate_divides_what_is_recorded() -> None:
    """Oracle: arithmetic; a recorded instant must be an instant of the loop."""
    from rtec.demo.day import EVERY_NS, NS

    assert EVERY_NS % (NS // RATE_HZ) == 0
    assert NS % EVERY_NS == 0
