"""The runbook and the page on the service against the code: every alarm is in it, every example works.

Oracles: the guard's own flags and texts; the shipped simulated machine; typer's own help.
"""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest
import tomli_w
from typer.testing import CliRunner

from rtec.cli.main import application
from rtec.correction.flags import REASONS, Flag
from rtec.loop.orders import Order
from rtec.loop.run_file import LogTable
from rtec.tomlfile import read_toml

ROOT = Path(__file__).parents[2]
CONFIGS = ROOT / "configs"
RUNBOOK = (ROOT / "docs" / "runbook.md").read_text(encoding="utf-8")
SERVICE = (ROOT / "docs" / "service.md").read_text(encoding="utf-8")


def table_rows(text: str, columns: int) -> list[list[str]]:
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line.startswith("|")]
    return [row for row in rows if len(row) == columns and not set(row[0]) <= set("-")]


def blocks(text: str) -> list[str]:
    return re.findall(r"```toml\n(.*?)```", text, re.DOTALL)


def test_every_flag_is_in_the_table_with_its_text_and_a_way_on() -> None:
    found = {row[0]: row[1:] for row in table_rows(RUNBOOK, 4) if row[0] != "flag"}
    assert set(found) == {flag.name for flag in Flag}
    for flag in Flag:
        text, means, does = found[flag.name or ""]
        assert text == REASONS.get(flag, "")
        assert len(means) > 20
        assert does


@pytest.mark.parametrize(
    ("module", "text"),
    [
        ("log/recording", "logging stopped, the correction went on"),
        ("log/recording", "logging goes on in"),
        ("log/recording", "rows came too fast and are in no log"),
        ("daemon/disk", "the disk is slow"),
        ("daemon/disk", "the state is not on disk"),
        ("daemon/supervisor", "somebody deleted"),
        ("loop/state_files", "another rtec keeps its state there"),
        ("daemon/claim", "another rtec sends its commands there"),
        ("loop/output", "the actuator has"),
        ("daemon/reload", "not reloaded"),
        ("daemon/fastpath", "the state that the run before kept in"),
        ("daemon/recover", "the run before had other axes, counts_per_mm or output units"),
        ("log/writer", "somebody removed it while it was written"),
        ("daemon/supervisor", "the loop's process"),
        ("daemon/process", "no real-time treatment for"),
    ],
)
def test_what_else_it_says_is_in_the_other_table(module: str, text: str) -> None:
    """The text is what the code says, and the table has it."""
    assert text in (ROOT / "rtec" / f"{module}.py").read_text(encoding="utf-8")
    assert any(row[0].startswith(text) for row in table_rows(RUNBOOK, 3))


EVENT_AT = {"note": 0, "_tell": 0, "_note": 1, "_done": 2}
"""Where the kind of an event stands among the arguments of what notes one."""


def kinds_in(source: str) -> set[str]:
    """Kinds of events that a module can note, of those that stand there as they are."""
    out = set()
    for call in ast.walk(ast.parse(source)):
        if isinstance(call, ast.Call) and isinstance(call.func, ast.Attribute) and len(call.args) > 1:
            at = EVENT_AT.get(call.func.attr, len(call.args))
            kind = call.args[at] if at < len(call.args) else None
            if isinstance(kind, ast.Constant) and isinstance(kind.value, str):
                out.add(kind.value)
    return out


def test_every_event_is_in_its_table() -> None:
    """Oracle: the program's own text, read as a program; and the orders, each of which is an event."""
    said = {str(order) for order in Order}
    for path in (path for room in ("daemon", "control", "log") for path in (ROOT / "rtec" / room).glob("*.py")):
        said |= kinds_in(path.read_text(encoding="utf-8"))
    assert {"fault", "worker", "clock step", "logs removed", "not reloaded", "refused"} <= said
    found = {row[0].strip("`") for row in table_rows(RUNBOOK, 3) if row[0].startswith("`")}
    assert found == said


def test_it_says_what_rtec_is_not() -> None:
    assert "no safety function" in RUNBOOK


def test_the_limits_of_the_runbook_are_accepted_and_hold(tmp_path: Path) -> None:
    """Put into the run file of the simulated machine; a dry run then says that it would hold."""
    content = example(tmp_path)
    limits = next(read(block, tmp_path) for block in blocks(RUNBOOK) if "[limits.X]" in block)
    content["run"] |= limits["run"]
    content["limits"] = dict.fromkeys("XZ", limits["limits"]["X"])
    content["guard"] = limits["guard"]
    assert "axis X: the model would ask for" in dry_run(tmp_path, content)


def test_the_step_of_the_sign_check_is_20_um_on_one_axis(tmp_path: Path) -> None:
    """Oracle: the text of the runbook, which says what to type and what the dry run must show."""
    typed = re.search(r"rtec run /etc/rtec/mill\.toml (--step \S+) --dry-run", RUNBOOK)
    expected = re.search(r"`(axis X: the model would ask for \+20\.00 µm)`", RUNBOOK)
    assert typed is not None
    assert expected is not None
    shown = dry_run(tmp_path, example(tmp_path), *typed[1].split())
    assert expected[1] in shown
    assert "axis Z: the model would ask for +0.00 µm" in shown


def test_the_log_rules_of_the_service_page_are_the_defaults(tmp_path: Path) -> None:
    (block,) = (block for block in blocks(SERVICE) if "[log]" in block)
    assert LogTable.model_validate(read(block, tmp_path)["log"]) == LogTable()


def test_every_command_of_the_pages_has_these_options() -> None:
    """`rtec NAME … --option` in a line of commands: the help of that command knows the option."""
    runner, seen = CliRunner(), set()
    for line in re.findall(r"^ {4,}(?:sudo -u rtec )?rtec ([a-z].*)$", RUNBOOK + SERVICE, re.MULTILINE):
        words = line.split()
        name = words[:2] if words[0] == "log" else words[:1]
        if name[0] in ("status", "ctl") and name[0] not in known():
            continue
        shown = runner.invoke(application(), [*name, "--help"], env={"COLUMNS": "200"}).stdout
        for option in (w for w in words if w.startswith("--")):
            assert option in shown, line
        seen.add(name[0])
    assert {"doctor", "run", "log", "replay"} <= seen


def test_links_lead_somewhere() -> None:
    links = re.findall(r"\]\(([a-z-]+\.md)\)", RUNBOOK + SERVICE)
    assert len(links) > 5
    for link in links:
        assert (ROOT / "docs" / link).is_file(), link


def known() -> set[str]:
    app = application()
    names = [command.name or getattr(command.callback, "__name__", "") for command in app.registered_commands]
    return set(names) | {group.name or "" for group in app.registered_groups}


def read(block: str, folder: Path) -> dict[str, dict[str, object]]:
    path = folder / "block.toml"
    path.write_text(block, encoding="utf-8")
    return dict(read_toml(path))


def example(folder: Path) -> dict[str, dict[str, object]]:
    """The shipped run file, with whole paths."""
    content: dict[str, dict[str, object]] = dict(read_toml(CONFIGS / "turning-centre-sim.toml"))
    content["run"] |= {
        "machine": str(CONFIGS / "machines" / "turning-centre.toml"),
        "model": str(CONFIGS / "models" / "turning-centre.toml"),
        "log_folder": str(folder / "logs"),
    }
    device = content["device"]["machine"]
    assert isinstance(device, dict)
    device["truth"] = str(CONFIGS / "sim" / "turning-centre.toml")
    return content


def dry_run(folder: Path, content: dict[str, dict[str, object]], *options: str) -> str:
    path = folder / "run.toml"
    guard = {**content["guard"], "counts_max_age_s": 1.0}  # a busy PC reads late: that is not what is judged here
    path.write_text(tomli_w.dumps({**content, "guard": guard}), encoding="utf-8")
    command = [sys.executable, "-m", "rtec.cli.main", "run", str(path), *options, "--dry-run"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout
