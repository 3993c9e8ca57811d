"""A machine that a real LinuxCNC runs: the driver keeps the laws that every driver keeps, and its errors fall."""

import os
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

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
        (session.folder / "places.ngc").write_text(PROGRAMME)
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
            sensors=["T_x", "T_y", "T_z", "T_spindle"],
            takes=FollowingErrorSink(resolution_um=0.01),
            wrong_sinks=[PulseSink(), FollowingErrorSink(resolution_um=0.1)],
            output=(300, -500, 20),
            missing={"socket": str(mill.folder / "no-such.sock")},
        )


AXES, Z = 3, 2
TRAVERSE = "G1 F6000 X{0} Y{0} Z{0}\nG4 P0.3\n"
PLACES = list(range(-80, 81, 40))
PROGRAMME = "G21 G90 G64 P0.001\n" + "".join(TRAVERSE.format(q) for q in [*PLACES, *PLACES[-2::-1]]) + "M2\n"


@pytest.fixture(scope="module")
def errors(mill: Session) -> dict[str, Floats]:
    """A part programme to 9 places, in both directions, without and with rtec, as LinuxCNC's sampler saw it."""
    out = {}
    mill.mdi("G0 X-90 Y-90 Z-90")
    out["without"] = recorded(mill)
    with LoopThread(mill):
        for _ in range(3):  # where a busy PC let LinuxCNC or rtec come too late for a dwell, once more
            mill.mdi("G0 X-80 Y-80 Z-80")
            mill.mdi("G0 X-90 Y-90 Z-90")
            out["with"] = recorded(mill)
            if at_dwells(out).all() and in_motion(out):
                return out
    load = os.getloadavg()[0]
    if load > len(os.sched_getaffinity(0)):
        pytest.skip(f"LinuxCNC has no real-time kernel here and the PC is busy (load {load:.1f}): run this file alone")
    return out


def recorded(mill: Session) -> Floats:
    """Record while the programme runs."""
    mill.record(1, "places.txt")
    mill.run("places.ngc")
    mill.stop_record(1)
    return mill.recorded("places.txt")


def at_dwells(errors: dict[str, Floats]) -> NDArray[np.bool_]:
    """Fell the largest error at a dwell by twenty, axis by axis?"""
    before, after = (np.abs(dwell_errors_um(errors[k], AXES, still=250)).max(axis=0) for k in ("without", "with"))
    return np.asarray((before > 5.0) & (after < before / 20.0))


def in_motion(errors: dict[str, Floats]) -> bool:
    """Is Z right within one servo period's travel and 2 µm, and a twentieth in its root mean square?"""
    before, after = (1e3 * (errors[k][:, 2 * AXES] - errors[k][:, AXES]) for k in ("without", "with"))
    travel_um = 1e3 * np.abs(np.diff(errors["with"][:, AXES])).max()
    root_mean_squares = [np.sqrt(np.mean(e**2)) for e in (before, after)]
    return bool(np.abs(after).max() < min(2.0, travel_um) and root_mean_squares[1] < root_mean_squares[0] / 20.0)


def test_errors_at_dwells_fall_by_twenty(errors: dict[str, Floats]) -> None:
    """Oracle: LinuxCNC's `sampler`; the model's numbers are the plant's."""
    assert at_dwells(errors).all()


def test_errors_in_motion_fall_too(errors: dict[str, Floats]) -> None:
    """Oracle: the sampler; Z, which has no play: a step at each reversal would come through as the limits let it."""
    assert in_motion(errors)


SLEW_UM = 0.4
"""What HAL's own limit lets a correction change in one servo period, µm: `rtec-limit-x.maxv` of mill.hal."""
OWN_UM = 0.06
"""What the plant's own errors change in one servo period of rapid motion, µm."""


def z_error_um(mill: Session) -> float:
    """Error of the tool along Z now, µm; Z has no play."""
    return 1e3 * (mill.gets("z-tip") - mill.gets("z-pos-cmd"))


def settled(mill: Session) -> bool:
    """Is Z corrected, and does it stand?"""
    return abs(z_error_um(mill)) < 0.3


def kill_bridge(mill: Session) -> None:
    """kill -9, and wait for the next one."""
    names = [w for line in mill.hal("show", "comp").splitlines() for w in line.split() if w.startswith("rtec")]
    before = mill.gets("z-correction")
    newest = max(names, key=lambda n: int(n.partition("-")[2] or 1))
    mill.kill(mill.component_pid(newest), 9)
    assert abs(mill.gets("z-correction") - before) < 1e-4  # it may have moved before the kill, with the temperature
    mill.until(lambda: len([w for w in mill.hal("show", "comp").split() if w.startswith("rtec")]) > len(names))


ZERO = "G0 X0 Y0 Z0"
"""The simulated joints have no switches: where they are homed is zero."""
STATES: dict[str, tuple[tuple[object, ...], ...]] = {
    "machine off and on": (("state", "off"), ("state", "on")),
    "E-stop": (("state", "estop"), ("state", "estop_reset"), ("state", "on")),
    "motion": (("mdi", "G0 X40 Y-40 Z60"),),
    "homed again": (("mdi", ZERO), ("home",)),
    "unhomed": (("mdi", ZERO), ("unhome",), ("home",)),
    "a joint is jogged": (("joints", True), ("jog", 2, 80.0, -20.0)),
    "an axis is jogged": (("joints", False), ("jog", 2, 80.0, 15.0)),
    "modes": (("mode", "mdi"), ("mode", "auto"), ("mode", "manual")),
    "abort in a programme": (("begin", "places.ngc"), ("abort",)),
}


def test_thirty_state_changes_and_kills_without_a_jump(mill: Session) -> None:
    """Oracle: LinuxCNC's sampler. In no servo period does the tool move further than commanded, but by HAL's own limit.

    In Z, which has no play, the error itself changes by no more. After each change it comes back to nothing.
    """
    mill.record(1, "states.txt")
    done = 0
    for _ in range(3):
        with LoopThread(mill):  # the connection is cut at the end of each round, as by a kill of rtec
            for orders in STATES.values():
                for name, *words in orders:
                    getattr(mill, str(name))(*words)
                mill.until(lambda: settled(mill))
            kill_bridge(mill)
            mill.until(lambda: settled(mill))
            done += len(STATES) + 1
    mill.stop_record(1)
    assert done >= 30
    rows = mill.recorded("states.txt")
    following = np.diff(rows[:, 0]) == 1
    assert np.count_nonzero(~following) < 100
    commanded_um, tip_um = (1e3 * np.diff(rows[:, 1 + k : 1 + k + AXES], axis=0)[following] for k in (0, AXES))
    assert (np.abs(tip_um) < np.abs(commanded_um) + SLEW_UM + OWN_UM).all()
    assert np.abs(tip_um - commanded_um)[:, Z].max() < SLEW_UM + OWN_UM


def test_a_restart_of_linuxcnc_waits_for_an_order(mill: Session) -> None:
    """Oracle: HAL's pins: zero after the restart, and they stay there until the order to resume comes."""
    with LoopThread(mill) as thread:
        mill.until(lambda: abs(mill.gets("z-correction")) > 1e-3)
        mill.restart()
        mill.state("estop_reset")
        mill.state("on")
        mill.home()
        mill.mdi("G0 X40 Y40 Z40")
        mill.until(lambda: "LinuxCNC restarted" in thread.loop.stats.last_error)
        assert mill.gets("z-correction") == 0.0
        thread.order_resume()
        mill.until(lambda: settled(mill))
