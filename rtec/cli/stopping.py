"""What is said when somebody stops a command with Ctrl-C."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def told_when_stopped(state: Callable[[], str] = lambda: "nothing was written") -> Iterator[None]:
    """Say one line on standard error when the work inside is interrupted; the interruption goes on.

    Args:
        state: gives what has been written by then, in words.
    """
    try:
        yield
    except KeyboardInterrupt:
        import typer

        typer.echo(f"rtec: stopped; {state()}", err=True)
        raise


def kept(target: Path, done: list[str]) -> str:
    """What a model file holds, in words; `done` has "refit" or "step" for each time it was written."""
    steps = done.count("step")
    parts = ["the refit"] * ("refit" in done) + [f"{steps} step{'s' if steps > 1 else ''}"] * (steps > 0)
    return f"{target} holds {' and '.join(parts)}" if parts else "nothing was written"
