"""Options of an encoder box, and a check that they fit the machine."""

from typing import Annotated

from pydantic import Field

from rtec.errors import ConfigError
from rtec.machine import Machine
from rtec.quantities import Counts, MillimetresPerSecond
from rtec.tomlfile import nearest
from rtec_drivers.serial_line import PortOptions


class BoxOptions(PortOptions):
    """Options of an encoder box on a serial port.

    Attributes:
        baud: ignored by a box with a USB port of its own.
        axes: the box's inputs in order, by the machine's axis names; not given: the machine's order.
        max_speed_mm_s: highest speed of each axis; faster counts are refused.
        box_serial: number of the box; another box is refused. Not given: any box.
        timeout_ms: longest wait for an answer in a cycle; shorter than the cycle.
        open_timeout_s: longest wait for the box when its port is opened (some boxes restart then).
        command_timeout_s: longest time without an accepted command before that is reported.
        silent_reopen_s: after this time of silence the port is closed and reopened.
        resume_step_counts: the first command after a start or an order to resume may differ from the box's ledger
            by at most this.
    """

    baud: Annotated[int, Field(ge=50, le=20_000_000)] = 1_000_000
    axes: tuple[str, ...] | None = None
    max_speed_mm_s: dict[str, MillimetresPerSecond]
    box_serial: Annotated[int, Field(ge=0, le=2**32 - 1)] | None = None
    timeout_ms: Annotated[float, Field(ge=1e-3, le=100)] = 0.6
    open_timeout_s: Annotated[float, Field(ge=0.1, le=30)] = 3.0
    command_timeout_s: Annotated[float, Field(ge=1e-4, le=10)] = 0.05
    silent_reopen_s: Annotated[float, Field(ge=1e-3, le=600)] = 2.0
    resume_step_counts: Counts = 16


def axis_order(axes: tuple[str, ...] | None, machine: Machine) -> tuple[int, ...]:
    """For every input of a device, the index of its axis in the machine's order.

    Raises:
        ConfigError: an axis that the machine does not have, or one that is missing or named twice.
    """
    names = machine.axis_names
    ordered = names if axes is None else axes
    faults = [f"axes: machine {machine.name!r} has no axis {n!r}{nearest(n, names)}" for n in ordered if n not in names]
    faults += [f"axes: {n!r} is there {ordered.count(n)} times; every axis must, once" for n in names
               if ordered.count(n) != 1]  # fmt: skip
    if faults:
        raise ConfigError("\n".join(faults))
    return tuple(names.index(n) for n in ordered)


def max_counts_per_s(max_speed_mm_s: dict[str, float], machine: Machine) -> tuple[float, ...]:
    """Highest speed of every axis in counts a second.

    Raises:
        ConfigError: an axis that the machine does not have, or one without a speed.
    """
    names = machine.axis_names
    faults = [
        f"max_speed_mm_s: machine {machine.name!r} has no axis {n!r}{nearest(n, names)}"
        for n in max_speed_mm_s
        if n not in names
    ]
    faults += [f"max_speed_mm_s: axis {n!r} is missing" for n in names if n not in max_speed_mm_s]
    if faults:
        raise ConfigError("\n".join(faults))
    return tuple(max_speed_mm_s[a.name] * a.counts_per_mm for a in machine.axes)
