"""docs/write-a-driver.md: its code is taken out of the page, installed as a package, listed, examined, run.

Oracles: what the test writes into the files that the driver reads; the page's tables against the ports.
"""

import json
import os
import re
import runpy
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtec.correction.sinks import OriginOffsetSink, PulseSink
from rtec.errors import DriverFault
from rtec.loop.clock import VirtualClock
from rtec.loop.driver_info import CAN_BE
from rtec.loop.ports import Actuator, Resumable
from rtec.tomlfile import validated
from tests.support import setups
from tests.support.command import here
from tests.support.conformance import MACHINE

PAGE = (Path(__file__).parents[2] / "docs" / "write-a-driver.md").read_text(encoding="utf-8")
pytestmark = pytest.mark.xdist_group("real-clock")


def blocks(language: str) -> list[str]:
    """Fenced blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)


(MODULE,), (PYPROJECT,), (COMMANDS,), (ACTUATOR,) = (blocks(kind) for kind in ("python", "toml", "text", "py"))
SAID = {"T_spindle_front": 31.25, "T_bed": 19.5}


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The page's package as `pip install` leaves it; a run file with its device, and the files that this reads."""
    project = tomllib.loads(PYPROJECT)["project"]
    info = tmp_path / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    info.mkdir()
    head = f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    (info / "METADATA").write_text(head, encoding="utf-8")
    ((group, points),) = project["entry-points"].items()
    text = f"[{group}]\n" + "".join(f"{name} = {place}\n" for name, place in points.items())
    (info / "entry_points.txt").write_text(text, encoding="utf-8")
    (module,) = tomllib.loads(PYPROJECT)["tool"]["setuptools"]["py-modules"]
    (tmp_path / f"{module}.py").write_text(MODULE, encoding="utf-8")
    tables = setups.tables(tmp_path)
    tables["role"]["temperatures"] = ["cabinet"]
    tables["device"]["cabinet"] = {"driver": "hwmon", "files": {name: name for name in SAID}}
    for name, degc in SAID.items():
        (tmp_path / name).write_text(f"{degc * 1000:.0f}\n", encoding="utf-8")
    setups.write(tmp_path, tables)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    sys.modules.pop(module, None)


def rtec(*words: str, expected: int = 0) -> str:
    """Run a command where the package is installed."""
    return said(here(*words), expected)


def apart(site: Path, *words: str, expected: int = 0) -> str:
    """The same in a process of its own, with all that its own processes say."""
    given = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in (str(site), os.environ.get("PYTHONPATH")) if p)}
    command = [sys.executable, "-m", "rtec.cli.main", *words]
    return said(subprocess.run(command, capture_output=True, text=True, env=given, check=False), expected)


def said(done: "subprocess.CompletedProcess[str]", expected: int) -> str:
    assert done.returncode == expected, done.stderr
    return done.stdout if done.returncode != 2 else done.stderr


def test_it_is_short() -> None:
    """The class, its options, nothing else; the example in it does not count."""
    code = re.sub(r'    EXAMPLE = """.*?"""\n', "", MODULE, flags=re.DOTALL)
    lines = [line for line in code.split("class ", 1)[1].splitlines() if line.strip()]
    assert len(lines) <= 20


def test_it_is_listed(site: Path) -> None:
    found: dict[str, Any] = json.loads(apart(site, "drivers", "hwmon", "--json"))
    assert (found["package"], found["roles"], found["trouble"]) == ("rtec-hwmon", ["temperatures"], "")
    assert [(o["name"], o["required"]) for o in found["options"]] == [("files", True)]
    assert "thousandths" in found["options"][0]["meaning"]
    assert tomllib.loads(found["example"])["device"]["cabinet"]["driver"] == "hwmon"
    assert "hwmon" in rtec("drivers")


def test_the_doctor_reads_it(site: Path) -> None:
    words = ("doctor", "run.toml", "--no-pc", "--seconds", "0.3", "--json")
    found = json.loads(rtec(*words))
    (cabinet,) = [d for d in found["devices"]["devices"] if d["name"] == "cabinet"]
    assert {v["name"]: v["value"] for v in cabinet["values"]} == SAID
    (site / "T_bed").unlink()
    found = json.loads(rtec(*words, expected=1))
    (cabinet,) = [d for d in found["devices"]["devices"] if d["name"] == "cabinet"]
    assert "T_bed" in cabinet["wrong"][0]["what"]
    assert [v["name"] for v in cabinet["values"]] == ["T_spindle_front"]


@pytest.mark.usefixtures("site")
def test_the_loop_runs_on_it() -> None:
    found = json.loads(rtec("run", "run.toml", "--duration", "0.5", "--json"))
    assert {name: found["degc"][name] for name in SAID} == SAID


def test_a_sensor_that_is_not_there_is_refused(site: Path) -> None:
    text = (site / "run.toml").read_text(encoding="utf-8")
    (site / "run.toml").write_text(text.replace('T_bed = "T_bed"', 'T_bett = "T_bed"'), encoding="utf-8")
    found = rtec("run", "run.toml", "--duration", "0.1", expected=2)
    assert "[device.cabinet] the machine has no sensor 'T_bett'; did you mean 'T_bed'?" in " ".join(found.split())


@pytest.mark.parametrize("in_loop", [True, False])
def test_a_fault_of_such_a_driver_is_told_by_its_own_words(site: Path, in_loop: bool) -> None:
    """Oracle: the error that is put into it, in the loop's process and in one of its own."""
    module = site / "rtec_hwmon.py"
    faulty = MODULE.replace("int(file.read_text()) / 1000", "{}['its own fault']")
    if in_loop:
        faulty = faulty.replace("    options_model =", "    IN_LOOP = True\n    options_model =")
    module.write_text(faulty, encoding="utf-8")
    found = " ".join(apart(site, "run", "run.toml", "--duration", "0.5", expected=2).split())
    told = "fault in the program or in a library that it uses: KeyError: 'its own fault'"
    where = "rtec: the loop's process ended at a" if in_loop else "rtec: [device.cabinet]"
    assert f"{where} {told}" in found
    assert "Traceback" not in found  # an exception's text could write what it likes into the journal
    assert "(rtec_hwmon.py:" in found


@pytest.mark.usefixtures("site")
def test_what_else_the_page_says() -> None:
    """Its table of methods against the ports; its commands run, but for the last part of the names."""
    rows = dict(re.findall(r"^\| (\w+) \| (.*?) \|", PAGE.split("## What a driver can be")[1], re.MULTILINE))
    rows.pop("key", None)
    for role, port in CAN_BE.items():
        named = set(re.findall(r"`(\w+)\(", rows[role]))
        assert named == {name for name in vars(port) if not name.startswith("_")}
    assert set(rows) == set(CAN_BE)
    for line in COMMANDS.splitlines():
        words = [*line.split()[1:], *(["--no-pc", "--seconds", "0.2"] if " doctor " in line else [])]
        rtec(*words)


def test_the_actuator_of_the_page(tmp_path: Path) -> None:
    """Oracle: the files. What somebody sets to zero stays zero until the order to resume."""
    (tmp_path / "x").write_text("0", encoding="utf-8")
    (tmp_path / "page_actuator.py").write_text(ACTUATOR, encoding="utf-8")
    module = runpy.run_path(str(tmp_path / "page_actuator.py"))
    options = validated(module["RegisterOptions"], {"files": {"X": "x"}, "step_um": 0.1}, "run.toml")
    driver = module["RegisterDriver"](options, MACHINE, VirtualClock(), tmp_path)
    assert all(isinstance(driver, port) for port in (Actuator, Resumable))
    assert driver.refuses(PulseSink()) == "takes origin_offset, not pulse"
    assert driver.refuses(OriginOffsetSink(kind="origin_offset", resolution_um=1.0)) == "its step is 0.1 µm, not 1.0 µm"
    assert driver.refuses(OriginOffsetSink(kind="origin_offset", resolution_um=0.1)) == ""
    has = np.zeros(len(MACHINE.axes), np.int64)
    with driver:
        for told in (3, 400):
            driver.read_output(has)
            driver.apply(np.full_like(has, told))
            assert (tmp_path / "x").read_text(encoding="utf-8") == str(told)
        (tmp_path / "x").write_text("0", encoding="utf-8")
        driver.apply(np.full_like(has, 400))
        driver.read_output(has)
        assert (has[0], (tmp_path / "x").read_text(encoding="utf-8")) == (0, "0")
        with pytest.raises(DriverFault, match="x has 0, 400 was written: somebody else wrote to it"):
            driver.apply(np.full_like(has, 401))
        driver.resume()
        driver.apply(np.full_like(has, 1))
    assert (tmp_path / "x").read_text(encoding="utf-8") == "1"
