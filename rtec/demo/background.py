"""A second process for parallel work; it always ends with its parent."""

import signal
from collections.abc import Callable
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any, Generic, Self, TypeVar

from rtec.errors import RtecError

T = TypeVar("T")


class Beside(Generic[T]):
    """Calls a function in a process of its own.

    Use as a context manager: leaving it ends the process, finished or not.

    Args:
        function: importable by name; its arguments and result are pickled.
        arguments: arguments of the function.
    """

    def __init__(self, function: Callable[..., T], *arguments: Any) -> None:
        context = get_context("spawn")
        self._here, there = context.Pipe(duplex=False)
        self._process = context.Process(target=_call, args=(there, function, arguments), daemon=True)
        self._process.start()
        there.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._process.terminate()
        self._process.join()
        self._here.close()

    def result(self) -> T:
        """Wait for the function's result.

        Raises:
            RtecError: the function raised it, or the process died.
        """
        try:
            done, value = self._here.recv()
        except EOFError as e:
            raise RtecError("the second process of the demo ended without a result; is there enough memory?") from e
        if not done:
            raise RtecError(str(value))
        return value  # type: ignore[no-any-return]


def _call(pipe: Connection, function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole process group; the parent ends this process
    try:
        pipe.send((True, function(*arguments)))
    except RtecError as e:
        pipe.send((False, str(e)))
    finally:
        pipe.close()
