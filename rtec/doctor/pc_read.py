"""Reads /proc and /sys below a root folder: `/` in life, a made-up tree in tests. What is not there reads as None."""

from dataclasses import dataclass
from pathlib import Path

CAP_IPC_LOCK, CAP_SYS_NICE = 14, 23
"""Bits of CapEff in /proc/PID/status (capabilities(7))."""
UNLIMITED = -1
SMI_COUNT = 0x34
"""MSR_SMI_COUNT of Intel processors (Software Developer's Manual, volume 4)."""


@dataclass(frozen=True)
class Pc:
    """This computer's files.

    Attributes:
        root: folder that they are below.
    """

    root: Path = Path("/")

    def text(self, path: str) -> str | None:
        """Content of a small file without white space around it."""
        try:
            return (self.root / path).read_text(encoding="utf-8", errors="replace").strip()
        except OSError:
            return None

    def number(self, path: str) -> int | None:
        """A file that holds one whole number."""
        text = self.text(path)
        try:
            return int(text) if text is not None else None
        except ValueError:
            return None

    def folders(self, path: str) -> list[Path]:
        """What is in a folder, in order; none where it cannot be read."""
        try:
            return sorted((self.root / path).iterdir())
        except OSError:
            return []

    def inside(self, path: Path) -> str:
        """A path that `folders` gave, as the other methods take it."""
        return str(path.relative_to(self.root))

    def processors(self, path: str) -> list[int] | None:
        """A list of processors as the kernel writes it, "0-2,7"; None where it is not there or not understood."""
        text = self.text(path)
        return None if text is None else processor_list(text)

    def allowed(self) -> list[int]:
        """Processors that this process may run on."""
        return processor_list(self.status("Cpus_allowed_list") or "") or []

    def status(self, key: str) -> str | None:
        """An entry of /proc/self/status."""
        for line in (self.text("proc/self/status") or "").splitlines():
            name, _, value = line.partition(":")
            if name == key:
                return value.strip()
        return None

    def capable(self, bit: int) -> bool | None:
        """Does this process have a capability?"""
        text = self.status("CapEff")
        try:
            return None if text is None else bool(int(text, 16) >> bit & 1)
        except ValueError:
            return None

    def limit(self, name: str) -> int | None:
        """Soft limit of this process, by its name in /proc/self/limits; `UNLIMITED` for none."""
        for line in (self.text("proc/self/limits") or "").splitlines():
            if line.startswith(name):
                soft = line.removeprefix(name).split()[:1]
                return _number(soft[0]) if soft else None
        return None

    def smi_count(self, processor: int) -> int | None:
        """System management interrupts since power on, as an Intel processor counts them.

        Needs root and the kernel module msr; None without.
        """
        try:
            with (self.root / f"dev/cpu/{processor}/msr").open("rb", buffering=0) as file:
                file.seek(SMI_COUNT)
                data = file.read(8)
        except OSError:
            return None
        return int.from_bytes(data[:4], "little") if len(data) == 8 else None


def _number(text: str) -> int | None:
    if text == "unlimited":
        return UNLIMITED
    return int(text) if text.isdigit() else None


def processor_list(text: str) -> list[int] | None:
    """Numbers of a list such as "0-2,7"; None where it is no list."""
    out: list[int] = []
    try:
        for part in (p for p in text.split(",") if p.strip()):
            first, _, last = part.partition("-")
            out += range(int(first), int(last or first) + 1)
    except ValueError:
        return None
    return out


def as_list(numbers: list[int]) -> str:
    """The other way round: "0-2,7"."""
    runs: list[list[int]] = []
    for n in sorted(set(numbers)):
        if runs and n == runs[-1][1] + 1:
            runs[-1][1] = n
        else:
            runs.append([n, n])
    return ",".join(str(a) if a == b else f"{a}-{b}" for a, b in runs)
