"""Report of grid-encoder set-ups, each alone and compared, with contour figures [XT Fig. 12-17]."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from rtec.arrays import Floats
from rtec.metrology.grid.compare import GridComparison, GridEvaluation, not_compared
from rtec.metrology.grid.paths import Edge
from rtec.metrology.grid.setup import GridSetup, Item, same_feed, slowest
from rtec.report.figures import GREY, LINES, OFF, ON, WIDTH_IN, as_png, canvas
from rtec.report.page import Figure, Page, Section, Table, shell_command
from rtec.version import __version__
from rtec.wording import counted, number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as MplFigure

COLOURS = (ON, OFF, LINES[3], LINES[4], LINES[5])
SMOOTH = 30
"""Half-width of the moving mean that is drawn bold over the readings, as a share of the piece."""
SCALES_UM = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)


@dataclass(frozen=True)
class Piece:
    """A straight piece.

    Attributes:
        along: 0 to the right, 1 upwards.
        way: -1, +1.
        place_mm: positions along it, in order, (n,).
        beside_mm: its position across.
        deviation_um: deviation across it, positive to the right or upwards, (n,).
        family: index in the list of names; pieces of one family have one colour.
    """

    along: int
    way: int
    place_mm: Floats
    beside_mm: float
    deviation_um: Floats
    family: int


@as_png
def contour(
    title: str,
    letters: tuple[str, str],
    pieces: Sequence[Piece],
    names: Sequence[str],
    magnification: float,
    how: str = "",
) -> "MplFigure":
    """Commanded path in grey, actual path beside it; arrows along the feed, a bar for the size of an error.

    Args:
        title: title of the figure.
        letters: directions to the right and upwards.
        pieces: pieces of all families (set-ups, feeds or directions in one overlay).
        names: names of the families.
        magnification: magnification of the deviation relative to the path.
        how: parts that were subtracted before, in words.
    """
    figure = canvas(WIDTH_IN * 0.95)
    ax = figure.subplots()
    named: set[int] = set()
    for piece in pieces:
        colour = COLOURS[piece.family % len(COLOURS)]
        label = names[piece.family] if piece.family not in named else ""
        named.add(piece.family)
        _draw(ax, piece, colour, magnification, label)
    _size(ax, pieces, magnification)
    ax.set_aspect("equal")
    ax.set_xlabel(f"{letters[0]}, mm; {how}" if how else f"{letters[0]}, mm")
    ax.set_ylabel(f"{letters[1]}, mm")
    ax.set_title(f"{title}; deviation drawn {f'{magnification:,.0f}'.replace(',', chr(0x2009))} times as large")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=min(3, len(names)), frameon=False)
    return figure


def usual_magnification(pieces: Sequence[Piece]) -> float:
    """A round one at which the largest deviation takes an eighth of the path."""
    span = max(float(np.ptp(p.place_mm)) for p in pieces)
    largest = max(float(np.abs(p.deviation_um).max()) for p in pieces)
    wanted = span * 1e3 / 8.0 / max(largest, 1e-3)
    decade = 10.0 ** np.floor(np.log10(wanted))
    return float(max(s * decade for s in (1.0, 2.0, 5.0) if s * decade <= wanted * (1 + 1e-9)))


def _draw(ax: "Axes", piece: Piece, colour: str, magnification: float, label: str) -> None:
    away = piece.beside_mm + piece.deviation_um * 1e-3 * magnification
    inner, smooth = _smoothed(away)
    place = piece.place_mm[inner]
    straight = np.full(len(away), piece.beside_mm)
    line: dict[str, Any] = {"color": colour, "linewidth": 2.4, "linestyle": "-" if piece.way > 0 else (0, (5, 2))}
    if piece.along == 0:
        ax.plot(piece.place_mm, straight, color=GREY, linewidth=1.0)
        ax.plot(piece.place_mm, away, color=colour, linewidth=0.8, alpha=0.35)
        ax.plot(place, smooth, label=label, **line)
    else:
        ax.plot(straight, piece.place_mm, color=GREY, linewidth=1.0)
        ax.plot(away, piece.place_mm, color=colour, linewidth=0.8, alpha=0.35)
        ax.plot(smooth, place, label=label, **line)
    n = len(smooth)
    at = int(n * (0.62 if piece.way > 0 else 0.38)) + 4 * piece.family
    step = max(n // 30, 1) * piece.way
    ends = [min(max(at, 0), n - 1), min(max(at + step, 0), n - 1)]
    points = [(place[k], smooth[k]) if piece.along == 0 else (smooth[k], place[k]) for k in ends]
    ax.annotate("", points[1], points[0], arrowprops={"arrowstyle": "-|>", "color": colour, "mutation_scale": 28})


def _smoothed(value: Floats) -> tuple[slice, Floats]:
    """Places with a complete window around them, and the mean over it."""
    reach = min(max(1, len(value) // SMOOTH), (len(value) - 1) // 2)
    size = 2 * reach + 1
    return slice(reach, len(value) - reach), np.convolve(value, np.full(size, 1.0 / size), mode="valid")


def _size(ax: "Axes", pieces: Sequence[Piece], magnification: float) -> None:
    """Error-scale bar."""
    span = max(float(np.ptp(p.place_mm)) for p in pieces)
    wanted_um = span / 8.0 / magnification * 1e3
    scale = min(SCALES_UM, key=lambda s: abs(np.log(s / wanted_um)))
    length = scale * 1e-3 * magnification
    x = 0.5 * sum(ax.get_xlim())
    y = 0.5 * sum(ax.get_ylim()) + 0.06 * span
    if any(p.along == 1 and abs(p.beside_mm - x) < 0.2 * span for p in pieces):
        x -= 0.28 * span
    if any(p.along == 0 and abs(p.beside_mm - y) < 0.15 * span for p in pieces):
        y += 0.15 * span
    ax.plot([x - 0.5 * length, x + 0.5 * length], [y, y], color="black", linewidth=3)
    for end in (-0.5, 0.5):
        ax.plot([x + end * length] * 2, [y - 0.012 * span, y + 0.012 * span], color="black", linewidth=3)
    ax.text(x, y + 0.02 * span, f"error {scale:g} µm", ha="center", va="bottom", fontweight="bold", fontsize=14)


FEET = (
    "Signs are those of e = ε × p: e_x = +EB z, e_z = -EB x. Squareness is the difference of the two edges' best-fit "
    "directions, which the plate's own turn does not enter. Straightness is the range about the best-fit line.",
    "U: expanded uncertainty, coverage factor 2, from the readings, widened by how long they err together, and the "
    "plate's accuracy where it does not fall out of the difference. Between set-ups it does if [setup] plate names the "
    "same plate in both and the same part of it is run over.",
    "“yes”: under noise alone, about one report in fifty would have any “yes”.",
)


def grid_page(r: GridEvaluation, figures: bool = True) -> Page:
    """The page.

    Args:
        r: the set-ups.
        figures: whether to draw.
    """
    sections = [
        Section(s.name, [_where(s)], _table(s.items), _contour(s, i, r.magnification) if figures else None)
        for i, s in enumerate(r.setups)
    ]
    sections += [Section(c.heading, [], _compared(c, r.found)) for c in r.comparisons]
    if figures:
        sections += _overlays(r)
    left_out = not_compared(r.setups)
    if left_out:
        sections.append(Section("Not compared", [f"{line}." for line in left_out]))
    lead = f"{counted(len(r.setups), 'set-up')}. "
    rigid, beyond = (_together([i for i in r.found if i.rigid is kind]) for kind in (True, False))
    lead += f"Rigid-body error motions between places [XT 4.1]: {rigid}. " if rigid else ""
    lead += f"More than noise between directions, feeds or places: {beyond}." if beyond else ""
    if r.comparisons and not r.found:
        lead += "No difference between directions, feeds or places is more than noise."
    return Page(
        "Grid encoder",
        lead.strip(),
        [],
        sections,
        [*FEET, f"rtec {__version__}, rtec grid."],
        brief=Section("", [], _brief(r)),
        next=[shell_command("rtec", "fit", *r.files, "-o", "model.toml")] if r.files else [],
    )


def _brief(r: GridEvaluation) -> Table:
    """Significant differences; then each error of the set-ups, with its range over them."""
    found = dict.fromkeys((i.name, i.means, number(i.value), "", number(i.u), i.unit, "yes") for i in r.found)
    rows = [[*row] for row in found]
    for first in r.setups[0].items:
        items = [i for s in r.setups for i in s.items if i.name == first.name]
        values = [i.value for i in items]
        ends = [number(min(values)), number(max(values)) if len(values) > 1 else ""]
        rows.append([first.name, first.means, *ends, number(max(i.u for i in items)), first.unit, ""])
    head = ["error", "what it is", "value", "to", "± U", "unit", "beyond noise"]
    return Table(head, rows, "Errors of several set-ups: from the smallest to the largest.", words=(0, 1, 5, 6))


def _together(items: Sequence[Item]) -> str:
    return ", ".join(dict.fromkeys(f"{i.name} = {number(i.value)} {i.unit}" for i in items))


def _where(s: GridSetup) -> str:
    origin = ", ".join(f"{d.lower()} {x:g}" for d, x in zip("XYZ", s.setup.origin_mm, strict=True))
    return f"plane {s.setup.plane}, centre of the plate at {origin}; {counted(len(s.edges), 'straight piece')}"


def _table(items: Sequence[Item]) -> Table:
    rows = [[i.name, i.means, i.where, number(i.value), number(i.u), i.unit] for i in items]
    return Table(["error", "what it is", "where, mm", "value", "± U", "unit"], rows, words=(0, 1, 2, 5))


def _compared(c: GridComparison, found: Sequence[Item]) -> Table:
    rows = [
        [i.name, i.means, i.where, number(i.value), number(i.u), i.unit,
         ("yes" if i in found else "no") if np.isfinite(i.chance) else ""]
        for i in c.items
    ]  # fmt: skip
    head = ["error", "what it is", "where, mm", "value", "± U", "unit", "beyond noise"]
    return Table(head, rows, words=(0, 1, 2, 5, 6))


def drawn_pieces(edges: Sequence[Edge], family: int, level: dict[int, float], turn: float) -> list[Piece]:
    """Edges without their plane's mean and the plate's rotation: the alignment of a plate is no machine error."""
    middle = {k: float(np.mean([np.ptp(e.place_mm) / 2 + e.place_mm.min() for e in edges if e.along == k] or [0.0]))
              for k in (0, 1)}  # fmt: skip
    out = []
    for e in edges:
        order = np.argsort(e.place_mm)
        place = e.place_mm[order]
        turned = (turn if e.along == 0 else -turn) * (place - middle[e.along])
        across = e.readings_um[1 - e.along][order] - level[1 - e.along] - turned
        out.append(Piece(e.along, e.way, place, e.beside_mm, across, family))
    return out


def plate_turn(s: GridSetup, edges: Sequence[Edge]) -> float:
    """Slope of the sides along the first letter, µm per mm, 0 where the plate is known: [XT] draws them level."""
    first = [e for e in edges if e.along == 0]
    if s.setup.alignment == "none" or not first:
        return 0.0
    return float(np.mean([e.across.line_um[0] / e.length_mm for e in first]))


def _how(s: GridSetup) -> str:
    return "" if s.setup.alignment == "none" else f"the plate's turn taken out by the sides along {s.lean.letters[0]}"


def _level(edges: Sequence[Edge]) -> dict[int, float]:
    return {
        k: float(np.mean(np.concatenate([e.readings_um[k] for e in edges if e.along == 1 - k] or [np.zeros(1)])))
        for k in (0, 1)
    }


def _contour(s: GridSetup, number_: int, magnification: float | None) -> Figure:
    """All pieces of the first runs at the lowest feed, the two senses in two colours."""
    slow = [e for e in s.edges if same_feed(e.feed_mm_min, slowest(s.edges))]
    whole = [e for e in slow if e.length_mm > max(x.length_mm for x in slow) - 1.0]
    outside = _outline(whole)
    chosen = outside or slow
    runs = sorted({e.run for e in chosen})[:2]
    level = _level([e for e in chosen if e.run in runs])
    turn = plate_turn(s, [e for e in chosen if e.run in runs])
    pieces = [
        p for k, run in enumerate(runs) for p in drawn_pieces([e for e in chosen if e.run == run], k, level, turn)
    ]
    gain = magnification or usual_magnification(pieces)
    png = contour(f"{s.name}, {s.setup.plane}", s.lean.letters, pieces, [f"run {r}" for r in runs], gain, _how(s))
    return Figure(f"contour-{number_ + 1}.png", png, "path with its deviation drawn normal to it, magnified")


def _outline(edges: Sequence[Edge]) -> list[Edge]:
    """Edges of the runs around a square."""
    return [e for e in edges if len({(x.along, round(x.beside_mm, 1)) for x in edges if x.run == e.run}) == 4]


def _overlays(r: GridEvaluation) -> list[Section]:
    """Overlays: two set-ups of one plane and size, each relative to its own middle; two feeds of one set-up."""
    out: list[Section] = []
    for i, one in enumerate(r.setups):
        for two in r.setups[i + 1 :]:
            if one.setup.plane == two.setup.plane:
                figure = _overlay(one, two, r.magnification, f"places-{len(out) + 1}.png")
                out += [Section(f"{one.name} and {two.name}", [], None, figure)] if figure else []
    for s in r.setups:
        known = sorted({round(e.feed_mm_min, 6) for e in s.edges if np.isfinite(e.feed_mm_min)})
        if len(known) > 1:
            families = {f"{f:g} mm/min": [e for e in _outline(s.edges) if same_feed(e.feed_mm_min, f)] for f in known}
            figure = _laid_over(families, s, r.magnification, f"feeds-{len(out) + 1}.png", still=True)
            out += [Section(f"{s.name}: feeds", [], None, figure)] if figure else []
    return out


def _overlay(one: GridSetup, two: GridSetup, magnification: float | None, name: str) -> Figure | None:
    families = {
        s.name: [_moved(e, s) for e in _outline(s.edges) if same_feed(e.feed_mm_min, slowest(s.edges))]
        for s in (one, two)
    }
    return _laid_over(families, one, magnification, name)


def _moved(e: Edge, s: GridSetup) -> Edge:
    """An edge with coordinates relative to the plate's middle."""
    middle = [s.setup.origin_mm["XYZ".index(d)] for d in s.lean.letters]
    return replace(e, place_mm=e.place_mm - middle[e.along], beside_mm=e.beside_mm - middle[1 - e.along])


def _laid_over(
    families: dict[str, list[Edge]], s: GridSetup, magnification: float | None, name: str, *, still: bool = False
) -> Figure | None:
    """Families of edges in one figure; without each set-up's alignment of the plate, unless the plate was `still`."""
    chosen = {k: [e for e in v if e.run == min(x.run for x in v)] for k, v in families.items() if v}
    if len(chosen) < 2:
        return None
    lies = [(_level(v), plate_turn(s, v)) for v in chosen.values()]
    lies = [lies[0]] * len(lies) if still else lies
    pieces = [p for k, v in enumerate(chosen.values()) for p in drawn_pieces(v, k, *lies[k])]
    gain = magnification or usual_magnification(pieces)
    png = contour(f"Plane {s.setup.plane}", s.lean.letters, pieces, list(chosen), gain, _how(s))
    return Figure(name, png, "two paths laid over each other, deviations drawn normal to them, magnified")
