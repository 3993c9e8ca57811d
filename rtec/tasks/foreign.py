"""Tasks of a worker process on a file of another program: look at it, import it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import rtec
from rtec.arrays import Floats
from rtec.errors import RtecError
from rtec.tasks.jobs import Reporter

if TYPE_CHECKING:
    from rtec.machine import Machine
    from rtec.metrology.importing import ImportProposal

PREVIEWED = 6000
"""Largest number of drawn readings of a foreign file."""


@dataclass(frozen=True)
class ImportView:
    """Preview of the import of a file of another program.

    Attributes:
        proposal: its map, and questions.
        title, place, readings: the plot: title and values of the horizontal axis, (n,), and the readings by name, (n,)
            each; of very many readings an even selection.
        rows: number of rows of the measurement; 0 before the questions are answered.
        notes: notes on the import, in words.
        trouble: why it cannot be imported like this; else empty.
    """

    proposal: "ImportProposal"
    title: str = ""
    place: Floats = field(default_factory=lambda: np.zeros(0))
    readings: Mapping[str, Floats] = field(default_factory=dict)
    rows: int = 0
    notes: tuple[str, ...] = ()
    trouble: str = ""


def look_at_foreign(
    line: Reporter,
    path: Path,
    machine: Path | None,
    answers: Mapping[str, str],
    edited: Mapping[str, Mapping[str, Any]] | None,
    temperatures: str = "",
) -> ImportView:
    """Propose a map for a file, and import it in memory if all questions are answered.

    Args:
        line: the reporter.
        path: path of the file.
        machine: file of the machine; None: not chosen yet.
        answers: answers to its questions, by key.
        edited: columns of the map that the user changed; None: as proposed.
        temperatures: name of a log of temperatures beside it; empty: there is none.

    Raises:
        RtecError: the file cannot be read.
    """
    from rtec.metrology.importing import import_measurement

    line.stage("reading the file", 0, 0)
    known = rtec.load_machine(machine) if machine is not None else None
    log = {"temperatures": {"file": temperatures}} if temperatures else {}
    proposal = _proposed(path, known, log, dict(answers))
    if edited is not None:
        proposal = proposal.with_columns(edited)
    if proposal.open or known is None:
        return ImportView(proposal)
    try:
        m = import_measurement(path, proposal.import_map(), known)
    except RtecError as e:
        return ImportView(proposal, trouble=str(e))
    moved = max(known.axes, key=lambda a: float(np.ptp(m.channels.get(a.channel, np.zeros(1)))))
    place = m.channels.get(moved.channel)
    title, over = ("time, h", m.time_s / 3600.0) if place is None else (f"{moved.name}, mm", place)
    some = slice(None, None, max(1, len(m) // PREVIEWED))
    readings = {name: values[some] for name, values in m.readings.items()}
    return ImportView(proposal, title, over[some], readings, len(m), m.notes)


def _proposed(
    path: Path, machine: "Machine | None", preset: Mapping[str, Any], answers: dict[str, str]
) -> "ImportProposal":
    """The proposal; an answer to a question that another answer took away is forgotten."""
    from rtec.metrology.importing import propose

    first = propose(path, machine, preset)
    for key, value in answers.items():
        if key in {q.key for q in first.questions}:
            first = first.answered({key: value})
    return first


def import_foreign(line: Reporter, path: Path, proposal: "ImportProposal", out: Path) -> tuple[str, ...]:
    """Write a file of another program as a measurement, with the map that made it; give the notes on it."""
    line.stage("importing", 0, 0)
    return rtec.import_table(path, proposal, out).notes
