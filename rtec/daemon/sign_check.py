"""The sign check: it deliberately moves one axis by a known step, so that an indicator shows the sign.

A model of one constant replaces the run file's model: "this axis is 20 µm too low" requests +20 µm. The request passes
guard, ledger and actuator like every correction, so the limits of the run file hold. The run begins with a return to
zero, wherever the run before ended, and ends with one: the actuator has confirmed an output of zero.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final

from rtec.correction.flags import MODE_OFF, MODE_ON, Flag
from rtec.correction.sinks import DEAD_BAND, PulseSink
from rtec.daemon.status import Status
from rtec.effects import EFFECTS
from rtec.errors import ConfigError
from rtec.loop.clock import Clock
from rtec.loop.orders import OrderWords
from rtec.loop.run_file import Setup, load_setup
from rtec.model import FittedEffect, Model
from rtec.tomlfile import nearest

SPARE_NS: Final = 2_000_000_000
_STEP: Final = re.compile(r"\s*(\w+)\s*=\s*([+-]?\d+(?:\.\d*)?|[+-]?\.\d+)\s*(?:um|µm|μm)\s*")


def step_of(text: str) -> dict[str, float]:
    """Axis and size, µm, of a step in words, such as `X=20um` or `Z=-5um`; never without its unit.

    Raises:
        ConfigError: the text is not a step.
    """
    match = _STEP.fullmatch(text)
    if match is None:
        meant = f"{text.strip()}um" if _STEP.fullmatch(f"{text}um") else "X=20um or X=-20um"
        raise ConfigError(f"--step {text!r}: give an axis and micrometres, as {meant}")
    return {match[1]: float(match[2])}


def load_stepped(path: Path, step_um: Mapping[str, float]) -> Setup:
    """Read a run file; with a step of one axis its model is not read, and need not exist yet.

    Raises:
        RtecError: as `rtec.loop.run_file.load_setup` and `with_step`.
    """
    return with_step(load_setup(path, needs_model=not step_um), step_um)


def with_step(setup: Setup, step_um: Mapping[str, float]) -> Setup:
    """The setup with a step of one axis in place of its model; without a step, the setup unchanged.

    Args:
        setup: an ordinary setup.
        step_um: µm by axis, positive where the axis counts up.

    Raises:
        ConfigError: the axis is unknown or not compensated, or the step is zero or more than its stop limit.
    """
    if not step_um:
        return setup
    for axis, um in step_um.items():
        _check(setup, axis, um)
    # Differs from the file's mode: after a kill the next ordinary run then begins with its run file's mode.
    mode = "off" if setup.file.run.mode != "off" else "hold"
    file = setup.file.model_copy(update={"run": setup.file.run.model_copy(update={"mode": mode})})
    return replace(setup, file=file, model=_model(setup.model, step_um), step_um=dict(step_um))


def _check(setup: Setup, axis: str, um: float) -> None:
    names, where = setup.machine.axis_names, f"--step {axis}={um:g}um"
    if axis not in names:
        raise ConfigError(f"{where}: machine {setup.machine.name!r} has no axis {axis!r}{nearest(axis, names)}")
    if setup.file.role.actuator is None:
        raise ConfigError(f"{where}: the run file has no [role] actuator, only tables; nothing moves the axis")
    if not setup.machine.axis(axis).compensate:
        raise ConfigError(f"{where}: axis {axis} has `compensate = false` in the machine file; nothing moves it")
    stop_um = setup.file.limits[axis].stop_um
    if um == 0.0 or not math.isfinite(um) or abs(um) > stop_um:
        raise ConfigError(f"{where}: give a step that is not zero and at most stop_um of [limits.{axis}], {stop_um:g}")


def _model(model: Model, step_um: Mapping[str, float]) -> Model:
    machine = model.machine
    kind = EFFECTS["polynomial_position"]
    effects = []
    for axis, um in step_um.items():
        component = f"E{machine.axis(axis).direction}{axis}"
        table = {"effect": "polynomial_position", "component": component, "axis": axis, "degrees": [0]}
        effects.append(FittedEffect(kind.model_validate(table), {"c0": -um}))
    return Model(machine, tuple(effects), name=" ".join(f"step {axis} {um:+g} um" for axis, um in step_um.items()))


class StepOrders:
    """Gives the orders of a sign check: to zero, then the step, at the end to zero again.

    In an ordinary run it gives none, and the run may end at any time.

    Args:
        setup: the running setup.
        clock: monotonic.

    Attributes:
        lasts_s: time, s, after which the return to zero begins by itself; None: never.
    """

    def __init__(self, setup: Setup, clock: Clock) -> None:
        self._setup, self._clock = setup, clock
        self._begins = bool(setup.step_um)
        self._last_ns: int | None = None
        self._zero_from: int | None = None
        self._scales = {a.name: setup.file.output.get(a.name, PulseSink()).scale(a) for a in setup.machine.axes}
        self.lasts_s: float | None = None

    def look(self, orders: OrderWords, status: Status, ending: bool) -> bool:
        """Give the next order; return whether the run may end now. Called some 50 times a second."""
        if not self._setup.step_um:
            return ending
        ending = ending or (self.lasts_s is not None and status.time_s >= self.lasts_s)
        there = self._at_zero(status)
        if ending:
            orders.mode = MODE_OFF
            return there or self._too_late()
        if self._begins:
            self._begins = not there
            orders.mode = MODE_ON if there else MODE_OFF
        return False

    def trouble(self, status: Status) -> str:
        """What the run did not finish; "" where it finished everything."""
        if not self._setup.step_um:
            return ""
        in_machine = self._output_um(status) | {a: um for a, um in status.applied_um.items() if um}
        if in_machine:
            held = ", ".join(f"{axis} {um:+.2f} µm" for axis, um in in_machine.items())
            return f"the way back to nothing was not finished, and is held at {held}"
        if status.flags & Flag.OUTPUT_TROUBLE:
            return "the actuator did not confirm that its output is nothing again: compare the indicator"
        return ""

    def _at_zero(self, status: Status) -> bool:
        """Is the machine at zero? Zero was commanded, and a later cycle found that the actuator had no other output.

        The correction is at zero before the output is: a slow controller gets its last command up to `period_s` later.
        """
        under_way = any(status.applied_um.values()) or bool(self._output_um(status))
        if not status.cycles or under_way or status.flags & (Flag.LIMITED | Flag.OUTPUT_TROUBLE):
            self._zero_from = None
            return False
        if self._zero_from is None:
            self._zero_from = status.cycles
        return status.cycles > self._zero_from

    def _output_um(self, status: Status) -> dict[str, float]:
        """The output, µm, of each axis that has more than the ledger leaves at zero."""
        scales = self._scales
        return {
            axis: units / scales[axis].units_per_um
            for axis, units in status.output.items()
            if abs(units) > DEAD_BAND * scales[axis].quantum
        }

    def _too_late(self) -> bool:
        """The correction is held, so zero cannot be reached: the run ends all the same."""
        if self._last_ns is None:
            limits = self._setup.file.limits.values()
            longest_s = max(2.0 * (x.stop_um / x.slew_um_s + x.slew_um_s / x.acceleration_um_s2) for x in limits)
            longest_s += 2.0 * max(scale.period_s for scale in self._scales.values())
            self._last_ns = self._clock.now_ns() + round(longest_s * 1e9) + SPARE_NS
        return self._clock.now_ns() > self._last_ns
