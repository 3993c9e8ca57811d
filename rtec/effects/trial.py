"""Tries plug-ins before they are used: a plug-in that fails is skipped, and all other effects still work."""

import itertools
import warnings
from typing import Any

import numpy as np
from pydantic import ValidationError

from rtec.effects.base import Effect, Parameter, Surroundings
from rtec.effects.state import State
from rtec.errors import ModelError
from rtec.machine import Machine

SKIPPED: dict[type[Effect], str] = {}
"""Plug-ins that failed in this process, each with its fault."""
MOST = 1000
"""Largest number of instances of a plug-in for one component error."""
INSTANTS = 4


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
        with np.errstate(all="ignore"):
            values = list(effect.basis(machine, _instants(machine), {p.name: p.start for p in free}))
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
    return ""


def check_effect(effect: Effect, machine: Machine, where: str) -> None:
    """Check an effect against a machine.

    Raises:
        ModelError: it does not fit the machine, or it is of a plug-in that fails.
    """
    if fault := fault_of(effect, machine):
        raise ModelError(f"{where}: effect {effect.effect!r} of a plug-in, {type(effect).__module__}: {fault}")
    effect.check(machine, where)


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
