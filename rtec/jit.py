"""Compiles the kernels where numba is installed; elsewhere the same source runs as plain Python.

Importing this module imports numba, so nothing that `import rtec` reaches may import it at the top.
"""

from collections.abc import Callable
from typing import Any, TypeVar, overload

numba: Any
try:
    import numba
except ImportError:
    numba = None

F = TypeVar("F", bound=Callable[..., Any])

HAVE_NUMBA: bool = numba is not None
"""Whether kernels are compiled."""


@overload
def njit(function: F) -> F: ...
@overload
def njit(**options: Any) -> Callable[[F], F]: ...
def njit(function: F | None = None, **options: Any) -> F | Callable[[F], F]:
    """Compile a function without the interpreter, and keep it on disk; without numba, return it unchanged.

    Use it bare (`@njit`) or with numba's own options (`@njit(fastmath=True)`). The function as written stays
    reachable through `as_written`.
    """

    def compile_one(f: F) -> F:
        return _compiled(f, options)

    return compile_one if function is None else compile_one(function)


def as_written(function: F) -> F:
    """The plain Python function behind a kernel: what runs without numba."""
    plain: F = getattr(function, "py_func", function)
    return plain


def _compiled(function: F, options: dict[str, Any]) -> F:
    if numba is None:
        return function
    settings: dict[str, Any] = {"cache": True, "nogil": True, **options}
    try:
        kernel: F = numba.njit(**settings)(function)
    except RuntimeError:  # no folder for the machine code (a read-only installation): compile each time
        kernel = numba.njit(**{**settings, "cache": False})(function)
    return kernel
