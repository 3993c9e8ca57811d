"""How the commands print: folded between words, as wide as COLUMNS, brief or full; oracles: the texts themselves."""

import pytest

from rtec.cli.common import give, print_table, show_page
from rtec.cli.screen import Console
from rtec.report.page import Page, Section, Table

WORDS = ("bi-directional", "axis_expansion_nonuniform(EXX,", "X,", "T_x_nut)", "0.123")
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


def test_brief_and_full(capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the verdict and the next command in both; one short table, or all."""
    give(lambda _: PAGE, {}, as_json=False, full=False)
    brief = capsys.readouterr().out
    give(lambda _: PAGE, {}, as_json=False, full=True)
    full = capsys.readouterr().out
    for shown in (brief, full):
        assert PAGE.lead in shown
        assert "Next: rtec diagnose model.toml laser-x.csv\n" in shown
    assert "1.62" in brief
    assert "Everything else." not in brief
    assert "Everything else." in full
    assert "--full" in brief
