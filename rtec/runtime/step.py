"""One step: `(state, sample) -> (state, command)`, the same for a live machine, a simulated one and a log."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtec.correction import guard, ledger
from rtec.correction.guard import GuardSettings, Limits
from rtec.correction.sinks import PulseSink, SinkScale
from rtec.effects import derived
from rtec.errors import ConfigError, ModelError
from rtec.machine import Machine
from rtec.machine.machine import CONSTANT_CHANNELS
from rtec.model import Model, elementary
from rtec.model.build import build_module
from rtec.model.codegen import EXTRA_ARRAYS, write_kernel
from rtec.runtime.inputs import Inputs, loop_faults
from rtec.runtime.kernel import StepSource, write_step
from rtec.runtime.records import Commands, Layout, Samples

Array = NDArray[Any]
NS = 1e9


@dataclass(frozen=True)
class StepSettings:
    """What a step is made of.

    Attributes:
        model: the model, with its machine.
        limits: by axis name; every compensated axis must have them.
        sinks: scale of the sink by axis name; pulses of one count where not given.
        guard: ages and fading.
        longest_cycle_s: a longer gap between samples counts as this long, so that nothing jumps after a pause.
        inputs: load, force, and the filter that makes velocity from counts.
    """

    model: Model
    limits: Mapping[str, Limits]
    sinks: Mapping[str, SinkScale] = field(default_factory=dict)
    guard: GuardSettings = field(default_factory=GuardSettings)
    longest_cycle_s: float = 0.05
    inputs: Inputs = field(default_factory=Inputs)


@dataclass(frozen=True)
class StepState:
    """Memory of a step: plain numbers, safe to copy and to keep."""

    floats: NDArray[np.float64]
    ints: NDArray[np.int64]

    def copy(self) -> "StepState":
        """Give a state with memory of its own."""
        return StepState(self.floats.copy(), self.ints.copy())


class Step:
    """The compiled step of one model and set of limits.

    Holds a state of its own for the loop (`bind`, `run`); `advance` is the same as a pure function.
    """

    def __init__(self, settings: StepSettings) -> None:
        self.settings = settings
        model = settings.model
        machine = model.machine
        _check_limits(machine, settings.limits)
        if faults := loop_faults(model):
            raise ModelError("\n".join(faults))
        self.layout = Layout(machine.axis_names, machine.sensor_names)
        values = model.parameter_values()
        kernel = write_kernel(model)
        self.source: StepSource = write_step(machine, kernel, len(values))
        self._step: Callable[..., None] = build_module(self.source.text, [derived, elementary, guard, ledger]).step
        self._numbers = _numbers(settings, self.source, values)
        self._times = _times(settings, self.source)
        self.state = self.fresh_state()
        self.sensors = tuple(machine.sensor_names[i] for i in kernel.sensors)

    def fresh_state(self) -> StepState:
        """Give the state before the first sample: no correction, no direction, no temperature history."""
        return StepState(np.zeros(self.source.floats.size), np.zeros(self.source.ints.size, dtype=np.int64))

    def bind(self, samples: Samples, commands: Commands) -> Callable[[], None]:
        """Give a call that reads these samples and writes these commands; it allocates nothing."""
        return partial(self._step, *_arrays(samples, commands), *self._constants, self.state.floats, self.state.ints)

    def run(self, samples: Samples, into: Commands | None = None) -> Commands:
        """Step through n samples from the state that the last call left; give their commands.

        Args:
            samples: n rows.
            into: memory for at least n commands, used again by the caller; new memory where not given.
        """
        commands = Commands.empty(self.layout, len(samples)) if into is None else into.rows(0, len(samples))
        self.bind(samples, commands)()
        return commands

    def advance(self, state: StepState, samples: Samples) -> tuple[StepState, Commands]:
        """`(state, sample) -> (state, command)`: changes neither argument nor this object."""
        after, commands = state.copy(), Commands.empty(self.layout, len(samples))
        self._step(*_arrays(samples, commands), *self._constants, after.floats, after.ints)
        return after, commands

    @property
    def _constants(self) -> tuple[Array, Array]:
        return self._numbers, self._times

    def output_of(self, state: StepState) -> NDArray[np.int64]:
        """The ledger: absolute output of every axis."""
        return state.ints[self.source.ints.at["out"]]

    def resume(self, output: NDArray[np.int64]) -> None:
        """Take over a ledger that the actuator already holds, so that starting again is no jump."""
        self.state.ints[self.source.ints.at["out"]] = output
        per_um = self._numbers[self.source.numbers.at["per_um"]]
        now = self.state.floats[self.source.floats.at["now"]]
        active = per_um != 0.0
        now[active] = output[active] / per_um[active] + 0.0  # no -0, which a replay would tell from 0

    def warm_up(self) -> None:
        """Compile (or fetch from disk) before the first real cycle."""
        self.advance(self.fresh_state(), Samples.empty(self.layout, 1))


def _arrays(samples: Samples, commands: Commands) -> list[Array]:
    return [*samples.arrays().values(), *commands.arrays().values()]


def _check_limits(machine: Machine, limits: Mapping[str, Limits]) -> None:
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


def _numbers(settings: StepSettings, source: StepSource, values: NDArray[np.float64]) -> NDArray[np.float64]:
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


def _times(settings: StepSettings, source: StepSource) -> NDArray[np.int64]:
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
