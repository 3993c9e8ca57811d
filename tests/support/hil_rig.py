"""Run files of the bench for tests: the shipped one, made shorter."""

import json
import os
import signal
import subprocess
import sys
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomli_w

from tests.support import gateware
from tests.support.modbus_peer import until
from tests.support.setups import CONFIGS

SHIPPED = CONFIGS / "hil.toml"


def tables() -> dict[str, Any]:
    """The shipped run file with absolute paths."""
    out = tomllib.loads(SHIPPED.read_text(encoding="utf-8"))
    out["run"] |= {key: str(CONFIGS / out["run"][key]) for key in ("machine", "model")}
    out["hil"]["truth"] = str(CONFIGS / out["hil"]["truth"])
    return out


def write(folder: Path, content: Mapping[str, Any]) -> Path:
    """Write a run file."""
    path = folder / "hil.toml"
    path.write_text(tomli_w.dumps(dict(content)), encoding="utf-8")
    return path


def short(folder: Path, **hil: Any) -> Path:
    """The shipped run file with some things of `[hil]` otherwise, temperatures stale after 2 s, memory not locked."""
    content = tables()
    content["realtime"] = {**content.get("realtime", {}), "lock_memory": False}
    content["hil"] |= hil
    content["guard"]["temperature_max_age_s"] = 2.0
    return write(folder, content)


def environment(folder: Path) -> dict[str, str]:
    """What a process is started with that keeps its passing things in this folder."""
    folder.mkdir(exist_ok=True)
    return {**os.environ, "TMPDIR": str(folder)}


def on_gateware(arguments: tuple[object, ...]) -> tuple[object, ...]:
    """The same command with the box's gateware in the place of the box in software, where `make gateware` wants it."""
    if not gateware.WHOLE or arguments[0] != "hil" or {"list", "--gateware"} & set(map(str, arguments)):
        return arguments
    return (*arguments, "--gateware", gateware.library(**gateware.REAL_CLOCK))


def rtec(*arguments: object, env: Mapping[str, str] | None = None) -> "subprocess.CompletedProcess[str]":
    """Run the command line."""
    command = [sys.executable, "-m", "rtec.cli.main", *map(str, on_gateware(arguments))]
    return subprocess.run(
        command, capture_output=True, text=True, env=env, start_new_session=True, timeout=400, check=False
    )


def facts_of(done: "subprocess.CompletedProcess[str]") -> dict[str, Any]:
    """The JSON that it printed, and what it said where it printed none."""
    assert done.stdout, done.stderr
    out: dict[str, Any] = json.loads(done.stdout)
    return out


def start(folder: Path, sign: str, *arguments: object) -> "subprocess.Popen[str]":
    """Start the command line in a process group of its own; return when the bench has made this file."""
    command = [sys.executable, "-m", "rtec.cli.main", *map(str, on_gateware(arguments))]
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(folder),
        start_new_session=True,
    )
    assert until(lambda: bool(list(folder.glob(f"rtec-hil-*/{sign}"))) or process.poll() is not None, 120.0)
    assert process.poll() is None, process.communicate()[1]
    return process


def processes_of(folder: Path) -> list[int]:
    """Processes that have this folder among their arguments or their variables: the bench's, wherever they run."""
    out, mark = [], str(folder).encode()
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            try:
                said = (entry / "cmdline").read_bytes() + (entry / "environ").read_bytes()
                state = (entry / "stat").read_text().rpartition(")")[2].split()[0]
            except OSError:
                continue
            if mark in said and state != "Z":
                out.append(int(entry.name))
    return out


def nothing_left(folder: Path) -> bool:
    """Neither processes nor ports nor files, within a while."""
    return until(lambda: not processes_of(folder) and not list(folder.glob("rtec-hil-*")), 30.0)


def interrupt(process: "subprocess.Popen[str]", number: signal.Signals) -> tuple[int, str]:
    """Send a signal to its process group, as a terminal does (SIGKILL to it alone); its status and what it said."""
    if number is signal.SIGKILL:
        process.kill()
    else:
        os.killpg(process.pid, number)
    try:
        _, said = process.communicate(timeout=60)
    finally:
        process.kill()
    return process.returncode, said
