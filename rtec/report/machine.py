"""Page on a machine file: axes, chain, sensors, and the names that follow from them."""

from rtec.machine import Machine
from rtec.report.page import Page, Section, Table
from rtec.wording import significant


def machine_page(machine: Machine) -> Page:
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
