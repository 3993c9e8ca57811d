"""Starts the processes of the bench, sends them orders, and ends them, whatever happens."""

import json
import subprocess
import sys
from collections.abc import Sequence
from multiprocessing.util import register_after_fork
from pathlib import Path
from typing import Any, Self

from rtec.errors import DriverUnavailable
from rtec.hil import FaultOrder
from rtec_drivers.hil.wiring import SENSED, TRACK

PARTS = ("machine", "sensors")
END_S = 10.0


class FarSides:
    """The far sides of all buses, in processes and sessions of their own, so that Ctrl-C does not reach them.

    Args:
        config: run file with section `[hil]`.
        folder: folder for ports and results.
        every_ms: period of recording the tip, ms.
        gateware: a library of simulated gateware, which replaces the box in software.

    Attributes:
        warnings: what the system refused them.
    """

    def __init__(self, config: Path, folder: Path, every_ms: int, gateware: Path | None = None) -> None:
        self.warnings: list[str] = []
        self._config, self._folder, self._every_ms, self._gateware = config, folder, every_ms, gateware
        self._processes: dict[str, subprocess.Popen[str]] = {}
        register_after_fork(self, FarSides._let_go)  # they end with this process, not with a copy of it

    def __enter__(self) -> Self:
        """Start them; return when their ports exist.

        Raises:
            DriverUnavailable: one could not start; the message says why.
        """
        for name in (SENSED, TRACK):
            (self._folder / name).unlink(missing_ok=True)
        try:
            # The machine creates the sensors' file, so its process comes first.
            for part in PARTS:
                self._processes[part] = self._start(part)
                self.warnings += [f"simulated {part}: {w}" for w in self._heard(part)["warnings"]]
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(self, *error: object) -> None:
        """End them."""
        self._end()

    def start(self, at_ns: int, faults: Sequence[FaultOrder]) -> None:
        """Start the machine at that instant, from which the faults count."""
        order = {"do": "start", "at_ns": at_ns, "faults": [(f.name, f.at_s, f.end_s) for f in faults]}
        for part in PARTS:
            self._tell(part, order)

    def finish(self) -> dict[str, dict[str, Any]]:
        """End them and give each one's counts; the machine's record is then in the folder."""
        out = {}
        for part in PARTS:
            self._tell(part, {"do": "stop"})
            out[part] = self._heard(part)
        return out

    def pids(self) -> dict[str, int]:
        """Process numbers by part."""
        return {part: process.pid for part, process in self._processes.items()}

    def _start(self, part: str) -> "subprocess.Popen[str]":
        command = [sys.executable, "-m", "rtec_drivers.hil.far_side", str(self._config), "--part", part]
        command += ["--folder", str(self._folder), "--every-ms", str(self._every_ms)]
        command += ["--gateware", str(self._gateware)] if self._gateware else []
        return subprocess.Popen(  # noqa: S603 - our own interpreter and module
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def _tell(self, part: str, order: dict[str, Any]) -> None:
        pipe = self._processes[part].stdin
        if pipe is not None:
            try:
                pipe.write(json.dumps(order) + "\n")
                pipe.flush()
            except BrokenPipeError:
                raise self._died(part) from None

    def _heard(self, part: str) -> dict[str, Any]:
        pipe = self._processes[part].stdout
        line = pipe.readline() if pipe is not None else ""
        if not line:
            raise self._died(part)
        answer: dict[str, Any] = json.loads(line)
        return answer

    def _died(self, part: str) -> DriverUnavailable:
        process = self._processes[part]
        lines = process.communicate()[1].strip().splitlines()
        why = lines[-1] if lines else f"exit code {process.returncode}"
        return DriverUnavailable(f"the bench's process {part!r} ended: {why}")

    def _let_go(self) -> None:
        for process in self._processes.values():
            for pipe in (process.stdin, process.stdout, process.stderr):
                if pipe is not None and not pipe.closed:
                    try:
                        pipe.close()
                    except BrokenPipeError:
                        continue

    def _end(self) -> None:
        self._let_go()
        for process in self._processes.values():
            try:
                process.wait(END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._processes = {}
