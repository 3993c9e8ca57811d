"""What holds for every figure: each scale names its quantity and unit, a legend names nothing twice, lines run forward.

Oracles: the texts and points of the figures as drawn, before they become pixels.
"""

from collections.abc import Callable

import numpy as np
import pytest
from matplotlib.figure import Figure

from rtec.demo import figures as demo
from rtec.report import (
    ball_bar_figures,
    compare_figures,
    diagnosis,
    effects_figures,
    fit,
    grid,
    hil,
    procedures_figures,
)
from rtec.report.effects_figures import EffectCurve, EffectShape
from tests.support.figures import drawn, lines

RNG = np.random.default_rng(1)
X = np.repeat(np.linspace(0.0, 100.0, 21), 4)
WAY = np.tile([1.0, -1.0], 42)
NOISE = np.asarray(RNG.standard_normal(84), dtype=np.float64)
HOURS = np.linspace(0.0, 24.0, 25)
TURNS = np.asarray(RNG.uniform(0.0, 2.0 * np.pi, 300), dtype=np.float64)
CIRCLE = ball_bar_figures.CircleTrace("flat", 1, TURNS, np.sin(TURNS) + RNG.standard_normal(300), np.sin(TURNS))
PIECES = [
    grid.Piece(along, way, np.linspace(0.0, 100.0, 201), beside, RNG.standard_normal(201), 0)
    for along, way, beside in ((0, 1, 0.0), (1, 1, 100.0), (0, -1, 100.0), (1, -1, 0.0))
]
BOTH = [("Diameter", NOISE[:25], 0.1 * NOISE[:25]), ("Length", NOISE[25:50], 0.1 * NOISE[25:50])]
PHASES = [procedures_figures.Stretch(0.0, 12.0, 2000.0), procedures_figures.Stretch(12.0, 24.0, 0.0)]

FIGURES: dict[str, Callable[[], Figure]] = {
    "over position": lambda: drawn(
        compare_figures.over_position, "laser", "µm", "X, mm", X, WAY, NOISE + WAY, 0.1 * X, 0.3
    ),
    "over time": lambda: drawn(
        compare_figures.over_time, "laser", "µm", "h", np.linspace(0.0, 9.0, 84), NOISE, None, 0.3, [("T_bed", X)]
    ),
    "contributions": lambda: drawn(
        compare_figures.contributions, "laser", "µm", [("scale(EXX, X)", 3.0, 5.0)], 3.2, 1.0, 0.3,
        compare_figures.stack_along(("X, mm", X), WAY, {"scale(EXX, X)": 0.1 * X}, 0.1 * X + NOISE),
    ),
    "map": lambda: drawn(
        compare_figures.residual_map, "laser", "µm", ("X, mm", np.arange(5.0)), ("T_bed, °C", np.arange(4.0)),
        [(", moving +", NOISE[:12].reshape(3, 4))], 0.3,
    ),
    "linear": lambda: drawn(ball_bar_figures.linear, [CIRCLE], 5.0),
    "causes": lambda: drawn(ball_bar_figures.causes, [CIRCLE], [("scale X (40 %)", [np.cos(TURNS)])], 5.0),
    "spectra": lambda: drawn(ball_bar_figures.spectra, [("flat", np.arange(1.0, 6.0), np.arange(1.0, 6.0))]),
    "contour": lambda: drawn(grid.contour, "grid, XY", ("X", "Y"), PIECES, ["run 1"], 5000.0),
    "positioning": lambda: drawn(
        procedures_figures.positioning, "X", np.linspace(0.0, 100.0, 5),
        {"up": NOISE[:20].reshape(5, 4), "down": NOISE[20:40].reshape(5, 4)}, (-3.0, 3.0), NOISE[:4],
    ),
    "straightness": lambda: drawn(
        procedures_figures.straightness, "Straightness of Z: 1.0 µm", "z, mm", HOURS, NOISE[:25], 0.2,
        ("Profile of the arbor, best-fit line taken out", NOISE[25:50]),
    ),
    "parallelism": lambda: drawn(
        procedures_figures.parallelism, "z, mm", HOURS, 0.01 * HOURS, 0.01, [NOISE[:25], NOISE[25:50]]
    ),
    "drift": lambda: drawn(
        procedures_figures.drift, HOURS, PHASES,
        [("Drift", "displacement, µm", {"axial": (NOISE[:25], np.sqrt(HOURS))}),
         ("Temperatures", "change since the start, K", {"T_bed": (HOURS, np.full(25, np.nan))})],
    ),
    "falling": lambda: drawn(fit.falling, *np.array([[0.0, 3.0, 4.0], [100.0, 30.0, 9.0], [106.0, 35.0, 12.0]])),
    "residuals": lambda: drawn(fit.residuals, [("laser", "µm", HOURS, NOISE[None, :25])]),
    "rivals": lambda: drawn(
        diagnosis.rivals,
        [("scale(EXX, X)", 0.98, True, "99% probable"), ("backlash(EXX, X)", 0.1, False, "less likely")],
        diagnosis.EACH_ALONE,
    ),
    "hil": lambda: drawn(hil.tip_errors, HOURS, [("X", NOISE[:25], NOISE[25:50])], [("silent", 3.0, 6.0)]),
    "shape": lambda: drawn(
        effects_figures.figure, "Backlash", "e = B", EffectShape(
            "EXX", "µm", "position of X, mm", HOURS,
            (EffectCurve("moving +", HOURS), EffectCurve("moving -", -HOURS)), "B = 1 µm",
        )
    ),
    "demo, over time": lambda: drawn(demo.over_time, HOURS, BOTH, 8.0),
    "demo, bars": lambda: drawn(demo.straightness_bars, HOURS, [(n, abs(a), abs(b)) for n, a, b in BOTH]),
    "demo, profiles": lambda: drawn(demo.profiles, [("Cylinder", "along the cylinder, mm", HOURS, *BOTH[0][1:])]),
    "demo, temperatures": lambda: drawn(demo.temperatures, HOURS, {"bed": HOURS}, 8.0),
    "demo, shares": lambda: drawn(demo.shares, "Where it comes from", [("servo", 0.3, 1.0)]),
    "demo, parts": lambda: drawn(demo.tip_by_part, "Tip", [("first", abs(NOISE[:5])), ("added", abs(NOISE[5:10]))]),
}  # fmt: skip
NO_UNIT = {"cycle, number", "number of terms", "part, the first cut cold",
           "waves in one turn (one wave: mostly where the ball was set up)"}  # fmt: skip


@pytest.fixture(scope="module", params=list(FIGURES))
def figure(request: pytest.FixtureRequest) -> Figure:
    return FIGURES[request.param]()


def test_scales_name_quantity_and_unit(figure: Figure) -> None:
    """Oracle: "quantity, unit"; the lower axis of each column, and every upright one that has numbers."""
    for ax in figure.axes:
        if any(t.get_text() for t in ax.get_yticklabels()):
            label = ax.get_ylabel().replace("\n", " ")
            beside = [other.get_ylabel() for other in figure.axes if other.get_position().y0 == ax.get_position().y0]
            assert ", " in label or (not label and any(", " in b for b in beside))
    below = [ax.get_xlabel() for ax in figure.axes if ax.get_xlabel()]
    assert below
    assert all(", " in b or b in NO_UNIT for b in below)


def test_a_legend_names_nothing_twice(figure: Figure) -> None:
    """Oracle: the names."""
    for ax in figure.axes:
        legend = ax.get_legend()
        names = [t.get_text() for t in legend.get_texts()] if legend else []
        assert len(names) == len(set(names))
        assert not any(word in name.split() for name in names for word in ("left", "found", "told"))


def test_lines_do_not_go_to_and_fro(figure: Figure) -> None:
    """Oracle: from the first to the last point a line goes one way, across or upwards."""
    for ax in figure.axes:
        for points in lines(ax):
            known = points[np.isfinite(points).all(axis=1)]
            forward = [np.diff(known[:, k]) for k in (0, 1)]
            assert any(np.all(d >= 0.0) or np.all(d <= 0.0) for d in forward)


def test_one_prediction_where_both_directions_have_it() -> None:
    """Oracle: the same prediction both ways is one line; a reversal makes it two."""
    for predicted, count in ((0.1 * X, 1), (0.1 * X + WAY, 2)):
        figure = drawn(compare_figures.over_position, "laser", "µm", "X, mm", X, WAY, NOISE, predicted, 0.3)
        top, low = figure.axes
        named = [line for line in top.get_lines() if str(line.get_label()).startswith("predicted")]
        assert len(named) == count
        assert top.get_xlim() == low.get_xlim()


def test_noise_of_a_grid_is_pale_and_its_mean_bold() -> None:
    """Oracle: the path between is a straight line with noise; its bold mean strays less than a third as far."""
    piece = grid.Piece(0, 1, np.linspace(0.0, 100.0, 401), 0.0, np.asarray(RNG.standard_normal(401)), 0)
    (ax,) = drawn(grid.contour, "grid", ("X", "Y"), [piece], ["run 1"], 1000.0).axes
    bold = max((line for line in ax.get_lines() if line.get_label() == "run 1"), key=lambda line: line.get_linewidth())
    assert float(np.std(np.asarray(bold.get_ydata()))) < float(np.std(piece.deviation_um)) / 3.0
