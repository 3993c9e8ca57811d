"""Turns kernel source into functions: compiled by numba and kept on disk, or plain Python where numba is missing.

Sine and cosine are the kernel's own: quicker than two library calls, and the same to the last bit on every machine.
Reduction by π/2 in three parts (Cody and Waite), then the Taylor series on -π/4 … π/4; the first term omitted is below
5e-17, so the result is within an ulp or so of the library's.
"""

import hashlib
import importlib.util
import inspect
import linecache
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

from rtec import jit
from rtec.errors import ModelError
from rtec.files import write_text
from rtec.jit import njit
from rtec.version import __version__

HEADER = "import math\n\nfrom rtec.jit import njit\n"


def build_module(text: str, depends_on: Sequence[ModuleType]) -> ModuleType:
    """Make a module from `text`, with compiled functions.

    The text and its machine code are kept in the user's cache folder. Their name is a hash of the text, this version,
    and the source of every module whose kernels the text calls (numba does not notice when those change).

    Args:
        text: the source after the header; made by this program.
        depends_on: modules whose compiled functions the text calls.
    """
    salt = "".join(inspect.getsource(m) for m in (jit, *depends_on))
    name = "rtec_kernel_" + hashlib.sha256(f"{__version__}\n{salt}\n{text}".encode()).hexdigest()[:24]
    whole = f'"""Made by rtec {__version__}; made again when anything in it changes."""\n\n{HEADER}{text}'
    if name in sys.modules:
        return sys.modules[name]
    path = _write(name, whole)
    if path is None:
        return _in_memory(name, whole)
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        return _in_memory(name, whole)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # the machine code on disk imports the module by its name
    spec.loader.exec_module(module)
    return module


def cache_folder() -> Path:
    """The user's folder for kernels and their machine code."""
    from platformdirs import user_cache_path

    return user_cache_path("rtec") / "kernels"


def _write(name: str, whole: str) -> Path | None:
    """Write the source unless the file already has exactly this text; None where the folder cannot be written.

    A file with other content is never run: it is overwritten.
    """
    folder = cache_folder()
    path = folder / f"{name}.py"
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        if path.is_file() and path.read_text(encoding="utf-8") == whole:
            return path
        write_text(whole, path, ModelError)
    except (OSError, UnicodeDecodeError, ModelError):
        return None
    return path


def _in_memory(name: str, whole: str) -> ModuleType:
    module = ModuleType(name)
    filename = f"<{name}>"
    linecache.cache[filename] = (len(whole), None, whole.splitlines(keepends=True), filename)
    exec(compile(whole, filename, "exec"), module.__dict__)  # noqa: S102 - our own text, see the docstring
    return module


# π/2 in three parts: the first two have 33 bits each, so that k times them is exact for k below 2^20.
_HALF_PI_1 = float.fromhex("0x1.921fb544p+0")
_HALF_PI_2 = float.fromhex("0x1.0b4611a6p-34")
_HALF_PI_3 = float.fromhex("0x1.3198a2e037073p-69")
LARGEST = 1.6e6
"""Beyond this angle the library computes sine and cosine: k would need more than 20 bits."""

S3, S5, S7, S9, S11, S13, S15 = ((-1.0) ** k / math.factorial(2 * k + 1) for k in range(1, 8))
C2, C4, C6, C8, C10, C12, C14, C16 = ((-1.0) ** k / math.factorial(2 * k) for k in range(1, 9))


@njit
def sin_cos(x: float) -> tuple[float, float]:
    """Sine and cosine of an angle in rad."""
    if not abs(x) < LARGEST:
        return math.sin(x), math.cos(x)
    k = math.floor(x * (2.0 / math.pi) + 0.5)
    r = ((x - k * _HALF_PI_1) - k * _HALF_PI_2) - k * _HALF_PI_3
    r2 = r * r
    r4 = r2 * r2
    r8 = r4 * r4
    # In pairs, not as one chain, so that the processor works on several at a time.
    s_low, s_high = (S3 + r2 * S5) + r4 * (S7 + r2 * S9), (S11 + r2 * S13) + r4 * S15
    c_low, c_high = (C2 + r2 * C4) + r4 * (C6 + r2 * C8), (C10 + r2 * C12) + r4 * (C14 + r2 * C16)
    s = r + r * r2 * (s_low + r8 * s_high)
    c = 1.0 + r2 * (c_low + r8 * c_high)
    quarter = int(k) & 3
    # Selected without a branch: the processor cannot predict the quarter.
    sine, cosine = (c, s) if quarter & 1 else (s, c)
    return (-sine if quarter & 2 else sine), (-cosine if (quarter + 1) & 2 else cosine)
