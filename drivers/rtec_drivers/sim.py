"""The simulated machine as a device: counts, temperatures, spindle and actuator in one.

The machine's time zero is the instant of entering; from then on it follows the given clock, so it runs in real time
or on a virtual clock alike.
"""

from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from rtec.arrays import Floats, Ints
from rtec.correction.sinks import Sink, differs
from rtec.errors import ConfigError, DriverUnavailable
from rtec.files import beside
from rtec.loop.clock import Clock
from rtec.machine import Machine
from rtec.quantities import MicrometresPositive, RevolutionsPerMinute, Seed
from rtec.sim.machine import SimulatedMachine
from rtec.sim.truth import load_truth
from rtec.tomlfile import Strict

OFFSETS = {"following_error": "following_error", "phase": "following_error", "origin_offset": "origin"}


class SimOptions(Strict):
    """Options of the simulated machine.

    Attributes:
        truth: file of the truth; a relative path starts at the run file's folder.
        seed: same seed, same day.
        program: text of a part program; without this and `program_file`, the axes stand still.
        program_file: a file with a part program, instead.
        repeat: start the program again when it ends.
        warm_up_s: duration of work before the run begins, so that there is something to correct.
        warm_up_rpm: spindle speed during the warm-up.
        actuator: kind of the sink.
        unit_um: one unit of output, µm, for kinds that do not count pulses.
    """

    truth: Path
    seed: Seed = 0
    program: str | None = None
    program_file: Path | None = None
    repeat: bool = True
    warm_up_s: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    warm_up_rpm: RevolutionsPerMinute = 0.0
    actuator: Literal["pulse", "following_error", "phase", "origin_offset"] = "pulse"
    unit_um: MicrometresPositive = 1.0

    @model_validator(mode="after")
    def _one_program(self) -> Self:
        if self.program is not None and self.program_file is not None:
            raise ValueError("give program or program_file, not both")
        return self


class SimDriver:
    """Simulated machine; needs no hardware.

    Args:
        options: options of the run file.
        machine: machine with the axes and sensors of the arrays.
        clock: clock of the machine.
        base: folder at which relative paths start.

    Raises:
        ConfigError: truth, machine or program is at fault. The constructor opens nothing else.
    """

    options_model = SimOptions
    IN_LOOP = True  # the machine is one object, in the time of one clock, so no worker can read its sensors
    EXAMPLE = """\
[device.machine]
driver = "sim"
truth = "sim/turning-centre.toml"    # what is so, beside what the machine's file says
seed = 1
warm_up_s = 7200                     # two hours of work before the run begins
warm_up_rpm = 2400
program = '''
M3 S2400
G0 X110 Z335
G1 Z330 F720
G1 X40
'''
"""

    def __init__(self, options: SimOptions, machine: Machine, clock: Clock, base: Path = Path()) -> None:
        self.options = options
        self._clock, self._start_ns = clock, -1
        self._output: Ints = np.zeros(len(machine.axes), np.int64)
        self.machine = SimulatedMachine(machine, load_truth(beside(base, options.truth)), options.seed)
        text = _program_text(options, base)
        if options.warm_up_s > 0:
            self.machine.work(options.warm_up_s, options.warm_up_rpm)
        self.machine.load_program(text, options.repeat)
        self._lead_ns = self.machine.time_ns

    def __enter__(self) -> Self:
        """Start the machine's time."""
        self._start_ns = self._clock.now_ns()
        return self

    def __exit__(self, *error: object) -> None:
        """Hold and stop the machine's time."""
        if self._start_ns >= 0:
            self._follow()
            self._start_ns = -1

    def read_counts(self, counts: Ints) -> int:
        """Fill in the raw counts; give the instant, ns of the clock, of the servo tick that latched them."""
        self._follow()
        counts[:] = self.machine.raw_counts
        return self._at(self.machine.time_ns)

    def read_temperatures(self, degc: Floats, time_ns: Ints) -> None:
        """Fill in temperatures, °C, and their instant; a new one once a second."""
        self._follow()
        degc[:], latched_ns = self.machine.temperatures()
        time_ns[:] = self._at(latched_ns)

    def read_spindle(self) -> float:
        """The spindle speed, 1/min."""
        self._follow()
        return self.machine.spindle_rpm

    def refuses(self, sink: Sink) -> str:
        """Refuse all kinds but that of the options, and any other unit."""
        return differs(sink, self.options.actuator, self.options.unit_um)

    def apply(self, output: Ints) -> None:
        """Set the absolute output: inserted counts, or units of `unit_um` in the other modes."""
        self._follow()
        self._output[:] = output
        if self.options.actuator == "pulse":
            self.machine.apply(self._output)
        else:
            self.machine.set_offset_um(self._output * self.options.unit_um, OFFSETS[self.options.actuator])

    def read_output(self, output: Ints) -> None:
        """Fill in the machine's output."""
        output[:] = self._output

    def hold(self) -> None:
        """Do nothing: the machine keeps the last output."""

    def _at(self, machine_ns: int) -> int:
        return self._start_ns + machine_ns - self._lead_ns

    def _follow(self) -> None:
        if self._start_ns < 0:
            raise DriverUnavailable("sim: not entered yet, so the simulated machine's time does not run")
        self.machine.advance_to(self._lead_ns + self._clock.now_ns() - self._start_ns)


def _program_text(options: SimOptions, base: Path) -> str:
    if options.program_file is None:
        return options.program or ""
    path = beside(base, options.program_file)
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as e:
        raise ConfigError(f"{path}: cannot be read as a part program: {e}") from e
