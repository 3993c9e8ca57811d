"""The command line: help that teaches, lazy imports, exit status. Oracle: `formats.md`'s table of exit status."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer

from rtec.cli import start
from rtec.cli.main import application, status
from rtec.errors import ConfigError, RtecError
from rtec_drivers.registry import DRIVERS


def commands(group: typer.Typer, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Every command as a user types it."""
    for command in group.registered_commands:
        name = command.name or getattr(command.callback, "__name__", "").replace("_", "-")
        yield (*path, name)
    for inner in group.registered_groups:
        assert inner.typer_instance is not None
        yield from commands(inner.typer_instance, (*path, str(inner.name)))


@pytest.mark.parametrize("command", list(commands(application())), ids=" ".join)
def test_help_teaches_with_an_example(command: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    assert status([*command, "--help"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "Example" in text
    assert f"rtec {' '.join(command)}" in text.split("Example", 1)[1]


@pytest.mark.parametrize("command", list(commands(application())), ids=" ".join)
def test_help_names_only_files_that_are_there(command: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the repository. What is in `configs` is shipped, not written by a command before."""
    assert status([*command, "--help"]) == 0
    named = re.findall(r"configs/[\w/.-]+\.toml", capsys.readouterr().out)
    missing = [n for n in named if not (Path(__file__).parents[2] / n).is_file()]
    assert not missing


def test_import_and_help_load_nothing_heavy() -> None:
    """Half a second is spent on imports alone if one of these slips in."""
    heavy = ["numba", "numpy", "pyarrow", "scipy", "matplotlib", "pydantic", "zmq", "can", "serial"]
    code = (
        "import sys, rtec, rtec.cli.main as m; m.status(['--help']); "
        f"print([h for h in {heavy} if h in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == "[]"


@pytest.mark.parametrize("command", [["status"], ["ctl", "hold"], ["studio"]], ids=" ".join)
def test_who_asks_a_running_loop_does_not_wait_for_a_compiler(command: list[str], tmp_path: Path) -> None:
    """An order to hold is urgent; numba and scipy take longer to import than all else.

    No other command is loaded.
    """
    code = (
        f"import sys, rtec.cli.main as m; m.status({[*command, str(tmp_path / 'run.toml')]}); "
        "print([h for h in ('numba', 'scipy', 'pyarrow', 'rtec.model', 'rtec.cli.model') if h in sys.modules])"
    )
    (tmp_path / "run.toml").write_text("")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_processes_beside_the_loop_need_no_compiler() -> None:
    """They ask one device, or tell a network; numba and what it brings would be half their memory and their start."""
    modules = ["rtec.daemon.workers", "rtec.telemetry.processes", "rtec.telemetry.mqtt", "rtec.telemetry.mtconnect"]
    modules += ["rtec.telemetry.opcua", *(module for name, (module, _) in DRIVERS.items() if name != "sim")]
    code = (
        f"import sys, importlib; [importlib.import_module(m) for m in {modules}]; "
        "print([h for h in ('numba', 'scipy', 'pyarrow', 'rtec.model', 'rtec.cli.model') if h in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_process_that_calls_no_kernel_waits_for_no_compiler() -> None:
    """The modules of the loop, the simulation and the fit; a kernel that is called brings it. Oracle: the modules."""
    modules = ["rtec.loop.step", "rtec.sim.machine", "rtec.estimation.gls", "rtec.characterise.run"]
    code = (
        f"import sys, importlib; [importlib.import_module(m) for m in {modules}]; print('numba' in sys.modules); "
        "from rtec.effects.derived import lag_update; lag_update(1.0, 2.0, 2.0, 0.1, 5.0); "
        "print('numba' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "True"]


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["--version"], 0),
        ([], 2),
        (["runn"], 2),
        (["run"], 2),
        (["run", "absent.toml"], 2),
        (["run", "absent.toml", "--duration", "0"], 2),
        (["run", "absent.toml", "--duration", "inf"], 2),
        (["run", "absent.toml", "--duration", "nan"], 2),
        (["log", "info", "absent.arrows"], 2),
        (["replay", "absent.toml", "absent.arrows"], 2),
    ],
)
def test_exit_status(arguments: list[str], code: int, capsys: pytest.CaptureFixture[str]) -> None:
    assert status(arguments) == code
    assert "Traceback" not in capsys.readouterr().err


def test_a_near_miss_names_the_right_command(capsys: pytest.CaptureFixture[str]) -> None:
    status(["replya"])
    assert "Did you mean 'replay'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (ConfigError("a.toml: first\na.toml: second"), 2, "rtec: a.toml: first\nrtec: a.toml: second\n"),
        (RtecError("plain"), 2, "rtec: plain\n"),
        (KeyboardInterrupt(), 130, "rtec: stopped\n"),
        (KeyboardInterrupt("told"), 130, ""),
    ],
)
def test_errors_become_one_clear_message(
    error: BaseException, code: int, text: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr("rtec.daemon.sign_check.load_stepped", fail)
    assert status(["run", "x.toml"]) == code
    assert capsys.readouterr().err == text


def test_effects_are_named_and_told(capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the registry; a near miss names the nearest."""
    from rtec.effects import EFFECTS
    from rtec.effects.time_data import NOT_EFFECTS

    assert status(["effects", "--json"]) == 0
    assert set(json.loads(capsys.readouterr().out)) == {*EFFECTS, *NOT_EFFECTS}
    assert status(["effects", "axis_expansion"]) == 0
    assert "ΔT" in capsys.readouterr().out
    assert status(["effects", "axis_expansio"]) == 2
    assert "did you mean 'axis_expansion'" in capsys.readouterr().err


def test_ctrl_c_is_not_lost_where_python_can_raise_nothing() -> None:
    """Oracle: Python itself, which lets go of an object whose end is interrupted. Without the hook it goes on."""
    program = """
import signal, sys
from rtec.cli.main import unraisable
signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background begins without it
if len(sys.argv) > 1:
    sys.unraisablehook = unraisable
class Ends:
    def __del__(self):
        raise KeyboardInterrupt
try:
    thing = Ends()
    del thing
    while len(sys.argv) > 1:
        pass
    print("went on")
except KeyboardInterrupt:
    print("stopped")
"""
    for words, said in ((["hook"], "stopped\n"), ([], "went on\n")):
        command = [sys.executable, "-c", program, *words]
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
        assert done.stdout == said


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        (["table", "write", "m.toml", "--format", "fan"], ["fanuc", "fanuc-both"]),
        (["table", "m.toml", "--format", "siemens-"], ["siemens-cec"]),
        (["effects", "lost_m"], ["lost_motion"]),
        (["drivers", "mod"], ["modbus"]),
        (["import", "--as", "delim"], ["delimited"]),
        (["hil", "--fault", "lis"], ["list"]),
    ],
)
def test_the_shell_completes_names(words: list[str], wanted: list[str]) -> None:
    """Oracle: the lists of the program. As bash asks."""
    asks = {"_RTEC_COMPLETE": "complete_bash", "COMP_WORDS": f"rtec {' '.join(words)}", "COMP_CWORD": str(len(words))}
    command = [sys.executable, "-c", "import sys; sys.argv[0] = 'rtec'; from rtec.cli.start import main; main()"]
    done = subprocess.run(command, env={**os.environ, **asks}, capture_output=True, text=True, timeout=120, check=False)
    assert done.stdout.split() == wanted, done.stderr


def test_ctrl_c_while_the_program_loads_is_no_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    """Oracle: the exit status of an interrupted program."""

    def interrupted() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("rtec.cli.main.main", interrupted)
    with pytest.raises(SystemExit) as ended:
        start.main()
    assert ended.value.code == 130


def test_a_file_is_no_text_of_a_mark(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The text was forgotten: the run file is in its place."""
    path = tmp_path / "mill.toml"
    path.write_text("")
    assert status(["ctl", "mark", str(path)]) == 2
    assert "write the text before it" in " ".join(capsys.readouterr().err.split())


def test_the_package_runs_as_a_module() -> None:
    """Oracle: the program itself."""
    done = subprocess.run([sys.executable, "-m", "rtec", "--version"], capture_output=True, text=True, check=True)
    assert re.fullmatch(r"rtec \S+", done.stdout.strip())


def test_a_reader_that_has_seen_enough_is_no_failure() -> None:
    """Oracle: a pipe whose reader has ended, as of `rtec effects | head -1`."""
    reads, writes = os.pipe()
    os.close(reads)
    done = subprocess.run(
        [sys.executable, "-m", "rtec", "effects"], stdout=writes, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(writes)
    assert (done.returncode, done.stderr) == (0, "")
