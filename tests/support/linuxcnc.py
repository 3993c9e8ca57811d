"""LinuxCNC's software encoder counter, run headless, as a judge that nobody here wrote.

`halstreamer` feeds A and B one row a thread period, the HAL component `encoder` counts them, `halsampler` reads back
the lines and the count at each period. HAL has one shared memory a machine, so runs take turns behind a file lock,
and none starts where somebody's own LinuxCNC is running.
"""

import fcntl
import os
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

PERIOD_NS = 50_000
TIMEOUT_S = 60
NEEDED = ("halrun", "halstreamer", "halsampler")
NOBODY = 65534

SCRIPT = """
loadrt threads name1=fast period1={period_ns} fp1=0
loadrt encoder num_chan=1
loadrt streamer depth={depth} cfg=bb
loadrt sampler depth={depth} cfg=bbs
net a streamer.0.pin.0 => encoder.0.phase-A sampler.0.pin.0
net b streamer.0.pin.1 => encoder.0.phase-B sampler.0.pin.1
net counts encoder.0.rawcounts => sampler.0.pin.2
addf streamer.0 fast
addf encoder.update-counters fast
addf sampler.0 fast
loadusr -w halstreamer {source}
start
loadusr -w halsampler -n {rows} {result}
stop
"""


@dataclass(frozen=True)
class Counted:
    """What HAL saw and counted, one row a thread period: lines 0 or 1, counts since the start."""

    a: NDArray[np.uint8]
    b: NDArray[np.uint8]
    counts: NDArray[np.int64]


def why_not() -> str | None:
    """Give the reason why LinuxCNC cannot judge here, or None."""
    missing = [tool for tool in NEEDED if shutil.which(tool) is None]
    if missing:
        return f"LinuxCNC is not installed (apt-get install linuxcnc-uspace): no {', '.join(missing)}"
    return None


def count(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> Counted:
    """Feed the lines to LinuxCNC's encoder component, one entry a period; skips where somebody uses HAL.

    Raises:
        RuntimeError: HAL did not give as many rows as it was fed; the message holds what it printed.
    """
    with _turn(), tempfile.TemporaryDirectory(prefix="rtec-hal-") as name:
        folder = Path(name)
        if _in_use():
            pytest.skip("LinuxCNC is running on this machine; its shared memory is not ours to use")
        source, result, script = folder / "in.txt", folder / "out.txt", folder / "count.hal"
        np.savetxt(source, np.column_stack((a, b)), fmt="%d")
        depth = 2 * len(a) + 16
        script.write_text(SCRIPT.format(period_ns=PERIOD_NS, depth=depth, source=source, result=result, rows=len(a)))
        said = _run(script, folder)
        rows = np.loadtxt(result, dtype=np.int64, ndmin=2) if result.exists() else np.zeros((0, 3), np.int64)
        if rows.shape != (len(a), 3):
            raise RuntimeError(f"LinuxCNC gave {len(rows)} rows for {len(a)}; it said:\n{said}")
    return Counted(rows[:, 0].astype(np.uint8), rows[:, 1].astype(np.uint8), rows[:, 2])


@contextmanager
def _turn() -> Iterator[None]:
    """One run at a time on this machine, whichever process asks."""
    with (Path(tempfile.gettempdir()) / f"rtec-hal-{os.getuid()}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _in_use() -> bool:
    """Whether a realtime process of LinuxCNC is alive."""
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            text = status.read_text()
        except OSError:  # it has ended
            continue
        name, state = text[text.find("(") + 1 : text.rfind(")")], text[text.rfind(")") + 2]
        if name.startswith("rtapi_app") and state != "Z":
            return True
    return False


def _run(script: Path, folder: Path) -> str:
    """Run one HAL script to its end, or end it and clean up; gives what it printed."""
    env = os.environ | {"RTAPI_FIFO_PATH": str(folder / "rtapi_fifo")}
    if os.getuid() == 0:  # rtapi_app refuses to be root; it becomes this user, who must reach the folder
        env["RTAPI_UID"] = str(NOBODY)
        os.chown(folder, NOBODY, NOBODY)
    log = folder / "said.txt"
    with log.open("w") as output:
        process = subprocess.Popen(
            ["halrun", "-f", str(script)],
            env=env,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            process.wait(TIMEOUT_S)
        finally:
            if process.poll() is None or process.returncode != 0:
                _clean_up(process, env)
    return log.read_text()


def _clean_up(process: subprocess.Popen[bytes], env: dict[str, str]) -> None:
    """End what is left of the run, and take HAL's shared memory away."""
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGTERM)
    subprocess.run(["halrun", "-U"], env=env, capture_output=True, timeout=TIMEOUT_S, check=False)
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait(TIMEOUT_S)
