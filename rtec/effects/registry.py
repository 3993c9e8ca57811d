"""The registry: a table of every effect by name, and the effects of installed plug-ins.

Plug-ins use the entry point `rtec.effects`: name of the effect -> its class. They are loaded at the first look-up of a
name that is not built in. A plug-in that cannot be loaded affects no other: its fault is kept as text, shown by
`rtec effects`, and shown again where its effect is looked up.

A plug-in is tried before it is used: one that fails is skipped, and all other effects still work.
"""

import functools
import inspect
import itertools
import sys
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Any

import numpy as np
from pydantic import ValidationError

from rtec.effects.base import About, Effect, Parameter, Surroundings
from rtec.effects.cyclic import CouplingMisalignment, CyclicPole, CyclicScrew, InterpolationError
from rtec.effects.expression import Expression
from rtec.effects.geometry import (
    AngularMotion,
    GuideCurvature,
    GuideTwist,
    Parallelism,
    PiecewisePosition,
    PolynomialPosition,
    Scale,
    Squareness,
    Straightness,
)
from rtec.effects.load import CrossTalk, ForceDeflection, LoadDeformation, RamSag
from rtec.effects.motion import ChangeOver, GuideLift, Inertia, ServoLag, ServoPhase
from rtec.effects.reversal import (
    AngularReversal,
    Backlash,
    BacklashLoad,
    BacklashPosition,
    BacklashTemperature,
    BacklashWear,
    BacklashZone,
    LostMotion,
    ReversalSpike,
    Stribeck,
)
from rtec.effects.spindle import SpindleGrowth, SpindleSpeedShift, SpindleTilt
from rtec.effects.state import State, Value
from rtec.effects.thermal import (
    AmbientDrift,
    AxisExpansion,
    AxisExpansionNonuniform,
    BedBending,
    ColumnTilt,
    CoolantExpansion,
    MountExpansion,
)
from rtec.effects.time_data import NOT_EFFECTS, DailyDrift, MissedCounts, WearDrift
from rtec.errors import ModelError
from rtec.machine import Machine
from rtec.tomlfile import nearest

SKIPPED: dict[type[Effect], str] = {}
"""Plug-ins that failed in this process, each with its fault."""
MOST = 1000
"""Largest number of instances of a plug-in for one component error."""
INSTANTS = 4
ARITHMETIC = (
    "add", "subtract", "multiply", "divide", "power", "negative", "absolute", "sin", "cos", "exp", "log", "sqrt",
    "tanh", "minimum", "maximum", "square", "reciprocal", "positive",
)  # fmt: skip
"""Functions of numpy that the loop's kernel has."""


class PlugInWarning(UserWarning):
    """A plug-in is skipped; the message names it and its fault."""


def is_plug_in(kind: type[Effect]) -> bool:
    """Whether a class comes from another package."""
    return not kind.__module__.startswith("rtec.effects.")


def instances(kind: type[Effect], around: Surroundings) -> list[Effect]:
    """Instances that an effect suggests; a plug-in that fails suggests none, and is skipped from then on."""
    if not is_plug_in(kind):
        return list(kind.suggest(around))
    if kind in SKIPPED:
        return []
    try:
        suggested: list[Any] = list(itertools.islice(kind.suggest(around), MOST))
    except Exception as e:  # noqa: BLE001 - somebody else's code may fail in any way, and only its effect is lost
        skip(kind, _suggest_fault(e))
        return []
    for effect in suggested:
        fault = fault_of(effect, around.machine) if isinstance(effect, Effect) else f"suggest() gives {effect!r}"
        if fault:
            skip(kind, fault)
            return []
    return suggested


def lacking(kind: type[Effect], around: Surroundings) -> str:
    """`missing` of an effect, in words; empty where nothing is missing, or where a plug-in fails."""
    if not is_plug_in(kind):
        return kind.missing(around)
    if kind in SKIPPED:
        return ""
    try:
        return str(kind.missing(around))
    except Exception as e:  # noqa: BLE001 - as above
        skip(kind, f"missing() raises {_error_text(e)}")
        return ""


def skip(kind: type[Effect], fault: str) -> None:
    """Skip a plug-in from now on, with a warning of one line."""
    SKIPPED[kind] = f"{kind.__module__}.{kind.__name__}: {fault}"
    name = kind.model_fields["effect"].default
    warnings.warn(f"plug-in effect {name!r} is skipped: {SKIPPED[kind]}", PlugInWarning, stacklevel=3)


def fault_of(effect: Effect, machine: Machine) -> str:
    """Fault of a plug-in's effect at made-up instants, in words; empty where it has none, and for effects of rtec."""
    if not is_plug_in(type(effect)):
        return ""
    method = "check"
    try:
        effect.check(machine, "trial")
        method = "coefficients"
        linear = tuple(effect.coefficients(machine))
        method = "nonlinear"
        free = tuple(effect.nonlinear(machine))
        method = "channels"
        unknown = [c for c in effect.channels(machine) if c not in machine.channel_names]
        method = "basis"
        state = _Trial(_instants(machine))
        with np.errstate(all="ignore"):
            values = list(effect.basis(machine, state, {p.name: p.start for p in free}))
            shapes = [np.broadcast_shapes(np.asarray(v, dtype=np.float64).shape, (INSTANTS,)) for v in values]
    except ModelError:
        return ""  # an effect may refuse a machine that it does not fit
    except Exception as e:  # noqa: BLE001 - as above
        return f"{method}() raises {_error_text(e)}"
    if not all(isinstance(p, Parameter) for p in (*linear, *free)):
        return "coefficients() and nonlinear() give Parameter(…), and nothing else"
    if unknown:
        return f"channels() names {unknown[0]!r}, which the machine does not have"
    if len(values) != len(linear):
        return f"basis() gives {len(values)} values for {len(linear)} coefficients"
    if any(shape != (INSTANTS,) for shape in shapes):
        return "basis() gives arrays of another length than the channels have"
    if not all(np.isfinite(np.asarray(v, dtype=np.float64)).all() for v in values):
        return "basis() gives values that are no finite numbers within the travel, at 20 °C and more"
    if unlisted := sorted(state.read - set(effect.channels(machine))):
        return f"basis() reads channel {unlisted[0]!r}, which channels() does not list"
    return ""


def check_effect(effect: Effect, machine: Machine, where: str) -> None:
    """Check an effect against a machine.

    Raises:
        ModelError: it does not fit the machine, or it is of a plug-in that fails.
    """
    if fault := fault_of(effect, machine):
        raise ModelError(f"{where}: effect {effect.effect!r} of a plug-in, {type(effect).__module__}: {fault}")
    effect.check(machine, where)


class _Watched(np.ndarray[Any, np.dtype[np.float64]]):
    """Values that know the loop's arithmetic only: what the kernel cannot compute is no effect."""

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **kwargs: Any) -> Any:
        if method != "__call__" or set(kwargs) - {"out"} or ufunc.__name__ not in ARITHMETIC:
            raise TypeError(f"np.{ufunc.__name__} is none of the loop's arithmetic: {', '.join(ARITHMETIC)}")
        return ufunc(*(np.asarray(i) for i in inputs)).view(_Watched)

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        raise TypeError(f"np.{func.__name__} is none of the loop's arithmetic: {', '.join(ARITHMETIC)}")

    def __bool__(self) -> bool:
        raise TypeError("asks whether a channel is true; write it without `if`, with np.minimum and np.maximum")


class _Trial:
    """Channels for a trial of a plug-in; records which are read."""

    def __init__(self, state: State) -> None:
        self.state, self.read = state, set[str]()

    def value(self, name: str) -> Value:
        """Give a channel."""
        self.read.add(name)
        return self.state.value(name).view(_Watched)

    def rise(self, sensor: str) -> Value:
        """Temperature above the reference, K."""
        return self.value(sensor) - self.state.reference_degc

    def lagged(self, value: Value, tau_s: Value) -> Value:
        """First-order lag."""
        return self.state.lagged(np.asarray(value), tau_s).view(_Watched)


def _instants(machine: Machine) -> State:
    """A few instants at which everything varies."""
    rising = np.linspace(0.0, 1.0, INSTANTS)
    channels: dict[str, Any] = dict.fromkeys(machine.channel_names, 1.0 + rising)
    for axis in machine.axes:
        low, high = axis.travel_mm
        channels[axis.channel] = low + (high - low) * rising
        channels[axis.direction_channel] = np.where(rising < 0.5, 1.0, -1.0)
    channels |= dict.fromkeys(machine.sensor_names, 20.0 + rising)
    return State(machine, np.arange(INSTANTS, dtype=np.float64) * 60.0, channels)


def _suggest_fault(error: Exception) -> str:
    if isinstance(error, ValidationError) and error.errors()[0]["type"] == "missing":
        key = ".".join(map(str, error.errors()[0]["loc"]))
        return f"its argument {key!r} has no default, and arguments() gives no value for it"
    return f"suggest() raises {_error_text(error)}"


def _error_text(error: Exception) -> str:
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"


GROUP = "rtec.effects"


@dataclass(frozen=True)
class PlugIns:
    """Effects of other packages.

    Attributes:
        effects: class by name.
        faults: why an effect cannot be used, in words, by its name.
    """

    effects: Mapping[str, type[Effect]]
    faults: Mapping[str, str]


def plug_ins(taken: tuple[str, ...]) -> PlugIns:
    """The effects of other packages.

    Args:
        taken: names that a plug-in must not have.
    """
    return _loaded(tuple(sys.path), taken)


@functools.lru_cache(maxsize=4)
def _loaded(path: tuple[str, ...], taken: tuple[str, ...]) -> PlugIns:
    del path  # key of the cache: another path may have other packages
    effects: dict[str, type[Effect]] = {}
    faults: dict[str, str] = {}
    for entry in sorted(entry_points(group=GROUP), key=lambda e: (e.name, _package(e))):
        if entry.name in taken:
            faults[entry.name] = f"{_origin(entry)}: {entry.name!r} is a name of rtec's own; a plug-in needs another"
        elif entry.name in effects:
            faults[entry.name] = f"{_origin(entry)}: another package has an effect {entry.name!r}; its own is used"
        else:
            loaded = _load(entry)
            if isinstance(loaded, str):
                faults[entry.name] = f"{_origin(entry)}: {loaded}"
            else:
                effects[entry.name] = loaded
    return PlugIns(effects, faults)


def _load(entry: EntryPoint) -> type[Effect] | str:
    """The class, or why it cannot be used."""
    try:
        kind = entry.load()
    except (Exception, SystemExit) as e:  # noqa: BLE001 - somebody else's module may fail in any way, and only its effect is lost
        return f"cannot be loaded: {type(e).__name__}: {e}"
    return _fault(kind, entry.name) or kind


def _fault(kind: object, name: str) -> str:
    if not (isinstance(kind, type) and issubclass(kind, Effect)):
        return f"{kind!r} is not a class derived from rtec.effects.Effect"
    if inspect.isabstract(kind):
        return f"{kind.__name__} lacks {', '.join(sorted(kind.__abstractmethods__))}"
    if not isinstance(getattr(kind, "about", None), About):
        return f"{kind.__name__} has no `about = About(…)`"
    own = kind.model_fields["effect"].default
    if own != name:
        return f"the entry point is named {name!r}, but `effect` of {kind.__name__} is {own!r}; they must be one word"
    return ""


def _package(entry: EntryPoint) -> str:
    return entry.dist.name if entry.dist is not None else ""


def _origin(entry: EntryPoint) -> str:
    return f"package {_package(entry) or '?'}, entry point {GROUP}: {entry.name} = {entry.value}"


EFFECTS: dict[str, type[Effect]] = {
    "scale": Scale,
    "polynomial_position": PolynomialPosition,
    "piecewise_position": PiecewisePosition,
    "cyclic_screw": CyclicScrew,
    "coupling_misalignment": CouplingMisalignment,
    "interpolation_error": InterpolationError,
    "cyclic_pole": CyclicPole,
    "straightness": Straightness,
    "squareness": Squareness,
    "parallelism": Parallelism,
    "angular_motion": AngularMotion,
    "guide_curvature": GuideCurvature,
    "guide_twist": GuideTwist,
    "backlash": Backlash,
    "backlash_position": BacklashPosition,
    "backlash_zone": BacklashZone,
    "backlash_wear": BacklashWear,
    "backlash_load": BacklashLoad,
    "backlash_temperature": BacklashTemperature,
    "angular_reversal": AngularReversal,
    "servo_lag": ServoLag,
    "servo_phase": ServoPhase,
    "change_over": ChangeOver,
    "lost_motion": LostMotion,
    "reversal_spike": ReversalSpike,
    "stribeck": Stribeck,
    "guide_lift": GuideLift,
    "inertia": Inertia,
    "axis_expansion": AxisExpansion,
    "axis_expansion_nonuniform": AxisExpansionNonuniform,
    "mount_expansion": MountExpansion,
    "spindle_growth": SpindleGrowth,
    "spindle_speed_shift": SpindleSpeedShift,
    "spindle_tilt": SpindleTilt,
    "column_tilt": ColumnTilt,
    "bed_bending": BedBending,
    "ambient_drift": AmbientDrift,
    "coolant_expansion": CoolantExpansion,
    "ram_sag": RamSag,
    "cross_talk": CrossTalk,
    "load_deformation": LoadDeformation,
    "force_deflection": ForceDeflection,
    "daily_drift": DailyDrift,
    "wear_drift": WearDrift,
    "missed_counts": MissedCounts,
    "expression": Expression,
}

FAMILIES: dict[str, tuple[str, ...]] = {
    "geometry": (
        "scale", "polynomial_position", "piecewise_position", "cyclic_screw", "coupling_misalignment",
        "interpolation_error", "cyclic_pole", "straightness", "squareness", "parallelism", "angular_motion",
        "guide_curvature", "guide_twist",
    ),
    "reversal": (
        "backlash", "backlash_position", "backlash_zone", "backlash_wear", "backlash_load", "backlash_temperature",
        "angular_reversal", "lost_motion", "reversal_spike", "stribeck",
    ),
    "motion": ("servo_lag", "servo_phase", "change_over", "guide_lift", "inertia"),
    "heat": (
        "axis_expansion", "axis_expansion_nonuniform", "mount_expansion", "spindle_growth", "spindle_speed_shift",
        "spindle_tilt", "column_tilt", "bed_bending", "ambient_drift", "coolant_expansion",
    ),
    "load": ("ram_sag", "cross_talk", "load_deformation", "force_deflection"),
    "time": ("daily_drift", "wear_drift", "missed_counts"),
    "your own": ("expression",),
}  # fmt: skip
"""The same names, in the order of the catalogue."""

TAKEN = (*EFFECTS, *NOT_EFFECTS)
"""Names that a plug-in must not have."""


def all_effects() -> dict[str, type[Effect]]:
    """Every effect by name: the built-in ones, then those of plug-ins without a fault."""
    added = plug_ins(TAKEN).effects
    return {**EFFECTS, **{name: kind for name, kind in added.items() if kind not in SKIPPED}}


def plug_in_faults() -> dict[str, str]:
    """Faults of plug-ins that could not be loaded or have failed, in words, by name of the effect."""
    found = plug_ins(TAKEN)
    return {**found.faults, **{name: SKIPPED[kind] for name, kind in found.effects.items() if kind in SKIPPED}}


def effect_class(name: str, where: str) -> type[Effect]:
    """Give the class of an effect.

    Raises:
        ModelError: no effect has that name, and the message suggests the nearest; it is an artefact of an instrument
            or its readings, not an effect; or its plug-in could not be loaded or has failed, and the message says why.
    """
    if name in EFFECTS:  # spares the import of plug-ins
        return EFFECTS[name]
    if name in NOT_EFFECTS:
        raise ModelError(
            f"{where}: {name!r} is no error of the machine, a model cannot hold it: {NOT_EFFECTS[name].reveal}"
        )
    found = plug_ins(TAKEN)
    if name in found.effects and found.effects[name] not in SKIPPED:
        return found.effects[name]
    if fault := plug_in_faults().get(name):
        raise ModelError(f"{where}: effect {name!r} of a plug-in: {fault}")
    near = nearest(name, all_effects())
    installed = "" if "did you mean" in near else " (if it is of a plug-in, install its package here)"
    raise ModelError(f"{where}: no effect {name!r}{installed}{near}")
