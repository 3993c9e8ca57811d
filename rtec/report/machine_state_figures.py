"""Figures of a model in one state, from arrays to PNG: the links, the errors over the travels, the component errors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rtec.machine import Machine
from rtec.machine.links import LinkPlaces, Side, room_around, room_mm
from rtec.model.volume import TipErrors
from rtec.report.figures import GREY, OFF, ON, as_png, canvas

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MplFigure

Floats = NDArray[np.float64]
SCALE = ("#3d7fd6", "#a87aa8", "#d9760b")
"""From the smallest to the largest error."""
HIGH_IN, HALF_VIEW_RAD = 7.6, np.pi / 8
"""Height of a figure in 3D, and half of the angle that its height shows: that of Plotly."""
LOOKS: dict[Side, tuple[str, str]] = {"tool": (OFF, "o"), "work": (ON, "s")}
MOST_BARS = 16
LONGEST = 1.2


@dataclass(frozen=True)
class Camera:
    """From where a machine is seen. Units: the longest side of the room in which it moves is `LONGEST`.

    Attributes:
        eye: place of the camera from the room's middle.
        centre: what it looks at.
        up: direction that is upwards in the picture.
    """

    eye: tuple[float, float, float] = (1.47, -2.23, 0.9)
    centre: tuple[float, float, float] = (0.0, 0.0, -0.1)
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)


@as_png
def links(machine: Machine, sides: Mapping[Side, LinkPlaces], magnified: float, camera: Camera) -> "MplFigure":
    """The links of both sides, nominal and moved by their errors.

    Args:
        machine: the machine.
        sides: its links, by side.
        magnified: factor by which errors are drawn larger.
        camera: from where it is seen.
    """
    figure, ax = _room(room_mm(machine), camera)
    for side, n in sides.items():
        colour, marker = LOOKS[side]
        ax.plot(*n.place_mm.T, color=GREY, linewidth=1.8, label="nominal" if side == "tool" else None)
        at = n.place_mm + 1e-3 * magnified * n.moved_um
        ax.plot(*at.T, color=colour, marker=marker, linewidth=4.0, label=f"{side} side, with its errors")
        for name, place in _names(n, base=side == "work"):
            ax.text(*(at[place]), f"  {name}", fontsize=12, ha="left" if side == "work" else "right")
    ax.legend(loc="upper left", fontsize=13, frameon=False)
    return figure


@as_png
def volume(errors: TipErrors, magnified: float, camera: Camera) -> "MplFigure":
    """Nominal places of the tool tip relative to the workpiece, each joined with where it is.

    Args:
        errors: at each place.
        magnified: factor by which errors are drawn larger.
        camera: from where it is seen.
    """
    from matplotlib.colors import LinearSegmentedColormap

    real = errors.place_mm + 1e-3 * magnified * errors.error_um
    figure, ax = _room(room_around(np.concatenate([errors.place_mm, real])), camera)
    for nominal, at in zip(errors.place_mm, real, strict=True):
        ax.plot(*np.stack([nominal, at]).T, color=GREY, linewidth=1.2)
    scale = LinearSegmentedColormap.from_list("errors", SCALE)
    dots = ax.scatter(*real.T, c=errors.size_um, cmap=scale, s=42, depthshade=False)
    bar = figure.colorbar(dots, ax=ax, shrink=0.6, pad=0.1)
    bar.set_label("error, µm")
    return figure


@as_png
def bars(rows: Sequence[tuple[str, float, str]]) -> "MplFigure":
    """Component errors as bars, the first at the top, each with its number.

    Args:
        rows: name, value and unit of each.
    """
    shown = list(rows[:MOST_BARS])[::-1]
    figure = canvas(1.4 + 0.75 * len(shown))
    ax = figure.subplots()
    most = max((abs(v) for _, v, _ in shown), default=0.0) or 1.0
    for place, (_, value, unit) in enumerate(shown):
        ax.barh(place, value, 0.6, color=ON)
        side = -1.0 if value < 0.0 else 1.0
        ax.text(value + side * 0.02 * most, place, f"{value:+.2f} {unit}", va="center", fontsize=14,
                ha="right" if value < 0.0 else "left")  # fmt: skip
    ax.set_yticks(range(len(shown)), [name for name, _, _ in shown], fontsize=13)
    ax.axvline(0.0, color="black", linewidth=1)
    low, high = min(0.0, *(v for _, v, _ in shown)), max(0.0, *(v for _, v, _ in shown))
    ax.set_xlim(low - (0.25 if low < 0.0 else 0.05) * most, high + (0.25 if high > 0.0 else 0.05) * most)
    ax.set_xlabel(f"component error, {' or '.join(sorted({unit for _, _, unit in shown}))}")
    ax.grid(visible=False, axis="y")
    return figure


def projection(room_mm: Floats, camera: Camera) -> Floats:
    """Matrix from places in mm to the picture, (4, 4): in perspective, its half height is the tangent of half the view.

    Args:
        room_mm: ends of the room along X, Y and Z, (3, 2).
        camera: from where it is seen.
    """
    scale = LONGEST / float(np.ptp(room_mm, axis=1).max())
    eye, centre, up = (np.array(v) for v in (camera.eye, camera.centre, camera.up))
    back = (eye - centre) / np.linalg.norm(eye - centre)
    right = np.cross(up, back)
    right = right / np.linalg.norm(right)
    axes = np.stack([right, np.cross(back, right), back])
    turned = scale * axes
    moved = -turned @ room_mm.mean(axis=1) - axes @ eye
    across, up, distance = (
        np.append(sign * t, sign * m) for sign, t, m in zip((1.0, 1.0, -1.0), turned, moved, strict=True)
    )
    # As matplotlib's own, the third coordinate is below zero and rises with the distance.
    return np.stack([across, up, np.array([0.0, 0.0, 0.0, -1.0]), distance])


def _room(room: Floats, camera: Camera) -> "tuple[MplFigure, Any]":
    """A room, (3, 2), with the same scale along all axes, seen by a camera."""
    from matplotlib.ticker import MaxNLocator

    figure = canvas(HIGH_IN)
    ax: Any = figure.add_subplot(projection="3d")
    for k, axis in enumerate("xyz"):
        getattr(ax, f"set_{axis}lim")(*room[k])
        getattr(ax, f"set_{axis}label")(f"{axis.upper()}, mm", labelpad=10)
    ax.set_box_aspect(np.ptp(room, axis=1))
    right, forward, high = np.array(camera.eye) - np.array(camera.centre)
    ax.view_init(np.rad2deg(np.arctan2(high, np.hypot(right, forward))), np.rad2deg(np.arctan2(forward, right)))
    half = float(np.tan(HALF_VIEW_RAD))
    # matplotlib has neither a camera's place nor its upward direction.
    ax.get_proj = lambda: projection(room, camera)
    ax.viewLim.intervalx = ax.viewLim.intervaly = (-half, half)
    ax.tick_params(labelsize=12)
    for axis, wide in zip((ax.xaxis, ax.yaxis, ax.zaxis), np.ptp(room, axis=1), strict=True):
        axis.set_major_locator(MaxNLocator(5 if wide > 0.5 * np.ptp(room, axis=1).max() else 2))
    return figure, ax


def _names(n: LinkPlaces, *, base: bool) -> list[tuple[str, int]]:
    """Names of the links, those at one place together, with their index; the base, which both sides have, if `base`."""
    out: dict[int, list[str]] = {}
    for k in range(0 if base else 1, len(n.names)):
        first = next((m for m in out if np.allclose(n.place_mm[m], n.place_mm[k])), k)
        out.setdefault(first, []).append(n.names[k])
    return [(", ".join(names), k) for k, names in out.items()]
