"""The measuring day: the model's only source.

It is not the day that is corrected (another seed): the spindle runs in steps with rests between, and every half hour,
later every hour, a probe reads the radial and axial tip error along lines, in both directions. It does not read the
error across (Y), because no axis could correct it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from rtec.arrays import Floats, Ints
from rtec.characterise.run import characterise, fitted_model
from rtec.demo.hidden import Fault, with_fault
from rtec.effects import Effect, State, effect_class
from rtec.effects.effect_list import AskedEffects
from rtec.machine import Machine
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from rtec.sim.machine import SimulatedMachine
from rtec.sim.truth import Truth
from rtec.tomlfile import digest, validated

Progress = Callable[[int, int], None]

PROBE_NOISE_UM = 0.3
LOG_EVERY_S = 10
LINE_S = 30
"""Duration of a line of stations, with the spindle at rest."""
SESSION_S = 1800
# (hours, spindle 1/min, share of the time that the axes move): up and down, with rests, because effects that only
# rise together are confounded.
SCHEDULE = (
    (2.0, 2800.0, 0.35),
    (1.0, 0.0, 0.0),
    (1.5, 1600.0, 0.6),
    (2.0, 3300.0, 0.15),
    (1.0, 0.0, 0.5),
    (2.5, 2400.0, 0.4),
    (1.0, 1200.0, 0.1),
    (2.0, 3000.0, 0.5),
    (7.0, 0.0, 0.0),
)
Z_LINES_AT_X_MM = (20.0, 150.0)
X_LINES_AT_Z_MM = (90.0, 310.0)
Z_STEP_MM, X_STEP_MM = 11.3, 5.9
"""Steps that are no multiples of the screws' pitch, which would hide their cyclic error."""
SHORT_SCHEDULE = (
    (2.0, 2800.0, 0.35),
    (1.0, 0.0, 0.0),
    (1.5, 1600.0, 0.6),
    (1.5, 3300.0, 0.15),
    (1.0, 0.0, 0.5),
    (2.0, 2400.0, 0.4),
    (3.0, 0.0, 0.0),
)
SHORT_EVERY_S, SHORT_Z_STEP_MM, SHORT_X_STEP_MM = 2700, 23.7, 10.9
BLOCK, OF_BLOCKS = 3, 4
"""The control fit holds out every fourth block of three sessions: whole hours."""

EFFECTS: tuple[dict[str, object], ...] = (
    # The shape of the guides and screws at 20 °C.
    {"effect": "piecewise_position", "component": "EXZ", "axis": "Z", "knots_mm": list(range(0, 401, 10))},
    {"effect": "piecewise_position", "component": "EZX", "axis": "X", "knots_mm": list(range(0, 201, 8))},
    {"effect": "polynomial_position", "component": "EXX", "axis": "X", "degrees": list(range(1, 13))},
    {"effect": "polynomial_position", "component": "EZZ", "axis": "Z", "degrees": list(range(1, 13))},
    {"effect": "polynomial_position", "component": "EBZ", "axis": "Z", "degrees": list(range(1, 7))},
    {"effect": "cyclic_screw", "component": "EXX", "axis": "X", "harmonics": 2},
    {"effect": "cyclic_screw", "component": "EZZ", "axis": "Z", "harmonics": 2},
    {"effect": "backlash", "component": "EXX", "axis": "X"},
    {"effect": "backlash", "component": "EZZ", "axis": "Z"},
    # Screws: no sensor turns with a screw; the nut's is the nearest one.
    {"effect": "axis_expansion", "component": "EXX", "axis": "X", "sensor": "T_x_nut"},
    {"effect": "axis_expansion", "component": "EZZ", "axis": "Z", "sensor": "T_z_nut"},
    {"effect": "axis_expansion_nonuniform", "component": "EZZ", "axis": "Z", "sensor": "T_z_nut"},
    # Structure.
    {"effect": "spindle_growth", "component": "EZ0spindle", "sensor": "T_spindle_front"},
    {"effect": "mount_expansion", "component": "EZ0spindle", "sensor": "T_headstock"},
    {"effect": "mount_expansion", "component": "EZZ", "sensor": "T_bed"},
    {"effect": "mount_expansion", "component": "EZZ", "sensor": "T_z_nut"},
    {"effect": "mount_expansion", "component": "EX0spindle", "sensor": "T_headstock"},
    {"effect": "column_tilt", "component": "EX0spindle", "front": "T_spindle_front", "back": "T_headstock"},
    {"effect": "mount_expansion", "component": "EXX", "sensor": "T_carriage"},
    {"effect": "mount_expansion", "component": "EXX", "sensor": "T_x_nut"},
    {"effect": "ambient_drift", "component": "EXX", "sensor": "T_air"},
    {"effect": "column_tilt", "component": "EB0spindle", "front": "T_spindle_front", "back": "T_spindle_rear"},
    {"effect": "column_tilt", "component": "EB0Z", "front": "T_headstock", "back": "T_bed"},
)


@dataclass(frozen=True)
class Visit:
    """Programme of a measuring day with the probe.

    Attributes:
        schedule: hours, spindle 1/min, share of motion; one after the other.
        every_s: time from session to session; twice as long in phases of four hours and more.
        z_step_mm, x_step_mm: distance between stations of a line.
    """

    schedule: tuple[tuple[float, float, float], ...] = SCHEDULE
    every_s: int = SESSION_S
    z_step_mm: float = Z_STEP_MM
    x_step_mm: float = X_STEP_MM


SHORT = Visit(SHORT_SCHEDULE, SHORT_EVERY_S, SHORT_Z_STEP_MM, SHORT_X_STEP_MM)
"""Half a day with fewer stations."""


@dataclass(frozen=True)
class MeasuringDay:
    """Readings of the measuring day.

    Attributes:
        state: temperatures of the whole day, with positions and directions of the readings.
        tip_um: readings, (n, 3); NaN where there is none.
        noise_free_um: the readings without noise.
        session: session of each instant, (n,); -1 between sessions.
    """

    state: State
    tip_um: Floats
    noise_free_um: Floats
    session: Ints

    @property
    def readings(self) -> int:
        """Number of readings."""
        return int(np.isfinite(self.tip_um).sum())


def effects() -> list[Effect]:
    """The effects of the model, without numbers."""
    return [validated(effect_class(str(e["effect"]), "demo"), e, "demo") for e in EFFECTS]


def measure(
    machine: Machine,
    truth: Truth,
    seed: int,
    progress: Progress | None = None,
    visit: Visit | None = None,
    fault: Fault | None = None,
) -> MeasuringDay:
    """Simulate the measuring day of a seed.

    Args:
        machine, truth: the measured machine.
        seed: seed of the day.
        progress: progress callback, called with the seconds done and in total.
        visit: programme of the day; by default a whole day.
        fault: additional fault of the machine.
    """
    visit = visit or Visit()
    sim = with_fault(SimulatedMachine(machine, truth, seed), fault, seed)
    day = _Notebook(sim, np.random.default_rng([seed, 30]), visit)
    day.session()
    total = sum(hours for hours, _, _ in visit.schedule) * 3600
    for hours, rpm, duty in visit.schedule:
        every_s = visit.every_s if hours < 4.0 else 2 * visit.every_s
        for _ in range(max(1, round(hours * 3600 / every_s))):
            day.work(every_s - day.session_s, rpm, duty)
            day.session()
            if progress:
                progress(sim.thermal.time_s, round(total))
    return day.close()


def fit_day(day: MeasuringDay, tip_um: Floats | None = None, name: str = "turning-centre") -> Model:
    """Characterise the machine from the readings of a day, as `rtec fit --effects`.

    Args:
        day: the measuring day.
        tip_um: other readings at the same instants; their model is for predictions only, and is not judged.
        name: name of the model.
    """
    wanted = AskedEffects((), tuple(effects()))
    if tip_um is not None:
        return fitted_model([measurement_of(day, tip_um)], wanted=wanted, name=name)
    return characterise([measurement_of(day, day.tip_um)], wanted=wanted, name=name).model


def held_out_rms_um(day: MeasuringDay) -> tuple[float, float]:
    """Root mean square of readings minus prediction, µm: of the sessions in the fit, and of the held-out ones."""
    out = (day.session >= 0) & (day.session // BLOCK % OF_BLOCKS == 1)
    model = fit_day(day, np.where(out[:, None], np.nan, day.tip_um))
    left = day.tip_um - model.predict(day.state)
    return tuple(float(np.sqrt(np.nanmean(left[part] ** 2))) for part in (~out, out))  # type: ignore[return-value]


def measurement_of(day: MeasuringDay, tip_um: Floats, name: str = "measuring-day") -> Measurement:
    """The readings of X and Z as a measurement; a session is a run, together with the work before the next."""
    machine = day.state.machine
    setup = {"directions": ["X", "Z"], "zero": "none"}
    probe = make_instrument("tool_tip", setup, None, None, machine, name)
    content = digest([day.state.time_s.tolist(), np.nan_to_num(tip_um).tolist()])
    return Measurement(
        name=name,
        instrument=probe,
        machine=machine,
        run=np.maximum.accumulate(np.maximum(day.session, 0)),
        time_s=day.state.time_s,
        channels=day.state.channels,
        readings={"reading_x_um": tip_um[:, 0], "reading_z_um": tip_um[:, 2]},
        sha256=content,
    )


class _Notebook:
    """Runs through the day and collects the readings."""

    def __init__(self, sim: SimulatedMachine, rng: np.random.Generator, visit: Visit) -> None:
        self._sim, self._rng, self._visit, self._sessions = sim, rng, visit, 0
        self._rows: list[tuple[Floats, Floats, Floats, Floats, int]] = []
        self.session_s = LINE_S * (len(Z_LINES_AT_X_MM) + len(X_LINES_AT_Z_MM))

    def work(self, seconds: int, rpm: float, duty: float) -> None:
        for _ in range(seconds // LOG_EVERY_S):
            self._sim.work(LOG_EVERY_S, rpm, duty)
            self._log(np.zeros((1, 2)), np.zeros((1, 2)), -1)

    def session(self) -> None:
        """Read every line in both directions, from a start that differs each time."""
        for line in self._lines():
            self._sim.work(LINE_S)
            towards = np.sign(line[-1] - line[0]) + (line[-1] == line[0])
            self._log(line, np.broadcast_to(towards, line.shape), self._sessions)
            back = np.where(line[-1] == line[0], 1.0, -towards)
            self._log(line[::-1], np.broadcast_to(back, line.shape), self._sessions)
        self._sessions += 1

    def _lines(self) -> Sequence[Floats]:
        z_step_mm, x_step_mm = self._visit.z_step_mm, self._visit.x_step_mm
        z = np.arange(self._rng.uniform(0.0, z_step_mm), 400.0, z_step_mm)
        x = np.arange(self._rng.uniform(0.0, x_step_mm), 200.0, x_step_mm)
        along_z = [np.stack([np.full(len(z), at), z], axis=1) for at in Z_LINES_AT_X_MM]
        return [*along_z, *(np.stack([x, np.full(len(x), at)], axis=1) for at in X_LINES_AT_Z_MM)]

    def _log(self, position: Floats, direction: Floats, session: int) -> None:
        degc, _ = self._sim.temperatures()
        error = np.full((len(position), 3), np.nan)
        if session >= 0:
            error = self._sim.geometric_error_at_um(position, direction)
            error[:, 1] = np.nan
        time = np.full((len(position), 1), self._sim.time_ns * 1e-9)
        degc = np.broadcast_to(degc, (len(position), len(degc)))
        self._rows.append((time, np.concatenate([position, direction, degc], axis=1), error, degc, session))

    def close(self) -> MeasuringDay:
        """The collected readings as arrays."""
        machine = self._sim.machine
        table = np.concatenate([row[1] for row in self._rows])
        axes, error = machine.axes, np.concatenate([row[2] for row in self._rows])
        names = [*(a.channel for a in axes), *(a.direction_channel for a in axes), *machine.sensor_names]
        channels = {name: np.ascontiguousarray(table[:, i]) for i, name in enumerate(names)}
        state = State(machine, np.concatenate([row[0][:, 0] for row in self._rows]), channels)
        noise = PROBE_NOISE_UM * self._rng.standard_normal(error.shape)
        session = np.concatenate([np.full(len(row[0]), row[4]) for row in self._rows])
        return MeasuringDay(state, error + noise, error, session)
