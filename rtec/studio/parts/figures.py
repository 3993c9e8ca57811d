"""The figures of the pages, from arrays to Plotly's format; colours are names that the theme resolves."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rtec.arrays import Bools, Floats, Ints
from rtec.report.figures import log_ticks
from rtec.report.thinning import MOST, by_place, cells_of, drawn, is_position, line_ends
from rtec.text import clean
from rtec.wording import ERROR_UNITS, number

if TYPE_CHECKING:
    from rtec.report.evidence import Evidence
    from rtec.report.history import Stairs
    from rtec.tasks.model import OutlierView, SeriesView

Figure = dict[str, Any]

PALETTE: Final = tuple(f"@c{k}" for k in range(1, 9))
SCALE: Final = ((0.0, "#3d7fd6"), (0.5, "#a87aa8"), (1.0, "#d9760b"))
"""From the least to the most; seen on light and on dark paper."""
FEW, LARGE, SMALL = 2_000, 9, 6
"""Up to this many readings have large markers; sizes of large and small markers."""
SINGLY = 1_000
"""Up to this many readings are drawn as SVG: WebGL starts slowly, and a browser has only 16 contexts for it."""
WAYS = 2
BETWEEN, ASIDE = 1.4, 0.7
"""Space between two panels of bars, in bars; room for the number at the end of a bar, in the longest one."""
DIGITS = 5


def text(words: str) -> str:
    """A foreign text for Plotly, with its markup escaped."""
    return clean(words).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


def numbers(values: Floats) -> list[float | None]:
    """Numbers for the page, rounded to visible digits; values that are not finite become gaps."""
    v = np.asarray(values, dtype=np.float64)
    good = np.isfinite(v)
    with np.errstate(divide="ignore", invalid="ignore"):
        power = np.where(good & (v != 0.0), DIGITS - 1 - np.floor(np.log10(np.abs(v))), 0.0)
    scale = 10.0 ** np.clip(power, -15.0, 15.0)
    out: list[float | None] = (np.round(np.where(good, v, 0.0) * scale) / scale).tolist()
    for k in np.flatnonzero(~good):
        out[int(k)] = None
    return out


def kind(readings: int, of: str = "scatter") -> str:
    """Plotly's kind of trace for a number of readings, the same for every visible part of them."""
    return of if readings <= SINGLY else f"{of}gl"


BUTTONS: Figure = {"text": "\u00a0", "side": "top", "font": {"size": 20}}
"""An empty first line of a legend, under the buttons of a plot."""


def layout(**more: Any) -> Figure:
    """Layout of a figure: paper and axes; `more` overrides it."""
    base: Figure = {
        "paper_bgcolor": "@paper",
        "plot_bgcolor": "@paper",
        "font": {"color": "@ink", "size": 14, "family": "Roboto, DejaVu Sans, sans-serif"},
        "margin": {"l": 70, "r": 20, "t": 44, "b": 56},
        "dragmode": "select",
        "hovermode": "closest",
        "hoverlabel": {"bgcolor": "@paper", "font": {"color": "@ink", "size": 14}, "bordercolor": "@ink"},
        "legend": {"orientation": "h", "x": 0, "y": 1.0, "yanchor": "bottom", "font": {"size": 13}, "title": BUTTONS},
        "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": "@muted", "activecolor": "@ink"},
        "uirevision": "kept",
    }
    return base | more


def axis(title: str, **more: Any) -> Figure:
    """One axis with its title."""
    base = {
        "title": {"text": text(title), "standoff": 10},
        "gridcolor": "@grid",
        "zerolinecolor": "@muted",
        "linecolor": "@muted",
        "automargin": True,
        "uirevision": title,  # the zoom of one quantity is none of another
    }
    return base | more


def _points(s: "SeriesView", rows: Ints, x: Floats, y: Floats, name: str, **marker: Any) -> Figure:
    return {
        "type": kind(len(s)),
        "mode": "markers",
        "name": text(name),
        "x": numbers(x[rows]),
        "y": numbers(y[rows]),
        "ids": [str(s.first + int(r)) for r in rows],
        "marker": {"size": LARGE if len(rows) <= FEW else SMALL, "opacity": 0.75, **marker},
        "selected": {"marker": {"opacity": 1.0, "size": LARGE + 2}},
        "unselected": {"marker": {"opacity": 0.12}},
        "hovertemplate": f"%{{x:.5g}}, %{{y:.3f}} {s.unit}<extra></extra>",
    }


def _band(floor: float) -> list[Figure]:
    """The noise floor as a band; empty where it is unknown."""
    if not np.isfinite(floor):
        return []
    place = {"xref": "x domain", "yref": "y", "x0": 0, "x1": 1, "y0": -floor, "y1": floor}
    return [{"type": "rect", **place, "fillcolor": "@floor", "line": {"width": 0}, "layer": "below"}]


def ways(direction: Floats) -> list[tuple[str, Bools, str, str]]:
    """Name, mask of the readings, (n,), colour and marker of each direction in the data."""
    both = [(", moving +", direction > 0, "@c3", "triangle-up"), (", moving −", direction < 0, "@c2", "triangle-down")]
    there = [w for w in both if w[1].any()]
    return there if len(there) == 2 else [("", np.ones(len(direction), dtype=bool), "@c3", "circle")]


def residual_over(
    s: "SeriesView",
    over: str,
    colour: str = "",
    chosen: Ints | None = None,
    what: str = "residual",
    wrong: "Sequence[OutlierView]" = (),
) -> Figure:
    """The residual, or measured and predicted values, over a channel.

    Args:
        s: reading column.
        over: title of the channel.
        colour: title of the channel for the colours; empty: by direction.
        chosen: rows of the readings that are drawn; None for the default.
        what: "residual", or "measured" for readings and prediction.
        wrong: excluded readings, drawn at their own residual.
    """
    x = s.channels[over]
    y = s.residuals if what == "residual" else s.measured
    rows = drawn(s.residuals, x, y) if chosen is None else chosen
    traces: list[Figure] = []
    if colour and colour in s.channels:
        shade = {
            "color": numbers(s.channels[colour][rows]),
            "colorscale": SCALE,
            "showscale": True,
            "colorbar": {"title": {"text": text(colour), "side": "right"}, "thickness": 14},
        }
        traces.append(_points(s, rows, x, y, what, **shade))
    else:
        for name, mask, tint, symbol in ways(s.direction):
            some = rows[mask[rows]]
            traces.append(_points(s, some, x, y, f"{what}{name}", color=tint, symbol=symbol))
    if what != "residual":
        traces += _predicted(s, x) if is_position(over) else _each_predicted(s, x, rows)
    elif there := [o for o in wrong if over in o.channels]:
        traces.append({
            "type": "scatter", "mode": "markers", "name": "wrong, excluded", "y": [o.off for o in there],
            "x": [o.channels[over] for o in there], "marker": {"symbol": "x", "size": 12, "color": "@c6"},
            "text": [f"{text(o.measurement)}, row {o.row}: off by {o.off:+.2f}" for o in there],
            "hovertemplate": "%{text}<extra></extra>",
        })  # fmt: skip
    title = f"{what}, {s.unit}" if what == "residual" else f"error, {s.unit}"
    legend = not colour or what != "residual"
    return {
        "data": traces,
        "layout": layout(
            xaxis=axis(over),
            yaxis=axis(title),
            shapes=_band(s.floor) if what == "residual" else [],
            showlegend=legend,
        ),
    }


def _predicted(s: "SeriesView", x: Floats) -> list[Figure]:
    out = []
    for name, mask, tint, symbol in ways(s.direction):
        at, mean = by_place(x[mask], s.predicted[mask])
        # Both directions stay visible where their predictions are the same.
        line = {"color": tint if name else "@ink", "width": 3, "dash": "dash" if symbol == "triangle-down" else "solid"}
        shown = f"predicted{name}"
        out.append(
            {
                "type": "scatter",
                "mode": "lines",
                "name": shown,
                "x": numbers(at),
                "y": numbers(mean),
                "line": line,
                "hoverinfo": "skip",
            }
        )
    return out


def _each_predicted(s: "SeriesView", x: Floats, rows: Ints) -> list[Figure]:
    """The prediction of each reading: over a temperature or the time, readings of different places are no line."""
    out: list[Figure] = []
    for name, mask, tint, symbol in ways(s.direction):
        some = rows[mask[rows]]
        marker = {"color": tint if name else "@ink", "symbol": f"{symbol}-open", "size": SMALL + 1}
        out.append(
            {
                "type": kind(len(s)),
                "mode": "markers",
                "name": f"predicted{name}",
                "x": numbers(x[some]),
                "y": numbers(s.predicted[some]),
                "marker": marker,
                "hoverinfo": "skip",
            }
        )
    return out


def over_time(s: "SeriesView", rows: Ints) -> Figure:
    """The residual of some readings over time, with the temperatures below."""
    title = next(t for t in s.channels if t.startswith("time "))
    x = s.channels[title]
    traces = [_points(s, rows, x, s.residuals, "residual", color="@c3")]
    for k, name in enumerate(s.sensors):
        line = {"color": PALETTE[k % 8], "width": 2, "dash": ("solid", "dash", "dot")[k // 8 % 3]}
        thin = line_ends(s.channels[name])
        traces.append(
            {
                "type": "scatter",
                "mode": "lines",
                "name": text(name.removesuffix(", °C")),
                "x": numbers(x[thin]),
                "y": numbers(s.channels[name][thin]),
                "line": line,
                "yaxis": "y2",
            }
        )
    both = bool(s.sensors)
    whole = layout(
        xaxis=axis(title, anchor="y2" if both else "y"),
        yaxis=axis(f"residual, {s.unit}", domain=[0.52, 1.0] if both else [0.0, 1.0]),
        shapes=_band(s.floor),
        legend={"orientation": "h", "x": 0, "y": -0.14, "yanchor": "top", "font": {"size": 13}},
    )
    if both:
        whole["yaxis2"] = axis("temperature, °C", domain=[0.0, 0.42])
    return {"data": traces, "layout": whole}


def residual_map(s: "SeriesView", across: str, up: str) -> Figure:
    """Mean residual in each cell of two channels."""
    cuts, mean = cells_of(s.channels[across], s.channels[up], s.residuals)
    most = max(float(np.nanmax(np.abs(mean), initial=0.0)), s.floor, 1e-9)
    grid = [numbers(row) for row in mean]
    middles = [0.5 * (c[1:] + c[:-1]) for c in cuts]
    data = [
        {
            "type": "heatmap",
            "x": numbers(middles[0]),
            "y": numbers(middles[1]),
            "z": grid,
            "zmin": -most,
            "zmax": most,
            "colorscale": "RdBu",
            "reversescale": False,
            "colorbar": {"title": {"text": f"mean residual, {s.unit}", "side": "right"}},
            "hovertemplate": f"%{{x:.4g}}, %{{y:.4g}}: %{{z:.2f}} {s.unit}<extra></extra>",
        }
    ]
    return {"data": data, "layout": layout(xaxis=axis(across), yaxis=axis(up), dragmode="zoom")}


def polar(s: "SeriesView", angle_rad: Floats, rows: Ints) -> Figure:
    """Some readings of a ball bar on its circle: measured and predicted, outwards from a ring."""
    order = rows[np.argsort(angle_rad[rows], kind="stable")]
    most = max(float(np.abs(s.measured).max()), float(np.abs(s.predicted).max()), 1e-9)
    angle = numbers(np.rad2deg(angle_rad[order]))
    traces = [
        {
            "type": kind(len(s), "scatterpolar"),
            "mode": "markers",
            "name": "measured",
            "theta": angle,
            "r": numbers(s.measured[order] + 2 * most),
            "marker": {"size": 4, "color": "@c2"},
            "ids": [str(s.first + int(r)) for r in order],
        },
        {
            "type": kind(len(s), "scatterpolar"),
            "mode": "markers",
            "name": "predicted",
            "theta": angle,
            "r": numbers(s.predicted[order] + 2 * most),
            "marker": {"size": 3, "color": "@c3"},
        },
    ]
    ticks = [2 * most - most, 2 * most, 3 * most]
    radial = {
        "tickvals": ticks,
        "ticktext": [f"{v - 2 * most:+.1f} {s.unit}" for v in ticks],
        "gridcolor": "@grid",
        "range": [0, 3.2 * most],
    }
    turned = {"gridcolor": "@grid", "linecolor": "@muted"}
    return {"data": traces, "layout": layout(polar={"radialaxis": radial, "angularaxis": turned, "bgcolor": "@paper"})}


def evidence_figure(e: "Evidence", title: str = "") -> Figure:
    """The residual over the driver of a finding, and the finding's curve through it."""
    traces: list[Figure] = []
    over, left = e.dots
    rows = np.arange(len(over))
    if len(rows) > MOST // 2:
        rows = np.sort(np.random.default_rng(0).choice(rows, MOST // 2, replace=False))
    traces.append(
        {
            "type": kind(len(over)),
            "mode": "markers",
            "name": "residual, each reading",
            "x": numbers(over[rows]),
            "y": numbers(left[rows]),
            "marker": {"color": "@muted", "size": 4, "opacity": 0.4},
            "hoverinfo": "skip",
        }
    )
    for k, c in enumerate(e.curves):
        tint = {1: "@c3", -1: "@c2", 0: "@c3"}[c.direction] if len(e.curves) <= WAYS else PALETTE[1 + k % 7]
        held = "" if c.level is None else f", {e.second} {c.level:.4g}"
        way = {1: ", moving +", -1: ", moving −", 0: ""}[c.direction]
        symbol = {1: "triangle-up", -1: "triangle-down", 0: "circle"}[c.direction]
        traces.append(
            {
                "type": "scatter",
                "mode": "markers",
                "name": text(f"residual, mean{way}{held}"),
                "x": numbers(c.place),
                "y": numbers(c.residual),
                "marker": {"color": tint, "size": 9, "symbol": symbol},
            }
        )
        traces.append(
            {
                "type": "scatter",
                "mode": "lines",
                "name": text(f"fitted effect{way}{held}"),
                "x": numbers(c.place),
                "y": numbers(c.part),
                "line": {"color": tint, "width": 4, "dash": "dash" if c.direction < 0 else "solid"},
            }
        )
    heading = {"text": text(title), "x": 0, "xanchor": "left", "font": {"size": 16}} if title else None
    return {
        "data": traces,
        "layout": layout(
            xaxis=axis(e.below),
            yaxis=axis(f"residual, {e.unit}"),
            dragmode="zoom",
            title=heading,
            margin={"l": 70, "r": 20, "t": 90, "b": 56},
        ),
    }


def staircase(s: "Stairs") -> Figure:
    """The residual on held-out runs after each step, on a log axis, down to the noise floor.

    The current step is large; the present residual of other measurements is a mark beside the steps.
    """
    unit, places = ERROR_UNITS.get(s.unit, s.unit), list(range(len(s.names)))
    steps = len(places) - s.ends_now
    end = max(len(places) - 0.2, 1.5)
    point: Figure = {"type": "scatter", "textposition": "top right", "textfont": {"size": 16}, "cliponaxis": False}
    point |= {"hovertemplate": "%{text}<extra></extra>"}
    edge = {"width": 2, "color": "@ink"}
    traces: list[Figure] = []
    if steps:
        traces.append(
            point
            | {
                "mode": "lines+markers+text",
                "name": "residual on held-out runs",
                "x": places[:steps],
                "y": s.errors[:steps],
                "text": [f"{e:.2f} {unit}" for e in s.errors[:steps]],
                "line": {"shape": "hv", "width": 4, "color": "@c3"},
                "marker": {"size": [20 if k == s.at else 12 for k in places[:steps]], "color": "@c3", "line": edge},
            }
        )
    if s.ends_now:
        traces.append(
            point
            | {
                "mode": "markers+text",
                "name": "residual of these measurements",
                "x": places[-1:],
                "y": s.errors[-1:],
                "text": [f"{s.errors[-1]:.2f} {unit}"],
                "marker": {"size": 20, "symbol": "diamond", "color": "@c2", "line": edge},
            }
        )
    notes: list[Figure] = []
    known = [*s.errors, *([s.floor] if s.floor else [])]
    low, high = min(known) / 1.7, max(known) * 1.6
    if s.floor:
        traces.append(
            {
                "type": "scatter",
                "mode": "lines",
                "name": "noise floor",
                "x": [-0.4, end],
                "y": [s.floor, s.floor],
                "line": {"dash": "dash", "width": 3, "color": "@ink"},
                "hoverinfo": "skip",
            }
        )
        below = {"x": end, "xanchor": "right", "y": float(np.log10(s.floor)), "yanchor": "top", "yshift": -4}
        notes.append(below | {"text": f"noise floor {s.floor:.2f} {unit}", "showarrow": False, "font": {"size": 14}})
    ticks = log_ticks(low, high)
    up = axis(
        f"residual on held-out runs, {unit}" if steps else f"residual, {unit}",
        type="log",
        range=[float(np.log10(low)), float(np.log10(high))],
        fixedrange=True,
        tickvals=ticks,
        ticktext=[f"{v:g}" for v in ticks],
    )
    across = axis(
        "",
        fixedrange=True,
        zeroline=False,
        tickvals=places,
        ticktext=[_broken(n) for n in s.names],
        range=[-0.4, end],
    )
    whole = layout(xaxis=across, yaxis=up, dragmode=False, showlegend=False, annotations=notes)
    return {"data": traces, "layout": whole}


def _broken(name: str) -> str:
    return text(name).replace("(", "<br>(", 1).replace(", these", ",<br>these")


def bars(rows: Mapping[str, float], units: Mapping[str, str], title: str, words: Mapping[str, str]) -> Figure:
    """Bars, largest at the top, in a panel for each unit; each with its name above, in words, its number and its unit.

    Args:
        rows: values by name, largest first.
        units, words: by name.
        title: title of the horizontal axes, without the unit.
    """
    groups = [(unit, [n for n in rows if units[n] == unit]) for unit in dict.fromkeys(units[n] for n in rows)]
    lines = len(rows) + BETWEEN * (len(groups) - 1)
    data: list[Figure] = []
    whole = layout(dragmode=False, showlegend=False, margin={"l": 24, "r": 40, "t": 34, "b": 56}, annotations=[])
    top = 1.0
    for k, (unit, names) in enumerate(groups):
        mark, values = str(k + 1) if k else "", [float(rows[n]) for n in names]
        down = list(range(len(names)))
        data.append(
            {
                "type": "bar",
                "orientation": "h",
                "x": values,
                "y": down,
                "xaxis": f"x{mark}",
                "yaxis": f"y{mark}",
                "customdata": names,
                "marker": {"color": "@c3"},
                "text": [f"{number(v, 2, sign=True)} {unit}" for v in values],
                "textposition": "outside",
                "textfont": {"size": 15},
                "cliponaxis": False,
                "width": 0.4,
                "hovertemplate": "%{customdata}: %{text}<extra></extra>",
            }
        )
        most = max(map(abs, values)) or 1.0
        low, high = min(0.0, *values), max(0.0, *values)
        ends = [low - (ASIDE if low < 0.0 else 0.04) * most, high + (ASIDE if high > 0.0 else 0.04) * most]
        bottom = max(top - len(names) / lines, 0.0)
        named = title if len(groups) == 1 else ("angles" if unit == "µrad" else "lengths")
        across = axis(f"{named}, {unit}", fixedrange=True, range=ends, anchor=f"y{mark}", zeroline=True, nticks=6)
        up = axis("", fixedrange=True, range=[len(names) - 0.5, -0.75], domain=[bottom, top], anchor=f"x{mark}")
        whole[f"xaxis{mark}"] = across | {"zerolinecolor": "@ink"}
        whole[f"yaxis{mark}"] = up | {"showticklabels": False, "showgrid": False, "zeroline": False, "showline": False}
        for place, n in zip(down, names, strict=True):
            at = {"xref": f"x{mark} domain", "x": 0, "xanchor": "left", "yref": f"y{mark}", "y": place - 0.28}
            shown = {"text": f"<b>{text(n)}</b> {text(words[n])}", "showarrow": False, "yanchor": "bottom"}
            whole["annotations"].append({**at, **shown, "align": "left", "font": {"size": 13}, "bgcolor": "@paper"})
        top = bottom - BETWEEN / lines
    return {"data": data, "layout": whole}


def bars_px(units: Sequence[str]) -> int:
    """Height of a plot of bars, from the unit of each."""
    return round(90 + 58 * (len(units) + BETWEEN * (len(set(units)) - 1)))
