"""Counts inserted in HAL: LinuxCNC's `stepgen` makes the edges, its `encoder` counts them beside those of the machine.

The machine's own encoders are HAL's `sim_encoder`, driven by a position loop (`pid`), 1 µm a count.
"""

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.support.linuxcnc_loop import Floats, LoopThread
from tests.support.linuxcnc_session import BRIDGE, CONFIGS, Session, why_not

pytestmark = [pytest.mark.xdist_group("others"), pytest.mark.skipif(bool(why_not()), reason=why_not() or "")]

AXES = "xz"
PER_MM = 1000
HEAD = """\
loadrt [KINS]KINEMATICS
loadrt [EMCMOT]EMCMOT base_period_nsec=100000 servo_period_nsec=[EMCMOT]SERVO_PERIOD num_joints=2
loadrt sim_encoder num_chan=2
loadrt encoder num_chan=4
loadrt stepgen step_type=2,2 ctrl_type=p,p
loadrt pid names=pid.x,pid.z
loadrt sum2 names=fb-x,fb-z
loadrt constant names=t-x,t-z
loadrt sampler depth=4000,16000 cfg=ffffbb,ssssss
loadusr -Wn rtec /usr/bin/python3 {bridge} --socket lathe.sock --axes X,Z --sensors T_x,T_z --actuator pulse
addf sim-encoder.make-pulses base-thread
addf stepgen.make-pulses base-thread
addf encoder.update-counters base-thread
addf encoder.capture-position servo-thread
addf stepgen.capture-position servo-thread
addf fb-x servo-thread
addf fb-z servo-thread
addf t-x servo-thread
addf t-z servo-thread
addf motion-command-handler servo-thread
addf motion-controller servo-thread
addf pid.x.do-pid-calcs servo-thread
addf pid.z.do-pid-calcs servo-thread
addf sim-encoder.update-speed servo-thread
addf stepgen.update-freq servo-thread
addf sampler.0 servo-thread
addf sampler.1 servo-thread
setp sampler.1.enable 0
net homed motion.is-all-homed => sampler.0.pin.4
net on motion.motion-enabled => sampler.0.pin.5
net rpm spindle.0.speed-out => rtec.spindle-rpm
net estop iocontrol.0.user-enable-out => iocontrol.0.emc-enable-in
net tool-prepare iocontrol.0.tool-prepare => iocontrol.0.tool-prepared
net tool-change iocontrol.0.tool-change => iocontrol.0.tool-changed
"""
AXIS = """\
setp sim-encoder.{k}.ppr 250
setp pid.{a}.Pgain 5
setp pid.{a}.maxoutput 20
setp pid.{a}.FF1 1
setp encoder.{k}.position-scale {per_mm}
setp encoder.{i}.position-scale {per_mm}
setp stepgen.{k}.position-scale 1
setp stepgen.{k}.maxvel 2000
setp stepgen.{k}.maxaccel 200000
setp stepgen.{k}.enable 1
net {a}-cmd joint.{k}.motor-pos-cmd => pid.{a}.command
net {a}-on joint.{k}.amp-enable-out => pid.{a}.enable
net {a}-speed pid.{a}.output => sim-encoder.{k}.speed
net {a}-line-a sim-encoder.{k}.phase-A => encoder.{k}.phase-A
net {a}-line-b sim-encoder.{k}.phase-B => encoder.{k}.phase-B
net {a}-inserted-a stepgen.{k}.phase-A => encoder.{i}.phase-A
net {a}-inserted-b stepgen.{k}.phase-B => encoder.{i}.phase-B
net {a}-raw encoder.{k}.position => fb-{a}.in0
net {a}-inserted encoder.{i}.position => fb-{a}.in1 sampler.0.pin.{i}
net {a}-fb fb-{a}.out => joint.{k}.motor-pos-fb pid.{a}.feedback
net {a}-pos joint.{k}.pos-fb => sampler.0.pin.{k}
net {a}-pulses rtec.pulses-{a} => stepgen.{k}.position-cmd
net {a}-pulses-fb stepgen.{k}.counts => rtec.pulses-fb-{a} sampler.1.pin.{k}
net {a}-counted encoder.{i}.rawcounts => sampler.1.pin.{i}
net {a}-machine encoder.{k}.rawcounts => sampler.1.pin.{m}
setp t-{a}.value 25
net T-{a} t-{a}.out => rtec.T_{a}
"""


@pytest.fixture
def lathe(tmp_path: Path) -> Iterator[Session]:
    source = tmp_path / "pulses"
    source.mkdir()
    shutil.copy(CONFIGS / "tool.tbl", source)
    ini = (CONFIGS / "lathe.ini").read_text()
    # The machine here lags by as long as this PC keeps the base thread waiting; that is not judged.
    ini = re.sub(r"FERROR = .*", "FERROR = 100", ini)
    (source / "lathe.ini").write_text(ini.replace("HALFILE = lathe-plant.hal\n", ""))
    hal = HEAD.format(bridge=BRIDGE)
    hal += "".join(AXIS.format(k=k, a=a, i=k + 2, m=k + 4, per_mm=PER_MM) for k, a in enumerate(AXES))
    (source / "lathe.hal").write_text(hal)
    machine = (CONFIGS / "lathe-machine.toml").read_text().replace("100000", str(PER_MM))
    (source / "pulse-machine.toml").write_text(machine)
    with Session("lathe", source=source) as session:
        session.state("estop_reset")
        session.state("on")
        session.home()
        yield session


def edits() -> tuple[tuple[str, str], ...]:
    """The run file with counts in place of offsets."""
    text = (CONFIGS / "lathe.toml").read_text()
    outputs = text[text.index("[output.X]") : text.index("[limits.X]")]
    return (
        ('"lathe-machine.toml"', '"pulse-machine.toml"'),
        ('"lathe-model.toml"', '"pulse-model.toml"'),
        ('actuator = "origin_offset"', 'actuator = "pulse"'),
        (outputs, ""),
    )


def test_the_ledger_is_what_linuxcnc_counts(lathe: Session) -> None:
    """Oracle: LinuxCNC's `encoder`, which counts the edges that `stepgen` makes; law: corrected = raw + inserted.

    Told, made and counted agree at rest, and never differ by more than what is on its way; the position that LinuxCNC
    has is the machine's count plus the inserted one, so the machine itself stands off by the correction.
    """
    model = (CONFIGS / "lathe-model.toml").read_text()
    model = re.sub(r'machine_hash = "\w+"', 'machine_hash = ""', model)
    (lathe.folder / "pulse-model.toml").write_text(model.replace("lathe-machine.toml", "pulse-machine.toml"))
    start = counts(lathe)  # the counters begin at any count, LinuxCNC's positions at the place of homing
    lathe.record(1, "pulses.txt")
    with LoopThread(lathe, edits()) as thread:
        for place in ("G1 F500 X4 Z-6", "G1 F500 X1 Z-1"):
            lathe.mdi(place)
            assert lathe.until(lambda: ended(lathe, thread, start)) == "settled"
            assert np.abs(thread.output).max() >= 1
    lathe.stop_record(1)
    rows = lathe.recorded("pulses.txt")[:, 1:]
    made, counted, machine = (rows[:, i : i + 2] - start[i : i + 2] for i in (0, 2, 4))
    assert np.abs(made - counted).max() <= 2
    assert np.abs(np.diff(counted, axis=0)).max() <= 2  # 200 µm/s are 0.2 counts a servo period
    assert np.abs(np.diff(machine, axis=0)).max() > 2
    assert made[-1].tolist() == counted[-1].tolist()


def counts(lathe: Session) -> Floats:
    """Made by `stepgen`, counted of these, counted of the machine; X and Z of each."""
    pins = ("stepgen.0.counts", "stepgen.1.counts", *(f"encoder.{k}.rawcounts" for k in (2, 3, 0, 1)))
    return np.array([lathe.gets(pin) for pin in pins])


def settled(lathe: Session, thread: LoopThread, start: Floats) -> bool:
    """Is what was told inserted and counted, and does the machine stand where that brings it?"""
    now = counts(lathe) - start
    wanted = np.array([PER_MM * lathe.gets(f"joint.{k}.pos-cmd") for k in range(2)])
    return thread.output.tolist() == now[2:4].tolist() and bool((abs(wanted - now[4:] - now[2:4]) <= 1.5).all())


def ended(lathe: Session, thread: LoopThread, start: Floats) -> str | None:
    """How it ended, once it has."""
    if lathe.gets("motion.motion-enabled") and settled(lathe, thread, start):
        return "settled"
    return None if lathe.gets("motion.motion-enabled") else f"LinuxCNC switched the machine off: {lathe.said()}"
