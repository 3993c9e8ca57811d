"""The columns that a measurement file may have, and the faults of others.

In a ball-bar table angles give positions, and the circle gives directions, velocities and accelerations.
"""

import difflib
import json
import re
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from rtec.arrays import Floats, Ints
from rtec.errors import MeasurementError
from rtec.machine import Machine
from rtec.metrology.files.faults import Faults
from rtec.metrology.instruments.ball_bar import BallBar, BallBarSetup, axis_along, circle_channels, travelled_deg
from rtec.metrology.instruments.base import Instrument
from rtec.metrology.units import SUFFIXES
from rtec.tomlfile import nearest
from rtec.wording import significant

PREFIXES = ("run", "time", "reading", "spindle", "feed", "load", "force", "angle", "dir_")


def check_columns(
    names: Sequence[str], machine: Machine, instrument: Instrument, ignored: Iterable[str], faults: Faults
) -> tuple[list[str], list[str]]:
    """Sort the columns of a file.

    Returns:
        Names to read, in the order of the file, and names that are not read.
    """
    allowed = {"run", "time_s", *instrument.columns(), *machine.columns}
    wished = set(ignored)
    used, unread = [], []
    for name in dict.fromkeys(names):
        if names.count(name) > 1:
            faults.whole(f"column {name!r} stands {names.count(name)} times in the header; keep one")
        if name in wished:
            unread.append(name)
        elif name in allowed:
            used.append(name)
        elif reason := _unknown(name, allowed, machine, instrument):
            faults.whole(f"{reason}; or leave it unread with ignore_columns = [{name!r}] under [table]")
        else:
            unread.append(name)
    for name in sorted(wished - set(names)):
        faults.whole(f"ignore_columns names {name!r}, which is no column of the file{nearest(name, names)}")
    _missing(used, names, machine, instrument, faults)
    return used, unread


def _missing(
    used: Sequence[str], names: Sequence[str], machine: Machine, instrument: Instrument, faults: Faults
) -> None:
    ways = {
        "run": "it numbers the uninterrupted traverses or cycles: 1 in every row where there is only one",
        "time_s": "seconds since the start; `rtec import` makes it from times of day, or from the order of rows",
    }
    needed = ["run", "time_s", *instrument.columns()]
    followed = next((a.channel for a in machine.axes if a.name == instrument.axis), None)
    # An instrument that may name an axis (a drift probe) need not follow it; that axis may be at rest.
    if followed is not None and instrument.axis_use == "required":
        needed.append(f"{followed}_mm")
        ways[needed[-1]] = f"the {instrument.name} follows axis {instrument.axis}; give its commanded position in mm"
    read = [d for d in getattr(instrument.setup, "directions", ()) if f"reading_{d.lower()}_um" in used]
    fewer = f"; with directions = {json.dumps(read)} in [setup] it reads no others" if read else ""
    for name in needed:
        if name not in used:
            way = ways.get(name, f"the {instrument.name} gives {', '.join(instrument.columns())}{fewer}")
            faults.whole(f"column {name!r} is missing{_near(name, set(names) - set(used))}; {way}")


def _near(name: str, names: Iterable[str]) -> str:
    by_letters = {n.strip().lower(): n for n in names}
    close = difflib.get_close_matches(name, by_letters, n=1, cutoff=0.6)
    return f" (there is {by_letters[close[0]]!r})" if close else ""


def is_own(name: str, machine: Machine) -> bool:
    """Whether a column is the user's own: no name that rtec reads, nor a wrong one of these."""
    allowed = {"run", "time_s", *machine.columns}
    return name not in allowed and not name.lower().startswith("reading") and not _unknown(name, allowed, machine, None)


def _unknown(name: str, allowed: set[str], machine: Machine, instrument: Instrument | None) -> str:
    """Why a column is wrong; empty for a column of the user's own, which is ignored."""
    if not name.strip():
        return "a column has no name"
    same = {a.lower(): a for a in allowed}
    tidy = name.strip().lower()
    if tidy in same:
        return f"unknown column {name!r}; write {same[tidy]!r} (names are exact: letters large and small, no blanks)"
    if wrong := _wrong_unit(tidy, same):
        return f"column {name!r}: {wrong}"
    if tidy.endswith("_degc"):
        sensors = [f"{s}_degc" for s in machine.sensor_names]
        return f"column {name!r}: machine {machine.name!r} has no such sensor{nearest(name, sensors)}"
    if tidy.startswith("reading") and instrument is not None:
        return f"unknown column {name!r}; the {instrument.name} gives {', '.join(instrument.columns())}"
    if _is_motion(tidy):
        return f"unknown column {name!r}: machine {machine.name!r} has axes {', '.join(machine.axis_names)}"
    if tidy.startswith(PREFIXES) or difflib.get_close_matches(tidy, same, n=1, cutoff=0.85):
        return f"unknown column {name!r}{nearest(name, allowed)}"
    return ""


def _is_motion(name: str) -> bool:
    """Whether a name looks like position, direction, speed or acceleration of an axis that the machine lacks."""
    return bool(re.fullmatch(r"[a-z]_(mm|um|m|inch|nm)|dir_\w+|v\w{1,3}_mm_s|a\w{1,3}_mm_s2", name))


def _wrong_unit(name: str, same: Mapping[str, str]) -> str:
    """The correct name where a name differs from a known column only by its unit."""
    endings = sorted(SUFFIXES, key=len, reverse=True)
    for right in same:
        ending = next((e for e in endings if right.endswith(e)), "")
        stem = right.removesuffix(ending)
        if not ending or not re.fullmatch(re.escape(stem) + r"(_[a-zµμ°]{1,4}(_(s2?|min))?|)", name):
            continue
        # `reading_x` may be the x reading without its unit: no wrong unit of `reading_um`.
        if not (stem == "reading" and re.fullmatch(r"reading_[a-z]", name)):
            return (
                f"{same[right]!r} is what is read, in {SUFFIXES[ending]}; rename it if its numbers are in "
                f"{SUFFIXES[ending]}, else convert it with `rtec import` (a map with unit = …)"
            )
    return ""


OFF_CIRCLE_MM = 0.05
"""Rounding of commanded positions stays far below this; feed-in and feed-out moves do not."""


def on_circle(
    instrument: Instrument, machine: Machine, channels: dict[str, Floats], run: Ints, where: str
) -> dict[str, Floats]:
    """Add positions, angles, directions, velocities and accelerations that a ball-bar table lacks.

    Raises:
        MeasurementError: a ball bar has neither angles nor positions, leaves its circle, or moves against its
            direction.
    """
    if not isinstance(instrument, BallBar):
        return channels
    setup = instrument.setup
    angle_deg = channels.get("angle_deg")
    if angle_deg is None:
        angle_deg = _angles(machine, setup, channels, where)
    _same_sense(setup, angle_deg, run, where)
    return circle_channels(machine, setup, np.deg2rad(angle_deg)) | channels | {"angle_deg": angle_deg}


def still_right(instrument: Instrument, notes: Iterable[str]) -> list[str]:
    """Notes on a table, without those on missing positions where the angles gave them."""
    return [n for n in notes if not (isinstance(instrument, BallBar) and n.startswith("no column "))]


def _angles(machine: Machine, setup: BallBarSetup, channels: dict[str, Floats], where: str) -> Floats:
    """Angle of commanded positions, degrees, (n,)."""
    beside: list[Floats] = []
    for letter, centre in zip(setup.letters[:2], (setup.centre_mm[i] for i in setup.rows[:2]), strict=True):
        axis = axis_along(machine, letter)
        if axis is None or axis.channel not in channels:
            name = f"{axis.channel}_mm" if axis else letter
            raise MeasurementError(
                f"{where}: neither column 'angle_deg' nor positions in both directions of plane {setup.plane} "
                f"({name!r} is missing); a ball bar needs one or the other"
            )
        same = [channels[a.channel] for a in machine.axes if a.direction == letter and a.channel in channels]
        beside.append(np.sum(same, axis=0) - centre)
    off = np.abs(np.hypot(beside[0], beside[1]) - setup.radius_mm)
    if off.max() > OFF_CIRCLE_MM:
        raise MeasurementError(
            f"{where}: {int((off > OFF_CIRCLE_MM).sum())} rows are off the circle about {list(setup.centre_mm)} of "
            f"radius {setup.radius_mm:g} mm, the first (row {int(np.argmax(off > OFF_CIRCLE_MM)) + 1}) by "
            f"{significant(off[int(np.argmax(off > OFF_CIRCLE_MM))])} mm; leave feed-in and feed-out out, or correct "
            "centre_mm and radius_mm"
        )
    return np.asarray(np.rad2deg(np.arctan2(beside[1], beside[0])), dtype=np.float64)


def _same_sense(setup: BallBarSetup, angle_deg: Floats, run: Ints, where: str) -> None:
    way = travelled_deg(setup, angle_deg, run)
    for number in np.unique(run):
        rows = way[run == number]
        if len(rows) > 1 and rows[-1] < rows[0]:
            raise MeasurementError(
                f"{where}: run {number} goes {'cw' if setup.sense > 0 else 'ccw'}, but [setup] direction is "
                f"{setup.direction!r} (from {setup.letters[0]} towards {setup.letters[1]}); one file for each sense"
            )
