"""Help pages: usage, description, examples to copy, then every option with its value, meaning and default."""

import inspect
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from textwrap import wrap
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import typer
from typer.core import TyperCommand, TyperGroup

F = TypeVar("F", bound=Callable[..., Any])
WIDEST = 100
"""Largest number of columns of a help page: longer lines are hard to read."""
LEFT = 30
"""Largest number of columns of a name with its value; the explanation of a longer one begins on the next line."""
Row = tuple[str, str]


class Command(TyperCommand):
    """A command whose help page is `page_lines`, and that says so when Ctrl-C ends it."""

    def invoke(self, ctx: Any) -> Any:
        """Carry it out; typer's hook for it."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as e:
            if not e.args:  # `interruptible` has said more
                typer.echo("rtec: stopped", err=True)
            raise

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """The arguments after the name of the command."""
        return usage(parameters(self, ctx))

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the page; typer's hook for it, whose formatter is not used."""
        del formatter
        _print(self, ctx)


class Group(TyperGroup):
    """A group of commands whose help page is `page_lines`."""

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """The arguments after the name of the group."""
        del ctx
        return ["COMMAND", "..."]

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the page; typer's hook for it, whose formatter is not used."""
        del formatter
        _print(self, ctx)


class App(typer.Typer):
    """A group of commands, with these help pages.

    Args:
        cls: class of the group.
        more: further arguments of `typer.Typer`.
    """

    def __init__(self, *, cls: type[TyperGroup] = Group, **more: Any) -> None:
        super().__init__(cls=cls, no_args_is_help=True, **more)

    def command(
        self, name: str | None = None, *, cls: type[TyperCommand] | None = Command, **more: Any
    ) -> Callable[[F], F]:
        """Add a function as a command; `more` are further arguments of `typer.Typer.command`."""
        return super().command(name, cls=cls, **more)


@dataclass(frozen=True, slots=True)
class HelpParameter:
    """An argument or option as a help page shows it.

    Args:
        names: long names of an option, or the name of an argument.
        short: names of one letter.
        value: name of an option's value; empty for a switch.
        meaning: description; in brackets its default, its limits, and whether it is required.
        option: whether it is an option, not an argument.
        required: whether it is required.
    """

    names: str
    short: str
    value: str
    meaning: str
    option: bool
    required: bool


def parameters(command: Any, ctx: Any) -> list[HelpParameter]:
    """Arguments and options of a command, in its order, with `--help`; versions of typer differ in their types.

    Args:
        command: a command of typer.
        ctx: its context.
    """
    hints = get_type_hints(command.callback, include_extras=True) if command.callback else {}
    shown = [p for p in command.get_params(ctx) if not getattr(p, "hidden", False)]
    return [_parameter(p, hints.get(p.name)) for p in shown]


def _parameter(param: Any, hint: Any) -> HelpParameter:
    kind, *info = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    limits = _limits(getattr(info[0], "min", None), getattr(info[0], "max", None)) if info else ""
    option = param.param_type_name == "option"
    notes = [f"default: {default}"] if (default := _default(param)) else []
    notes += [limits] if limits else []
    notes += ["required"] if param.required and option else []
    text = (param.help or "").replace("`", "")
    declared = (*param.opts, *param.secondary_opts)
    names = [name for name in declared if name.startswith("--")] if option else [_argument(param)]
    return HelpParameter(
        ", ".join(names),
        ", ".join(name for name in declared if option and not name.startswith("--")),
        _value(param, kind) if option else "",
        f"{text} [{'; '.join(notes)}]" if notes else text,
        option,
        param.required,
    )


def _argument(param: Any) -> str:
    name = str(param.metavar or param.name.upper()).strip("[]")
    return name if param.nargs == 1 or name.endswith("...") else f"{name}..."


def _value(param: Any, kind: Any) -> str:
    """Name of an option's value: as declared, its choices, by its type, or the option's name."""
    if param.is_flag or kind is None:
        return ""
    inner = next((k for k in get_args(kind) if k is not type(None)), kind) if not _choices(kind) else kind
    by_kind = {int: "N", float: "NUMBER", Path: "FILE"}
    name = max((o for o in param.opts), key=len).strip("-").upper()
    return str(param.metavar or "|".join(_choices(inner)) or by_kind.get(inner) or name)


def _choices(kind: Any) -> list[str]:
    if isinstance(kind, type) and issubclass(kind, Enum):
        return [str(c.value) for c in kind]
    return [str(c) for c in get_args(kind)] if get_origin(kind) is Literal else []


def _default(param: Any) -> str:
    """A default as the user would type it, or in the words of its declaration; empty where there is none."""
    if isinstance(param.show_default, str):
        return str(param.show_default)
    value = getattr(param.default, "value", param.default)
    if not param.show_default or callable(value) or value in (None, False, "", ()):
        return ""
    if value is True:
        return str(param.opts[0]) if param.secondary_opts else ""
    return f"{value:g}" if isinstance(value, float) else str(value)


def _limits(low: float | None, high: float | None) -> str:
    """`0.1 to 3600`; empty for a lower limit alone or an upper one of a million, which only exclude nonsense."""
    return "" if low is None or high is None or high >= 1e6 else f"{low:g} to {high:g}"


def usage(params: Sequence[HelpParameter]) -> list[str]:
    """Words of the usage line: arguments, required options, and `[OPTIONS]` for others.

    Args:
        params: arguments and options of a command.
    """
    arguments = [p.names if p.required else f"[{p.names}]" for p in params if not p.option]
    required = [f"{p.names} {p.value}" for p in params if p.option and p.required]
    return [*arguments, *required, "[OPTIONS]"]


def _print(command: Any, ctx: Any) -> None:
    from rich.text import Text

    from rtec.cli.screen import Console

    page = Text()
    for line, style, first in page_lines(command, ctx, min(shutil.get_terminal_size().columns, WIDEST)):
        page.append(line[:first], style)
        page.append(line[first:] + "\n")
    Console(highlight=False).print(page, soft_wrap=True, end="")


def page_lines(command: Any, ctx: Any, width: int) -> Iterator[tuple[str, str, int]]:
    """The lines of a help page, each with a style and the number of characters that have it.

    Args:
        command: a command of typer.
        ctx: its context.
        width: columns.
    """
    pieces = " ".join(command.collect_usage_pieces(ctx))
    for line in wrap(f"Usage: {ctx.command_path} {pieces}", width, subsequent_indent="  ", break_long_words=False):
        yield line, "bold", len(line)
    described, examples, details = paragraphs(command.help or "")
    yield from _prose(described, width)
    if examples:
        yield from _heading("Examples" if len(examples) > 1 else "Example")
    for when, example in examples:
        if when:
            yield f"  # {when}", "dim", width
        yield from ((f"  {line}", "", 0) for line in continued(example, width - 4))
    yield from _prose(details, width)
    for title, rows in _parts(command, ctx):
        yield from _heading(title)
        yield from _table(rows, width)


def _prose(texts: Sequence[str], width: int) -> Iterator[tuple[str, str, int]]:
    for text in texts:
        yield "", "", 0
        yield from ((line, "", 0) for line in _wrapped(text, width))


def _heading(title: str) -> Iterator[tuple[str, str, int]]:
    yield "", "", 0
    yield title, "bold", len(title)


def _table(rows: Sequence[Row], width: int) -> Iterator[tuple[str, str, int]]:
    """Rows of name and explanation; a name that is too long has a line of its own."""
    left = max((len(name) for name, _ in rows if len(name) <= LEFT), default=LEFT) + 4
    for name, text in rows:
        lines = _wrapped(text, width - left) or [""]
        if len(name) + 4 > left:
            yield f"  {name}", "cyan", width
        else:
            yield (f"  {name}".ljust(left) + lines.pop(0)).rstrip(), "cyan", left
        yield from ((" " * left + line, "", 0) for line in lines)


def _wrapped(text: str, width: int) -> list[str]:
    return wrap(text, width, break_long_words=False, break_on_hyphens=False)


def paragraphs(text: str) -> tuple[list[str], list[Row], list[str]]:
    """Description, examples (use, and command), and details of a help text.

    Args:
        text: a docstring: an example is a paragraph in backticks, after `Example:` or `Example, …:` or alone.
    """
    described: list[str] = []
    examples: list[Row] = []
    details: list[str] = []
    for paragraph in (" ".join(p.split()) for p in re.split(r"\n\s*\n", inspect.cleandoc(text)) if p.strip()):
        if match := re.fullmatch(r"Examples?(?:,? ([^`]*?))?: `([^`]*)`|`(rtec [^`]*)`", paragraph):
            examples.append((match[1] or "", match[2] or match[3]))
        else:
            (details if examples else described).append(paragraph.replace("`", ""))
    return described, examples, details


def continued(command: str, width: int) -> list[str]:
    r"""A command in lines of at most `width` columns that a shell reads as one: each but the last ends with `\`.

    Args:
        command: the command; a text in quotes is not broken, nor an option and its value.
        width: columns of a line without ` \`.
    """
    lines = [""]
    for word in re.findall(r"""(?:--?[a-z][\w-]*\s+(?!-))?(?:[^\s"']|"[^"]*"|'[^']*')+""", command):
        if lines[-1] and len(lines[-1]) + 1 + len(word) > width:
            lines.append(f"  {word}")
        else:
            lines[-1] += f" {word}" if lines[-1] else word
    return [*(f"{line} \\" for line in lines[:-1]), lines[-1]]


def _parts(command: Any, ctx: Any) -> Iterator[tuple[str, list[Row]]]:
    """The tables of a page: commands of a group by purpose, arguments, options."""
    panels: dict[str, list[Row]] = {}
    for name, inner in getattr(command, "commands", {}).items():
        panel = getattr(inner, "rich_help_panel", None)
        first = (paragraphs(inner.help or "")[0] or [""])[0]
        panels.setdefault(panel if isinstance(panel, str) else "Commands", []).append((name, first))
    widest = max((len(name) for rows in panels.values() for name, _ in rows), default=0)
    yield from ((title, [(name.ljust(widest), text) for name, text in rows]) for title, rows in panels.items())
    params = parameters(command, ctx)
    if arguments := [(p.names, p.meaning) for p in params if not p.option]:
        yield "Arguments", arguments
    options = [p for p in params if p.option]
    before = max(len(p.short) for p in options)
    if options:
        yield "Options", [(_first_column(p, before), p.meaning) for p in options]


def _first_column(option: HelpParameter, before: int) -> str:
    """First column of an option, `-o, --out MODEL`, indented by `before` where it has no short name."""
    short = f"{option.short}, " if option.short else " " * (before + 2 if before else 0)
    return f"{short}{option.names} {option.value}".rstrip()
