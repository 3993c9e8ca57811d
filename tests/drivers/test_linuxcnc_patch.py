"""rtec put into a copy of somebody's HAL files: LinuxCNC's own simulated mill runs with it."""

import re
from pathlib import Path

import numpy as np
import pytest

from rtec.cli.main import status
from rtec.errors import ConfigError
from rtec.loop.clock import RealClock
from rtec.loop.run_file import load_setup
from rtec_drivers.linuxcnc.adopt import RtecWiring, patched
from rtec_drivers.linuxcnc.driver import LinuxCncDriver, LinuxCncOptions
from tests.support.linuxcnc_session import BRIDGE, Session, why_not

SAMPLE = Path("/usr/share/doc/linuxcnc/examples/sample-configs/sim/axis/axis_mm.ini")
INI = """\
[EMC]
MACHINE = old-lathe
[HAL]
HALFILE = x.hal
[TRAJ]
LINEAR_UNITS = inch
[KINS]
KINEMATICS = trivkins coordinates=XZ
[AXIS_X]
MIN_LIMIT = -10
MAX_LIMIT = 10
[AXIS_Z]
MIN_LIMIT = -10
MAX_LIMIT = 10
"""
SERVO = """\
loadrt motmod num_joints=1
addf encoder.capture-position servo-thread
addf motion-command-handler servo-thread
addf motion-controller servo-thread
addf pid.x.do-pid-calcs servo-thread
net x-cmd joint.0.motor-pos-cmd
net x-cmd => pid.x.command
net x-fb encoder.0.position => joint.0.motor-pos-fb pid.x.feedback   # the scale
"""


def test_a_servo_axis_is_cut_on_both_sides() -> None:
    """Oracle: the wiring picture of docs/linuxcnc.md: the drive's loop has the offset, LinuxCNC's motion does not."""
    text = patched({"x.hal": SERVO}, RtecWiring({"X": 0}, BRIDGE, Path("s"), {"T_x": "t-x", "T_bed": ""}), "x.ini")[
        "x.hal"
    ]
    nets = [line for line in text.splitlines() if line.startswith(("net x-", "net rtec-x-drive", "net rtec-x-fb"))]
    assert nets == [
        "net x-cmd joint.0.motor-pos-cmd => rtec-offset-x.in",
        "net rtec-x-drive-cmd rtec-offset-x.out => pid.x.command",
        "net x-fb encoder.0.position pid.x.feedback rtec-offset-x.fb-in",
        "net rtec-x-fb rtec-offset-x.fb-out => joint.0.motor-pos-fb",
    ]
    order = re.findall(r"^addf (\S+)", text, re.MULTILINE)
    assert order == [
        "encoder.capture-position",
        "rtec-offset-x.update-feedback",
        "motion-command-handler",
        "motion-controller",
        "rtec-limit-x",
        "rtec-offset-x.update-output",
        "sampler.0",
        "pid.x.do-pid-calcs",
    ]
    assert "net t-x => rtec.T_x" in text
    assert "# net YOUR-SIGNAL => rtec.T_bed" in text


BOTH = SERVO + "net z-cmd joint.1.motor-pos-cmd => joint.1.motor-pos-fb\n"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (SERVO.replace("joint.0.motor-pos-fb", "joint.1.motor-pos-fb"), "net` line with joint.0.motor-pos-fb"),
        (SERVO.replace("addf motion-controller", "addf other"), "addf motion-controller"),
        (SERVO + "loadrt sampler depth=1 cfg=f\n", "loadrt sampler"),
    ],
)
def test_what_is_not_understood_is_told(text: str, says: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(says)):
        patched({"x.hal": text}, RtecWiring({"X": 0}, BRIDGE, Path("s"), {}), "x.ini")


def test_the_copy_is_changed_and_the_original_is_not(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the user's files, byte by byte; what is written is what rtec itself loads."""
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "m.ini").write_text(INI)
    (tmp_path / "shared.hal").write_text(BOTH)
    (mine / "x.hal").symlink_to("../shared.hal")
    before = {f.name: f.read_bytes() for f in mine.iterdir()}
    words = ["init", "--controller", "linuxcnc", str(mine / "m.ini"), "--set", 'sensors=["T_x"]']
    assert status(words) == 0
    out = capsys.readouterr().out
    assert (tmp_path / "shared.hal").read_text() == BOTH
    assert {f.name: f.read_bytes() for f in mine.iterdir()} == before
    assert "+net x-cmd joint.0.motor-pos-cmd => rtec-offset-x.in" in out
    assert "-net x-cmd => pid.x.command" in out
    assert "To go back, start LinuxCNC with yours" in " ".join(out.split())
    copy = tmp_path / "mine-rtec"
    setup = load_setup(copy / "run.toml")
    assert setup.machine.axis("X").travel_mm == (-254.0, 254.0)  # inches in the INI file
    assert setup.file.run.mode == "hold"
    hal = (copy / "x.hal").read_text()
    assert " --sensors T_x --inch " in hal
    assert f"setp rtec-limit-x.max {0.2 / 25.4:g}" in hal
    assert status(words) == 2
    assert "is there already" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("trivkins coordinates=XZ", "genhexkins", "KINEMATICS is not trivkins"),
        ("coordinates=XZ", "coordinates=XZX", "axis X has two joints"),
        ("[AXIS_Z]", "[AXIS_Q]", "rtec has templates for X, Y, Z and for X, Z"),
        ("MIN_LIMIT = -10\n", "", "[AXIS_X] has no MIN_LIMIT"),
        ("x.hal", "../x.hal", "it is in another folder"),
        ("x.hal", "none.hal", "neither beside the INI file nor in"),
        ("x.hal", "LIB:basic_sim.tcl", "a Tcl script"),
    ],
)
def test_what_cannot_be_adopted_is_said_and_leaves_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, says: str
) -> None:
    """Law: exit status 2, one message with the key, no folder."""
    mine = tmp_path / "mine"
    mine.mkdir()
    assert old in INI
    (mine / "m.ini").write_text(INI.replace(old, new))
    (mine / "x.hal").write_text(BOTH)
    (tmp_path / "x.hal").write_text(BOTH)
    assert status(["init", "--controller", "linuxcnc", str(mine / "m.ini")]) == 2
    assert says in " ".join(capsys.readouterr().err.split())
    assert sorted(f.name for f in tmp_path.iterdir()) == ["mine", "x.hal"]


@pytest.mark.xdist_group("others")
@pytest.mark.skipif(bool(why_not()) or not SAMPLE.exists(), reason=why_not() or "LinuxCNC's samples are not there")
def test_linuxcncs_own_sample_runs_with_it(tmp_path: Path) -> None:
    """Oracle: LinuxCNC: the drive's command has the offset, and the position that LinuxCNC shows has not."""
    copy = tmp_path / "copy"
    assert status(["init", "--controller", "linuxcnc", str(SAMPLE), "--copy", str(copy)]) == 0
    dialogue = [("HALFILE = axis_manualtoolchange.hal\n", "")]  # a window
    with Session("axis_mm", {"axis_mm.ini": dialogue}, source=copy) as mill:
        mill.state("estop_reset")
        mill.state("on")
        mill.home()
        mill.mdi("G0 X10 Y5 Z2")
        setup = load_setup(mill.folder / "run.toml")
        device = setup.file.device["cnc"]
        options = LinuxCncOptions.model_validate({k: v for k, v in device.items() if k != "driver"})
        with LinuxCncDriver(options, setup.machine, RealClock(), mill.folder) as driver:
            counts, has = np.zeros(3, np.int64), np.zeros(3, np.int64)
            mill.until(lambda: apply(driver, [500, 0, -300]))
            mill.until(lambda: has_now(driver, has) == [500, 0, -300])
            mill.until(lambda: abs(mill.gets("rtec-offset-x.out") - mill.gets("joint.0.motor-pos-cmd") - 0.005) < 1e-6)
            mill.until(lambda: driver.read_counts(counts) > 0)
            assert counts == pytest.approx([10e5, 5e5, 2e5], abs=1)
            assert mill.position() == pytest.approx([10.0, 5.0, 2.0], abs=1e-6)


def apply(driver: LinuxCncDriver, output: list[int]) -> bool:
    """Command it; an error where the bridge has not said anything yet."""
    driver.apply(np.array(output))
    return True


def has_now(driver: LinuxCncDriver, has: "np.ndarray[tuple[int], np.dtype[np.int64]]") -> list[int]:
    """What LinuxCNC's pins say, units."""
    driver.read_output(has)
    return has.tolist()
