"""Ball-bar readings in a comparison: a polar figure, and the angle on the circle to draw the others over."""

import numpy as np
from numpy.typing import NDArray

from rtec.estimation.readings import Readings, Series
from rtec.metrology.instruments.ball_bar import BallBar
from rtec.report.ball_bar_figures import MIDDLE, ROOM, Trace, around, arrow, frame
from rtec.report.figures import GREY, OFF, ON, WIDTH_IN, _png, _styled

Floats = NDArray[np.float64]
TURN_DEG = 360.0


def angle_of(readings: Readings, s: Series) -> tuple[str, Floats, Floats] | None:
    """Name, angle, degrees about the middle of the arc, and no direction, of a ball bar's readings; None for others."""
    bar, angle = _bar(readings, s), readings.states[s.source].channels.get("angle_deg")
    if bar is None or angle is None:
        return None
    middle = (bar.setup.start_deg + 0.5 * bar.setup.sense * bar.setup.arc_deg) % TURN_DEG
    turned = middle + (angle[s.row] - middle + 0.5 * TURN_DEG) % TURN_DEG - 0.5 * TURN_DEG
    return "angle on the circle, degrees", turned, np.zeros(len(turned))


def circle_picture(readings: Readings, s: Series, title: str, measured: Floats, predicted: Floats) -> bytes | None:
    """Measured and predicted drawn outwards from the circle, and beside it what is left; None for other instruments.

    Args:
        readings: all of them.
        s: the ball bar's.
        title: of the figure.
        measured, predicted: µm, (n,), without what the set-up cannot know (place of the ball on the table).
    """
    bar, angle = _bar(readings, s), readings.states[s.source].channels.get("angle_deg")
    if bar is None or angle is None:
        return None
    turned = np.deg2rad(angle[s.row])
    return _polar_pair(title, bar.setup.letters[:2], Trace("", bar.setup.sense, turned, measured, predicted))


@_styled
def _polar_pair(title: str, letters: tuple[str, str], trace: Trace) -> bytes:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH_IN, 0.56 * WIDTH_IN), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    both, left = figure.subplots(1, 2)
    gain = frame(both, letters, max(float(np.abs(v).max()) for v in (trace.measured_um, trace.fitted_um)))
    around(both, trace.angle_rad, MIDDLE + gain * trace.measured_um, GREY, "-", 3.0, 0.5, "measured")
    around(both, trace.angle_rad, MIDDLE + gain * trace.fitted_um, ON, "-", 2.0, 1.0, "predicted")
    arrow(both, trace, MIDDLE + 1.1 * ROOM, GREY)
    rest = trace.measured_um - trace.fitted_um
    gain = frame(left, letters, float(np.abs(rest).max()))
    around(left, trace.angle_rad, MIDDLE + gain * rest, OFF, "-", 1.4, 1.0, "left")
    for ax in (both, left):
        ax.legend(loc="upper left", frameon=False, fontsize=13)
    figure.suptitle(f"{title}: deviation from the circle, magnified", x=0.01, ha="left", fontweight="bold")
    return _png(figure)


def _bar(readings: Readings, s: Series) -> BallBar | None:
    instrument = readings.measurements[s.source].instrument
    return instrument if isinstance(instrument, BallBar) else None
