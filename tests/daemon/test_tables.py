"""`[table]` of a run file: tables that follow the temperatures, by limited changes, and stay where nothing is known."""

import errno
import json
import math
import os
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from rtec.cli.main import status
from rtec.correction.tables import FORMATS
from rtec.correction.tables.table import CompensationTable, TableAxes
from rtec.daemon.status import Status
from rtec.daemon.tables import LEAST_S, TableKeeper
from rtec.errors import ConfigError
from rtec.loop.run_file import Setup, load_setup

CONFIGS = Path(__file__).parents[2] / "configs"
MILL = CONFIGS / "linuxcnc"
TABLE = """
[table]
files = {X = "x.comp"}
grid_mm = 20.0
interval_s = 300.0
change_um = 1.0
hysteresis_um = 0.5
most_change_um = 3.0
"""
GROWTH_UM = 11.5e-3 * 100.0
"""Of X at its end, µm/°C: 11.5 µm/m·K, 100 mm; the model's own numbers, by hand."""


class Rig:
    """A run file of the mill without an actuator, its keeper, and what that reports."""

    def __init__(self, folder: Path, table: str = TABLE, model: str = "") -> None:
        shutil.copy(MILL / "mill-machine.toml", folder)
        text = (MILL / "mill-model.toml").read_text()
        text = text.replace("effects = 9", "effects = 10") if model else text
        (folder / "mill-model.toml").write_text(text + model)
        text = (MILL / "mill.toml").read_text().replace('actuator = "cnc"\n', "") + table
        self.path = folder / "run.toml"
        self.path.write_text(text)
        self.setup: Setup = load_setup(self.path)
        self.said: list[tuple[str, str]] = []
        self.keeper = TableKeeper(self.setup, lambda kind, text: self.said.append((kind, text)))

    def look(self, time_s: float, t_x: float, mode: str = "on", age_s: float = 0.0) -> None:
        degc = {"T_x": t_x, "T_y": 25.0, "T_z": 24.0, "T_spindle": 22.0}
        now = Status(time_s=time_s, cycles=1 + round(1000 * time_s), degc=degc, degc_age_s=dict.fromkeys(degc, age_s))
        self.keeper.look(self.setup, now, mode)

    @property
    def file(self) -> CompensationTable:
        path = self.path.with_name("x.comp")
        return FORMATS["linuxcnc"].read(path.read_text(), "x", TableAxes("X", "X"))


@pytest.fixture
def rig(tmp_path: Path) -> Rig:
    return Rig(tmp_path)


def test_a_table_follows_the_temperature_by_limited_changes(rig: Rig) -> None:
    """Oracle: expansion by hand. Noise below the hysteresis rewrites nothing; a change is limited, then goes on."""
    rig.look(1.0, 26.0)
    first = rig.file
    assert rig.said[-1][0] == "table"
    assert "written for T_x = 26, T_y = 25, T_z = 24: errors from" in rig.said[-1][1]
    assert "residual: up to" in rig.said[-1][1]
    rig.look(400.0, 26.3)  # the interval has passed, 0.35 µm have not
    rig.look(405.0, 26.7)  # 0.8 µm have, the second 1.0 µm have not, and the interval passed long ago
    assert len(rig.said) == 2
    assert "changed by up to 0.80 µm" in rig.said[-1][1] or "changed by up to 0.81 µm" in rig.said[-1][1]
    rig.look(405.0 + LEAST_S - 1, 31.0)
    assert len(rig.said) == 2
    rig.look(405.0 + LEAST_S, 31.0)  # 4.9 µm: three of them now
    assert "changed by up to 3.00 µm (limited by most_change_um; 1.9" in rig.said[-1][1]
    rig.look(405.0 + 2 * LEAST_S, 31.0)
    ends = rig.file.forward_um[[0, -1]] - first.forward_um[[0, -1]]
    assert ends == pytest.approx([-5 * GROWTH_UM, 5 * GROWTH_UM], abs=2e-3)
    assert rig.file.backward_um - first.backward_um == pytest.approx(rig.file.forward_um - first.forward_um, abs=2e-3)
    rig.look(405.0 + 3 * LEAST_S, 31.0)
    assert len(rig.said) == 4


@pytest.mark.parametrize(
    ("then", "why"),
    [
        ({"t_x": 40.0, "mode": "hold"}, "the mode is hold"),
        ({"t_x": 40.0, "mode": "off"}, "the mode is off"),
        ({"t_x": math.nan}, "T_x is not known"),
        ({"t_x": 40.0, "age_s": 6.0}, "T_x is old"),
        ({"t_x": 61.0}, "T_x is outside the range of the model (15 to 60)"),
    ],
)
def test_what_is_not_known_leaves_the_file_and_says_so_once(rig: Rig, then: dict[str, float], why: str) -> None:
    """Law: the guard's: stale input changes nothing."""
    rig.look(1.0, 26.0)
    before = rig.path.with_name("x.comp").read_bytes()
    rig.look(400.0, **then)  # type: ignore[arg-type]
    rig.look(401.0, **then)  # type: ignore[arg-type]
    assert rig.path.with_name("x.comp").read_bytes() == before
    assert len(rig.said) == 2
    assert rig.said[-1][1].startswith(f"the tables stay as they are: {why}")
    rig.look(402.0, 29.0)
    assert "rewritten for T_x = 29, " in rig.said[-1][1]


def test_a_value_beyond_the_limits_is_not_written(tmp_path: Path) -> None:
    """Oracle: `stop_um`; the file that is there stays."""
    rig = Rig(tmp_path)
    rig.look(1.0, 26.0)
    text = (
        rig.path.read_text()
        .replace("stop_um = 150.0", "stop_um = 25.0")
        .replace("warning_um = 120.0", "warning_um = 20.0")
    )
    rig.path.write_text(text)
    before = rig.path.with_name("x.comp").read_bytes()
    rig.setup = load_setup(rig.path)
    rig.keeper = TableKeeper(rig.setup, lambda kind, text: rig.said.append((kind, text)))
    for k in range(3):
        rig.look(2.0 + k, 55.0)
    assert rig.path.with_name("x.comp").read_bytes() == before
    alarms = [text for kind, text in rig.said if kind == "alarm"]
    assert len(alarms) == 1
    assert "is beyond stop_um = 25 of [limits.X]" in alarms[0]


def test_a_full_disk_leaves_the_table_whole(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk is full after the first half of the file. Oracle: one alarm that says so, the bytes of the old table, no
    rest of the new one; the table goes on when there is space."""
    rig.look(1.0, 26.0)
    folder = rig.path.parent
    before = {path: path.read_bytes() for path in folder.iterdir()}
    with monkeypatch.context() as patch:
        patch.setattr("os.fsync", full)
        for k in range(5):
            rig.look(400.0 + k, 31.0 + k / 10)
    assert {path: path.read_bytes() for path in folder.iterdir()} == before
    assert rig.said[1:] == [("alarm", f"{folder / 'x.comp'}: cannot be written: No space left on device")]
    rig.look(420.0, 31.0)
    assert rig.said[-1][0] == "table"
    assert "changed by up to 3.00 µm" in rig.said[-1][1]


def test_another_reason_is_another_alarm(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """Oracle: one alarm for each reason why the file cannot be written, however long it lasts."""
    rig.look(1.0, 26.0)
    for k, errors in enumerate((errno.ENOSPC, errno.EROFS)):
        with monkeypatch.context() as patch:
            patch.setattr("os.fsync", partial(refuse, errors))
            for s in range(5):
                rig.look(400.0 + 10 * k + s, 31.0 + s / 10)
    reasons = [text.rpartition(": ")[2] for kind, text in rig.said if kind == "alarm"]
    assert reasons == ["No space left on device", "Read-only file system"]


def refuse(reason: int, number: int) -> None:
    """Nothing can be written to an open file."""
    del number
    raise OSError(reason, os.strerror(reason))


def full(number: int) -> None:
    """Half of what was written is there; no more can be."""
    os.ftruncate(number, os.fstat(number).st_size // 2)
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


LAGGED = """
[[effect]]
effect = "mount_expansion"
component = "EXX"
sensor = "T_y"
lag = true

[effect.coefficient.k]
value = 10.0
unit = "um_per_degc"

[effect.nonlinear.tau]
value = 100.0
unit = "s"
"""


def test_an_effect_that_lags_comes_with_its_lag(tmp_path: Path) -> None:
    """Oracle: the first-order lag after a step, 1 - exp(-t/τ), by hand: T_y steps by 4 °C, τ = 100 s, 10 µm/°C."""
    text = TABLE.replace("most_change_um = 3.0", "most_change_um = 100.0")
    rig = Rig(tmp_path, text, LAGGED)
    start = None
    for t in range(0, 121):
        degc = {"T_x": 26.0, "T_y": 25.0 if t < 20 else 29.0, "T_z": 24.0, "T_spindle": 22.0}
        rig.keeper.look(rig.setup, Status(time_s=float(t), cycles=t + 1, degc=degc), "on")
        start = rig.file if start is None and t else start
    assert start is not None
    last = [text for _, text in rig.said][-1]
    assert last.startswith("x.comp: rewritten")
    change = float((rig.file.forward_um - start.forward_um).mean())
    expected = [40.0 * (1 - math.exp(-(t - 19.5) / 100.0)) for t in range(111, 121)]
    assert min(expected) - 0.3 < change < max(expected) + 0.3


def test_lost_history_of_months_is_thinned_out(rig: Rig) -> None:
    """Law: what is kept is bounded, and its last instant is now."""
    for t in range(9000):
        rig.keeper._remember(float(t), {"T_x": 20.0})
    times, _ = rig.keeper._history(["T_x"])
    assert len(times) <= 4096
    assert times[-1] == 8999.0
    assert (np.diff(times) > 0).all()


def test_what_is_no_table_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "x.comp").write_text("my notes\n")
    with pytest.raises(ConfigError, match="would replace it: name another file"):
        Rig(tmp_path)
    assert (tmp_path / "x.comp").read_text() == "my notes\n"


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('{X = "x.comp"}', '{Q = "x.comp"}', "[table] files.Q: 'Q' is no axis"),
        ('{X = "x.comp"}', "{}", "files"),
        ('{X = "x.comp"}', '{X = "a/b/x.comp"}', "files.X: the folder"),
        ('{X = "x.comp"}', '{X = "x.comp", Y = "x.comp"}', "is the file of X already"),
        ('{X = "x.comp"}', '{EYX = "x.comp"}', "has no tables between axes"),
        ("[table]", '[table]\nformat = "linuxcncc"', "no format 'linuxcncc'"),
        (
            "[table]",
            '[table]\nformat = "fanuc"',
            "fanuc is a list to type in; the daemon cannot put it into the control",
        ),
        ("[table]", '[table]\nformat = "isg-crosscomp2"', "write --cross EZXY"),
        ("grid_mm = 20.0", "grid_mm = 0.1", "takes 2 to 256 points"),
        ("hysteresis_um = 0.5", "hysteresis_um = 2.0", "hysteresis_um: must not be above"),
        ("interval_s = 300.0", "interval_s = 0.0", "interval_s"),
        ("interval_s", "interval", "interval_s"),
    ],
)
def test_what_cannot_be_is_said_at_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, says: str
) -> None:
    """Law: one message with the key, exit status 2, and no file."""
    assert old in TABLE
    with pytest.raises(ConfigError):
        Rig(tmp_path, TABLE.replace(old, new))
    assert status(["run", str(tmp_path / "run.toml"), "--duration", "1"]) == 2
    assert says in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "x.comp").exists()


def test_a_table_beside_an_actuator_of_its_axis_is_refused(tmp_path: Path) -> None:
    """The error would be taken out twice; without both of them there is nothing to run."""
    rig = Rig(tmp_path)
    rig.path.write_text((MILL / "mill.toml").read_text() + TABLE)
    with pytest.raises(ConfigError, match="would be taken out twice"):
        load_setup(rig.path)
    rig.path.write_text((MILL / "mill.toml").read_text().replace('actuator = "cnc"\n', ""))
    with pytest.raises(ConfigError, match=r"\[role\] actuator is missing, and there is no \[table\]"):
        load_setup(rig.path)


@pytest.mark.xdist_group("real-clock")
def test_a_run_with_tables_alone_writes_them_and_commands_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Oracle: the file is the table that `rtec table` makes at the same temperatures; nothing is inserted."""
    shutil.copytree(CONFIGS, tmp_path / "configs")
    run = tmp_path / "configs" / "turning-centre-sim.toml"
    text = run.read_text()
    actuator = next(line for line in text.splitlines() if line.startswith("actuator"))
    text = text.replace(actuator + "\n", "") + '\n[table]\nfiles = {X = "x.eec"}\nformat = "siemens"\n'
    run.write_text(text + "\n[realtime]\nlock_memory = false\n")  # to fill all that a test has takes seconds
    assert status(["run", str(run), "--duration", "3", "--json", "--log", str(tmp_path / "log")]) == 0
    out = capsys.readouterr()
    assert "x.eec: written for" in out.err
    result = json.loads(out.out)
    assert set(result["largest_um"].values()) == {0.0}
    assert status(["run", str(run), "--step", "X=5um", "--duration", "1"]) == 2
    assert "no [role] actuator, only tables" in " ".join(capsys.readouterr().err.split())
    assert FORMATS["siemens"].read(run.with_name("x.eec").read_text(), "x", TableAxes("X", "X")).largest_um > 0.1


def test_a_file_with_tables_of_other_axes_is_never_replaced(tmp_path: Path) -> None:
    """Law: nothing is lost: a CEC file can hold eight tables; ours is rewritten only if it is alone."""
    form, grid = FORMATS["siemens-cec"], np.linspace(-100.0, 100.0, 11)
    text = TABLE.replace('{X = "x.comp"}', '{EYX = "cec.ini"}') + 'format = "siemens-cec"\n'
    rig = Rig(tmp_path, text)
    rig.look(1.0, 26.0)
    ours = rig.path.with_name("cec.ini")
    mine = ours.read_text()
    assert "$AN_CEC_OUTPUT_AXIS[0]=(Y1)" in mine
    other = form.text(CompensationTable("Z", "X", grid, 0 * grid, 0 * grid)).replace("[0", "[7")
    ours.write_text(mine.replace("M17\n", "") + "".join(other.splitlines(keepends=True)[2:]))
    before = ours.read_bytes()
    with pytest.raises(ConfigError, match=r"holds 1 more tables, of other axes; \[table\] files.EYX would"):
        Rig(tmp_path, text)
    assert ours.read_bytes() == before


def test_a_plane_follows_the_temperature(tmp_path: Path) -> None:
    """Oracle: expansion by hand, at each of the rows."""
    text = TABLE.replace('{X = "x.comp"}', '{EXXY = "x.lis"}') + 'format = "isg-crosscomp2"\n'
    rig = Rig(tmp_path, text)
    tables = []
    for time_s, degc in ((1.0, 26.0), (500.0, 28.0)):
        rig.look(time_s, degc)
        read = FORMATS["isg-crosscomp2"].read(rig.path.with_name("x.lis").read_text(), "x", TableAxes("X", "X", "Y"))
        tables.append(read)
    grown = tables[1].forward_um - tables[0].forward_um
    assert grown.shape == (11, 11)
    assert grown[:, -1] == pytest.approx(np.full(11, 2 * GROWTH_UM), abs=0.11)
    assert "changed by up to 2.3" in rig.said[-1][1]
