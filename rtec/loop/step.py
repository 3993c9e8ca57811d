"""One step: `(state, sample) -> (state, command)`, the same for a live machine, a simulated one and a log.

A step is made of a model and of the run file's settings (`StepSettings`, `Inputs`). Its source is for the machine
and the structure of the model (`rtec.loop.step_source`); this module puts its numbers into arrays, so that a reload of
limits or coefficients changes numbers only. A model that replaces another while the loop runs takes over the lags of
the same temperature (`lags_of`, `slots_to_carry`).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from rtec.arrays import Bools, Floats, Ints
from rtec.correction import guard
from rtec.correction.flags import GuardSettings, Limits
from rtec.correction.sinks import DEAD_BAND, PulseSink, SinkScale
from rtec.effects import derived
from rtec.errors import ConfigError, ModelError
from rtec.loop.records import Commands, Layout, Samples, StepState
from rtec.loop.step_source import StepSource, write_step
from rtec.machine import Machine
from rtec.machine.machine import CONSTANT_CHANNELS
from rtec.model import Model
from rtec.model.kernel import build as elementary
from rtec.model.kernel.build import build_module
from rtec.model.kernel.trace import KernelPlan, plan_model
from rtec.model.kernel.write import EXTRA_ARRAYS, LAG_SLOTS, write_kernel
from rtec.quantities import Kilograms, Newtons
from rtec.tomlfile import Strict

Array = NDArray[Any]
Lag = tuple[str, float]
NS: Final = 1e9
MOST_APART: Final = math.log(2.0)
"""Time constants within a factor of two remember nearly the same."""


class Inputs(Strict):
    """`[inputs]`: quantities that are constant during the run.

    Attributes:
        load_kg: weight on the table, the channel `load_kg`.
        force_n: force on the tool or a clamp, the channel `force_n`.
        motion_filter_s: time constant of the low-pass that makes velocity and acceleration from counts
            (`rtec.effects.derived.motion_update`); only models that read these channels use it.
    """

    load_kg: Kilograms = 0.0
    force_n: Newtons = 0.0
    motion_filter_s: Annotated[float, Field(ge=0.001, le=10)] = 0.02


@dataclass(frozen=True)
class StepSettings:
    """Everything that a step is made of.

    Attributes:
        model: the model, with its machine.
        limits: by axis name; required for every compensated axis.
        sinks: scale of the sink by axis name; an axis without one gets pulses of one count.
        guard: ages and fading.
        longest_cycle_s: a longer gap between samples counts as this, so that no correction jumps after a pause.
        inputs: load, force, and the filter that makes velocity from counts.
    """

    model: Model
    limits: Mapping[str, Limits]
    sinks: Mapping[str, SinkScale] = field(default_factory=dict)
    guard: GuardSettings = field(default_factory=GuardSettings)
    longest_cycle_s: float = 0.05
    inputs: Inputs = field(default_factory=Inputs)


class Step:
    """The compiled step of one model and set of limits.

    Holds a state of its own for the loop (`bind`, `run`); `advance` computes the same as a pure function.
    """

    def __init__(self, settings: StepSettings) -> None:
        self.settings = settings
        model = settings.model
        machine = model.machine
        check_limits(machine, settings.limits)
        if faults := loop_faults(model):
            raise ModelError("\n".join(faults))
        self.layout = Layout(machine.axis_names, machine.sensor_names)
        values = model.parameter_values()
        kernel = write_kernel(model)
        self.source: StepSource = write_step(machine, kernel, len(values))
        self._step: Callable[..., None] = build_module(self.source.text, [derived, elementary, guard]).step
        self._numbers = numbers_of(settings, self.source, values)
        self._times = times_of(settings, self.source)
        self.state = self.fresh_state()
        self.sensors = tuple(machine.sensor_names[i] for i in kernel.sensors)
        self._uses_spindle = kernel.uses_spindle
        self.lags = lags_of(model)

    def fresh_state(self) -> StepState:
        """The state before the first sample: no correction, no direction, no temperature history."""
        return StepState(np.zeros(self.source.floats.size), np.zeros(self.source.ints.size, dtype=np.int64))

    def bind(self, samples: Samples, commands: Commands) -> Callable[[], None]:
        """A call that reads these samples and writes these commands; the call allocates nothing."""
        return partial(self._step, *_arrays(samples, commands), *self._constants, self.state.floats, self.state.ints)

    def run(self, samples: Samples, into: Commands | None = None) -> Commands:
        """Step through n samples, starting at the present state; give their commands.

        Args:
            samples: n rows.
            into: memory for at least n commands, to be reused; None: new memory.
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

    def constants(self, name: str) -> Array:
        """The step's numbers of that name, one an axis or sensor (`rtec.loop.step_source`)."""
        return self._numbers[self.source.numbers.at[name]].copy()

    def output_of(self, state: StepState) -> Ints:
        """The ledger: absolute output of every axis."""
        return state.ints[self.source.ints.at["out"]]

    def units_in(self, span_s: float) -> Ints:
        """Largest change of each axis' output in this span, in the sink's units: at the slew limit, in whole quanta.

        A span shorter than the sink's period counts as that period.
        """
        span = np.maximum(span_s, self._times[self.source.times.at["period"]] / NS)
        quantum = self.constants("quantum")
        units = np.abs(self.constants("per_um")) * self.constants("slew") * span
        steps = np.floor(units / quantum + (0.5 + DEAD_BAND + 1e-9))
        return np.asarray(steps * quantum, np.int64)

    def resume(self, output: Ints) -> None:
        """Take over the actuator's ledger and start from rest, so that the correction does not jump."""
        self.state.ints[self.source.ints.at["out"]] = output
        per_um = self._numbers[self.source.numbers.at["per_um"]]
        now = self.state.floats[self.source.floats.at["now"]]
        active = per_um != 0.0
        now[active] = output[active] / per_um[active] + 0.0  # no -0: a replay compares bits
        self.state.floats[self.source.floats.at["speed"]] = 0.0

    def restore(self, state: StepState) -> None:
        """Take over the memory of a step of the same structure, to the last bit."""
        self.state.floats[:] = state.floats
        self.state.ints[:] = state.ints

    def rest(self) -> None:
        """Set all speeds to zero: after a pause the correction starts from rest."""
        self.state.floats[self.source.floats.at["speed"]] = 0.0

    def forget_directions(self, axes: Bools, counts: Ints | None) -> None:
        """Make the direction of these axes unknown, as before their first motion.

        Args:
            axes: True for those axes, (axes,).
            counts: their present counts; None: those of the next sample.
        """
        at, floats = self.source.floats.at, self.state.floats
        floats[at["d"]][axes] = 0.0
        if "turn" in at:
            floats[at["turn"]][axes] = np.inf
        if counts is None:
            self.state.ints[self.source.ints.at["started"]] = 0
        else:
            floats[at["extreme"]][axes] = counts[axes] / self.constants("counts_per_mm")[axes]

    def all_numbers(self) -> tuple[Array, Array]:
        """Everything that a reload can change without a new source: limits, coefficients, ranges; and ages, ns."""
        return self._numbers.copy(), self._times.copy()

    def take_numbers(self, numbers: Array, times: Array) -> None:
        """Go on with `all_numbers` of a step of the same source; the memory stays."""
        self._numbers[:] = numbers
        self._times[:] = times
        self.recompute_slow_part()

    def adopt(self, other: "Step", samples: Samples) -> None:
        """Go on from the present state of a step of another model, on the same machine.

        Ledger, correction and directions are those of the other step; so is the memory of lags of the same temperature.
        Memory that the other step does not have begins as at a start, with this sample.
        """
        self.state.floats[:], self.state.ints[:] = 0.0, 0
        self.bind(samples, Commands.empty(self.layout, len(samples)))()
        for mine, theirs, array, source in (
            (self.source.floats.at, other.source.floats.at, self.state.floats, other.state.floats),
            (self.source.ints.at, other.source.ints.at, self.state.ints, other.state.ints),
        ):
            for name in (set(mine) & set(theirs)) - {"m", "u", "ready", "degc_at"}:
                array[mine[name]] = source[theirs[name]]
        if other.state.ints[other.source.ints.at["ready"]][0]:
            pairs = slots_to_carry(other.lags, self.lags)
            memory, before = self._memory, other._memory
            for source_at, at in pairs:
                memory[at] = before[source_at]
        self.recompute_slow_part()

    def recompute_slow_part(self) -> None:
        """Make the next cycle recompute the slow part with the present numbers, even without a new temperature."""
        floats, ints = self.source.floats.at, self.source.ints.at
        if self.sensors:
            self.state.ints[ints["degc_at"]] = -1
        elif self._uses_spindle:
            self.state.floats[floats["u"]][len(self.layout.sensors)] = np.nan
        else:
            self.state.ints[ints["ready"]] = 0

    @property
    def _memory(self) -> Floats:
        return self.state.floats[self.source.floats.at["m"]]

    def warm_up(self) -> None:
        """Compile (or fetch from disk) before the first real cycle."""
        self.advance(self.fresh_state(), Samples.empty(self.layout, 1))


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


def loop_faults(model: Model) -> list[str]:
    """Reasons why the loop cannot run a model, one message an effect; empty where it can."""
    return [
        f"model {model.name!r}: effect {i + 1}, {fitted.label}, reads time_s. Such an effect can be found and its "
        "cause removed, but not corrected by the loop: time since the start of a measurement means nothing on another "
        "day. Fit the model again without it, or delete its [[effect]] from the model file"
        for i, fitted in enumerate(model.effects)
        if "time_s" in fitted.effect.channels(model.machine)
    ]


def numbers_of(settings: StepSettings, source: StepSource, values: Floats) -> Floats:
    """Parameters, scales, limits and ranges, in the places of `StepSource.numbers`."""
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


def times_of(settings: StepSettings, source: StepSource) -> Ints:
    """Ages and periods, ns, in the places of `StepSource.times`."""
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


def lags_of(model: Model) -> list[Lag]:
    """Input of each lag of a model, as text, and its time constant, s; in the order of the kernel's memory."""
    plan = plan_model(model)
    values = [float(v) for v in model.parameter_values()]
    out = []
    for n in plan.lags:
        value, tau = plan.graph.nodes[n].args
        node = plan.graph.nodes[tau]
        at = values[int(node.key or 0)] if node.op == "param" else float(node.key or 0.0) if node.op == "const" else 0.0
        out.append((_text(plan, value, values), at))
    return out


def slots_to_carry(old: Sequence[Lag], new: Sequence[Lag]) -> list[tuple[int, int]]:
    """Places (from, to) in the memories: for each new lag, the old lag of the same input, nearest in time constant."""
    out = []
    for k, (what, tau_s) in enumerate(new):
        near = [(_apart(tau_s, other_s), i) for i, (other, other_s) in enumerate(old) if other == what]
        if near and min(near)[0] <= MOST_APART:
            source = LAG_SLOTS * min(near)[1]
            out += [(source + j, LAG_SLOTS * k + j) for j in range(LAG_SLOTS)]
    return out


def _apart(a_s: float, b_s: float) -> float:
    if a_s == b_s:
        return 0.0
    return abs(math.log(a_s / b_s)) if min(a_s, b_s) > 0.0 else math.inf


def _text(plan: KernelPlan, n: int, values: Sequence[float]) -> str:
    node = plan.graph.nodes[n]
    if node.op == "param":
        return repr(values[int(node.key or 0)])
    if node.op in ("input", "const"):
        return str(node.key)
    return f"{node.op}({', '.join(_text(plan, a, values) for a in node.args)})"


def _arrays(samples: Samples, commands: Commands) -> list[Array]:
    return [*samples.arrays().values(), *commands.arrays().values()]
