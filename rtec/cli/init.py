"""`rtec init`: the first files of a machine, from questions, from an answers file, or the shipped example."""

import sys
import tomllib
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from shlex import join, quote
from typing import Annotated, Any

import typer

from rtec.cli.common import bar, grid, interruptible

ANSWERS = "answers.toml"
STEP_UM = 20.0
"""Step of a sign check."""
SHOWN = 12
"""Largest number of lines of live values."""


def init(
    folder: Annotated[Path, typer.Argument(metavar="[FOLDER]", help="Where the files go.")] = Path(),
    example: Annotated[
        bool, typer.Option("--example", help="Copy the shipped example: simulated machine, model, tutorial.")
    ] = False,
    answers: Annotated[
        Path | None, typer.Option("--answers", help="Take the answers from this file; ask nothing.", show_default=False)
    ] = None,
    template: Annotated[
        str | None,
        typer.Option("--template", help="lathe, mill, bridge or axis; alone: without devices.", show_default=False),
    ] = None,
    options: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="One answer, over the file's: axis.X.resolution_um=0.1"),
    ] = None,
    print_answers: Annotated[
        bool, typer.Option("--print-answers", help="Print an answers file to fill in; write nothing.")
    ] = False,
    check: Annotated[bool, typer.Option("--check/--no-check", help="End with doctor and dry run.")] = True,
    seconds: Annotated[
        float, typer.Option("--seconds", min=0.1, max=600, help="How long live values are shown.")
    ] = 5.0,
    force: Annotated[bool, typer.Option("--force", help="Replace files that are there already.")] = False,
    controller: Annotated[
        str | None,
        typer.Option(
            "--controller",
            metavar="NAME",
            help="linuxcnc: FOLDER is your INI file; its folder is copied and the copy's HAL files changed.",
            show_default=False,
        ),
    ] = None,
    copy: Annotated[
        Path | None,
        typer.Option(
            "--copy", metavar="FOLDER", help="Folder of that copy.", show_default="beside it, -rtec behind its name"
        ),
    ] = None,
) -> None:
    """Writes the first files of a machine: machine.toml, run.toml, an empty model.toml.

    Example, answer its questions; the files go to the folder lathe: `rtec init lathe`

    Example, copy a simulated turning centre into the folder configs: `rtec init --example`

    Example, only measure for the time being, no devices: `rtec init lathe --template lathe`

    Example, print an answers file to fill in: `rtec init --template lathe --print-answers`

    Example, ask nothing: `rtec init lathe --answers lathe-answers.toml --set axis.X.resolution_um=0.5`

    Example, for a machine that LinuxCNC runs: `rtec init --controller linuxcnc my-mill/my-mill.ini`

    Without options it asks: axes, encoders, sensors, output, limits. It shows live values, and ends with doctor and dry
    run: exit status 1 if they fail, the files stay. Ctrl-C leaves nothing behind.
    """
    from rtec.errors import ConfigError

    if example:
        _example(folder, force)
        return
    if controller is not None:
        _adopt(controller, folder, copy, answers, options or [])
        return
    if print_answers:
        _print_answers(template or "lathe")
        return
    asks = answers is None and template is None and not options
    if asks and not sys.stdin.isatty():
        raise ConfigError(
            "rtec init: no terminal to ask at; give --answers FILE, --template lathe, or --example "
            "(`rtec init --template lathe --print-answers` prints a file to fill in)"
        )
    if asks and not force:
        _refuse_to_replace(folder)
    with interruptible():
        tables, source = _ask_user(seconds, folder) if asks else _scanned(*_given(answers, template, options or []))
        written = _write(tables, source, folder, force, keep_answers=asks)
    for path in written:
        typer.echo(f"Written: {path}")
    run = next((path for path in written if path.name == "run.toml"), None)
    if run is None:
        _measure_first(folder)
        return
    if check and _ready(run):
        typer.echo(f"Next: {_first_run(run)}")
        return
    typer.echo(f"Next: {join(['rtec', 'doctor', str(run)])}")
    if check:
        raise typer.Exit(1)


def _measure_first(folder: Path) -> None:
    """What to do with a machine that has no devices yet."""
    machine = folder / "machine.toml"
    typer.echo(f"No devices, so no run.toml. Check travel, tool and sensors in {machine}.")
    typer.echo(f"Next: {join(['rtec', 'import', 'FILE', '--machine', str(machine), '-o', 'NAME'])}")
    typer.echo(f"Devices later: rtec init {quote(str(folder))} --force asks again; --answers FILE asks nothing.")


def _refuse_to_replace(folder: Path) -> None:
    """Refuse to replace existing files before the first question, not after the last one."""
    from rtec.commission.write import MACHINE, MODEL, RUN
    from rtec.errors import ConfigError

    there = [str(folder / name) for name in (MACHINE, RUN, MODEL, ANSWERS) if (folder / name).exists()]
    if there:
        raise ConfigError(f"{', '.join(there)}: already there; name another FOLDER, or --force replaces")


def _example(folder: Path, force: bool) -> None:
    from rtec.commission.example import FOLDER, write_example
    from rtec.wording import counted

    files = write_example(folder, overwrite=force)
    at = folder / FOLDER
    typer.echo(f"{counted(len(files), 'file')} in {at}: a simulated turning centre, its model, the tutorial's data.")
    go_there = f"cd {quote(str(folder))} && " if folder != Path() else ""
    for command in ("rtec run configs/turning-centre-sim.toml --duration 10", "rtec demo"):
        typer.echo(f"Next: {go_there}{command}")


def _adopt(controller: str, ini: Path, copy: Path | None, answers: Path | None, options: list[str]) -> None:
    """Copy and change a controller's own files, and write rtec's files beside them."""
    import shutil

    from rtec.commission.answers import answers_from, with_answers
    from rtec.commission.write import check
    from rtec.errors import ConfigError
    from rtec.loop.devices import driver_class

    kind = driver_class(controller, "--controller")
    if not hasattr(kind, "adopt"):
        raise ConfigError(f"--controller {controller}: this driver changes no files of a controller; linuxcnc does")
    adopted = kind.adopt(ini)
    given, _ = _given(answers, None, options)
    tables = with_answers(adopted.answers, given)
    if tables["sensors"] and "temperatures" not in tables["role"]:
        tables["role"]["temperatures"] = [tables["role"]["counts"]]
    folder = copy or ini.resolve().parent.with_name(f"{ini.resolve().parent.name}-rtec")
    check(answers_from(tables, str(ini)), folder)
    with interruptible():
        difference = adopted.copy(folder, list(tables["sensors"]))
        try:
            written = _write(tables, str(ini), folder, force=False, keep_answers=False)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
    typer.echo(difference)
    typer.echo(
        f"Your files in {ini.parent} are as they were; the copy is {folder}. To go back, start LinuxCNC with yours."
    )
    for path in written:
        typer.echo(f"Written: {path}")
    for command in (["linuxcnc", folder / ini.name], ["rtec", "doctor", folder / "run.toml"]):
        typer.echo(f"Next: {join(map(str, command))}")


def _print_answers(template: str) -> None:
    from rtec.commission.write import answers_text

    typer.echo(answers_text(template))


def _given(answers: Path | None, template: str | None, options: list[str]) -> tuple[dict[str, Any], str]:
    """The answers of a file and of options."""
    from rtec.commission.answers import with_answers
    from rtec.errors import ConfigError
    from rtec.tomlfile import read_toml

    tables = read_toml(answers) if answers is not None else {}
    if template is not None:
        tables["template"] = template
    for option in options:
        key, equals, value = option.partition("=")
        text = f"{key} = {value}\n"
        try:
            given = tomllib.loads(text)
        except tomllib.TOMLDecodeError:
            try:
                given = tomllib.loads(f'{key} = "{value}"\n')  # the shell has removed the quotes of a text
            except tomllib.TOMLDecodeError as e:
                raise ConfigError(f"--set {option!r}: give KEY=VALUE as in the answers file: {e}") from e
        if not equals:
            raise ConfigError(f"--set {option!r}: give KEY=VALUE, as axis.X.resolution_um=0.1")
        tables = with_answers(tables, given)
    return tables, str(answers) if answers is not None else "rtec init"


def _scanned(tables: dict[str, Any], source: str) -> tuple[dict[str, Any], str]:
    """The answers, completed by a scan of the devices with `scan = true`."""
    from rtec.commission.scan import fill_in
    from rtec.loop.clock import RealClock

    return fill_in(tables, _Terminal(), RealClock(), source), source


class _Terminal:
    """Asks at the terminal."""

    def ask(self, question: str, default: str) -> str:
        return str(typer.prompt(question, default=default, show_default=True)).strip()

    def say(self, text: str) -> None:
        typer.echo(text)

    def progress(self, title: str) -> AbstractContextManager[Callable[[int, int], None]]:
        return bar(title)


def _ask_user(seconds: float, folder: Path) -> tuple[dict[str, Any], str]:
    """The user's answers at the terminal; names are exchanged where live values show it."""
    from rtec.commission.answers import answers_from
    from rtec.commission.ask import Interview, check_names
    from rtec.commission.scan import LiveSource, live, watch
    from rtec.commission.write import machine_of
    from rtec.errors import RtecError
    from rtec.loop.clock import RealClock

    talk, clock = _Terminal(), RealClock()

    def shown(source: LiveSource) -> dict[str, float]:
        with _Screen() as screen:
            return watch(source, clock, seconds, screen.show)

    interview = Interview(talk, clock, shown)
    tables = interview.tables()
    role = answers_from(tables, "answers").role
    if role is None:
        return tables, "answers"

    def watched() -> Mapping[str, float]:
        now = answers_from(tables, "answers")
        with live(machine_of(now), now.device, role, clock, folder.resolve()) as values:
            change = shown(values)
            for device, trouble in values.troubles.items():
                talk.say(f"{device}: {trouble}")
        return change

    talk.say("\nNow the devices are opened and read; nothing is commanded.")
    try:
        return check_names(talk, tables, watched, interview.sure), "answers"
    except RtecError as e:
        talk.say(f"{e}\nThe files are written all the same; rtec doctor says what to mend.")
        return tables, "answers"


class _Screen:
    """A live table of values and their changes."""

    def __enter__(self) -> "_Screen":
        from rich.live import Live

        from rtec.cli.screen import Console

        self._live = Live(console=Console(), refresh_per_second=5, transient=True)
        self._live.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._live.stop()

    def show(self, values: Mapping[str, float], change: Mapping[str, float]) -> None:
        from rtec.report.page import Table
        from rtec.wording import number

        names = list(values)
        if len(names) > SHOWN:  # with a whole bus, show the values that change most
            most = sorted(names, key=lambda name: -abs(change[name]))[:SHOWN]
            names = [name for name in names if name in most]
        rows = [(name, number(values[name], 3), number(change[name], 3, sign=True)) for name in names]
        self._live.update(grid(Table(("input", "now", "change"), rows)))


def _write(tables: dict[str, Any], source: str, folder: Path, force: bool, *, keep_answers: bool) -> list[Path]:
    import tomli_w

    from rtec.commission.answers import answers_from
    from rtec.commission.example import write_together
    from rtec.commission.write import check, texts

    answers = answers_from(tables, source)
    check(answers, folder)
    files = {Path(name): text for name, text in texts(answers).items()}
    if keep_answers:
        head = "# What rtec init was answered; `rtec init --answers answers.toml` writes the same files again.\n"
        files[Path(ANSWERS)] = head + tomli_w.dumps(tables)
    return write_together(folder, files, overwrite=force)


def _first_run(run: Path) -> str:
    """The command of the first run: a sign check of the first axis that is corrected, within its limit."""
    from rtec.loop.run_file import load_setup

    setup = load_setup(run)
    axis = next((a.name for a in setup.machine.axes if a.compensate), None)
    if setup.file.role.actuator is None or axis is None:
        return join(["rtec", "run", str(run)])
    step_um = min(STEP_UM, setup.file.limits[axis].stop_um)
    return join(["rtec", "run", str(run), "--step", f"{axis}={step_um:g}um"])


def _ready(run: Path) -> bool:
    """Whether doctor and dry run succeed."""
    from rtec.cli.common import show_page
    from rtec.cli.run import show_dry_run
    from rtec.daemon.dry_run import dry_run
    from rtec.doctor.devices import examine
    from rtec.errors import RtecError
    from rtec.loop.run_file import load_setup
    from rtec.report.devices import doctor_page

    typer.echo(f"\n{join(['rtec', 'doctor', str(run), '--no-pc'])}")
    found = examine(run, 3.0)
    show_page(doctor_page(found))
    typer.echo(join(["rtec", "run", str(run), "--dry-run"]))
    try:
        setup = load_setup(run)
        dry = dry_run(setup)
    except RtecError as e:
        typer.echo(f"rtec: {e}", err=True)
        return False
    show_dry_run(setup, dry)
    return found.well and not dry["reasons"] and not dry["troubles"]
