"""Many sets over several processes, one thread of linear algebra in each."""

import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from itertools import islice
from multiprocessing import get_context

from rtec.parallel import one_blas_thread
from tests.discovery import methods
from tests.discovery.generator.cases import Case
from tests.discovery.score import Outcome, judge

Tell = Callable[[int, int], None]
METHODS = {"evidence": (methods.evidence, methods.improving), "naive": (methods.naive, None)}
ONE = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

AHEAD = 2
"""So many cases for each process are handed out at a time."""


def run(cases: Sequence[Case], method: str, jobs: int, tell: Tell) -> list[Outcome]:
    """Judge all cases; on an interrupt what there is until then. In the order of the cases.

    Args:
        cases: data sets.
        method: key of `METHODS`.
        jobs: processes.
        tell: told how many are done, of how many.
    """
    done: dict[int, Outcome] = {}
    tell(0, len(cases))
    if jobs <= 1:
        try:
            for i, case in enumerate(cases):
                done[i] = one(method, case)
                tell(len(done), len(cases))
        except KeyboardInterrupt:
            pass
        return [done[i] for i in sorted(done)]
    with _pool(jobs) as pool:
        waiting = iter(enumerate(cases))
        running: dict[Future[Outcome], int] = {}
        try:
            while _refill(pool, method, waiting, running, AHEAD * jobs):
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    done[running.pop(future)] = future.result()
                    tell(len(done), len(cases))
        except KeyboardInterrupt:
            # What runs already is few, ends by itself within seconds, and is taken along.
            done |= {i: future.result() for future, i in running.items()}
    return [done[i] for i in sorted(done)]


def one(method: str, case: Case) -> Outcome:
    """Judge one case by a method's name."""
    diagnose, improve = METHODS[method]
    with one_blas_thread():
        return judge(case, diagnose, improve)


def _refill(
    pool: ProcessPoolExecutor,
    method: str,
    waiting: Iterator[tuple[int, Case]],
    running: dict[Future[Outcome], int],
    most: int,
) -> bool:
    """Keep so many cases under way; say whether any is."""
    for i, case in islice(waiting, most - len(running)):
        running[pool.submit(one, method, case)] = i
    return bool(running)


@contextmanager
def _pool(jobs: int) -> Iterator[ProcessPoolExecutor]:
    """Fresh processes, which take their number of threads from the environment and leave Ctrl-C to this one."""
    before = {name: os.environ.get(name) for name in ONE}
    os.environ.update(dict.fromkeys(ONE, "1"))
    try:
        with ProcessPoolExecutor(jobs, mp_context=get_context("spawn"), initializer=_deaf) as pool:
            yield pool
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _deaf() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
