"""`rtec`: assembles the commands, cleans their output, turns errors into one message and an exit status.

Exit status: 0 done; 1 a check or limit failed; 2 wrong use or bad input; 130 interrupted.
"""

import gc
import os
import signal
import sys
import threading
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from typing import Annotated, Any, TextIO, cast

import typer

from rtec.cli.help import App
from rtec.errors import RtecError
from rtec.text import clean_lines
from rtec.version import __version__


class _Shield:
    """A stream that cleans its text; rich recognises such a proxy and writes to the stream behind it."""

    def __init__(self, stream: TextIO) -> None:
        self.rich_proxied_file = stream

    def write(self, text: str) -> int:
        return self.rich_proxied_file.write(clean_lines(text))

    def __getattr__(self, name: str) -> Any:
        return getattr(self.rich_proxied_file, name)


@contextmanager
def shielded() -> Iterator[None]:
    """Context in which all text to standard output and error is cleaned."""
    out, err = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = cast(TextIO, _Shield(out)), cast(TextIO, _Shield(err))
    try:
        yield
    finally:
        sys.stdout, sys.stderr = out, err


COMMANDS: Mapping[str, Mapping[str, str]] = {
    "Try": {
        "demo": "demo.demo",
        "init": "init.init",
        "simulate": "simulate.simulate",
        "studio": "studio.studio",
        "hil": "hil.hil",
        "bench": "bench.app",
    },
    "Measure": {
        "import": "import_.import_",
        "plan": "measure.plan",
        "iso230": "measure.iso230",
        "straightness": "measure.straightness",
        "parallelism": "measure.parallelism",
        "drift": "measure.drift",
        "ballbar": "measure.ballbar",
        "grid": "measure.grid",
    },
    "Model": {
        "fit": "model.fit",
        "compare": "model.compare",
        "diagnose": "model.diagnose",
        "add": "model.add",
        "improve": "model.improve",
        "history": "model.history",
        "effects": "look_up.effects",
    },
    "Run": {
        "doctor": "doctor.doctor",
        "run": "run.run",
        "ctl": "control.app",
        "table": "table.app",
        "replay": "run.replay",
    },
    "Look": {
        "status": "control.status",
        "telemetry": "control.telemetry",
        "log": "log.app",
        "machine": "look_up.app",
        "drivers": "look_up.drivers",
        "explain": "look_up.explain",
    },
}
"""Every command of `rtec`, by purpose: its module in `rtec.cli`, and its name there. This table is the only list of
commands."""


def application(named: str = "") -> App:
    """`rtec` with one command, so that only its module is loaded; with all commands where none has that name."""
    app = App(
        name="rtec",
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
        help="""rtec makes machine tools more accurate than they were built.

It reads axis counts and temperatures, computes the tool-tip error from a geometric-thermal model, and corrects each
axis.

Start with `rtec demo`: a simulated machine, uncorrected and corrected.
""",
    )
    app.callback()(_main)
    known = any(named in commands for commands in COMMANDS.values())
    for group, commands in COMMANDS.items():
        for name, place in commands.items():
            if known and name != named:
                continue
            module, _, attribute = place.partition(".")
            command = getattr(import_module(f"rtec.cli.{module}"), attribute)
            if isinstance(command, typer.Typer):
                app.add_typer(command, name=name, rich_help_panel=group)
            else:
                app.command(name, rich_help_panel=group)(command)
    return app


# Depending on its version typer contains click or requires it; its own exceptions show which.
USAGE_ERROR: type[Exception] = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"rtec {__version__}")
        raise typer.Exit


def _main(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and end.")
    ] = False,
) -> None:
    del version


def main() -> None:
    """Run the command line and leave with its status."""
    program = sys.modules["__main__"]  # without a name, child processes do not import this module again
    program.__spec__ = program.__file__ = None
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy is imported, as in `rtec.parallel`
    gc.set_threshold(20_000, 20, 20)  # at Python's own, the search for garbage is a tenth of a command's start
    sys.unraisablehook = unraisable
    warnings.showwarning = _warned
    sys.exit(status(sys.argv[1:]))


def _warned(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """Print a warning in one line, without the place in the code."""
    del category, filename, lineno, file, line
    typer.echo(f"rtec: {message}", err=True)


def unraisable(what: "sys.UnraisableHookArgs") -> None:
    """Hook for exceptions that Python cannot raise, as in a destructor: repeats Ctrl-C, which would be lost there."""
    if what.exc_type is KeyboardInterrupt:
        hook_ended = threading.Event()
        threading.Thread(target=_interrupt, args=(hook_ended,), daemon=True).start()
        hook_ended.set()
    else:
        sys.__unraisablehook__(what)


def _interrupt(hook_ended: threading.Event) -> None:
    """Interrupt the main thread shortly after the hook has ended: inside it the interrupt would be lost again."""
    hook_ended.wait()
    threading.Event().wait(0.05)
    signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)


def status(arguments: list[str]) -> int:
    """Run one command; give its exit status."""
    with shielded():
        try:
            return _status(arguments)
        except BrokenPipeError:
            sys.stderr.close()  # the reader of the output has ended
            return 0


def _status(arguments: list[str]) -> int:
    try:
        code = application(next(iter(arguments), ""))(args=arguments, prog_name="rtec", standalone_mode=False)
    except RtecError as e:
        return _print_error(str(e))
    except USAGE_ERROR as e:
        return _wrong_use(e)
    except (KeyboardInterrupt, typer.Abort):
        return 130
    return code if isinstance(code, int) else 0


def _print_error(message: str) -> int:
    for line in message.splitlines():
        typer.echo(f"rtec: {line}", err=True)
    return 2


def _wrong_use(error: Exception) -> int:
    from typer import rich_utils

    if type(error).__name__ == "NoArgsIsHelpError":
        typer.echo(str(error))
    else:
        rich_utils.rich_format_error(error)  # type: ignore[arg-type]
    return int(getattr(error, "exit_code", 2))


if __name__ == "__main__":
    main()
