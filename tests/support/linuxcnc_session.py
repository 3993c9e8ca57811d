"""LinuxCNC, headless, in namespaces of its own: its shared memory, processes, network and /tmp are nobody else's.

Several run at a time, beside somebody's own LinuxCNC, and leave nothing behind: when the first process of the
namespaces ends, the kernel ends all the others and takes the shared memory away.
"""

import json
import os
import shutil
import signal
import socket
import subprocess
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from rtec.loop.clock import RealClock
from tests.support.conformance import soon

ROOT = Path(__file__).parents[2]
CONFIGS = ROOT / "configs" / "linuxcnc"
BRIDGE = ROOT / "drivers" / "rtec_drivers" / "linuxcnc" / "bridge.py"
AGENT = Path(__file__).with_name("linuxcnc_agent.py")
PYTHON = "/usr/bin/python3"
NEEDED = ("linuxcnc", "halcmd", "halsampler", "unshare", "mount", PYTHON)
NAMESPACES = ("--ipc", "--net", "--pid", "--fork", "--mount", "--mount-proc", "--kill-child")
NOBODY = 65534

# The session's folder and the project stay where they are, although /tmp around them becomes another one.
INIT = """\
set -e
mount -t tmpfs tmpfs /mnt
mkdir /mnt/folder /mnt/root
mount --bind {folder} /mnt/folder
mount --bind {root} /mnt/root
mount -t tmpfs tmpfs /tmp
mkdir -p {folder} {root}
mount --bind /mnt/folder {folder}
mount --bind /mnt/root {root}
/usr/bin/python3 -c 'import fcntl, socket, struct
s = socket.socket(); fcntl.ioctl(s, 0x8914, struct.pack("16sh14x", b"lo", 0x49))'
export HOME={folder} RTAPI_FIFO_PATH=/tmp/rtapi_fifo RTAPI_UID={uid} PYTHONPATH=/usr/lib/python3/dist-packages
cd {folder}
exec linuxcnc {ini}
"""


def why_not() -> str | None:
    """Give the reason why LinuxCNC cannot run here, or None."""
    missing = [tool for tool in NEEDED if shutil.which(tool) is None]
    if missing:
        return f"LinuxCNC is not installed (apt-get install linuxcnc-uspace): no {', '.join(missing)}"
    tried = subprocess.run(
        ["unshare", *NAMESPACES, "mount", "-t", "tmpfs", "tmpfs", "/mnt"], capture_output=True, text=True, check=False
    )
    if tried.returncode:
        return f"this user may not make namespaces: {tried.stderr.strip()}"
    return None


class Session:
    """One LinuxCNC with one of the shipped configurations, copied; the test's orders go to its agent.

    Attributes:
        folder: its configuration, the bridge's socket, what is recorded.

    Args:
        name: of the INI file in configs/linuxcnc, without its ending.
        edits: text to replace in the copied files: file name to (old, new) pairs.
        files: text of more files beside them, by name.
        source: folder of the configuration, where it is another than configs/linuxcnc.
    """

    def __init__(
        self,
        name: str,
        edits: dict[str, list[tuple[str, str]]] | None = None,
        files: dict[str, str] | None = None,
        source: Path = CONFIGS,
    ) -> None:
        self.name, self._edits, self._files, self._source = name, edits or {}, files or {}, source
        self.folder = Path()
        self._clock = RealClock()

    def __enter__(self) -> Self:
        self.folder = Path(tempfile.mkdtemp(prefix="rtec-cnc-"))
        self.folder.chmod(0o777)
        try:
            self._copy()
            self._start()
        except BaseException:
            shutil.rmtree(self.folder, ignore_errors=True)
            raise
        return self

    def __exit__(self, *error: object) -> None:
        self._end()
        shutil.rmtree(self.folder, ignore_errors=True)

    def restart(self) -> None:
        """End this LinuxCNC, and start it again."""
        self._end()
        (self.folder / "session.agent").unlink(missing_ok=True)
        self._start()

    def __getattr__(self, name: str) -> Any:
        """Orders are the agent's methods."""
        if name.startswith("_"):
            raise AttributeError(name)
        return lambda *args: self._ask(name, *args)

    def gets(self, pin: str) -> float:
        """Value of a pin, a signal or a parameter; a bit is 0 or 1."""
        try:
            said = self._ask("hal", "getp", pin)
        except RuntimeError:
            said = self._ask("hal", "gets", pin)
        bits = {"FALSE": 0.0, "TRUE": 1.0}
        return bits[said] if said in bits else float(said)

    def until(self, met: Any) -> Any:
        """Wait, a minute at most, until something holds."""
        return soon(self._clock, met)

    def rest(self, seconds: float) -> None:
        """Let LinuxCNC's time go on."""
        self._clock.sleep_until_ns(self._clock.now_ns() + round(seconds * 1e9))

    def recorded(self, name: str) -> NDArray[np.float64]:
        """Rows that halsampler wrote: the sample's number, then the pins; whole rows only."""
        lines = (line.split() for line in (self.folder / name).read_text().splitlines())
        rows = [words for words in lines if words[:1] and words[0].isdigit()]
        width = max(map(len, rows), default=0)
        return np.array([r for r in rows if len(r) == width], dtype=np.float64)

    def said_at_start(self) -> str:
        """What LinuxCNC and its parts printed."""
        files = [self.folder / n for n in ("linuxcnc.log", "linuxcnc_print.txt", "linuxcnc_debug.txt")]
        return "\n".join(f.read_text() for f in files if f.exists())

    def _copy(self) -> None:
        for file in self._source.iterdir():
            if file.suffix in (".ini", ".hal", ".tbl", ".toml", ".var"):
                shutil.copy(file, self.folder / file.name)
        for name, text in self._files.items():
            (self.folder / name).write_text(text)
        changes = {f"{self.name}.ini": [("DISPLAY = axis", "DISPLAY = ./agent")]}
        if self._source == CONFIGS:
            changes[f"{self.name}.hal"] = [("../../drivers/rtec_drivers/linuxcnc/bridge.py", str(BRIDGE))]
        agent = self.folder / "agent"
        agent.write_text(f"#!/bin/sh\nexec {PYTHON} -I {AGENT}\n")
        agent.chmod(0o755)
        for name, pairs in self._edits.items():
            changes[name] = [*changes.get(name, []), *pairs]
        for name, pairs in changes.items():
            text = (self.folder / name).read_text()
            for old, new in pairs:
                assert old in text, f"{name} has no {old!r}"
                text = text.replace(old, new)
            (self.folder / name).write_text(text)

    def _start(self) -> None:
        uid = NOBODY if os.getuid() == 0 else os.getuid()
        text = INIT.format(folder=self.folder, root=ROOT, ini=f"{self.name}.ini", uid=uid)
        self._log = (self.folder / "linuxcnc.log").open("ab")
        self._process = subprocess.Popen(
            ["unshare", *NAMESPACES, "bash", "-c", text],
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=self._log,
            start_new_session=True,
        )
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            soon(self._clock, self._connected)
        except AssertionError as e:
            self._end()
            raise RuntimeError(f"LinuxCNC did not start:\n{self.said_at_start()}") from e

    def _connected(self) -> bool:
        assert self._process.poll() is None
        try:
            self._socket.connect(str(self.folder / "session.agent"))
        except OSError:
            return False
        return True

    def _ask(self, *order: Any) -> Any:
        self._socket.send(json.dumps(order).encode())
        good, answer = json.loads(self._socket.recv(1 << 20))
        if not good:
            raise RuntimeError(answer)
        return answer

    def _end(self) -> None:
        with suppress(OSError):
            self._socket.send(b'["quit"]')
        self._socket.close()
        try:
            self._process.wait(15)
        except subprocess.TimeoutExpired:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait(10)
        self._log.close()
