"""Every way into the machine, closed loop: the axis ends up where the correction wants it.

Oracle: the simulated machine's own encoder, driven by its own servo, not what rtec says that it applied. (The slide
behind the encoder may lag by its play where the correction alone turned it round.)
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.loop.clock import VirtualClock
from rtec.loop.devices import Ports
from rtec.loop.run_file import load_setup
from rtec_drivers.sim import SimDriver
from tests.loop.test_loop import run
from tests.support import setups

Floats = NDArray[np.float64]
RANGE_MM, BITS = 0.1, 8
SINKS: dict[str, tuple[dict[str, Any], float]] = {
    "single counts": ({"kind": "pulse"}, 1.0),
    "whole cycles": ({"kind": "pulse", "quantum_counts": 4}, 4.0),
    "following error": ({"kind": "following_error", "resolution_um": 0.5}, 0.5),
    "phase": ({"kind": "phase", "bits": BITS, "range_mm": RANGE_MM}, 2e3 * RANGE_MM / 2**BITS),
    "origin offset": ({"kind": "origin_offset", "resolution_um": 1.0, "period_s": 0.5}, 1.0),
}


def encoder_um(box: SimDriver) -> Floats:
    """How far the encoders are from where the program wants the axes, µm."""
    per_mm = np.array([a.counts_per_mm for a in box.machine.machine.axes])
    return np.asarray((box.machine.raw_counts / per_mm - [100.0, 200.0]) * 1e3, dtype=np.float64)


@pytest.mark.parametrize("name", SINKS)
def test_the_axis_goes_where_the_correction_wants_it(tmp_path: Path, name: str) -> None:
    sink, unit_um = SINKS[name]
    actuator = str(sink["kind"])
    content = setups.tables(tmp_path, actuator=actuator, unit_um=unit_um, program="G0 X100 Z200", repeat=False)
    content["output"] = {"X": sink, "Z": sink}
    path = setups.write(tmp_path, content)

    machines: list[SimDriver] = []

    def remember(ports: Ports) -> Ports:
        assert isinstance(ports.counts, SimDriver)
        machines.append(ports.counts)
        return ports

    _, commands, loop, _ = run(load_setup(path), VirtualClock(10**9), 6000, remember)
    applied_um = commands.applied_um[-1]
    assert abs(applied_um[0]) > 10.0
    shift_um = encoder_um(machines[0])
    # One unit of the sink, one count of the encoder, and half of each for rounding.
    allowed = 0.5 + 0.75 * unit_um + 1.0
    plain, _, _, _ = run_without(tmp_path, content)
    np.testing.assert_allclose(shift_um - plain, applied_um, atol=allowed)
    assert loop.stats.driver_errors == 0


@pytest.mark.parametrize("reversal_um", [4.0, -4.0, 25.0])
def test_a_correction_does_not_chase_its_own_reversal(tmp_path: Path, reversal_um: float) -> None:
    """At rest the corrections' own motion turns the axis round; its reversal term must not turn it back for ever.

    Oracle: an axis at rest under constant temperatures comes to rest. With the machine's dead band of 2 counts alone,
    the output went to and fro by the reversal value twice a second.
    """
    sink, unit_um = SINKS["origin offset"]
    content = setups.tables(tmp_path, actuator="origin_offset", unit_um=unit_um, program="G0 X100 Z200", repeat=False)
    content["output"] = {"X": sink, "Z": sink}
    path = setups.write(tmp_path, content)
    made = load_setup(path)
    effects = tuple(
        replace(f, values={"B": reversal_um}) if f.effect.effect == "backlash" else f for f in made.model.effects
    )
    made = replace(made, model=replace(made.model, effects=effects))
    _, commands, _, _ = run(made, VirtualClock(10**9), 8000)
    moves = np.count_nonzero(np.diff(commands.output[4000:, 0]))
    assert moves <= 2
    assert np.ptp(commands.output[4000:, 0]) <= 2


def run_without(tmp_path: Path, content: dict[str, Any]) -> tuple[Any, Any, Any, Any]:
    """The same with the correction off: where the servo leaves the axes by themselves, µm."""
    from rtec.correction.flags import MODE_OFF

    folder = tmp_path / "off"
    folder.mkdir()
    machines: list[SimDriver] = []

    def remember(ports: Ports) -> Ports:
        assert isinstance(ports.counts, SimDriver)
        machines.append(ports.counts)
        return ports

    made = load_setup(setups.write(folder, content))
    _, commands, loop, ports = run(made, VirtualClock(10**9), 6000, remember, MODE_OFF)
    assert not commands.output.any()
    return encoder_um(machines[0]), commands, loop, ports
