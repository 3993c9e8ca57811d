"""How the commands print: folded between words, as wide as COLUMNS, brief or full; oracles: the texts themselves."""

from typing import Any

import pytest

from rtec.cli.common import print_table, show, show_page
from rtec.cli.screen import Console
from rtec.report.page import Page, Section, Table
from rtec.result import Result

WIDE = Table(
    ("effect", "numbers", "what would show it"),
    [["axis_expansion_nonuniform(EXX, X, T_x_nut)", "0.123 ± 0.045 µm/(m·K)", "measure with spindle_drift, tool_tip"]],
    words=(0, 1, 2),
)
PAGE = Page(
    "Title",
    "The verdict is a sentence that is longer than forty columns are wide.",
    [],
    [Section("All", ["Everything else."], WIDE)],
    brief=Section("", [], Table(("what", "µm"), [["residual", "1.62"]])),
    next=["rtec diagnose model.toml laser-x.csv"],
)


@pytest.mark.parametrize("columns", [12, 40, 80, 200])
def test_no_word_is_broken_in_two(
    columns: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Oracle: the words that went in; lines are longer than asked only where one word is."""
    monkeypatch.setenv("COLUMNS", str(columns))
    show_page(PAGE, full=False)
    printed = capsys.readouterr().out
    shown = f"{PAGE.lead} residual 1.62"
    assert set(shown.split()) <= set(printed.split())
    longest = max(map(len, shown.split())) + 4
    assert max(map(len, printed.splitlines())) <= max(columns, longest)


@pytest.mark.parametrize("columns", [20, 40, 60, 80, 120])
def test_no_word_of_a_table_is_broken_in_two(columns: int) -> None:
    """Oracle: the words of the cells; columns that do not fit beside each other become a list."""
    console = Console(width=columns)
    with console.capture() as shown:
        print_table(WIDE, console)
    printed = shown.get()
    assert set(" ".join(WIDE.rows[0]).split()) <= set(printed.split())
    listed = "\n  numbers: " in printed
    assert listed == (columns <= 40)
    longest = max(len(word) for cell in WIDE.rows[0] for word in cell.split())
    assert max(map(len, printed.splitlines())) <= max(columns, longest + 4)


class Paged(Result):
    def page(self, figures: bool = True) -> Page:  # noqa: ARG002 - as every result
        return PAGE

    def facts(self) -> dict[str, Any]:
        return {}


def test_brief_and_full(capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the verdict and the next command in both; one short table, or all."""
    show(Paged(), as_json=False, full=False)
    brief = capsys.readouterr().out
    show(Paged(), as_json=False, full=True)
    full = capsys.readouterr().out
    for shown in (brief, full):
        assert PAGE.lead in shown
        assert "Next: rtec diagnose model.toml laser-x.csv\n" in shown
    assert "1.62" in brief
    assert "Everything else." not in brief
    assert "Everything else." in full
    assert "--full" in brief


@pytest.mark.parametrize(("names", "columns"), [(("laser-x", "beside"), 80), (("a", "b", "c"), 60)])
def test_a_wide_table_of_few_rows_is_turned(names: tuple[str, ...], columns: int) -> None:
    """Oracle: every number of the table, in the column under its name; the lines that a screen has room for."""
    head = ("measurement", "readings", "root mean square", *(f"quantity{k}_without_blanks" for k in range(5)))
    table = Table(head, [[name, *(f"{k}.{name}" for k in range(7))] for name in names])
    console = Console(width=columns)
    with console.capture() as shown:
        print_table(table, console)
    lines = [line.split() for line in shown.get().splitlines() if line.strip() and "─" not in line]
    assert lines[0] == ["measurement", *names]
    assert [line[-len(names) :] for line in lines[1:]] == [[f"{k}.{n}" for n in names] for k in range(7)]
    assert max(map(len, shown.get().splitlines())) <= columns


def test_columns_come_nearer_before_a_table_is_turned() -> None:
    """Oracle: six columns of ten characters and five times two blanks, with the edges 76; three blanks need 79."""
    table = Table(["column_001"] * 6, [["1.000"] * 6] * 20)
    for columns in (78, 81):
        console = Console(width=columns)
        with console.capture() as shown:
            print_table(table, console)
        assert sum("1.000" in line for line in shown.get().splitlines()) == 20
        assert max(map(len, shown.get().splitlines())) <= columns


@pytest.mark.parametrize("columns", range(12, 40))
def test_a_number_stays_with_its_unit(
    columns: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Oracle: no line begins with a unit."""
    monkeypatch.setenv("COLUMNS", str(columns))
    show_page(Page("", "It is 88 % of 1.2 µm or 3 µm/m over 5 mm at 20 °C in 8 h, and 3 holes.", [], []))
    starts = {line.split()[0] for line in capsys.readouterr().out.splitlines() if line.strip()}
    assert not starts & {"%", "µm", "µm/m", "mm", "°C", "h,"}
