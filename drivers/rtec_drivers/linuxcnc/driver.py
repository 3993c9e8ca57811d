"""A machine that LinuxCNC runs, as a device: counts, temperatures, spindle speed and actuator (`docs/linuxcnc.md`)."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Self

import numpy as np
from pydantic import Field

from rtec.arrays import Floats, Ints
from rtec.correction.sinks import Sink, differs
from rtec.errors import ConfigError, DriverError, DriverFault, DriverTimeout, DriverUnavailable
from rtec.loop.clock import Clock
from rtec.loop.ports import HOLDS
from rtec.machine import Machine
from rtec.quantities import MicrometresPositive, SecondsPositive
from rtec.tomlfile import Strict
from rtec_drivers.linuxcnc.link import BridgeHello, BridgeLink, HalState
from rtec_drivers.reopen import Reopener
from rtec_drivers.temperatures import StuckWatch

if TYPE_CHECKING:
    from rtec_drivers.linuxcnc.adopt import AdoptedMachine

LONGEST_SOCKET = 100
FIRST_S, LONGEST_S = 0.1, 2.0


class LinuxCncOptions(Strict):
    """Options of a machine that LinuxCNC runs; they must match those of the bridge in its HAL file."""

    socket: Path = Field(description="The bridge's socket, as its option --socket says; relative: from the run file.")
    actuator: Literal["following_error", "origin_offset", "pulse"] = Field(
        "following_error",
        description="Which way corrections go in: HAL offset, external offsets, or counts through stepgen.",
    )
    unit_um: MicrometresPositive = Field(
        0.01, description="One unit of output, µm, for those that do not count pulses."
    )
    silent_s: SecondsPositive = Field(0.1, description="So long without a servo period is a LinuxCNC that stands.")
    stuck_after_s: SecondsPositive = Field(
        3600.0, description="A temperature that is constant to its last digit for this time is not used."
    )


class LinuxCncDriver:
    """LinuxCNC by its HAL: joint positions latched in the servo thread, corrections added to its own motion.

    Counts are the joints' positions without the correction, times `counts_per_mm`. While a joint is not homed they are
    unknown, and the correction holds. After a restart of LinuxCNC, and after "machine off" cleared external offsets,
    the correction holds until `resume` is called. A killed bridge restarts by itself, with its pins' values.

    Args:
        options: options of the run file.
        machine: machine with the axes and sensors of the arrays.
        clock: clock of the instants; must be CLOCK_MONOTONIC, as the bridge's.
        base: folder at which a relative path of the socket starts.

    Raises:
        ConfigError: the socket's path is longer than the system allows.
    """

    options_model = LinuxCncOptions
    EXAMPLE = """\
[device.cnc]
driver = "linuxcnc"
socket = "/run/rtec/linuxcnc.sock"     # as in the HAL file's line that loads the bridge
actuator = "following_error"           # the HAL component offset, behind LinuxCNC's own position
unit_um = 0.01
"""

    def __init__(self, options: LinuxCncOptions, machine: Machine, clock: Clock, base: Path = Path()) -> None:
        self.options, self._machine, self._clock = options, machine, clock
        self._path = base / options.socket
        if len(str(self._path).encode()) > LONGEST_SOCKET:
            raise ConfigError(
                f"socket: {str(self._path)!r} is longer than {LONGEST_SOCKET} bytes; choose a shorter path"
            )
        self._per_mm = np.array([a.counts_per_mm for a in machine.axes])
        self._link: BridgeLink | None = None
        self._reopener: Reopener[BridgeLink] | None = None
        self._stuck = StuckWatch(options.stuck_after_s)
        self._session = ""
        self._must_resume, self._restarted = "", False
        self._resuming = False

    @staticmethod
    def adopt(ini: Path) -> "AdoptedMachine":
        """Read the INI file of a machine that LinuxCNC runs already, for `rtec init --controller linuxcnc`.

        Raises:
            ConfigError: it cannot be read, or rtec has no template for the machine.
        """
        from rtec_drivers.linuxcnc.adopt import adopt

        return adopt(ini)

    def __enter__(self) -> Self:
        """Connect. Starting a run is an order to resume.

        Raises:
            DriverError: there is no bridge, it belongs to another machine, or it sends nothing.
        """
        self._link = self._connect()
        self._session, self._must_resume, self._restarted = self._link.hello.session, "", False
        self._stuck = StuckWatch(self.options.stuck_after_s)
        self._reopener = Reopener(self._connect, BridgeLink.close, self._clock, FIRST_S, LONGEST_S)
        self._reopener.start()
        return self

    def __exit__(self, *error: object) -> None:
        """Hold, then close."""
        self.hold()
        if self._reopener is not None:
            self._reopener.close()
            self._reopener = None
        self._drop()

    @property
    def must_resume(self) -> str:
        """Why the correction waits for an order to resume; "" where it does not."""
        if not self._restarted:
            return self._must_resume
        state = None if self._link is None else self._link.state
        homed = "" if state is not None and state.homed else ", and its joints are not homed"
        return f"LinuxCNC restarted: its corrections begin at zero again{homed}; {HOLDS}"

    def resume(self) -> None:
        """Go on: LinuxCNC's present output is accepted."""
        self._must_resume, self._restarted = "", False
        link = self._link
        if link is not None:
            self._session = link.hello.session
            if link.state is not None and link.state.cleared_um is not None:
                link.send(None)
                self._resuming = True  # states from before the bridge got the order still have "cleared"

    def read_counts(self, counts: Ints) -> int:
        """Fill in the joints' positions as counts; give the instant of latching, ns.

        Raises:
            DriverFault: not all joints are homed, or it waits for an order to resume.
            DriverTimeout: the servo thread has stopped.
            DriverUnavailable: not entered, or the bridge has gone.
        """
        state = self._now()
        if self.must_resume:
            raise DriverFault(self.must_resume)
        if not state.homed:
            raise DriverFault("LinuxCNC: not all joints are homed, so nobody knows where the axes are: home them")
        counts[:] = np.rint(np.array(state.mm) * self._per_mm)
        return min(state.time_ns, self._clock.now_ns())

    def read_temperatures(self, degc: Floats, time_ns: Ints) -> None:
        """Fill in the pins' temperatures, °C; their instant is that of the servo period.

        Raises:
            DriverFault: a sensor's pin is not wired, or a sensor is stuck.
            DriverTimeout, DriverUnavailable: as `read_counts`.
        """
        link = self._listened()
        state = self._now()
        wrong = []
        for name, value in zip(link.hello.sensors, state.degc, strict=True):
            if value is None:
                wrong.append(
                    f"{name}: nothing is wired to the pin {link.hello.component}.{name}, or it gives no number"
                )
                continue
            stuck = self._stuck.look(name, value, state.time_ns)
            if stuck:
                wrong.append(stuck)
                continue
            k = self._machine.sensor_place(name)
            degc[k], time_ns[k] = value, min(state.time_ns, self._clock.now_ns())
        if wrong:
            raise DriverFault(f"LinuxCNC: {'; '.join(wrong)}")

    def read_spindle(self) -> float:
        """The spindle speed, 1/min.

        Raises:
            DriverFault: its pin is not wired.
            DriverTimeout, DriverUnavailable: as `read_counts`.
        """
        rpm = self._now().rpm
        if rpm is None:
            raise DriverFault("LinuxCNC: nothing is wired to the pin rtec.spindle-rpm")
        return rpm

    def refuses(self, sink: Sink) -> str:
        """Refuse all kinds but that of the options, and any other unit."""
        options = self.options
        return differs(sink, options.actuator, options.unit_um)

    @property
    def most_um(self) -> tuple[float, ...]:
        """The largest output of each axis, µm, by the bridge's option and HAL's limit3; no limit before it is open."""
        known = self._link.hello.max_um if self._link is not None else ()
        return known or (math.inf,) * len(self._machine.axes)

    def apply(self, output: Ints) -> None:
        """Send the absolute output of every axis; does not wait.

        Raises:
            DriverFault: the bridge refused the last command, or it waits for an order to resume.
            DriverTimeout: the servo thread has stopped.
            DriverUnavailable: not entered, or the bridge has gone.
        """
        link = self._listened()
        if self.must_resume:
            raise DriverFault(self.must_resume)
        self._now()
        refused, link.refused = link.refused, ""
        link.send([int(n) for n in output])
        if refused:
            raise DriverFault(f"LinuxCNC: the bridge refuses commands: {refused}")

    def read_output(self, output: Ints) -> None:
        """Fill in the values of LinuxCNC's own pins.

        Raises:
            DriverTimeout: they have not been reported for too long, or not yet.
            DriverUnavailable: not entered, or the bridge has gone.
        """
        output[:] = self._now().out

    def hold(self) -> None:
        """Send nothing: HAL's signals keep their values."""

    def _now(self) -> HalState:
        """Newest state, unless it is too old."""
        state = self._listened().state
        age_s = math.inf if state is None else (self._clock.now_ns() - state.time_ns) * 1e-9
        if state is None or age_s > self.options.silent_s:
            raise DriverTimeout(f"{self._path}: LinuxCNC's servo thread stands")
        return state

    def _listened(self) -> BridgeLink:
        """Process the received messages; where the bridge has gone, look for the next one.

        Raises:
            DriverUnavailable, DriverFault: it has gone, or sends impossible messages.
        """
        if self._reopener is None:
            raise DriverUnavailable("linuxcnc: not entered, so no bridge is connected")
        if self._link is None:
            self._link = self._reopener.poll()
            if self._link is None:
                raise DriverUnavailable(self._reopener.error)
            self._greet(self._link.hello)
        try:
            self._link.listen()
        except DriverError as e:
            self._drop()
            self._reopener.lost(str(e))
            raise
        state = self._link.state
        if state is not None and state.cleared_um is None:
            self._resuming = False
        elif state is not None and state.cleared_um is not None and not (self.must_resume or self._resuming):
            self._must_resume = self._cleared(state.cleared_um)
        return self._link

    def _greet(self, hello: BridgeHello) -> None:
        self._restarted = self._restarted or (hello.session != self._session and not self._must_resume)

    def _cleared(self, cleared_um: tuple[float, ...]) -> str:
        by_axis = ", ".join(
            f"{a} by {um:+.2f} µm" for a, um in zip(self._machine.axis_names, cleared_um, strict=True) if um
        )
        return (
            f"LinuxCNC cleared the external offsets when the machine went off; the joints stay displaced ({by_axis}):"
            f" its coordinates have moved by that much; home again if that matters; {HOLDS}"
        )

    def _connect(self) -> BridgeLink:
        link = BridgeLink(self._path)
        wrong = self._mismatch(link.hello)
        if wrong:
            link.close()
            raise DriverFault(f"{self._path}: {wrong}; give the bridge in LinuxCNC's HAL file what the run file says")
        return link

    def _mismatch(self, hello: BridgeHello) -> str:
        """Differences between the bridge's options and the run file's; "" where they match."""
        options, machine = self.options, self._machine
        if hello.axes != machine.axis_names:
            return f"the bridge has the axes {', '.join(hello.axes)}, the machine {', '.join(machine.axis_names)}"
        unknown = sorted(set(hello.sensors) - set(machine.sensor_names))
        if unknown:
            return f"the bridge has the sensor {unknown[0]!r}, which the machine has not"
        if hello.actuator != options.actuator:
            return f"the bridge's --actuator is {hello.actuator!r}, the device's actuator {options.actuator!r}"
        if options.actuator != "pulse" and not math.isclose(hello.unit_um, options.unit_um, rel_tol=1e-9):
            return f"the bridge's --unit-um is {hello.unit_um:g}, the device's unit_um {options.unit_um:g}"
        return ""

    def _drop(self) -> None:
        if self._link is not None:
            self._link.close()
            self._link = None
