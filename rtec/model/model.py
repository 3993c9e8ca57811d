"""The model: a machine plus fitted effects, and how far its correction jumps when an axis turns round."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from rtec.arrays import Floats
from rtec.effects import Effect, Parameter, State
from rtec.effects.derived import FAR_MM
from rtec.effects.registry import check_effect
from rtec.errors import ModelError
from rtec.machine import Axis, Machine
from rtec.machine.machine import CONSTANT_CHANNELS
from rtec.model.at import state_at
from rtec.result import Shown
from rtec.tomlfile import digest, nearest

PLACES = 3
"""Positions along each axis, and levels of the temperatures, at which `reversal_um` evaluates the model."""


def reversal_um(model: "Model") -> dict[str, float]:
    """Largest rise of the tip error along each axis from moving negative to moving positive, µm, by axis name.

    Zero where the error falls at every such reversal, as with ordinary play: the correction then moves the axis further
    in its new direction. Where the error rises, the correction moves the axis back.

    Evaluated at the ends and the middle of every axis' travel, and at both ends of the temperatures' fitted range.
    """
    machine = model.machine
    turning = {a.name for a in machine.axes if {a.direction_channel, a.since_reversal_channel} & set(model.channels)}
    out = dict.fromkeys(machine.axis_names, 0.0)
    if not turning:
        return out
    poses = np.array(list(product(*(np.linspace(*a.travel_mm, PLACES) for a in machine.axes))))
    for axis in (a for a in machine.axes if a.name in turning):
        for level in range(PLACES):
            positive, negative = (_along(model, poses, level, axis, direction) for direction in (1.0, -1.0))
            out[axis.name] = max(out[axis.name], float((positive.max(axis=0) - negative.min(axis=0)).max()))
    return out


def _along(model: "Model", poses: np.ndarray, level: int, axis: Axis, direction: float) -> np.ndarray:
    """Tip error along an axis, µm, (distances, poses): at standstill, the other axes far from their reversal.

    Where the model reads the distance since the reversal, there are many distances: an error that builds up within
    micrometres moves the axis back as a jump does, and an axis may reverse again before the error has faded.
    """
    fades = axis.since_reversal_channel in model.channels
    since_mm = np.array([0.0, *np.logspace(-4, 3, 29), FAR_MM]) if fades else np.array([FAR_MM])
    rows = np.tile(poses, (len(since_mm), 1))
    tip = _tip(model, rows, level, axis.name, direction, np.repeat(since_mm, len(poses)))
    return tip[:, "XYZ".index(axis.direction)].reshape(len(since_mm), len(poses))


def _tip(
    model: "Model", poses: np.ndarray, level: int, turned: str, direction: float, since_mm: np.ndarray
) -> np.ndarray:
    machine, n = model.machine, len(poses)
    channels = {a.channel: poses[:, i] for i, a in enumerate(machine.axes)}
    channels |= {a.direction_channel: np.full(n, direction if a.name == turned else 1.0) for a in machine.axes}
    channels |= {a.since_reversal_channel: since_mm if a.name == turned else np.full(n, FAR_MM) for a in machine.axes}
    channels |= {c: np.zeros(n) for a in machine.axes for c in (a.velocity_channel, a.acceleration_channel)}
    for name in machine.slow_channels:
        usual = 0.0 if name in ("spindle_rpm", *CONSTANT_CHANNELS) else model.reference_degc
        low, high = model.valid_range.get(name, (usual, usual))
        channels[name] = np.full(n, (low, usual, high)[level])
    return model.predict(State(machine, np.zeros(n), channels, model.reference_degc))


@dataclass(frozen=True)
class FittedEffect:
    """An effect with its numbers.

    Attributes:
        effect: the effect and its arguments.
        values: coefficients by name.
        theta: non-linear parameters by name.
        errors: standard errors by name, of coefficients and of `theta`; unknown ones are missing.
    """

    effect: Effect
    values: Mapping[str, float]
    theta: Mapping[str, float] = field(default_factory=dict)
    errors: Mapping[str, float] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """Short name for tables: effect, component and arguments."""
        return self.effect.label


@dataclass(frozen=True)
class ErrorCorrelation:
    """ErrorCorrelation of the errors of a model's numbers.

    Attributes:
        numbers: place and label of the effect, from 1, and name of the number; as `number_names` gives them.
        rows: of each number with those before it, -1 to 1.
    """

    numbers: tuple[str, ...]
    rows: tuple[tuple[float, ...], ...]

    @classmethod
    def of(cls, numbers: Sequence[str], covariance: Floats) -> "ErrorCorrelation":
        """From the covariance of numbers, (n, n); those without an error correlate with none."""
        sizes = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        scale = np.where(sizes > 0.0, sizes, np.inf)
        r = np.clip(covariance / np.outer(scale, scale), -1.0, 1.0)
        rows = tuple(tuple(float(f"{v:.4f}") for v in r[i, :i]) for i in range(len(numbers)))
        return cls(tuple(numbers), rows)

    def matrix(self, numbers: Sequence[str]) -> Floats:
        """ErrorCorrelation matrix of some numbers, (n, n); what is not in it correlates with none."""
        whole = np.eye(len(self.numbers))
        for i, row in enumerate(self.rows):
            whole[i, :i] = whole[:i, i] = row
        place = {n: i for i, n in enumerate(self.numbers)}
        out = np.eye(len(numbers))
        there = [(i, place[n]) for i, n in enumerate(numbers) if n in place]
        if there:
            mine, theirs = (list(x) for x in zip(*there, strict=True))
            out[np.ix_(mine, mine)] = whole[np.ix_(theirs, theirs)]
        return out

    def among(self, effects: Sequence[FittedEffect]) -> "ErrorCorrelation":
        """The same for the numbers of these effects that are in it."""
        names = [n for n in number_names(effects) if n in self.numbers]
        return ErrorCorrelation.of(names, self.matrix(names))


def number_name(place: int, effect: Effect, name: str) -> str:
    """Name of a number: place of the effect, from 1, and its label, and the number's own name."""
    return f"{place} {effect.label} {name}"


def number_names(effects: Sequence[FittedEffect]) -> list[str]:
    """Names of all numbers of effects."""
    return [number_name(i, f.effect, n) for i, f in enumerate(effects, 1) for n in (*f.values, *f.theta)]


@dataclass(frozen=True)
class Model(Shown):
    """A geometric-thermal model.

    Attributes:
        machine: its chain turns component errors into tip error.
        effects: fitted effects; those of one component add up.
        name: for people.
        reference_degc: temperature at which a temperature effect is nothing.
        valid_range: channel to lowest and highest value in the fit; the guard holds outside.
        noise_um: noise floor of the measurements behind the fit.
        measurements: SHA-256 of those measurements by name.
        history: one entry a change, as tables.
        correlation: of the errors of its numbers; None where it is unknown.
    """

    page_maker: ClassVar[str] = "rtec.report.history:model_page"

    machine: Machine = field(repr=False)
    effects: tuple[FittedEffect, ...] = ()
    name: str = "model"
    reference_degc: float = 20.0
    valid_range: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    noise_um: float | None = None
    measurements: Mapping[str, str] = field(default_factory=dict)
    history: tuple[Mapping[str, Any], ...] = ()
    correlation: ErrorCorrelation | None = None

    def facts(self) -> dict[str, Any]:
        """The model as plain data: its name, its machine, and every number with its standard error and unit."""
        return {
            "name": self.name,
            "machine": self.machine.name,
            "sha256": self.hash,
            "reference_degc": self.reference_degc,
            "noise_um": self.noise_um,
            "valid_range": {channel: list(pair) for channel, pair in self.valid_range.items()},
            "numbers": self.rows(),
            "history": [dict(entry) for entry in self.history],
        }

    def rows(self) -> list[dict[str, Any]]:
        """Every number of every effect."""
        out: list[dict[str, Any]] = []
        for fitted in self.effects:
            effect, both = fitted.effect, {**fitted.values, **fitted.theta}
            head = {"effect": fitted.label, "component": effect.component}
            out += [
                head | {"name": p.name, "value": both[p.name], "se": fitted.errors.get(p.name), "unit": p.unit}
                for p in (*effect.coefficients(self.machine), *effect.nonlinear(self.machine))
            ]
        return out

    def check(self, source: str = "model") -> None:
        """Check every effect against the machine.

        Raises:
            ModelError: all faults, one a line.
        """
        faults = self._range_faults(source)
        for i, fitted in enumerate(self.effects):
            try:
                check_fitted(fitted, self.machine, f"{source}: [effect {i + 1}, {fitted.effect.effect}]")
            except ModelError as e:
                faults.append(str(e))
        if faults:
            raise ModelError("\n".join(faults))

    def _range_faults(self, source: str) -> list[str]:
        known = set(self.machine.channel_names)
        where = f"{source}: [valid_range]"
        out = [f"{where} {c!r} is no channel{nearest(c, known)}" for c in self.valid_range if c not in known]
        return out + [
            f"{where} {channel}: {list(pair)}: need lowest <= highest"
            for channel, pair in self.valid_range.items()
            if not pair[0] <= pair[1]
        ]

    def state(self, time_s: Floats, channels: Mapping[str, Floats]) -> State:
        """A state with this model's machine, reference temperature and dead bands; channels (n,) by name."""
        return State(self.machine, time_s, channels, self.reference_degc, self.dead_bands_mm)

    @cached_property
    def dead_bands_mm(self) -> dict[str, float]:
        """Motion back by at most this much is no reversal, by axis name; the loop uses the same.

        Where the correction of a reversal moves the axis back, the band is the machine's plus 1.25 times that jump.
        Otherwise the correction would reverse the axis, and the next correction would reverse it again, for ever.
        """
        jumps = reversal_um(self)
        return {
            a.name: max(a.dead_band_mm, 1.25e-3 * jumps[a.name] + (a.dead_band_mm if jumps[a.name] else 0.0))
            for a in self.machine.axes
        }

    def effect_components(self, state: State) -> list[Floats]:
        """Contribution of each effect to its component, µm or µrad: a list of (n,)."""
        return [self._contribution(fitted, state) for fitted in self.effects]

    def components(self, state: State) -> Floats:
        """Component errors, (n, components), µm and µrad, in the order of `machine.components`."""
        out = np.zeros((len(state), len(self.machine.components)))
        for fitted, value in zip(self.effects, self.effect_components(state), strict=True):
            out[:, self.machine.components.index(fitted.effect.component)] += value
        return out

    def predict(self, at: Any = None, /, **channels: ArrayLike) -> Floats:
        """Tool-tip error, µm, (n, 3): actual minus nominal position of the tool relative to the workpiece.

        `model.predict(X=100.0, Z=[-200.0, 0.0], T_x_nut=24.5, dir_X=1)`: numbers and arrays of one length, together.

        Args:
            at: a dict, a frame of pandas, polars or Arrow, or a `State`. Columns of a frame that are no channel (the
                run, the readings) are not read.
            channels: further channels: positions by the axis' name, mm; temperatures by the sensor's name, °C;
                `dir_X`, +1 or -1; `spindle_rpm`, `load_kg`, `force_n`, `time_s`; or the names of a table's columns
                (`x_mm`, `T_bed_degc`, `vx_mm_s`). Without `time_s` each instant is a steady state. Without `dir_X`
                directions follow from the order of the positions, as in a measurement.

        Returns:
            (n, 3) along X, Y, Z; (3,) where every channel is a single number.

        Raises:
            ModelError: a name is no channel, or a channel that the model needs is missing.
        """
        if not isinstance(at, State):
            state, single = state_at(self, at, channels)
            out = self._tip_error(state)
            return out[0] if single else out
        return self._tip_error(at)

    def _tip_error(self, state: State) -> Floats:
        return self.machine.chain.tip_error_um(state.positions_mm(), self.components(state))

    def explain(self, state: State) -> Floats:
        """Each effect's own tool-tip error, µm, (effects, n, 3); their sum is `predict`."""
        arms = self.machine.chain.jacobian(state.positions_mm())
        columns = [self.machine.components.index(f.effect.component) for f in self.effects]
        parts = self.effect_components(state)
        if not parts:
            return np.zeros((0, len(state), 3))
        return np.stack([arms[:, :, c] * part[:, None] for c, part in zip(columns, parts, strict=True)])

    def parameter_values(self) -> Floats:
        """All coefficients and non-linear parameters in the kernel's order."""
        out: list[float] = []
        for fitted in self.effects:
            linear, free = names_of(fitted.effect, self.machine)
            out += [fitted.values[n] for n in linear] + [fitted.theta[n] for n in free]
        return np.array(out, dtype=np.float64)

    @property
    def fed(self) -> tuple[str, ...]:
        """Components that the effects feed, sorted."""
        return tuple(sorted({f.effect.component for f in self.effects}))

    @cached_property
    def channels(self) -> tuple[str, ...]:
        """Channels that the effects read, sorted."""
        return tuple(sorted({c for f in self.effects for c in f.effect.channels(self.machine)}))

    @cached_property
    def hash(self) -> str:
        """SHA-256 of everything that decides a prediction."""
        effects = [[f.effect.model_dump(mode="json"), _floats(f.values), _floats(f.theta)] for f in self.effects]
        ranges = {k: list(v) for k, v in self.valid_range.items()}
        return digest([self.machine.content(), self.reference_degc, effects, ranges])

    def _contribution(self, fitted: FittedEffect, state: State) -> Floats:
        basis = fitted.effect.basis(self.machine, state, fitted.theta)
        out = np.zeros(len(state))
        for parameter, value in zip(fitted.effect.coefficients(self.machine), basis, strict=True):
            out = out + fitted.values[parameter.name] * value
        return out


def _floats(numbers: Mapping[str, float]) -> dict[str, float]:
    return {name: float(value) for name, value in numbers.items()}


def names_of(effect: Effect, machine: Machine) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of an effect's coefficients and of its non-linear parameters."""

    def names(parameters: tuple[Parameter, ...]) -> tuple[str, ...]:
        return tuple(p.name for p in parameters)

    return names(effect.coefficients(machine)), names(effect.nonlinear(machine))


def check_fitted(fitted: FittedEffect, machine: Machine, where: str) -> None:
    """Raise ModelError where an effect does not fit the machine or lacks a number, or where a plug-in fails."""
    check_effect(fitted.effect, machine, where)
    for kind, names, numbers in zip(
        ("coefficient", "non-linear parameter"),
        names_of(fitted.effect, machine),
        (fitted.values, fitted.theta),
        strict=True,
    ):
        missing = [n for n in names if n not in numbers]
        extra = [n for n in numbers if n not in names]
        if missing or extra:
            fault = f"unknown {kind} {extra[0]!r}" if extra else f"{kind} {missing[0]!r} is missing"
            raise ModelError(f"{where}: {fault}; it has: {', '.join(names) or 'none'}")
        if not all(np.isfinite(v) for v in numbers.values()):
            raise ModelError(f"{where}: a {kind} is not a finite number")
    for parameter in fitted.effect.nonlinear(machine):
        low, high = _believable(parameter)
        if not low <= fitted.theta[parameter.name] <= high:
            raise ModelError(
                f"{where}: [nonlinear.{parameter.name}] value: must be from {low:g} to {high:g} {parameter.unit}, "
                f"found {fitted.theta[parameter.name]:g}"
            )


def _believable(parameter: Parameter) -> tuple[float, float]:
    """Lowest and highest value that a model may have: ten times beyond the bounds of a search, with the same sign."""
    low, high = parameter.low, parameter.high
    if low > 0:
        return low / 10, high * 10
    return (low - 10 * (high - low), high + 10 * (high - low)) if np.isfinite(high - low) else (low, high)
