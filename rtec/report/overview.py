"""Overviews of a machine file and of a measurement."""

from typing import TYPE_CHECKING

import numpy as np

from rtec.arrays import Floats
from rtec.report.figures import LINES, as_png, canvas
from rtec.report.page import Figure, Page, Section, Table
from rtec.wording import ERROR_UNITS, counted, number, significant

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MplFigure

    from rtec.machine import Machine
    from rtec.metrology.importing import Imported
    from rtec.metrology.measurement import Measurement
    from rtec.sim.campaign.campaign import Simulated


def machine_page(machine: "Machine") -> Page:
    """Axes, chain, sensors, component errors and channels of a machine."""
    head = ("axis", "along", "travel, mm", "counts per mm", "one count, µm", "pitch, mm", "corrected")
    rows = [
        (
            a.name,
            a.direction,
            f"{a.travel_mm[0]:g} to {a.travel_mm[1]:g}",
            f"{a.counts_per_mm:g}",
            significant(1e3 / a.counts_per_mm),
            "-" if a.pitch_mm is None else f"{a.pitch_mm:g}",
            "yes" if a.compensate else "no",
        )
        for a in machine.axes
    ]
    sensors = [(s.name, f"{s.range_degc[0]:g} to {s.range_degc[1]:g}") for s in machine.sensors]
    chain = [
        f"From the base to the tool tip: {' > '.join(machine.tool_chain)}.",
        f"From the base to the cutting point: {' > '.join(machine.work_chain) or 'nothing moves'}.",
    ]
    sections = [
        Section("Axes", (), Table(head, rows, words=(0, 1, 2, 6))),
        Section("Chain", chain),
        Section("Sensors", (), Table(("sensor", "believed from … to, °C"), sensors, words=(0, 1)))
        if sensors
        else Section("Sensors", ("None.",)),
        Section("Component errors", (", ".join(machine.components),)),
        Section("Channels that an effect may read", (", ".join(machine.channel_names),)),
    ]
    return Page(machine.name, f"{machine.name}\nmachine_hash {machine.hash}", (), sections)


WAYS = {1.0: ("moving +", "-", "o"), -1.0: ("moving −", "--", "s"), 0.0: ("no direction", ":", ".")}


def measurement_page(m: "Measurement", figures: bool = True) -> Page:
    """Set-up, columns and ranges of a measurement."""
    facts = m.facts()
    along = f" along {m.instrument.axis}" if m.instrument.axis else ""
    lead = (
        f"{m.name}: {m.instrument.name}{along}, {counted(len(m), 'reading')} in {counted(facts['runs'], 'run')} over "
        f"{number(facts['hours'], 1)} h."
    )
    rows = [[name, *_spread(m.readings[name])] for name in m.instrument.columns()]
    table = Table(("column", "unit", "readings", "mean", "standard deviation", "lowest", "highest"), [
        [name, ERROR_UNITS[_unit(name)], *rest] for name, *rest in rows
    ], words=(0, 1))  # fmt: skip
    figure = Figure("readings.png", _drawn(m), "Every reading over the position or the time.") if figures else None
    return Page(f"Measurement {m.name}", lead, [], [Section("Readings", [f"{n}." for n in m.notes], table, figure)])


def recorded_page(s: "Simulated", figures: bool = True) -> Page:
    """The page of a simulated measurement."""
    return measurement_page(s.measurement, figures)


def imported_page(i: "Imported", figures: bool = True) -> Page:
    """The page of an import; with the readings where a machine was given."""
    if i.measurement is not None:
        return measurement_page(i.measurement, figures)
    lead = f"{counted(i.rows_in, 'row')} in, {counted(i.rows_out, 'row')} out; not checked against a machine."
    return Page("Imported table", lead, [], [Section("Notes", [f"{n}." for n in i.notes])])


def _unit(column: str) -> str:
    return column.rpartition("_")[2]


def _spread(values: Floats) -> list[str]:
    read = values[np.isfinite(values)]
    return [str(len(read)), *(number(float(f(read))) for f in (np.mean, np.std, np.min, np.max))]


@as_png
def _drawn(m: "Measurement") -> "MplFigure":
    """Readings over the axis that the instrument follows, each direction with its own line; else over time."""
    figure = canvas(5.5)
    ax = figure.subplots()
    names = m.instrument.columns()
    axis = next((a for a in m.machine.axes if a.name == m.instrument.axis and a.channel in m.channels), None)
    for k, name in enumerate(names):
        colour, label = LINES[k % len(LINES)], f"{name}, " if len(names) > 1 else ""
        if axis is None:
            ax.plot(m.time_s / 3600.0, m.readings[name], ".", color=colour, label=name)
            continue
        x, way = m.channels[axis.channel], m.state().value(axis.direction_channel)
        for direction, (words, line, marker) in WAYS.items():
            at = way == direction
            for run in np.unique(m.run[at]):
                here = at & (m.run == run)
                first = label + words if run == m.run[at][0] else None
                shade = colour if direction >= 0 or len(names) > 1 else LINES[1]
                ax.plot(x[here], m.readings[name][here], line, marker=marker, color=shade, linewidth=1.0, label=first)
    ax.set_xlabel(f"{axis.name}, mm" if axis is not None else "time, h")
    ax.set_ylabel(f"reading, {' and '.join(dict.fromkeys(ERROR_UNITS[_unit(n)] for n in names))}")
    ax.set_title(m.name)
    ax.legend(loc="best", fontsize=12)
    return figure
