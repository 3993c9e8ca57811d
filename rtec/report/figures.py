"""Figures that are read at arm's length: large type, µm axes, names at the lines, colours that everybody tells apart.

Colours are those of Okabe and Ito; uncorrected and corrected differ in marker and line too, so that a print without
colour still tells them apart. Only arrays come in: this layer knows nothing of who draws. Every function gives a PNG.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from io import BytesIO
from typing import TYPE_CHECKING, Any, ParamSpec

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]
OFF, ON, GREY = "#D55E00", "#0072B2", "#595959"
LINES = ("#000000", "#D55E00", "#0072B2", "#009E73", "#CC79A7", "#B8860B", "#3A9BD9", "#6B4E9B")
STYLE: Any = {
    "font.size": 15,
    "axes.titlesize": 17,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#DDDDDD",
    "lines.linewidth": 2.4,
    "lines.markersize": 7,
}
KINDS: tuple[dict[str, Any], ...] = (
    {"color": OFF, "linestyle": "--", "marker": "s"},
    {"color": ON, "linestyle": "-", "marker": "o"},
)
WIDTH_IN = 11.0
P = ParamSpec("P")


def styled(draw: Callable[P, bytes]) -> Callable[P, bytes]:
    """Draw in this file's style, and leave matplotlib's own as it was."""

    @functools.wraps(draw)
    def styled(*args: P.args, **kwargs: P.kwargs) -> bytes:
        from matplotlib import rc_context

        with rc_context(STYLE):
            return draw(*args, **kwargs)

    return styled


@styled
def over_time(hours: Floats, panels: Sequence[tuple[str, Floats, Floats]], night_from_h: float) -> bytes:
    """Errors over the day, one panel a kind, uncorrected and corrected.

    Args:
        hours: (n,).
        panels: title, then uncorrected and corrected error, µm, (n,) or (n, places): the mean as a line, the range
            over the places as a band.
        night_from_h: from here on the machine stands and cools.
    """
    figure, axes = new_figure(len(panels), 3.9)
    for ax, (title, *both) in zip(axes, panels, strict=True):
        _night(ax, hours, night_from_h)
        for values, style in zip(both, KINDS, strict=True):
            rows = values.reshape(len(hours), -1)
            ax.fill_between(hours, rows.min(axis=1), rows.max(axis=1), color=style["color"], alpha=0.25, linewidth=0)
            ax.plot(hours, rows.mean(axis=1), **style)
        ax.axhline(0.0, color="black", linewidth=1)
        ax.set_title(title)
        ax.set_ylabel("error, µm")
        _names(ax, hours, [v.reshape(len(hours), -1).mean(axis=1) for v in both])
    axes[-1].set_xlabel("hours since the cold start")
    return png_of(figure)


@styled
def straightness_bars(hours: Floats, panels: Sequence[tuple[str, Floats, Floats]]) -> bytes:
    """One bar a part, uncorrected and corrected side by side.

    Args:
        hours: when the part was cut, (n,).
        panels: title, then uncorrected and corrected, µm, (n,).
    """
    figure, axes = new_figure(len(panels), 3.6)
    place = np.arange(len(hours))
    for ax, (title, *both) in zip(axes, panels, strict=True):
        for shift, values, style, name in zip((-0.2, 0.2), both, KINDS, ("uncorrected", "corrected"), strict=True):
            hatch = "//" if name == "uncorrected" else ""
            ax.bar(place + shift, values, 0.4, color=style["color"], hatch=hatch, edgecolor="white", label=name)
        ax.set_title(title)
        ax.set_ylabel("µm")
        ax.set_xticks(place[::2], [f"{h:.0f}" for h in hours[::2]])
        ax.grid(visible=False, axis="x")
        ax.set_ylim(0, 1.25 * max(float(v.max()) for v in both))
        ax.legend(ncols=2, frameon=False, loc="upper right", borderaxespad=0.0)
    axes[-1].set_xlabel("part cut at, hours since the cold start")
    return png_of(figure)


@styled
def profiles(panels: Sequence[tuple[str, str, Floats, Floats, Floats]]) -> bytes:
    """The line of a surface, uncorrected and corrected, about its best-fit line.

    Args:
        panels: title, name of the axis below, place, mm, (n,), uncorrected and corrected, µm, (n,).
    """
    figure, axes = new_figure(len(panels), 3.6)
    for ax, (title, below, place, *both) in zip(axes, panels, strict=True):
        for values, style in zip(both, KINDS, strict=True):
            ax.plot(place, values, color=style["color"], linestyle=style["linestyle"])
        ax.axhline(0.0, color="black", linewidth=1)
        ax.set_title(title)
        ax.set_xlabel(below)
        ax.set_ylabel("error, µm")
        _names(ax, place, both)
    return png_of(figure)


@styled
def temperatures(hours: Floats, degc: Mapping[str, Floats], night_from_h: float) -> bytes:
    """Temperatures over the day, °C, (n,) by name, named in the order of their highest."""
    figure, (ax,) = new_figure(1, 5.5)
    _night(ax, hours, night_from_h)
    hottest_first = sorted(enumerate(degc.items()), key=lambda item: -float(item[1][1].max()))
    for place, (name, values) in hottest_first:
        ax.plot(hours, values, color=LINES[place % len(LINES)], label=name)
    ax.legend(loc="upper right", title="hottest first", frameon=True, facecolor="white", framealpha=1.0)
    ax.set_title("Temperatures that the sensors read")
    ax.set_ylabel("°C")
    ax.set_xlabel("hours since the cold start")
    return png_of(figure)


@styled
def shares(title: str, rows: Sequence[tuple[str, float, float]]) -> bytes:
    """Horizontal bars, largest on top: name, root mean square and largest size, µm."""
    figure, (ax,) = new_figure(1, 0.62 * len(rows) + 1.4)
    for place, (name, rms, largest) in enumerate(reversed(rows)):
        ax.barh(place, largest, 0.72, color="#9FC5E8")
        ax.barh(place, rms, 0.36, color=ON)
        ax.text(largest, place, f"  {rms:.2f} µm, at most {largest:.1f}", va="center", fontsize=14)
        ax.text(-0.02, place, name, va="center", ha="right", transform=ax.get_yaxis_transform())
    ax.set_yticks([])
    ax.set_xlim(0, 1.45 * max(largest for _, _, largest in rows))
    ax.set_title(title)
    ax.set_xlabel("µm at the tool tip: dark bar root mean square, light bar largest")
    ax.grid(visible=False, axis="y")
    return png_of(figure)


def new_figure(panels: int, height_in: float) -> "tuple[Figure, Sequence[Axes]]":
    """Give an empty figure of the usual width, and its panels from the top down."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH_IN, height_in * panels), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure, list(figure.subplots(panels, 1, squeeze=False)[:, 0])


def png_of(figure: "Figure") -> bytes:
    """Give the figure as PNG."""
    out = BytesIO()
    figure.savefig(out, format="png", dpi=100, metadata={"Software": None})
    return out.getvalue()


def _night(ax: "Axes", hours: Floats, from_h: float) -> None:
    if hours[-1] <= from_h:
        return
    ax.axvspan(from_h, float(hours[-1]), color="#ECECEC", zorder=0)
    ax.text(
        0.5 * (from_h + float(hours[-1])), 0.03, "night: machine stands and cools", color=GREY, ha="center",
        va="bottom", transform=ax.get_xaxis_transform(), fontsize=13,
    )  # fmt: skip


def _names(ax: "Axes", place: Floats, both: Sequence[Floats]) -> None:
    """Name each line where the two are furthest apart, on the outer side."""
    low, high = min(float(v.min()) for v in both), max(float(v.max()) for v in both)
    room = max(high - low, 1e-9)
    ax.set_ylim(*_with_room(ax.get_ylim(), 0.16 * room))
    inner = slice(len(place) // 6, len(place) - len(place) // 6)
    at = inner.start + int(np.argmax(np.abs(both[0] - both[1])[inner]))
    above = both[0][at] > both[1][at]
    for values, style, name, up in zip(both, KINDS, ("uncorrected", "corrected"), (above, not above), strict=True):
        edge = float(values.max() if name == "uncorrected" and up else values[at])
        ax.annotate(
            name, (place[at], edge), (0, 12 if up else -12), textcoords="offset points", color=style["color"],
            fontweight="bold", ha="center", va="bottom" if up else "top",
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5, "alpha": 0.8},
        )  # fmt: skip


def _with_room(limits: tuple[float, float], room: float) -> tuple[float, float]:
    return limits[0] - room, limits[1] + room
