"""Work in a process of its own. Oracles: what the task returns, raises, asks; and the process table."""

import asyncio
import os
import signal
import threading
from collections.abc import Awaitable, Callable
from multiprocessing.context import ForkServerProcess
from typing import Any

import pytest

from rtec.errors import RtecError
from rtec.tasks import jobs
from rtec.tasks.jobs import Cancelled, Job, Reporter, _work

pytestmark = pytest.mark.xdist_group("others")


@pytest.fixture(autouse=True)
def _nothing_is_loaded_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """This work needs nothing of rtec's."""
    monkeypatch.setattr(jobs, "PRELOAD", list[str]())


def _double(line: Reporter, value: int) -> int:
    line.stage("half way", 1, 2)
    return 2 * value


def _asks(line: Reporter) -> str:
    return f"answered {line.ask('how many?')}"


def _refuses(_: Reporter) -> None:
    raise RtecError("laser.csv: line 3: no number")


def _breaks(_: Reporter) -> None:
    raise ZeroDivisionError("by zero")


def _unreadable() -> None:
    raise LookupError("read in the studio")


class _Unreadable:
    def __reduce__(self) -> Any:
        return _unreadable, ()


def _gives_what_cannot_be_read(_: Reporter) -> _Unreadable:
    return _Unreadable()


def _ends(_: Reporter) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _waits(line: Reporter) -> None:
    line.stage(str(os.getpid()), 0, 0)
    threading.Event().wait()


def _run(work: Callable[[], Awaitable[Any]]) -> Any:
    async def main() -> Any:
        return await work()

    return asyncio.run(main())


def test_work_reports_and_gives_its_result() -> None:
    """The stage is seen before the end."""
    seen: list[tuple[str, int, int]] = []
    job = Job("doubling", lambda: seen.append((job.what, job.done, job.total)))
    assert _run(lambda: job.run(_double, 21)) == 42
    assert seen == [("half way", 1, 2)]


def test_work_asks_and_gets_an_answer() -> None:
    """The question arrives, the answer goes back."""

    def answered(question: Any) -> asyncio.Future[Any]:
        made: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
        made.set_result(7 if question == "how many?" else 0)
        return made

    assert _run(lambda: Job("asking", lambda: None, answered).run(_asks)) == "answered 7"


@pytest.mark.parametrize(
    ("task", "said"),
    [(_refuses, "line 3: no number"), (_breaks, "a fault of rtec itself: ZeroDivisionError"), (_ends, "process")],
)
def test_what_goes_wrong_is_one_error_with_a_sentence(task: Callable[[Reporter], None], said: str) -> None:
    """An error of the input as it is; a fault of ours, and a process that was killed, in words."""
    with pytest.raises(RtecError, match=said):
        _run(lambda: Job("failing", lambda: None).run(task))


class _WhereItIsRead:
    def __reduce__(self) -> Any:
        return threading.get_ident, ()


def _gives_where_it_is_read(_: Reporter) -> _WhereItIsRead:
    return _WhereItIsRead()


def test_a_result_is_read_beside_the_pages() -> None:
    """A large one, or one whose modules must be loaded first, would stop them. Oracle: the thread of the pages."""
    assert _run(lambda: Job("reading", lambda: None).run(_gives_where_it_is_read)) != threading.get_ident()


def test_a_result_that_cannot_be_read_is_one_error_too() -> None:
    """Nobody would hear of it, and the page would wait for ever. So it is with a page that cannot show a question."""
    with pytest.raises(RtecError, match="a fault of rtec itself: LookupError"):
        _run(lambda: Job("reading", lambda: None).run(_gives_what_cannot_be_read))

    def not_shown(_: Any) -> Any:
        raise LookupError("no page")

    with pytest.raises(RtecError, match="a fault of rtec itself: LookupError"):
        _run(lambda: Job("asking", lambda: None, not_shown).run(_asks))


def test_a_process_that_cannot_be_started_is_one_error_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """As where there is no memory for one."""

    def no_more(_: Any) -> None:
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(ForkServerProcess, "start", no_more)
    with pytest.raises(RtecError, match="no process could be started"):
        _run(lambda: Job("starting", lambda: None).run(_double, 1))


def test_cancelled_work_ends_at_once_and_its_process_is_gone() -> None:
    """Oracle: the process table."""
    job = Job("waiting", lambda: job.cancel())  # noqa: PLW0108 - it is made by the same line
    with pytest.raises(Cancelled):
        _run(lambda: job.run(_waits))
    process = job._process
    assert process is not None
    process.join(10)
    assert not process.is_alive()


class _StudioThatEnded:
    """The end of a pipe whose other end is gone once something was asked."""

    def send(self, _: object) -> None: ...

    def recv(self) -> object:
        raise EOFError


def test_a_studio_that_ends_while_work_asks_is_no_fault_of_the_work(capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: nothing on the terminal, where a traceback stood."""
    pipe: Any = _StudioThatEnded()
    _work(pipe, _asks, ())
    assert capsys.readouterr().err == ""
