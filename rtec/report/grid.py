"""Report of grid-encoder set-ups, each alone and compared."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rtec.metrology.grid.compare import not_compared
from rtec.metrology.grid.evaluation import GridComparison, GridEvaluation
from rtec.metrology.grid.paths import Edge
from rtec.metrology.grid.setup import GridSetup, Item, same_feed, slowest
from rtec.report import grid_figures as draw
from rtec.report.page import Figure, Page, Section, Table, shell_command
from rtec.version import __version__
from rtec.wording import counted, number

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


def drawn_pieces(edges: Sequence[Edge], family: int, level: dict[int, float], turn: float) -> list[draw.Piece]:
    """Edges without their plane's mean and the plate's rotation: the alignment of a plate is no machine error."""
    middle = {k: float(np.mean([np.ptp(e.place_mm) / 2 + e.place_mm.min() for e in edges if e.along == k] or [0.0]))
              for k in (0, 1)}  # fmt: skip
    out = []
    for e in edges:
        order = np.argsort(e.place_mm)
        place = e.place_mm[order]
        turned = (turn if e.along == 0 else -turn) * (place - middle[e.along])
        across = e.readings_um[1 - e.along][order] - level[1 - e.along] - turned
        out.append(draw.Piece(e.along, e.way, place, e.beside_mm, across, family))
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
    gain = magnification or draw.usual_magnification(pieces)
    png = draw.contour(f"{s.name}, {s.setup.plane}", s.lean.letters, pieces, [f"run {r}" for r in runs], gain, _how(s))
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
    gain = magnification or draw.usual_magnification(pieces)
    png = draw.contour(f"Plane {s.setup.plane}", s.lean.letters, pieces, list(chosen), gain, _how(s))
    return Figure(name, png, "two paths laid over each other, deviations drawn normal to them, magnified")
