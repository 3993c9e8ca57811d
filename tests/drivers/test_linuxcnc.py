"""The LinuxCNC driver keeps the laws that every driver keeps; a real LinuxCNC is the device."""

from collections.abc import Iterator

import pytest

from rtec.correction.sinks import FollowingErrorSink, PulseSink
from rtec.machine import load_machine
from rtec_drivers.linuxcnc.driver import LinuxCncDriver
from tests.support.conformance import DriverLaws, Rig
from tests.support.linuxcnc_session import CONFIGS, Session, why_not

pytestmark = [pytest.mark.xdist_group("linuxcnc"), pytest.mark.skipif(bool(why_not()), reason=why_not() or "")]


@pytest.fixture(scope="module")
def mill() -> Iterator[Session]:
    with Session("mill") as session:
        session.state("estop_reset")
        session.state("on")
        session.home()
        yield session


class TestLinuxCnc(DriverLaws):
    @pytest.fixture
    def rig(self, mill: Session) -> Rig:
        return Rig(
            LinuxCncDriver,
            {"socket": str(mill.folder / "mill.sock")},
            misspelt="sockt",
            nearest="socket",
            machine=load_machine(CONFIGS / "mill-machine.toml"),
            sensors=["T_x", "T_y", "T_z"],
            takes=FollowingErrorSink(resolution_um=0.01),
            wrong_sinks=[PulseSink(), FollowingErrorSink(resolution_um=0.1)],
            output=(300, -500, 20),
            missing={"socket": str(mill.folder / "no-such.sock")},
        )
