"""`rtec init` for a machinist's lathe whose devices are on ptys: by an answers file, and by questions.

Oracles: what the simulated devices print, hold and take; the exact product of the model's numbers with the position.
"""

import io
import json
import re
import shlex
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from rtec.cli.main import status
from rtec.commission.answers import TEMPLATES, answers_from
from rtec.commission.write import answers_text, machine_of
from rtec.effects import EFFECTS
from rtec.errors import ConfigError
from rtec.loop.clock import RealClock
from rtec.machine import load_machine
from rtec.metrology.files.load import load_measurement
from rtec.model import FittedEffect, Model, save_model
from rtec.tomlfile import read_toml
from rtec_drivers.ascii.driver import pattern, places_of
from rtec_drivers.modbus.driver import ModbusScanner
from rtec_drivers.modbus.frame import ModbusRequest
from rtec_drivers.pty_peer import PtyPeer
from tests.support.modbus_peer import FakeSlave, line
from tests.support.offset_controller import OffsetController

pytestmark = pytest.mark.xdist_group("real-clock")


@dataclass
class Readout:
    """Prints the positions of both axes; the one that `moving` names moves."""

    x_mm: float = 100.0
    z_mm: float = 250.0
    moving: str = ""

    def receive(self, data: bytes, now_ns: int) -> bytes:
        del data, now_ns
        return b""

    def idle(self, now_ns: int) -> bytes:
        del now_ns
        self.x_mm += 0.01 * (self.moving == "x")
        self.z_mm += 0.01 * (self.moving == "z")
        return f"X={self.x_mm:.4f} Z={self.z_mm:.4f}\r\n".encode()


@dataclass
class Lathe:
    readout: Readout
    controller: OffsetController
    ports: dict[str, str]


@contextmanager
def lathe(folder: Path) -> Iterator[Lathe]:
    """Two scales on a readout, six thermocouples in one Modbus module, a controller that takes offsets."""
    with ExitStack() as stack:
        clock, readout, controller = RealClock(), Readout(), OffsetController()
        stack.enter_context(PtyPeer(readout, clock, folder / "readout", 0.01))
        stack.enter_context(PtyPeer(controller, clock, folder / "offsets", 0.001))
        bus = stack.enter_context(line({1: FakeSlave(value=lambda _: 215)}))
        ports = {"0": str(folder / "readout"), "1": bus.port, "2": str(folder / "offsets")}
        yield Lathe(readout, controller, ports)


@pytest.fixture
def devices(tmp_path: Path) -> Iterator[Lathe]:
    with lathe(tmp_path) as devices:
        yield devices


def answers_file(folder: Path, devices: Lathe) -> Path:
    """The one that `--print-answers` prints, with the ports of this test and the controller's line ends."""
    text = answers_text("lathe")
    for number, port in devices.ports.items():
        text = text.replace(f"/dev/ttyUSB{number}", port)
    text = text.replace('parity = "even"', 'parity = "none"')  # which a pty does not take
    text = text.replace('acknowledge = "OK"', 'acknowledge = "OK"\nline_end = "crlf"')
    path = folder / "lathe-answers.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_from_an_answers_file_to_a_lathe_that_is_corrected(
    devices: Lathe, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Doctor and dry run are well; with a model of 30 µm/m the controller has -3 µm at X = 100 mm.

    Z: 12 µm/(m·°C) at 250 mm, 21.9 °C (the register of T_z_nut) above 20 °C: 5.7 µm.
    """
    folder = tmp_path / "the lathe"
    options = ["--answers", str(answers_file(tmp_path, devices)), "--set", "name=L 3", "--set", 'mode="on"']
    assert status(["init", str(folder), *options]) == 0
    out = capsys.readouterr().out
    (command,) = [line.removeprefix("Next: ") for line in out.splitlines() if line.startswith("Next: ")]
    assert shlex.split(command) == ["rtec", "run", str(folder / "run.toml"), "--step", "X=20um"]
    assert "ready to run" in out
    assert "dry run, nothing was commanded" in out
    assert {p.name for p in folder.iterdir()} == {"machine.toml", "run.toml", "model.toml"}
    assert {line for line in devices.controller.lines if line != "OFS?"} == set(), "nothing was commanded"
    assert "21.90 °C" in out

    machine = load_machine(folder / "machine.toml")
    assert (machine.name, machine.axis("X").counts_per_mm) == ("L 3", 2000.0)
    scale = EFFECTS["scale"].model_validate({"effect": "scale", "component": "EXX", "axis": "X"})
    tables = {"effect": "axis_expansion", "component": "EZZ", "axis": "Z", "sensor": "T_z_nut", "lag": False}
    grows = EFFECTS["axis_expansion"].model_validate({**tables, "fixed_mm": 0.0})
    effects = (FittedEffect(scale, {"k": 30.0}), FittedEffect(grows, {"k": 12.0}))
    save_model(Model(machine, effects), folder / "model.toml")
    assert status(["run", str(folder / "run.toml"), "--duration", "2", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["requested_um"] == pytest.approx({"X": -3.0, "Z": -5.7}, abs=1e-6)
    assert devices.controller.has == pytest.approx({"X": -0.0030, "Z": -0.0057}, abs=1e-7)


def test_a_controller_that_restarts_in_a_run_is_sent_nothing_more(
    devices: Lathe, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """30 µm at 20 µm/s are some seven commands; it loses its offsets after the third. Oracle: the lines it was sent."""
    folder = tmp_path / "lathe"
    more = ["--set", 'mode="on"', "--set", "device.offsets.restarted=READY.*", "--no-check"]
    assert status(["init", str(folder), "--answers", str(answers_file(tmp_path, devices)), *more]) == 0
    scale = EFFECTS["scale"].model_validate({"effect": "scale", "component": "EXX", "axis": "X"})
    machine = load_machine(folder / "machine.toml")
    save_model(Model(machine, (FittedEffect(scale, {"k": 300.0}),)), folder / "model.toml")
    devices.controller.restarts_after = 3
    capsys.readouterr()
    assert status(["run", str(folder / "run.toml"), "--duration", "3", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert len(devices.controller.lines) == 3
    assert devices.controller.has == {"X": 0.0, "Z": 0.0}
    assert report["flags_seen"]["OUTPUT_TROUBLE"] > 0.1
    assert "restarted" in json.dumps(report["devices"])


def test_what_is_wrong_with_a_device_is_exit_status_1_and_the_files_stay(
    devices: Lathe, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "lathe"
    unplugged = ["--set", f"device.encoders.port={tmp_path}/unplugged"]
    assert status(["init", str(folder), "--answers", str(answers_file(tmp_path, devices)), *unplugged]) == 1
    assert "unplugged: no such port" in " ".join(capsys.readouterr().out.split())
    assert (folder / "run.toml").is_file()


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("template=lath", "no template 'lath'; did you mean 'lathe'?"),
        ("axis.Y.pitch_mm=5.0", "[axis.Y] the template 'lathe' has no such axis"),
        ("limit.stop_um=50.0", "unknown key 'limit'; did you mean 'limits'?"),
        ("role.counts=encodrs", "[role] counts: no [device.encodrs]; did you mean 'encoders'?"),
        ("device.encoders.bawd=9600", "unknown key 'bawd'; did you mean 'baud'?"),
        ("limits.warning_um=60.0", "warning_um is above stop_um"),
        ("rate_hz", "give KEY=VALUE"),
        ("device.offsets.resolution_um=0.01", "more decimals"),
        ('sensors=["T bed"]', "sensors"),
    ],
)
def test_a_wrong_answer_is_one_message_and_nothing_is_written(
    devices: Lathe, tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str, message: str
) -> None:
    folder = tmp_path / "lathe"
    answers = str(answers_file(tmp_path, devices))
    assert status(["init", str(folder), "--answers", answers, "--set", option]) == 2
    assert message in capsys.readouterr().err
    assert not folder.exists()


def test_files_that_are_there_stay(devices: Lathe, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, answers = tmp_path / "lathe", str(answers_file(tmp_path, devices))
    command = ["init", str(folder), "--answers", answers, "--no-check"]
    assert status(command) == 0
    (folder / "model.toml").write_text("measured for a day")
    assert status(command) == 2
    assert "model.toml: already there" in capsys.readouterr().err
    assert (folder / "model.toml").read_text() == "measured for a day"
    assert status([*command, "--force"]) == 0


Line = str | tuple[str, Callable[[], None]]
"""What is typed, and what the hands do behind it."""


class Keys(io.StringIO):
    """A terminal at which somebody types these lines, and then Ctrl-C."""

    def __init__(self, lines: Sequence[Line]) -> None:
        super().__init__()
        self._lines = iter(lines)

    def isatty(self) -> bool:
        return True

    def readline(self, size: int = -1, /) -> str:  # type: ignore[override]
        del size
        line = next(self._lines, None)
        if line is None:
            raise KeyboardInterrupt
        if isinstance(line, tuple):
            line[1]()
            line = line[0]
        return f"{line}\n"


LENGTHS = ["", "", "", ""]  # travel, resolution and pitch of an axis: the template's


MACHINE = ["lathe", "L 3", *LENGTHS, *LENGTHS, ""]
START = [*MACHINE, "y"]  # devices: yes


def typed(devices: Lathe) -> list[str]:
    """What the machinist types who knows the registers: Enter takes what is proposed."""
    start = START
    encoders = ["ascii_lines", devices.ports["0"], "y", "n", "", "", ""]
    sensors = ["modbus", devices.ports["1"], "19200", "none", "n", "1", "0", "0.1", "holding"]
    offsets = ["ascii_offset", "mm", "0.1", "", "OK", devices.ports["2"], "", ""]
    return [*start, *encoders, *sensors, *offsets, "60", "20"]


@pytest.fixture
def no_ports(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever ports the computer has that the test runs on."""
    monkeypatch.setattr("rtec.commission.ask.serial_ports", list)


@pytest.mark.usefixtures("no_ports")
def test_by_questions_with_live_values(
    devices: Lathe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The readout is heard at its port, and its line becomes the pattern; X moves when X is asked for."""
    live: list[Line] = [("y", lambda: setattr(devices.readout, "moving", "x")), *["n"] * 7]
    monkeypatch.setattr("sys.stdin", Keys([*typed(devices), *live]))
    folder = tmp_path / "lathe"
    assert status(["init", str(folder), "--seconds", "0.5", "--no-check"]) == 0
    out = capsys.readouterr().out
    assert "prints lines at 9600 baud: X=1" in out
    assert re.search(r"X changed by \+\d", out)
    run = read_toml(folder / "run.toml")
    assert run["device"]["encoders"]["patterns"] == [r"X=(?P<X>[+-]?[\d.,]+)\s*Z=(?P<Z>[+-]?[\d.,]+)"]
    assert run["limits"]["X"]["stop_um"] == 60.0
    assert run["device"]["thermocouples"]["slave"]["module"]["register"]["T_air"]["address"] == 5
    assert load_machine(folder / "machine.toml").name == "L 3"
    assert status(["init", str(folder)]) == 2, "before the first question"
    assert "already there" in capsys.readouterr().err
    again = tmp_path / "again"
    assert status(["init", str(again), "--answers", str(folder / "answers.toml"), "--no-check"]) == 0
    assert (again / "run.toml").read_text() == (folder / "run.toml").read_text()


class Warmth:
    """Six thermocouples in one module of tenths of °C, wired in another order than they are named; and a clock."""

    WIRED = (3, 0, 5, 1, 4, 2)
    SENSORS = ("T_spindle", "T_headstock", "T_bed", "T_x_nut", "T_z_nut", "T_air")

    def __init__(self) -> None:
        self.seconds, self.hand, self.tenths = 0, "", dict.fromkeys(self.SENSORS, 215)
        names = {address: name for name, address in zip(self.SENSORS, self.WIRED, strict=True)}
        registers = {a: (lambda name=n: self.read(name)) for a, n in names.items()}
        self.slave = FakeSlave(register={**registers, 6: self.tick, 7: lambda: 0}, last=7)

    def tick(self) -> int:
        self.seconds += 1
        return self.seconds

    def read(self, name: str) -> int:
        self.tenths[name] += 2 * (name == self.hand)
        return self.tenths[name]

    def warm(self, name: str) -> Line:
        return "y", lambda: setattr(self, "hand", name)


@pytest.mark.usefixtures("no_ports")
def test_warming_each_sensor_finds_its_register(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Slave 3 answers; its registers are those that were wired. Nothing but functions 3 and 4 goes out.

    X is the number behind the letter Z here: it is what moves when X is asked for.
    """
    monkeypatch.setattr("rtec_drivers.modbus.driver.NUMBERS", range(1, 5))
    warmth, readout = Warmth(), Readout()
    with PtyPeer(readout, RealClock(), tmp_path / "readout", 0.01), line({3: warmth.slave}) as bus:
        move: list[Line] = [
            ("y", lambda: setattr(readout, "moving", "z")),
            ("y", lambda: setattr(readout, "moving", "x")),
        ]
        encoders: list[Line] = ["ascii_lines", str(tmp_path / "readout"), "y", "y", *move, "", "", ""]
        warm = [warmth.warm(name) for name in Warmth.SENSORS]
        sensors: list[Line] = ["modbus", bus.port, "19200", "none", "y", "y", *warm, ""]
        offsets = ["ascii_offset", "mm", "0.1", "", "OK", "127.0.0.1:5001"]
        monkeypatch.setattr("sys.stdin", Keys([*START, *encoders, *sensors, *offsets, "60", "20"]))
        folder = tmp_path / "lathe"
        assert status(["init", str(folder), "--seconds", "0.4", "--no-check"]) == 0, capsys.readouterr()
        assert {frame[1] for frame in bus.unknown} <= {3, 4}
    out = capsys.readouterr().out
    assert "slave 3 answers: 8 input registers and 8 holding registers" in out
    device = read_toml(folder / "run.toml")["device"]
    found = device["thermocouples"]["slave"]["slave_3"]
    assert found["id"] == 3
    assert {n: r["address"] for n, r in found["register"].items()} == dict(
        zip(Warmth.SENSORS, Warmth.WIRED, strict=True)
    )
    assert {r["scale"] for r in found["register"].values()} == {0.1}
    assert device["encoders"]["patterns"] == [r"X=(?P<Z>[+-]?[\d.,]+)\s*Z=(?P<X>[+-]?[\d.,]+)"]
    assert device["offsets"]["tcp"] == {"host": "127.0.0.1", "port": 5001}


@pytest.mark.usefixtures("no_ports")
def test_ctrl_c_in_a_search_keeps_the_answers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Slave 3 is found, then Ctrl-C: its registers go into the file, and so do the answers from before."""
    monkeypatch.setattr("rtec_drivers.modbus.driver.NUMBERS", range(1, 5))
    true_ask = ModbusScanner._ask

    def ask(self: ModbusScanner, request: ModbusRequest, timeout_ns: int) -> object:
        if request.slave == 4:
            raise KeyboardInterrupt
        return true_ask(self, request, timeout_ns)

    monkeypatch.setattr(ModbusScanner, "_ask", ask)
    with line({3: FakeSlave(value=lambda _: 215, last=7)}) as bus:
        encoders = ["ascii_lines", str(tmp_path / "none"), "n", "", "", "", "", ""]
        sensors = ["modbus", bus.port, "19200", "none", "y", "n", ""]
        offsets = ["ascii_offset", "mm", "0.1", "", "OK", "127.0.0.1:5001"]
        live = ["n"] * 8
        monkeypatch.setattr("sys.stdin", Keys([*START, *encoders, *sensors, *offsets, "60", "20", *live]))
        assert status(["init", str(tmp_path / "lathe"), "--no-check"]) == 0, capsys.readouterr()
    assert "ended early; what it found is kept" in capsys.readouterr().out
    run = read_toml(tmp_path / "lathe" / "run.toml")
    assert list(run["device"]["thermocouples"]["slave"]["slave_3"]["register"]) == list(Warmth.SENSORS)
    assert load_machine(tmp_path / "lathe" / "machine.toml").name == "L 3"


def scanning(folder: Path, devices: Lathe) -> Path:
    """The answers file, but what is on the Modbus line is to be looked for."""
    text = answers_file(folder, devices).read_text(encoding="utf-8")
    before, _, rest = text.partition("[device.thermocouples.slave.module]")
    path = folder / "scan.toml"
    path.write_text(before + "scan = true\n\n[device.offsets]" + rest.partition("[device.offsets]")[2])
    return path


def test_an_answers_file_has_the_line_scanned(
    devices: Lathe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Registers in order, in tenths of °C as 215 could be a room's; what was taken is printed."""
    monkeypatch.setattr("rtec_drivers.modbus.driver.NUMBERS", range(1, 3))
    folder = tmp_path / "lathe"
    assert status(["init", str(folder), "--answers", str(scanning(tmp_path, devices)), "--no-check"]) == 0
    assert "T_spindle: slave 1, input register 0, now 21.50 °C" in capsys.readouterr().out
    slave = read_toml(folder / "run.toml")["device"]["thermocouples"]["slave"]["slave_1"]
    assert {n: r["address"] for n, r in slave["register"].items()} == {n: k for k, n in enumerate(Warmth.SENSORS)}


def test_a_line_that_does_not_say_which_is_which_is_listed(
    devices: Lathe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("rtec_drivers.modbus.driver.NUMBERS", range(2, 4))
    folder = tmp_path / "lathe"
    assert status(["init", str(folder), "--answers", str(scanning(tmp_path, devices)), "--no-check"]) == 2
    assert "[device.thermocouples] scan: what is there does not say" in capsys.readouterr().err
    assert not folder.exists()


@pytest.mark.usefixtures("no_ports")
@pytest.mark.parametrize("lines", [0, 3, 12, 25])
def test_ctrl_c_leaves_nothing(devices: Lathe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lines: int) -> None:
    monkeypatch.setattr("sys.stdin", Keys(typed(devices)[:lines]))
    assert status(["init", str(tmp_path / "lathe")]) == 130
    assert not (tmp_path / "lathe").exists()


def test_without_a_terminal_it_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO())
    assert status(["init", str(tmp_path)]) == 2
    assert "--print-answers" in capsys.readouterr().err


@pytest.mark.parametrize("template", TEMPLATES)
def test_the_answers_file_of_every_template_is_one(template: str, tmp_path: Path) -> None:
    """Oracle: the loaders of machine and run file."""
    path = tmp_path / "a.toml"
    path.write_text(answers_text(template), encoding="utf-8")
    assert status(["init", str(tmp_path / "m"), "--answers", str(path), "--no-check"]) == 0
    machine = load_machine(tmp_path / "m" / "machine.toml")
    assert machine == machine_of(answers_from(read_toml(path), "a"))
    assert len(machine.components) > 6


def test_devices_without_a_role_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"needs \[role\]"):
        answers_from({"template": "mill", "device": {"a": {"driver": "sim"}}}, "a")


@pytest.mark.usefixtures("no_ports")
def test_only_measuring_needs_no_devices(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Oracle: the loader of machine files, and a table of readings that is imported with the machine, as it says next.

    By questions and by a template alone the same files come out.
    """
    monkeypatch.setattr("sys.stdin", Keys([*MACHINE, "n"]))
    asked, named = tmp_path / "asked", tmp_path / "named"
    assert status(["init", str(asked)]) == 0
    assert "rtec import FILE --machine" in capsys.readouterr().out
    assert status(["init", str(named), "--template", "lathe", "--set", "name=L 3"]) == 0
    for name in ("machine.toml", "model.toml"):
        assert (asked / name).read_text() == (named / name).read_text()
    assert {p.name for p in named.iterdir()} == {"machine.toml", "model.toml"}
    assert load_machine(named / "machine.toml").name == "L 3"
    table = tmp_path / "laser.csv"
    table.write_text("X_mm,deviation_um\n" + "".join(f"{x},{x / 50.0}\n" for x in range(0, 200, 10)))
    machine = str(named / "machine.toml")
    assert (
        status(["import", str(table), "--machine", machine, "--answer", "axis=X", "-o", str(tmp_path / "laser-x")]) == 0
    )
    assert len(load_measurement(tmp_path / "laser-x.csv", load_machine(Path(machine)))) == 20
    assert status(["init", str(tmp_path / "again"), "--answers", str(asked / "answers.toml")]) == 0
    assert (tmp_path / "again" / "machine.toml").read_text() == (asked / "machine.toml").read_text()


@pytest.mark.parametrize(
    ("text", "names", "values"),
    [
        ("X=+0012.345 Z= -0003.210", ("X", "Z"), ("+0012.345", "-0003.210")),
        ("Z:1.5 X:2.5", ("X", "Z"), ("2.5", "1.5")),
        ("1;  12,5; 13,5", ("T_a", "T_b"), ("1", "12,5")),
        ("X-12.5Z3", ("X", "Z"), ("-12.5", "3")),
        ("T1 21.5 T2 22.5", ("X", "Z"), ("21.5", "22.5")),
    ],
)
def test_a_pattern_from_a_line(text: str, names: tuple[str, ...], values: tuple[str, ...]) -> None:
    """Oracle: Python's own matching of the line that the pattern was made from."""
    match = re.fullmatch(pattern(text, places_of(text, names)), text)
    assert match is not None
    assert tuple(match[name] for name in names) == values
    assert places_of("no number", names) == {}


def test_paths_that_lead_out_of_a_folder_that_is_not_there_yet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Oracle: the same answers where the folder exists. Without it the kernel finds no `new/..`."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "truth.toml").write_text(
        "[body.bed]\ncapacity_j_per_k = 1.0\nto_air_w_per_k = 1.0\n"
        '[spindle]\nw_at_1000_rpm = 3.0\nexponent = 1.3\nshares = { bed = 1.0 }\n[axis.X.screw]\nbodies = ["bed"]\n',
        encoding="utf-8",
    )
    (tmp_path / "answers.toml").write_text(
        """template = "axis"
name = "m"
mode = "hold"
sensors = []
[role]
counts = "m"
actuator = "m"
[device.m]
driver = "sim"
truth = "../truth.toml"
""",
        encoding="utf-8",
    )
    (tmp_path / "old").mkdir()
    for folder in ("old", "new"):
        assert status(["init", folder, "--answers", "answers.toml", "--no-check"]) == 0, capsys.readouterr().err
    assert (tmp_path / "old" / "run.toml").read_text() == (tmp_path / "new" / "run.toml").read_text()
