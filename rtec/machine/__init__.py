"""The machine: axes, encoder scale, sensors, and the kinematic chain that turns component errors into tip error."""

from rtec.machine.chain import Axis, Link
from rtec.machine.machine import Machine, Sensor, load_machine, machine_from

__all__ = ["Axis", "Link", "Machine", "Sensor", "load_machine", "machine_from"]
