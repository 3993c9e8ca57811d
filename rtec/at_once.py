"""Several looks at once, where there are many readings."""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

MANY = 16_000
"""From so many readings on a first look takes about so many of them, and threads pay."""

T = TypeVar("T")
R = TypeVar("R")


def each(work: Callable[[T], R], items: Iterable[T], readings: int) -> list[R]:
    """Work on each, in order; at once where there are many readings, as numpy lets go of the interpreter then."""
    workers = min(os.cpu_count() or 1, 4)
    if readings <= MANY or workers == 1:
        return [work(i) for i in items]
    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(work, items))
