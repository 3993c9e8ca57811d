"""An effect of the user's own, written as an expression over channels (arithmetic.py says what is let through)."""

from collections.abc import Mapping, Sequence
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from rtec.effects.arithmetic import CONSTANTS, MAX_LENGTH, degree, evaluate, names_in, parse
from rtec.effects.base import About, Effect, Parameter
from rtec.effects.state import Channels, Value
from rtec.errors import ModelError
from rtec.machine import Machine
from rtec.tomlfile import Strict, nearest


class Free(Strict):
    """A non-linear parameter of an expression: where the search begins and its bounds."""

    start: float
    low: float
    high: float
    unit: str = "1"

    @model_validator(mode="after")
    def _ordered(self) -> "Free":
        if not self.low <= self.start <= self.high or self.low >= self.high:
            raise ValueError("need low <= start <= high and low < high")
        return self


class Expression(Effect):
    """`e = expression`, linear in `linear`, with the names in `free` as non-linear parameters.

    Names in the expression are channels of the machine and the parameters. Channels: position `x` mm, direction
    `d_x`, velocity `v_x` mm/s, acceleration `a_x` mm/s², distance since the last reversal `s_x` mm, temperatures
    above the reference K, `spindle_rpm`, `load_kg`, `force_n`, `time_s`. `lag(value, tau)` is the first-order lag.
    """

    about: ClassVar[About] = About(
        title="An expression of your own",
        equation="e = the expression",
        typical="-",
        seen_by=(),
        source="the user",
    )
    effect: Literal["expression"] = "expression"
    expression: Annotated[str, Field(min_length=1, max_length=MAX_LENGTH)]
    linear: Annotated[dict[str, str], Field(min_length=1)]
    free: dict[str, Free] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _parses(self) -> "Expression":
        names = names_in(self.expression)
        both = sorted(set(self.linear) & set(self.free))
        if both:
            raise ValueError(f"parameter {both[0]!r} stands under both linear and free")
        unused = [n for n in (*self.linear, *self.free) if n not in names]
        if unused:
            raise ValueError(f"parameter {unused[0]!r} does not stand in the expression")
        return self

    def check(self, machine: Machine, where: str) -> None:
        """Check that every name is known and that the expression is linear in its coefficients."""
        super().check(machine, where)
        known = machine.channel_names
        for name in names_in(self.expression) - set(self.linear) - set(self.free) - set(CONSTANTS):
            if name not in known:
                raise ModelError(f"{where}: {name!r} is neither a channel nor a parameter{nearest(name, known)}")
        clash = next((n for n in (*self.linear, *self.free) if n in known or n in CONSTANTS), None)
        if clash:
            raise ModelError(f"{where}: parameter {clash!r} has the name of a channel; choose another")
        self._check_linear(where)
        with np.errstate(all="ignore"):
            self.basis(machine, _Probe(machine), {name: free.start for name, free in self.free.items()})

    def _check_linear(self, where: str) -> None:
        said = ", ".join(self.linear)
        try:
            found = degree(parse(self.expression), set(self.linear))
        except ValueError as e:
            raise ModelError(f"{where}: not linear in {said}: {e}; declare what is not linear under `free`") from e
        if found != 1:
            raise ModelError(f"{where}: with all of {said} zero the expression is not zero")

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """Give the names and units under `linear`."""
        del machine
        return tuple(Parameter(name, unit) for name, unit in self.linear.items())

    def nonlinear(self, machine: Machine) -> tuple[Parameter, ...]:
        """Give the parameters under `free`."""
        del machine
        return tuple(Parameter(n, f.unit, f.start, f.low, f.high) for n, f in self.free.items())

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """Read every channel that the expression names."""
        return tuple(sorted(names_in(self.expression) & set(machine.channel_names)))

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """Give the expression with one coefficient at one and the others at zero, in turn."""
        return [
            self._evaluate(machine, channels, theta, {n: float(n == name) for n in self.linear}) for name in self.linear
        ]

    def _evaluate(
        self, machine: Machine, channels: Channels, theta: Mapping[str, Value], coefficients: Mapping[str, float]
    ) -> Value:
        names: dict[str, Value] = {**CONSTANTS, **theta, **coefficients}
        for name in self.channels(machine):
            names[name] = channels.rise(name) if name in machine.sensor_names else channels.value(name)
        try:
            return evaluate(parse(self.expression), names, channels)
        except (OverflowError, ZeroDivisionError, ValueError) as e:
            raise ModelError(f"expression {self.expression!r}: {e}") from e


class _Probe:
    """Three arbitrary instants, to try an expression on."""

    def __init__(self, machine: Machine) -> None:
        self._values = {n: np.array([0.37, 0.61, 0.83]) + 0.1 * i for i, n in enumerate(sorted(machine.channel_names))}

    def value(self, name: str) -> Value:
        return self._values[name]

    def rise(self, sensor: str) -> Value:
        return self._values[sensor]

    def lagged(self, value: Value, tau_s: Value) -> Value:
        if np.ndim(tau_s):
            raise ModelError("the time constant of lag() is a number or a parameter, not a channel")
        return value
