"""One step: `(state, sample) -> (state, command)`, the same for a live machine, a simulated one and a log."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtec.correction import guard, ledger
from rtec.correction.guard import GuardSettings, Limits
from rtec.correction.sinks import SinkScale
from rtec.effects import derived
from rtec.errors import ModelError
from rtec.loop.inputs import Inputs, loop_faults
from rtec.loop.lags import lags_of, slots_to_carry
from rtec.loop.records import Commands, Layout, Samples
from rtec.loop.step_numbers import check_limits, numbers_of, times_of
from rtec.loop.step_source import StepSource, write_step
from rtec.model import Model
from rtec.model.kernel import build as elementary
from rtec.model.kernel.build import build_module
from rtec.model.kernel.write import write_kernel

Array = NDArray[Any]


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
        check_limits(machine, settings.limits)
        if faults := loop_faults(model):
            raise ModelError("\n".join(faults))
        self.layout = Layout(machine.axis_names, machine.sensor_names)
        values = model.parameter_values()
        kernel = write_kernel(model)
        self.source: StepSource = write_step(machine, kernel, len(values))
        self._step: Callable[..., None] = build_module(self.source.text, [derived, elementary, guard, ledger]).step
        self._numbers = numbers_of(settings, self.source, values)
        self._times = times_of(settings, self.source)
        self.state = self.fresh_state()
        self.sensors = tuple(machine.sensor_names[i] for i in kernel.sensors)
        self._uses_spindle = kernel.uses_spindle
        self.lags = lags_of(model)

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

    def constants(self, name: str) -> Array:
        """The numbers of that name that the step works with, one an axis or sensor (`rtec.loop.step_source`)."""
        return self._numbers[self.source.numbers.at[name]].copy()

    def output_of(self, state: StepState) -> NDArray[np.int64]:
        """The ledger: absolute output of every axis."""
        return state.ints[self.source.ints.at["out"]]

    def resume(self, output: NDArray[np.int64]) -> None:
        """Take over a ledger that the actuator already holds, so that starting again is no jump; from rest."""
        self.state.ints[self.source.ints.at["out"]] = output
        per_um = self._numbers[self.source.numbers.at["per_um"]]
        now = self.state.floats[self.source.floats.at["now"]]
        active = per_um != 0.0
        now[active] = output[active] / per_um[active] + 0.0  # no -0, which a replay would tell from 0
        self.state.floats[self.source.floats.at["speed"]] = 0.0

    def restore(self, state: StepState) -> None:
        """Take over the memory of a step of the same structure, to the last bit."""
        self.state.floats[:] = state.floats
        self.state.ints[:] = state.ints

    def rest(self) -> None:
        """Stop where the correction is: after a pause it starts from rest."""
        self.state.floats[self.source.floats.at["speed"]] = 0.0

    def forget_directions(self, axes: NDArray[np.bool_], counts: NDArray[np.int64] | None) -> None:
        """Of these axes nobody knows which way they came: as before their first motion.

        Args:
            axes: which, (axes,).
            counts: where they are now; None: wherever the next sample finds them.
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
        """Everything that a reload can change without another text: limits, coefficients, ranges; and ages, ns."""
        return self._numbers.copy(), self._times.copy()

    def take_numbers(self, numbers: Array, times: Array) -> None:
        """Go on with `all_numbers` of a step of the same text; the memory stays."""
        self._numbers[:] = numbers
        self._times[:] = times
        self.look_anew()

    def adopt(self, other: "Step", samples: Samples) -> None:
        """Go on from where a step of another model is, on the same machine.

        Ledger, correction and directions are the other's, and so is what lags of the same temperature remember; what
        the other did not know begins as at a start, with this sample.
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
        self.look_anew()

    def look_anew(self) -> None:
        """Let the next cycle work out the slow part with the numbers of now, whether a temperature is new or not."""
        floats, ints = self.source.floats.at, self.source.ints.at
        if self.sensors:
            self.state.ints[ints["degc_at"]] = -1
        elif self._uses_spindle:
            self.state.floats[floats["u"]][len(self.layout.sensors)] = np.nan
        else:
            self.state.ints[ints["ready"]] = 0

    @property
    def _memory(self) -> NDArray[np.float64]:
        return self.state.floats[self.source.floats.at["m"]]

    def warm_up(self) -> None:
        """Compile (or fetch from disk) before the first real cycle."""
        self.advance(self.fresh_state(), Samples.empty(self.layout, 1))


def _arrays(samples: Samples, commands: Commands) -> list[Array]:
    return [*samples.arrays().values(), *commands.arrays().values()]
