"""Figures of a model in one state, from arrays to PNG: the links, the errors over the travels, the component errors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from rtec.arrays import Floats
from rtec.machine import Machine
from rtec.machine.links import LinkPlaces, Side, room_around, room_mm
from rtec.model.volume import TipErrors
from rtec.report.figures import GREY, OFF, ON, as_png, canvas, stacked

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as MplFigure

SCALE = ("#3d7fd6", "#a87aa8", "#d9760b")
"""From the smallest to the largest error."""
HIGH_IN, HALF_VIEW_RAD = 7.6, np.pi / 8
"""Height of a figure in 3D, and half of the angle that its height shows: that of Plotly."""
LOOKS: dict[Side, tuple[str, str]] = {"tool": (OFF, "o"), "work": (ON, "s")}
MOST_BARS = 16
EDGE = 0.03
"""Space between a link that leads out of its room, and the edge of the larger one, in the longest side."""
BESIDE = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1))
AWAY_PT = 8.0
"""Distance of a name from its place."""
LETTER_WIDE, LETTER_HIGH, MARK = 0.035, 0.085, 0.03
"""Sizes of a letter of a name, and half of that of a mark, where half of the picture's height is 1."""
FILLED = 0.75
"""Share of a square picture that a room fills when it is first seen: titles and numbers are around it."""


@dataclass(frozen=True)
class Camera:
    """From where a machine is seen. Units: the longest side of the room in which it moves is `longest` of it.

    Attributes:
        eye: place of the camera from the room's middle.
        centre: what it looks at.
        up: direction that is upwards in the picture.
    """

    eye: tuple[float, float, float] = (1.4, -2.1, 1.25)
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
    figure, ax = _room(room_of(machine, sides, magnified), camera)
    for side, n in sides.items():
        colour, marker = LOOKS[side]
        ax.plot(*n.place_mm.T, color=GREY, linewidth=1.8, label="nominal" if side == "tool" else None)
        at = n.place_mm + 1e-3 * magnified * n.moved_um
        ax.plot(*at.T, color=colour, marker=marker, linewidth=4.0, label=f"{side} side, with its errors")
    for name in names_at(machine, sides, magnified, camera):
        across, up = name.beside
        ha, va = ("right", "center", "left")[across + 1], ("top", "center", "bottom")[up + 1]
        x, y, _, far = ax.get_proj() @ [*name.place_mm, 1.0]
        away = AWAY_PT * across, AWAY_PT * up
        ax.annotate(name.words, (x / far, y / far), away, textcoords="offset points", ha=ha, va=va, fontsize=15)
    ax.legend(loc="upper left", fontsize=15, frameon=False)
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
    ax.set_position((0.0, 0.0, 0.86, 1.0))
    bar = figure.colorbar(dots, cax=figure.add_axes((0.9, 0.15, 0.02, 0.7)))
    bar.set_label("error, µm")
    return figure


@as_png
def bars(rows: Sequence[tuple[str, float, str]]) -> "MplFigure":
    """Component errors as bars, the first at the top, in a panel for each unit; each with its number.

    Args:
        rows: name, value and unit of each.
    """
    shown = rows[:MOST_BARS]
    panels = [[r for r in shown if r[2] == unit] for unit in dict.fromkeys(unit for _, _, unit in shown)]
    figure, all_axes = stacked(*(1.0 + 0.75 * len(panel) for panel in panels))
    for ax, panel in zip(all_axes, panels, strict=True):
        _bars(ax, panel)
    figure.align_ylabels()
    return figure


def _bars(ax: "Axes", rows: Sequence[tuple[str, float, str]]) -> None:
    """Bars of one unit, the first at the top."""
    most = max(abs(v) for _, v, _ in rows) or 1.0
    for place, (_, value, unit) in enumerate(rows):
        ax.barh(place, value, 0.6, color=ON)
        side = -1.0 if value < 0.0 else 1.0
        ax.text(value + side * 0.02 * most, place, f"{value:+.2f} {unit}", va="center", fontsize=15,
                ha="right" if value < 0.0 else "left")  # fmt: skip
    ax.set_yticks(range(len(rows)), [name for name, _, _ in rows], fontsize=14)
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.axvline(0.0, color="black", linewidth=1)
    low, high = min(0.0, *(v for _, v, _ in rows)), max(0.0, *(v for _, v, _ in rows))
    ax.set_xlim(low - (0.4 if low < 0.0 else 0.05) * most, high + (0.4 if high > 0.0 else 0.05) * most)
    ax.set_xlabel(f"component error, {rows[0][2]}")
    ax.grid(visible=False, axis="y")


def longest(room_mm: Floats) -> float:
    """Length of the longest side of a room, (3, 2), in units of a camera: at first it is seen whole, and large."""
    low, high = 0.1, 4.0
    for _ in range(30):
        middle = 0.5 * (low + high)
        corners = np.array([(*c, 1.0) for c in product(*room_mm)]) @ _projection(room_mm, Camera(), middle).T
        seen = np.abs(corners[:, :2] / corners[:, 3:]).max() / np.tan(HALF_VIEW_RAD)
        low, high = (middle, high) if seen < FILLED and corners[:, 3].min() > 0.0 else (low, middle)
    return low


def projection(room_mm: Floats, camera: Camera) -> Floats:
    """Matrix from places in mm to the picture, (4, 4): in perspective, its half height is the tangent of half the view.

    Args:
        room_mm: ends of the room along X, Y and Z, (3, 2).
        camera: from where it is seen.
    """
    return _projection(room_mm, camera, longest(room_mm))


def _projection(room_mm: Floats, camera: Camera, length: float) -> Floats:
    scale = length / float(np.ptp(room_mm, axis=1).max())
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
    figure.set_layout_engine("none")
    ax: Any = figure.add_axes((0.0, 0.0, 1.0, 1.0), projection="3d")
    for k, axis in enumerate("xyz"):
        getattr(ax, f"set_{axis}lim")(*room[k])
        getattr(ax, f"set_{axis}label")(f"{axis.upper()}, mm", labelpad=20)
    ax.set_box_aspect(np.ptp(room, axis=1))
    right, forward, high = np.array(camera.eye) - np.array(camera.centre)
    ax.view_init(np.rad2deg(np.arctan2(high, np.hypot(right, forward))), np.rad2deg(np.arctan2(forward, right)))
    half = float(np.tan(HALF_VIEW_RAD))
    # matplotlib has neither a camera's place nor its upward direction.
    ax.get_proj = lambda: projection(room, camera)
    ax.viewLim.intervalx = ax.viewLim.intervaly = (-half, half)
    ax.tick_params(labelsize=15)
    for axis, wide in zip((ax.xaxis, ax.yaxis, ax.zaxis), np.ptp(room, axis=1), strict=True):
        axis.set_major_locator(MaxNLocator(5 if wide > 0.5 * np.ptp(room, axis=1).max() else 2))
    return figure, ax


def room_of(machine: Machine, sides: Mapping[Side, LinkPlaces], magnified: float) -> Floats:
    """Lowest and highest coordinate, (3, 2), of the room of a machine: larger where its errors lead out of it."""
    room = room_mm(machine)
    at = np.concatenate([n.place_mm + 1e-3 * magnified * n.moved_um for n in sides.values()])
    edge = EDGE * float(np.ptp(room, axis=1).max())
    return np.stack(
        [np.minimum(room[:, 0], at.min(axis=0) - edge), np.maximum(room[:, 1], at.max(axis=0) + edge)], axis=1
    )


@dataclass(frozen=True)
class NameAt:
    """Name of one or more links in a figure.

    Attributes:
        side, index: of the link whose place it has.
        place_mm: that place, moved by the magnified errors, (3,).
        words: the name.
        beside: on which side of the place it is, to the right and upwards, each -1, 0 or 1.
    """

    side: Side
    index: int
    place_mm: Floats
    words: str
    beside: tuple[int, int]


def names_at(machine: Machine, sides: Mapping[Side, LinkPlaces], magnified: float, camera: Camera) -> list[NameAt]:
    """Names of the links, each where it covers no other, as far as there is room.

    Args:
        machine, sides, magnified, camera: as for `links`.
    """
    lens = projection(room_of(machine, sides, magnified), camera)
    out: list[NameAt] = []
    marks, boxes = list[Floats](), list[Floats]()
    there = []
    for side, n in sides.items():
        at = n.place_mm + 1e-3 * magnified * n.moved_um
        seen = np.column_stack([at, np.ones(len(at))]) @ lens.T
        seen = seen[:, :2] / seen[:, 3:] / np.tan(HALF_VIEW_RAD)
        marks += [np.stack([p - MARK, p + MARK]) for p in seen]
        there += [(side, k, at[k], words, seen[k]) for words, k in _names(n, base=side == "work")]
    for side, k, place, words, point in there:
        half = 0.5 * np.array([LETTER_WIDE * len(words), LETTER_HIGH])
        ways = sorted(BESIDE, key=lambda way: way[0] != (1 if side == "work" else -1))
        middles = [point + np.array(way) * (half + MARK) for way in ways]
        around = [np.stack([m - half, m + half]) for m in middles]
        own = [m for m in marks if not (m.mean(axis=0) == point).all()]
        cost = [10 * sum(_meet(b, x) for x in boxes) + sum(_meet(b, x) for x in own) for b in around]
        best = cost.index(min(cost))
        boxes.append(around[best])
        out.append(NameAt(side, k, place, words, ways[best]))
    return out


def _meet(one: Floats, two: Floats) -> bool:
    """Whether two boxes, (2, 2), have a part in common."""
    return bool((one[0] < two[1]).all() and (two[0] < one[1]).all())


def _names(n: LinkPlaces, *, base: bool) -> list[tuple[str, int]]:
    """Names of the links, those at one place together, with their index; the base, which both sides have, if `base`."""
    out: dict[int, list[str]] = {}
    for k in range(0 if base else 1, len(n.names)):
        first = next((m for m in out if np.allclose(n.place_mm[m], n.place_mm[k])), k)
        out.setdefault(first, []).append(n.names[k])
    return [(", ".join(names), k) for k, names in out.items()]
