"""Help pages: of all commands at once. Oracle: a terminal of 80 columns, a shell, the declarations of the commands."""

import contextlib
import io
import re
import shlex
from functools import cache

import pytest
from typer.main import get_command

from rtec.cli.help import continued, paragraphs
from rtec.cli.main import application, status
from tests.cli.test_examples import leaves

pytestmark = pytest.mark.xdist_group("help")  # each page is rendered once

COMMANDS = dict(leaves(get_command(application())))
CODE_WORDS = re.compile(r"<\w|list\[|\brange\]|\b(bool|str|int|float)\b|x[<>]=|\w…")
"""What only a programmer would understand, and cells that were cut off."""


@cache
def rendered(command: tuple[str, ...]) -> str:
    out = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out):
        patch.setenv("COLUMNS", "80")
        assert status([*command, "--help"]) == 0
    return out.getvalue()


@pytest.fixture(params=list(COMMANDS), ids=" ".join)
def page(request: pytest.FixtureRequest) -> str:
    """The help page of each command on 80 columns."""
    return rendered(request.param)


def test_a_page_fits_80_columns_and_has_no_words_of_the_code(page: str) -> None:
    assert max(map(len, page.splitlines())) <= 80
    options = page.split("\nOptions\n")[1]
    assert not CODE_WORDS.findall(options)


def test_every_word_of_an_option_is_on_the_page_whole(page: str) -> None:
    """Oracle: the texts as declared; a column that is too narrow would break or cut them."""
    path = tuple(re.match(r"Usage: rtec ((?:[a-z0-9]+ )+)", page)[1].split())  # type: ignore[index]
    shown = " ".join(page.split())
    for param in COMMANDS[path].params:
        if not param.hidden:
            assert " ".join((param.help or "").replace("`", "").split()) in shown


def test_the_brackets_of_a_usage_line_come_in_pairs(page: str) -> None:
    usage = page.split("\n\n", maxsplit=1)[0]
    assert usage.count("[") == usage.count("]")


def test_an_example_is_copied_as_it_is(page: str) -> None:
    """Oracle: the shell's rules: a line that ends with a backslash goes on, quotes keep words together."""
    path = tuple(re.match(r"Usage: rtec ((?:[a-z0-9]+ )+)", page)[1].split())  # type: ignore[index]
    block = re.search(r"\nExamples?\n(.*?)\n\n", page, re.DOTALL)[1]  # type: ignore[index]
    copied = [shlex.split(line, comments=True) for line in block.replace("\\\n", "").splitlines()]
    declared = [shlex.split(command) for _, command in paragraphs(COMMANDS[path].help)[1]]
    assert declared
    assert [words for words in copied if words] == declared


def test_a_long_command_is_continued_between_its_words() -> None:
    """Oracle: by hand."""
    lines = continued('rtec add model.toml --expr "A*sin(2*pi*x/p + phi)" --json -o b.toml', 24)
    assert lines == ["rtec add model.toml \\", '  --expr "A*sin(2*pi*x/p + phi)" \\', "  --json -o b.toml"]
