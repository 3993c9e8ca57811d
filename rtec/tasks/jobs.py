"""Jobs: longer work in a process of its own, with progress, questions, and cancellation.

A process is forked from a server that has already loaded everything, so that it begins at once, and ending it does not
affect the page. Results come through a pipe from our own child process; nothing from a file or a client is unpickled.
"""

import asyncio
import contextlib
import multiprocessing
import sys
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerProcess
from typing import Any, Final, Protocol, TypeVar, TypeVarTuple

from rtec.errors import RtecError

Ts = TypeVarTuple("Ts")
R = TypeVar("R")
PRELOAD: Final = ["rtec.tasks.preload"]


class Cancelled(Exception):
    """The user cancelled the job."""


class Reporter(Protocol):
    """Connection of a job's process to the page: progress and questions."""

    def stage(self, what: str, done: int, total: int) -> None:
        """Report progress: name of the stage, steps done, and their total."""

    def ask(self, question: object) -> Any:
        """Ask the page a question; give its answer."""


class _Line:
    """The job's end of the pipe."""

    def __init__(self, pipe: "Connection[Any, Any]") -> None:
        self._pipe = pipe

    def stage(self, what: str, done: int, total: int) -> None:
        self._pipe.send(("stage", (what, done, total)))

    def ask(self, question: object) -> Any:
        self._pipe.send(("ask", question))
        try:
            return self._pipe.recv()
        except EOFError as e:
            raise ConnectionResetError("the studio has ended") from e


def warm_up() -> None:
    """Start the server from which processes are forked; it continues loading in the background."""
    from multiprocessing import forkserver

    _context()
    forkserver.ensure_running()


def fault(e: Exception) -> str:
    """Message of a page on a bug of rtec; the terminal shows the traceback."""
    traceback.print_exception(e, file=sys.stderr)
    return f"a fault of rtec itself: {type(e).__name__}: {e}; the terminal shows where"


def _context() -> "multiprocessing.context.ForkServerContext":
    """Context of a fork server that loads the modules of jobs."""
    made = multiprocessing.get_context("forkserver")
    made.set_forkserver_preload(PRELOAD)
    return made


def _work(pipe: "Connection[Any, Any]", task: Callable[..., Any], args: tuple[Any, ...]) -> None:
    with contextlib.suppress(ConnectionError):  # the page no longer waits
        _report(pipe, task, args)


def _report(pipe: "Connection[Any, Any]", task: Callable[..., Any], args: tuple[Any, ...]) -> None:
    try:
        pipe.send(("done", task(_Line(pipe), *args)))
    except ConnectionError:
        raise
    except RtecError as e:
        pipe.send(("failed", str(e)))
    except Exception as e:  # noqa: BLE001 - whatever it is, the page shows that it ended
        pipe.send(("failed", fault(e)))


class Job:
    """One job.

    Attributes:
        title: description in words.
        what, done, total: progress: stage, steps done, and their total; `total` is 0 where it is unknown.

    Args:
        title: see above.
        changed: progress callback: called without arguments after every change.
        asked: answers the questions of the job.
    """

    def __init__(
        self, title: str, changed: Callable[[], None], asked: "Callable[[Any], asyncio.Future[Any]] | None" = None
    ) -> None:
        self.title, self.what, self.done, self.total = title, "starting", 0, 0
        self._changed, self._asked = changed, asked
        self._process: ForkServerProcess | None = None
        self._ended: asyncio.Future[Any] | None = None
        self._reading: asyncio.Task[None] | None = None

    async def run(self, task: Callable[[Reporter, *Ts], R], *args: *Ts) -> R:
        """Run a task in its process; give the result.

        Raises:
            RtecError: the task failed; the message has the reason.
            Cancelled: `cancel` was called.
        """
        loop = asyncio.get_running_loop()
        self._ended = loop.create_future()
        here, there = _context().Pipe()
        self._process = _context().Process(target=_work, args=(there, task, args), daemon=True)
        try:
            try:
                await loop.run_in_executor(None, self._process.start)
            except (OSError, EOFError) as e:
                raise RtecError(f"no process could be started that works on it: {e!r}; is there enough memory?") from e
            finally:
                there.close()
            loop.add_reader(here.fileno(), self._arrived, here)
            result: R = await self._ended
            return result
        finally:
            loop.remove_reader(here.fileno())
            if self._process.is_alive():
                self._process.kill()
            if self._reading is not None:
                await self._reading  # the pipe is read in a thread, which ends with the process
            here.close()

    def cancel(self) -> None:
        """End the process."""
        if self._ended is not None and not self._ended.done():
            self._ended.set_exception(Cancelled(self.title))

    def _arrived(self, pipe: "Connection[Any, Any]") -> None:
        loop = asyncio.get_running_loop()
        loop.remove_reader(pipe.fileno())
        self._reading = loop.create_task(self._read(pipe))

    async def _read(self, pipe: "Connection[Any, Any]") -> None:
        """Take one message. A thread reads it, as a result may be large, and may need modules that are not loaded."""
        try:
            self._take(pipe, *await asyncio.to_thread(pipe.recv))
            if self._ended is not None and not self._ended.done():
                asyncio.get_running_loop().add_reader(pipe.fileno(), self._arrived, pipe)
        except (EOFError, OSError):
            self._fail("the process that worked on it ended; is there enough memory?")
        except Exception as e:  # noqa: BLE001 - else the page would wait for ever
            self._fail(fault(e))

    def _fail(self, why: str) -> None:
        if self._ended is not None and not self._ended.done():
            self._ended.set_exception(RtecError(why))

    def _take(self, pipe: "Connection[Any, Any]", kind: str, content: Any) -> None:
        if self._ended is None or self._ended.done():
            return
        if kind == "stage":
            self.what, self.done, self.total = content
            self._changed()
        elif kind == "ask" and self._asked is not None:
            self.what, self.done, self.total = "waiting for your answer", 0, 0
            self._changed()
            self._asked(content).add_done_callback(lambda answer: self._answer(pipe, answer))
        elif kind == "done":
            self._ended.set_result(content)
        else:
            self._fail(content)

    def _answer(self, pipe: "Connection[Any, Any]", answer: "asyncio.Future[Any]") -> None:
        if self._ended is not None and not self._ended.done() and not answer.cancelled():
            pipe.send(answer.result())
