"""One thread for the linear algebra of a fit.

The fit has a thread of its own for its sums. More in the library below would wait for each other by spinning, which
on a shared computer costs ten times what it saves; and one thread gives the same bits whatever the number of cores.
"""

import functools
from contextlib import AbstractContextManager
from typing import Any


@functools.cache
def _controller() -> Any:
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def one_blas_thread() -> AbstractContextManager[object]:
    """Limit the linear algebra to one thread while the context lasts."""
    limited: AbstractContextManager[object] = _controller().limit(limits=1, user_api="blas")
    return limited
