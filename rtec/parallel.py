"""One thread for the linear algebra of a fit.

The fit has a thread of its own for its sums. More threads in the library below would wait for each other by spinning,
which on a shared computer costs ten times what it saves; and one thread gives the same bits on any number of cores.

With many readings, work on several items runs in parallel.
"""

import functools
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from typing import Any, TypeVar


@functools.cache
def _controller() -> Any:
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def one_blas_thread() -> AbstractContextManager[object]:
    """Limit the linear algebra to one thread while the context lasts."""
    limited: AbstractContextManager[object] = _controller().limit(limits=1, user_api="blas")
    return limited


MANY = 16_000
"""Readings from which threads pay."""

T = TypeVar("T")
R = TypeVar("R")


def each(work: Callable[[T], R], items: Iterable[T], readings: int) -> list[R]:
    """Apply `work` to each, in order; in parallel with many readings, as numpy then releases the interpreter's lock."""
    workers = min(os.cpu_count() or 1, 4)
    if readings <= MANY or workers == 1:
        return [work(i) for i in items]
    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(work, items))
