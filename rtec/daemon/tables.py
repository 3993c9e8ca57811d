"""Compensation tables of a run file's `[table]`: rewritten while the machine warms up.

A thread of the supervisor checks once a second. It rewrites a file whole or not at all, at the interval or when the
prediction differs from it by enough, and limits the change of each value. While the mode is not "on", or a
temperature is stale or outside the model's range, the files stay unchanged, and the events have the reason.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Final, Self

import numpy as np

from rtec.arrays import Floats
from rtec.correction.tables import table_format
from rtec.correction.tables.predict import (
    History,
    beyond,
    checked,
    conditions,
    grids_mm,
    residuals,
    table_axes,
    table_of,
)
from rtec.correction.tables.table import CompensationTable, TableAxes, table_text
from rtec.daemon.status import Status
from rtec.daemon.supervision import DaemonPart, KeptThread
from rtec.errors import ConfigError, RtecError
from rtec.files import write_text
from rtec.loop.run_file import Setup, TableRewrites
from rtec.model import Model
from rtec.text import without_numbers

LOOK_S: Final = 1.0
LEAST_S: Final = 10.0
"""Shortest time, s, between two rewrites of a file."""
MOST_ROWS: Final = 4096
"""Rows of the kept history; beyond that its older half is thinned out."""
END_S: Final = 5.0


class TableFile:
    """One file, and its table.

    Args:
        key: of `files`: an axis, or a component.
        setup: setup with machine, model and `[table]`.

    Raises:
        ConfigError: the content of the file is no table of the format.
    """

    def __init__(self, key: str, setup: Setup, table: TableRewrites) -> None:
        self._key, self._table = key, table
        self.form = table_format(table.format, f"{setup.path}: [table] format")
        self.path = setup.base / table.files[key]
        self.moves, self.corrects, self._second = table_axes(setup.machine, key)
        self._grid, self._second_mm = grids_mm(self.form, self.moves, self._second, table.grid_mm)
        self._stop_um = setup.file.limits[self.corrects.name].stop_um
        self.written = self._read()
        self._written_s: float | None = None

    def look(self, now_s: float, model: Model, at: Mapping[str, float], history: History) -> str:
        """Rewrite it where that is due; give the text of an event, or "".

        Args:
            now_s: instant, s.
            model: model that predicts.
            at: present temperatures and speed.
            history: until now.

        Raises:
            ConfigError: the format cannot hold the prediction, the file cannot be written, or a value is beyond the
                limits.
        """
        since_s = np.inf if self._written_s is None else now_s - self._written_s
        if since_s < LEAST_S:
            return ""
        known = {k: v for k, v in at.items() if k in model.channels}
        whole = conditions(model, self.moves, known)
        predicted = table_of(
            model, self.moves, self.corrects, self._grid, whole, history, self._second, self._second_mm
        )
        target = checked(predicted, self.form)
        if target.largest_um > self._stop_um:
            raise ConfigError(
                f"{self.path}: not written: {target.largest_um:.1f} µm is beyond stop_um = {self._stop_um:g} of "
                f"[limits.{self.corrects.name}]"
            )
        old, table = self.written, self._table
        difference = target.largest_um if old is None else _difference_um(old, target)
        passed = table.change_um is not None and difference >= table.change_um
        due = old is None or (difference >= table.hysteresis_um and (passed or since_s >= table.interval_s))
        if not due:
            return ""
        new = target if old is None else checked(_limited(old, target, table.most_change_um), self.form)
        write_text(self.form.text(new), self.path, ConfigError)
        self.written, self._written_s = new, now_s
        return self._line(old, new, target, model, history)

    def _line(
        self, old: CompensationTable | None, new: CompensationTable, target: CompensationTable, model: Model,
        history: History,
    ) -> str:  # fmt: skip
        worst = residuals(model, target, history, slow=False)[0]
        made = ", ".join(f"{k} = {v:.4g}" for k, v in new.at.items() if k in model.channels)
        low, high = (float(f([new.forward_um, new.backward_um])) for f in (np.min, np.max))
        text = f"{self.path.name}: {'written' if old is None else 'rewritten'} for {made or 'all temperatures'}: "
        text += f"errors from {low:+.2f} to {high:+.2f} µm"
        if old is not None:
            text += f", changed by up to {_difference_um(old, new):.2f} µm"
        still = _difference_um(new, target)
        if still > self.form.limits.quantum_um:
            text += f" (limited by most_change_um; {still:.2f} µm are still to come)"
        return f"{text}; residual: up to {worst.largest_um:.2f} µm, {worst.what}"

    def _read(self) -> CompensationTable | None:
        try:
            text = table_text(self.path)
        except FileNotFoundError:
            return None
        axes = TableAxes(self.moves.name, self.corrects.name, self._second.name if self._second else "")
        try:
            content = self.form.read(text, str(self.path), axes)
            if content.others:
                raise ConfigError(f"{self.path}: holds {content.others} more tables, of other axes")
            return content
        except ConfigError as e:
            raise ConfigError(
                f"{e}; [table] files.{self._key} would replace it: name another file, or move this one away"
            ) from e


class TableKeeper:
    """All files of a run.

    Args:
        setup: with a `[table]`.
        report: puts a kind of event and a sentence into the events.

    Raises:
        ConfigError: an existing file is no table of the format; all of these.
    """

    def __init__(self, setup: Setup, report: Callable[[str, str], None]) -> None:
        self._report, self._files, faults = report, list[TableFile](), list[str]()
        table = setup.file.table
        for key in table.files if table else ():
            try:
                self._files.append(TableFile(key, setup, table))  # type: ignore[arg-type]
            except ConfigError as e:
                faults.append(str(e))
        if faults:
            raise ConfigError("\n".join(faults))
        self._times: list[float] = []
        self._slow: list[dict[str, float]] = []
        self._last_texts: dict[str, str] = {}

    def look(self, setup: Setup, status: Status, mode: str) -> None:
        """Check all files once.

        Args:
            setup: setup in force; its model may be newer than at the start.
            status: of the newest row.
            mode: the ordered mode: "on", "hold" or "off".
        """
        if not status.cycles or (self._times and status.time_s <= self._times[-1]):
            return
        model = setup.model
        names = [n for n in (*setup.machine.sensor_names, "spindle_rpm") if n in model.channels]
        now = {n: status.spindle_rpm if n == "spindle_rpm" else status.degc.get(n, np.nan) for n in names}
        inputs = setup.file.inputs
        now |= {n: float(getattr(inputs, n)) for n in ("load_kg", "force_n") if n in model.channels}
        why = "" if mode == "on" else f"the mode is {mode}"
        why = why or _unusable(now, status, model, setup.file.guard.temperature_max_age_s)
        if self._is_new("input", why) and why:
            self._report("table", f"the tables stay as they are: {why}")
        if not all(np.isfinite(list(now.values()))):
            return
        self._remember(status.time_s, now)
        if why:
            return
        history = self._history(names)
        for file in self._files:
            try:
                line, wrong = file.look(status.time_s, model, now, history), ""
            except RtecError as e:
                line, wrong = "", str(e)
            if line or (wrong and self._is_new(str(file.path), wrong)):
                self._report("table" if line else "alarm", line or wrong)
            if not wrong:
                self._last_texts.pop(str(file.path), None)

    def _is_new(self, about: str, text: str) -> bool:
        """Does the text differ from the last one? Differences in numbers do not count."""
        plain = without_numbers(text)
        before, self._last_texts[about] = self._last_texts.get(about, ""), plain
        return before != plain

    def _remember(self, time_s: float, now: dict[str, float]) -> None:
        self._times.append(time_s)
        self._slow.append(now)
        if len(self._times) > MOST_ROWS:
            half = MOST_ROWS // 2
            self._times[:half], self._slow[:half] = self._times[:half:2], self._slow[:half:2]

    def _history(self, names: list[str]) -> History:
        columns = {n: np.array([row.get(n, now) for row in self._slow]) for n, now in self._slow[-1].items()}
        return np.array(self._times), {n: columns[n] for n in names}


class TableThread:
    """Checks once a second, in a thread of its own: a slow disk delays nothing else.

    Args:
        keeper: keeper of the files; None: there are none.
        now: gives setup, status and ordered mode.
        part: counts its faults.
    """

    def __init__(
        self, keeper: TableKeeper | None, now: Callable[[], tuple[Setup, Status, str]], part: DaemonPart
    ) -> None:
        self._keeper, self._now = keeper, now
        self._thread = KeptThread(part, self._work)

    def __enter__(self) -> Self:
        if self._keeper is not None:
            self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._thread.end(END_S)

    def _work(self) -> None:
        while self._keeper is not None and not self._thread.stop.wait(LOOK_S):
            self._keeper.look(*self._now())


def _difference_um(a: CompensationTable, b: CompensationTable) -> float:
    """Largest difference at the points of `b`."""
    return max(
        float(np.abs(a.at_points_of(b, d) - values).max()) for d, values in ((1.0, b.forward_um), (-1.0, b.backward_um))
    )


def _limited(old: CompensationTable, target: CompensationTable, most_um: float) -> CompensationTable:
    """Change the old values towards the target, each by `most_um` at most."""

    def towards(direction: float, values: Floats) -> Floats:
        before = old.at_points_of(target, direction)
        return before + np.clip(values - before, -most_um, most_um)

    return replace(target, forward_um=towards(1.0, target.forward_um), backward_um=towards(-1.0, target.backward_um))


def _unusable(now: Mapping[str, float], status: Status, model: Model, most_s: float) -> str:
    """Why no prediction is possible now; "" where one is."""
    for name, value in now.items():
        if not np.isfinite(value):
            return f"{name} is not known"
        if status.degc_age_s.get(name, 0.0) > most_s:
            return f"{name} is old"
    return next(iter(beyond(model, now)), "")
