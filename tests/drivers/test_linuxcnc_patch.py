"""rtec put into a copy of somebody's HAL files: LinuxCNC's own simulated mill runs with it."""

import re
from pathlib import Path

import numpy as np
import pytest

from rtec.errors import ConfigError
from rtec.loop.clock import RealClock
from rtec.machine import load_machine
from rtec_drivers.linuxcnc.driver import LinuxCncDriver, LinuxCncOptions
from rtec_drivers.linuxcnc.patch import RtecWiring, main, patched
from tests.support.linuxcnc_session import BRIDGE, CONFIGS, Session, why_not

CORE = Path("/usr/share/linuxcnc/hallib/core_sim.hal")
WIRING = RtecWiring({"X": 0, "Y": 1, "Z": 2}, BRIDGE, Path("mill.sock"), {})
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
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "m.ini").write_text("[HAL]\nHALFILE = x.hal\n")
    (mine / "x.hal").write_text(SERVO)
    words = [str(mine / "m.ini"), str(tmp_path / "copy"), "--joints", "X=0", "--socket", "s"]
    assert main(words) == 0
    difference = capsys.readouterr().out
    assert (mine / "x.hal").read_text() == SERVO
    assert "+net x-cmd joint.0.motor-pos-cmd => rtec-offset-x.in" in difference
    assert "-net x-cmd => pid.x.command" in difference
    assert "rtec-offset-x.update-output" in (tmp_path / "copy" / "x.hal").read_text()
    assert main(words) == 2
    assert "is there already" in capsys.readouterr().err


@pytest.mark.xdist_group("real-clock")
@pytest.mark.skipif(bool(why_not()) or not CORE.exists(), reason=why_not() or "LinuxCNC's core_sim.hal is not there")
def test_linuxcnc_runs_its_own_simulation_with_it() -> None:
    """Oracle: LinuxCNC: the drive's command has the offset, and the position that LinuxCNC shows has not."""
    text = patched({"core_sim.hal": CORE.read_text()}, WIRING, "mill.ini")["core_sim.hal"]
    ini = [("HALFILE = mill.hal\n", "HALFILE = core_sim.hal\n"), ("HALFILE = mill-plant.hal\n", "")]
    ini.append(("SERVO_PERIOD = 1000000", "SERVO_PERIOD = 1000000\nBASE_PERIOD = 0"))
    machine = load_machine(CONFIGS / "mill-machine.toml")
    with Session("mill", {"mill.ini": ini}, {"core_sim.hal": text}) as mill:
        mill.state("estop_reset")
        mill.state("on")
        mill.home()
        mill.mdi("G0 X10")
        options = LinuxCncOptions.model_validate({"socket": mill.folder / "mill.sock"})
        with LinuxCncDriver(options, machine, RealClock()) as driver:
            counts, has = np.zeros(3, np.int64), np.zeros(3, np.int64)
            mill.until(lambda: apply(driver, [500, 0, -300]))
            mill.until(lambda: has_now(driver, has) == [500, 0, -300])
            mill.until(lambda: abs(mill.gets("rtec-offset-x.out") - 10.005) < 1e-6)
            mill.until(lambda: driver.read_counts(counts) > 0)
            assert counts.tolist() == [10 * 100000, 0, 0]
            assert mill.position() == pytest.approx([10.0, 0.0, 0.0], abs=1e-6)


def apply(driver: LinuxCncDriver, output: list[int]) -> bool:
    """Command it; an error where the bridge has not said anything yet."""
    driver.apply(np.array(output))
    return True


def has_now(driver: LinuxCncDriver, has: "np.ndarray[tuple[int], np.dtype[np.int64]]") -> list[int]:
    """What LinuxCNC's pins say, units."""
    driver.read_output(has)
    return has.tolist()
