"""Turns kernel source into functions: numba where it is there, kept on disk; plain Python where it is not."""

import hashlib
import importlib.util
import inspect
import linecache
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

from rtec import __version__, jit

HEADER = "import math\n\nfrom rtec.jit import njit\n"


def build_module(text: str, depends_on: Sequence[ModuleType]) -> ModuleType:
    """Give a module made of `text`, compiled functions and all.

    The text and its machine code are kept in the user's cache folder under a name made from the text, this version,
    and the source of every module whose kernels it calls (numba itself does not notice when those change).

    Args:
        text: what follows the header; made by this program.
        depends_on: modules whose compiled functions the text calls.
    """
    salt = "".join(inspect.getsource(m) for m in (jit, *depends_on))
    name = "rtec_kernel_" + hashlib.sha256(f"{__version__}\n{salt}\n{text}".encode()).hexdigest()[:24]
    whole = f'"""Made by rtec {__version__}; made anew when anything in it changes."""\n\n{HEADER}{text}'
    if name in sys.modules:
        return sys.modules[name]
    path = _write(name, whole)
    if path is None:
        return _in_memory(name, whole)
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        return _in_memory(name, whole)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # the machine code on disk refers to the module by its name
    spec.loader.exec_module(module)
    return module


def cache_folder() -> Path:
    """Where kernels are kept."""
    from platformdirs import user_cache_path

    return user_cache_path("rtec") / "kernels"


def _write(name: str, whole: str) -> Path | None:
    """Write the source unless it stands there to the letter; None where there is no place for it.

    A file with other content is never run: it is written anew.
    """
    folder = cache_folder()
    path = folder / f"{name}.py"
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        if path.is_file() and path.read_text(encoding="utf-8") == whole:
            return path
        temporary = folder / f".{name}.{os.getpid()}"
        temporary.write_text(whole, encoding="utf-8")
        temporary.replace(path)
    except (OSError, UnicodeDecodeError):
        return None
    return path


def _in_memory(name: str, whole: str) -> ModuleType:
    module = ModuleType(name)
    filename = f"<{name}>"
    linecache.cache[filename] = (len(whole), None, whole.splitlines(keepends=True), filename)
    exec(compile(whole, filename, "exec"), module.__dict__)  # noqa: S102 - our own text, see the docstring
    return module
