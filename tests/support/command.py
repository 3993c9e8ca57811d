"""The command line in the test's own process: no start of an interpreter where no process is judged."""

import io
from contextlib import redirect_stderr, redirect_stdout
from subprocess import CompletedProcess

from rtec.cli.main import status


def here(*arguments: object) -> "CompletedProcess[str]":
    """Run one command; its exit status and what it wrote."""
    out, err = io.StringIO(), io.StringIO()
    words = [str(a) for a in arguments]
    with redirect_stdout(out), redirect_stderr(err):
        code = status(words)
    return CompletedProcess(words, code, out.getvalue(), err.getvalue())
