"""A machine that a real LinuxCNC runs: the driver keeps the laws that every driver keeps, and its errors fall."""

from collections.abc import Iterator

import numpy as np
import pytest

from rtec.correction.sinks import FollowingErrorSink, PulseSink
from rtec.machine import load_machine
from rtec_drivers.linuxcnc.driver import LinuxCncDriver
from tests.support.conformance import DriverLaws, Rig
from tests.support.linuxcnc_loop import Floats, LoopThread, dwell_errors_um
from tests.support.linuxcnc_session import CONFIGS, Session, why_not

pytestmark = [pytest.mark.xdist_group("real-clock"), pytest.mark.skipif(bool(why_not()), reason=why_not() or "")]


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


AXES = 3
TRAVERSE = "G1 F6000 X{0} Y{0} Z{0}\nG4 P0.08\n"
PLACES = list(range(-80, 81, 40))
PROGRAMME = "G21 G90 G64 P0.001\n" + "".join(TRAVERSE.format(q) for q in [*PLACES, *PLACES[-2::-1]]) + "M2\n"


@pytest.fixture(scope="module")
def errors(mill: Session) -> dict[str, Floats]:
    """A part programme to 9 places, in both directions, without and with rtec, as LinuxCNC's sampler saw it."""
    (mill.folder / "places.ngc").write_text(PROGRAMME)
    out = {}
    mill.mdi("G0 X-90 Y-90 Z-90")
    out["without"] = recorded(mill)
    with LoopThread(mill):
        mill.mdi("G0 X-80 Y-80 Z-80")
        mill.mdi("G0 X-90 Y-90 Z-90")
        out["with"] = recorded(mill)
    return out


def recorded(mill: Session) -> Floats:
    """Record while the programme runs."""
    mill.record(1, "places.txt")
    mill.run("places.ngc")
    mill.stop_record(1)
    return mill.recorded("places.txt")


def test_errors_at_dwells_fall_by_twenty(errors: dict[str, Floats]) -> None:
    """Oracle: LinuxCNC's `sampler`; the model's numbers are the plant's."""
    before, after = (np.abs(dwell_errors_um(errors[k], AXES)).max(axis=0) for k in ("without", "with"))
    assert (before > 5.0).all()
    assert (after < before / 20.0).all()


def test_errors_in_motion_fall_too(errors: dict[str, Floats]) -> None:
    """Oracle: the sampler; Z, which has no play: a step at each reversal would come through as the limits let it."""
    before, after = (1e3 * (errors[k][:, 2 * AXES] - errors[k][:, AXES]) for k in ("without", "with"))
    travel_um = 1e3 * np.abs(np.diff(errors["with"][:, AXES])).max()
    assert np.abs(after).max() < min(2.0, travel_um)
    assert np.sqrt(np.mean(after**2)) < np.sqrt(np.mean(before**2)) / 20.0
