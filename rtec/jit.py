"""Compiles the kernels where numba is installed; elsewhere the same source runs as plain Python.

numba is imported at the first call of a kernel: it takes longer to import than all else, and many processes import
kernels that they never call.
"""

from collections.abc import Callable
from functools import cached_property, update_wrapper
from importlib.util import find_spec
from typing import Any, TypeVar, cast, overload

F = TypeVar("F", bound=Callable[..., Any])

HAVE_NUMBA: bool = find_spec("numba") is not None
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
        return cast(F, _Kernel(f, options)) if HAVE_NUMBA else f

    return compile_one if function is None else compile_one(function)


def as_written(function: F) -> F:
    """The plain Python function behind a kernel: what runs without numba."""
    plain: F = getattr(function, "py_func", function)
    return plain


class _Kernel:
    """A function that numba compiles, or loads from disk, at its first call."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        self.py_func, self._options = function, options
        update_wrapper(self, function)

    def __call__(self, *arguments: Any) -> Any:
        return self._compiled(*arguments)

    @property
    def _numba_type_(self) -> Any:
        """The type by which numba knows this function where another kernel calls it."""
        return self._compiled._numba_type_

    @cached_property
    def _compiled(self) -> Any:
        try:
            import numba
        except ImportError:  # there, but not for this Python or numpy
            return self.py_func
        settings: dict[str, Any] = {"cache": True, "nogil": True, **self._options}
        try:
            return numba.njit(**settings)(self.py_func)
        except RuntimeError:  # no folder for the machine code (a read-only installation): compile each time
            return numba.njit(**{**settings, "cache": False})(self.py_func)
