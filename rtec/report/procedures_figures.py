"""The standard figures of the procedures, from arrays to PNG; style and colours as in `figures`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rtec.arrays import Floats
from rtec.report.figures import GREY, LINES, MOST_DOTS, OFF, ON, as_png, room_above, stacked

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as MplFigure

LOOKS = ((ON, "-"), (OFF, "--"), (LINES[3], "-."), (LINES[4], ":"))


@dataclass(frozen=True)
class Stretch:
    """A stretch of constant speed, hours and 1/min."""

    start_h: float
    end_h: float
    rpm: float


@as_png
def positioning(
    title: str, target_mm: Floats, ways: Mapping[str, Floats], limits_um: tuple[float, float], cycle_um: Floats | None
) -> "MplFigure":
    """Deviation over targets: every reading, the means with ±2 s, and the band of accuracy A; below it the cycles.

    Args:
        title: title of the figure.
        target_mm: (m,).
        ways: "up" and "down" to deviations, µm, (m, n).
        limits_um: lowest and highest of mean ∓ 2 s.
        cycle_um: mean of each cycle, (n,).
    """
    looks = {"up": (ON, "^", "-", "approached upwards ▲"), "down": (OFF, "v", "--", "approached downwards ▼")}
    shift = 0.005 * float(np.ptp(target_mm))
    figure, axes = stacked(*([5.2, 2.6] if cycle_um is not None else [5.2]))
    ax = axes[0]
    for name, x in ways.items():
        colour, marker, line, label = looks[name]
        place = target_mm + (shift if name == "up" else -shift)
        mean, s = np.nanmean(x, axis=1), np.nanstd(x, axis=1, ddof=1)
        beside = np.repeat(2 * place - target_mm, x.shape[1])
        ax.plot(
            beside, x.ravel(), color=colour, marker=marker, linestyle="", alpha=0.6,
            markersize=5, markeredgewidth=0,
        )  # fmt: skip
        ax.errorbar(place, mean, 2 * s, color=colour, marker=marker, linestyle=line, capsize=6, label=label)
    for limit in limits_um:
        ax.axhline(limit, color=GREY, linestyle=":", linewidth=2)
    ax.axhline(0.0, color="black", linewidth=1)
    room_above(ax, 0.2, 0.12)
    ax.legend(ncols=2, loc="upper right", frameon=False)
    ax.set_title(title)
    ax.set_xlabel("target, mm")
    ax.set_ylabel("deviation, µm")
    ax.annotate(
        f"A = {limits_um[1] - limits_um[0]:.1f} µm between the dotted lines; bars: ±2 s", (0.01, limits_um[0]),
        (0, -5), xycoords=ax.get_yaxis_transform(), textcoords="offset points", va="top", color=GREY, fontsize=13,
    )  # fmt: skip
    if cycle_um is not None:
        _cycles(axes[1], cycle_um)
    return figure


def _cycles(ax: "Axes", cycle_um: Floats) -> None:
    number = np.arange(1, len(cycle_um) + 1)
    ax.plot(number, cycle_um, color=LINES[0], marker="o")
    ax.axhline(0.0, color="black", linewidth=1)
    ax.set_xticks(number[:: max(1, len(number) // 20)])
    ax.set_title("Cycles as a whole: mean over all targets")
    ax.set_xlabel("cycle, number")
    ax.set_ylabel("mean deviation, µm")


@as_png
def straightness(
    title: str, below: str, place_mm: Floats, straight_um: Floats, se_um: float, other: tuple[str, Floats]
) -> "MplFigure":
    """Straightness with a band of ±2 standard errors, and the artefact's profile below.

    Args:
        title: title of the upper panel.
        below: title of the lower axis.
        place_mm, straight_um: (n,).
        se_um: standard error of a point; NaN: no band.
        other: title and values, (n,), of the lower panel.
    """
    figure, axes = stacked(4.4, 3.2)
    if np.isfinite(se_um):
        axes[0].fill_between(
            place_mm, straight_um - 2 * se_um, straight_um + 2 * se_um, color=ON, alpha=0.22, linewidth=0,
            label="±2 standard errors",
        )  # fmt: skip
    axes[0].plot(place_mm, straight_um, color=ON, marker="o", label="straightness, best-fit line taken out")
    axes[0].legend(loc="upper right", frameon=False, ncols=2)
    axes[1].plot(place_mm, other[1], color=OFF, marker="s", linestyle="--")
    for ax, name in zip(axes, (title, other[0]), strict=True):
        ax.axhline(0.0, color="black", linewidth=1)
        ax.set_title(name)
        ax.set_ylabel(f"{name.split(',')[0].split(' of ')[0].lower()}, µm")
    room_above(axes[0], 0.22, 0.132)
    axes[-1].set_xlabel(below)
    return figure


@as_png
def parallelism(
    below: str, place_mm: Floats, axis_um: Floats, slope_um_per_mm: float, radii: Sequence[Floats]
) -> "MplFigure":
    """The spindle's axis relative to the motion with its best-fit line, and the radii of the circles.

    Args:
        below: title of the lower axis.
        place_mm, axis_um: (k,).
        slope_um_per_mm: slope of the line.
        radii: radii of both probes, (k,) each.
    """
    figure, axes = stacked(4.2, 3.2)
    level = float(axis_um.mean())
    line = slope_um_per_mm * (place_mm - place_mm.mean())
    axes[0].plot(place_mm, axis_um - level, color=ON, marker="o", linestyle="", markersize=11, label="best circles")
    axes[0].plot(place_mm, line, color=LINES[0], linestyle="-", label=f"line: {slope_um_per_mm * 1e3:+.1f} µrad")
    axes[0].set_title("Spindle's axis seen from the motion, positive towards probe 1")
    axes[0].legend(frameon=False, loc="best")
    for values, colour, marker, style, name in zip(
        radii, (ON, OFF), ("o", "s"), ("-", "--"), ("probe 1", "probe 2"), strict=True
    ):
        axes[1].plot(place_mm, values - values.mean(), color=colour, marker=marker, linestyle=style, label=name)
    axes[1].set_title("Radius of the best-fit circle, from its mean")
    axes[1].legend(frameon=False, loc="best")
    for ax in axes:
        ax.axhline(0.0, color="black", linewidth=1)
        ax.set_ylabel("distance, µm" if ax is axes[0] else "radius, µm")
    axes[-1].set_xlabel(below)
    return figure


@as_png
def drift(
    hours: Floats, phases: Sequence[Stretch], groups: Sequence[tuple[str, str, Mapping[str, tuple[Floats, Floats]]]]
) -> "MplFigure":
    """Drift over time, one panel a group, with the fitted approaches and the speeds.

    Args:
        hours: (n,).
        phases: stretches of constant speed; those at 0 1/min are shaded.
        groups: title, title of the axis, and by name the values and the fitted curve, (n,) each; NaN for none.
    """
    figure, axes = stacked(*[4.4] * len(groups))
    thin = slice(None, None, max(1, len(hours) // MOST_DOTS))
    for ax, (title, beside, traces) in zip(axes, groups, strict=True):
        _shade(ax, phases)
        for k, (name, (values, curve)) in enumerate(traces.items()):
            colour, line = LOOKS[k % len(LOOKS)]
            if np.isnan(curve).all():
                ax.plot(hours, values, color=colour, linestyle=line, label=name)
                continue
            ax.plot(hours[thin], values[thin], color=colour, linestyle="", marker=".", markersize=5, alpha=0.4)
            ax.plot(hours, curve, color=colour, linewidth=2.6)
            ax.plot([], [], color=colour, linewidth=2.6, marker="o", label=name)
        ax.axhline(0.0, color="black", linewidth=1)
        room_above(ax, 0.28, 0.168)
        ax.set_title(title)
        ax.set_ylabel(beside)
        ax.legend(frameon=True, framealpha=0.9, facecolor="white", edgecolor="none", ncols=4, loc="lower left")
    axes[-1].set_xlabel("time, hours; grey: spindle off; dots: read; lines: fitted approach")
    _speeds(axes[0], phases)
    return figure


def _shade(ax: "Axes", phases: Sequence[Stretch]) -> None:
    for phase in phases:
        if phase.rpm < 1.0:
            ax.axvspan(phase.start_h, phase.end_h, color="#ECECEC", zorder=0)


def _speeds(ax: "Axes", phases: Sequence[Stretch]) -> None:
    whole = phases[-1].end_h - phases[0].start_h
    for phase in phases:
        if phase.rpm >= 1.0 and phase.end_h - phase.start_h > 0.02 * whole:
            narrow = phase.end_h - phase.start_h < 0.08 * whole
            ax.text(
                0.5 * (phase.start_h + phase.end_h), 0.98, f"{phase.rpm:.0f}" + ("" if narrow else " 1/min"),
                transform=ax.get_xaxis_transform(), ha="center", va="top", fontsize=13,
                rotation=90 if narrow else 0, color=GREY,
            )  # fmt: skip
