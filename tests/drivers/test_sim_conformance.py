"""The simulated machine keeps the laws that every driver keeps."""

import pytest

from rtec.correction.sinks import FollowingErrorSink
from rtec.loop.clock import VirtualClock
from rtec_drivers.sim import SimDriver
from tests.support.conformance import MACHINE, DriverLaws, Rig


class TestSim(DriverLaws):
    @pytest.fixture
    def rig(self) -> Rig:
        return Rig(
            SimDriver,
            {"truth": "sim/turning-centre.toml"},
            misspelt="sed",
            nearest="seed",
            clock=VirtualClock(10**12),
            sensors=MACHINE.sensor_names,
            wrong_sinks=[FollowingErrorSink(resolution_um=1.0)],
            device_inside=True,
        )
