"""Runs the commands of `docs/tutorial.md`, as a reader would, and takes the figures that it shows.

`make figures` runs this file: `python -m tests.tutorial.tutorial docs/figures`.
"""

import contextlib
import io
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

from rtec.cli.main import status

ROOT = Path(__file__).parents[2]
TUTORIAL = ROOT / "docs" / "tutorial.md"
FIGURES: Mapping[str, str] = {
    "tutorial-compare.png": "compare/laser-x-position.png",
    "tutorial-evidence.png": "diagnose/evidence.png",
    "tutorial-history.png": "history/history.png",
}
"""Figure in `docs/figures`, and which one of `out/tutorial` it is."""
ALONE = ("rtec run",)
"""Commands that start processes of their own: run in one."""


def commands(text: str) -> list[str]:
    """The shell blocks of a page, in order; one entry a command, its continued lines with it."""
    blocks = re.findall(r"^```sh\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    whole = "".join(blocks).replace("\\\n", " ")
    return [line for line in whole.splitlines() if line.strip()]


def run_all(folder: Path) -> list[tuple[str, str]]:
    """Run every command in a folder that holds a copy of `configs`; give each with what it printed.

    Raises:
        RuntimeError: a command ended with another status than 0.
    """
    shutil.copytree(ROOT / "configs", folder / "configs")
    (folder / "out" / "tutorial").mkdir(parents=True)
    return [(command, run(command, folder)) for command in commands(TUTORIAL.read_text(encoding="utf-8"))]


def run(command: str, folder: Path) -> str:
    """Run a command line in a folder, one of rtec's in this process; give what it printed.

    Raises:
        RuntimeError: it ended with another status than 0; with its messages.
    """
    if command.startswith("rtec ") and not command.startswith(ALONE):
        out = io.StringIO()
        with contextlib.chdir(folder), contextlib.redirect_stdout(out):
            ended, printed, messages = status(shlex.split(command)[1:]), out.getvalue(), ""
    else:
        path = os.pathsep.join((str(Path(sys.executable).parent), os.environ.get("PATH", "")))
        line, env = ["bash", "-c", command], {**os.environ, "PATH": path}
        done = subprocess.run(line, cwd=folder, env=env, capture_output=True, text=True, check=False)
        ended, printed, messages = done.returncode, done.stdout, done.stderr
    if ended:
        raise RuntimeError(f"{command}\nended with {ended}:\n{printed}{messages}")
    return printed


def take_figures(folder: Path, to: Path) -> None:
    """Copy the figures of a run to a folder."""
    to.mkdir(parents=True, exist_ok=True)
    for name, made in FIGURES.items():
        shutil.copyfile(folder / "out" / "tutorial" / made, to / name)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as scratch:
        for typed, printed in run_all(Path(scratch)):
            sys.stdout.write(f"$ {typed}\n{printed}\n")
        take_figures(Path(scratch), Path(sys.argv[1]))
