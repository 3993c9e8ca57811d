"""The numbers that a step works with, laid into the arrays that its compiled text reads."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rtec.correction.guard import Limits
from rtec.correction.sinks import PulseSink
from rtec.errors import ConfigError
from rtec.loop.step_source import StepSource
from rtec.machine import Machine
from rtec.machine.machine import CONSTANT_CHANNELS
from rtec.model.kernel.write import EXTRA_ARRAYS

if TYPE_CHECKING:
    from rtec.loop.step import StepSettings

NS = 1e9


def check_limits(machine: Machine, limits: Mapping[str, Limits]) -> None:
    """Refuse a machine without a compensated axis, or one of these without limits.

    Raises:
        ConfigError: what is missing.
    """
    compensated = [a.name for a in machine.axes if a.compensate]
    if not compensated:
        raise ConfigError(f"machine {machine.name!r}: no axis has compensate = true; there is nothing to correct")
    missing = [name for name in compensated if name not in limits]
    if missing:
        raise ConfigError(
            "\n".join(
                f"[limits.{name}] is missing: axis {name} is compensated and needs warning_um, stop_um, slew_um_s "
                "and acceleration_um_s2; nothing runs without limits"
                for name in missing
            )
        )


def numbers_of(settings: "StepSettings", source: StepSource, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Parameters, scales, limits and ranges, as `StepSource.numbers` lays them."""
    machine = settings.model.machine
    out = np.zeros(source.numbers.size)

    def put(name: str, numbers: Any) -> None:
        out[source.numbers.at[name]] = numbers

    put("p", values)
    put("counts_per_mm", [a.counts_per_mm for a in machine.axes])
    put("dead_band", [settings.model.dead_bands_mm[a.name] for a in machine.axes])
    limits = [settings.limits.get(a.name) for a in machine.axes]
    put("warning", [x.warning_um if x else 0.0 for x in limits])
    put("stop", [x.stop_um if x else 0.0 for x in limits])
    put("slew", [x.slew_um_s if x else 0.0 for x in limits])
    put("acceleration", [x.acceleration_um_s2 if x else 0.0 for x in limits])
    sinks = [settings.sinks.get(a.name) or PulseSink().scale(a) for a in machine.axes]
    put("per_um", [s.units_per_um for s in sinks])
    put("quantum", [s.quantum for s in sinks])
    put("rate", [s.rate_per_s for s in sinks])
    put("lowest", [s.low for s in sinks])
    put("highest", [s.high for s in sinks])
    ranges = settings.model.valid_range
    everything = (-np.inf, np.inf)
    axes = [ranges.get(a.channel, everything) for a in machine.axes]
    slow = [ranges.get(name, everything) for name in machine.slow_channels]
    pairs_of = {"q": axes, "u": slow, "s": [s.range_degc for s in machine.sensors]}
    for name, of in EXTRA_ARRAYS.items():
        if f"{name}_low" in source.numbers.at:
            read = [of(a) if of(a) in settings.model.channels else "" for a in machine.axes]
            pairs_of[name] = [ranges.get(channel, everything) for channel in read]
    for name, pairs in pairs_of.items():
        put(f"{name}_low", [low for low, _ in pairs])
        put(f"{name}_high", [high for _, high in pairs])
    put("constants", [getattr(settings.inputs, name) for name in CONSTANT_CHANNELS])
    put("motion_filter", settings.inputs.motion_filter_s)
    return out


def times_of(settings: "StepSettings", source: StepSource) -> NDArray[np.int64]:
    """Ages and periods, ns, as `StepSource.times` lays them."""
    guards, machine = settings.guard, settings.model.machine
    sinks = [settings.sinks.get(a.name) or PulseSink().scale(a) for a in machine.axes]
    out = np.zeros(source.times.size, dtype=np.int64)
    out[source.times.at["max_age"]] = [
        round(guards.counts_max_age_s * NS),
        round(guards.temperature_max_age_s * NS),
    ]
    out[source.times.at["fade"]] = round((guards.fade_after_s or 0.0) * NS)
    out[source.times.at["longest"]] = round(settings.longest_cycle_s * NS)
    out[source.times.at["period"]] = [round(s.period_s * NS) for s in sinks]
    return out
