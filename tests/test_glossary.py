"""What people read uses the field's terms: help pages, texts in the code, README, docs. Oracle: the list of words."""

import ast
import functools
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.main import get_command

from rtec.cli.main import application

ROOT = Path(__file__).parents[1]
NOT: dict[str, str] = {
    r"\b(is|are|was|were) told\b": "is reported, is shown",
    r"\btold (as|by|apart)\b": "reported as; separated",
    r"\banew\b": "refitted, re-estimated, restarted, again",
    r"\b(is|are) left\b(?! out)|\bleft by the model\b|\bleft over\b": "residual",
    r"\bspeaks? up\b": "is also significant",
    r"\b(draws?|shuffles) of chance\b|\bput up with\b": "random draws under noise alone; accepted false-positive rate",
    r"\bgoes with it\b": "adding it removes … of the held-out mean square error",
    r"\bruns? (that (was|were) )?(left out|not used)\b|\bleft-out\b": "held-out runs",
    r"\b(cannot|can not|can't) tell\b|\btells? .{1,40} apart\b|\bare alike\b": "cannot be distinguished; separates",
    r"\border(s|ed)? a daemon about\b": "controls a running daemon",
    r"\bstands? (in|at|on|under|beside|behind|between|there|here|below|above|twice)\b": "is (in, at)",
    r"\bnumber that is open\b|\bstays? open\b": "is not determined by these data",
    r"\bkind sensors?\b|\bsensors are kind\b": "idealised sensors",
    r"\bspoil(t|ed)\b": "malformed",
    r"\bcr(y|ies) wolf\b": "false alarm",
    r"\bwhat it bought\b|\bbuys nothing\b": "the error before and after",
    r"\d[eE][+-]\d\d (µm|µrad)\b": "plain decimals",
}
TEXTS = sorted(
    p for p in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")] if "adr" not in p.parts
)
CODE = sorted([*(ROOT / "rtec").rglob("*.py"), *(ROOT / "drivers").rglob("*.py")])


def faults(text: str) -> list[str]:
    """What a text has of the words to avoid, each with the word to use."""
    flat = " ".join(text.split())
    return [f"{m.group(0)!r}: {use}" for words, use in NOT.items() for m in re.finditer(words, flat, re.IGNORECASE)]


def literals(source: str) -> Iterator[str]:
    """Every text of a module but its docstrings: messages, headings, words of tables."""
    docs = set()
    for node in ast.walk(ast.parse(source)):  # a statement before what it consists of
        if isinstance(node, ast.Expr):
            docs.add(id(node.value))
        elif isinstance(node, ast.JoinedStr):
            yield "".join(str(v.value) if isinstance(v, ast.Constant) else "…" for v in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docs:
            yield node.value


def explanations(source: str) -> Iterator[tuple[int, str]]:
    """Every docstring of a module, those of constants too, and every comment; each with its line."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            yield node.lineno, node.value.value
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string


@functools.cache
def commands() -> dict[str, str]:
    """Help of every command, with those of its options, by name."""
    out = {}
    todo = [("rtec", get_command(application()))]
    while todo:
        name, command = todo.pop()
        options = [str(getattr(p, "help", "") or "") for p in command.params]
        out[name] = "\n".join([command.help or "", *options])
        todo += [(f"{name} {n}", c) for n, c in getattr(command, "commands", {}).items()]
    return out


@pytest.mark.parametrize("name", commands())
def test_help(name: str) -> None:
    """Oracle: the list; and the first line is a sentence that says what the command does."""
    text = commands()[name]
    assert not faults(text)
    first = text.split("\n\n")[0]
    assert re.match(r"[A-Z]\w*s\b|rtec makes", first), first
    assert len(first) < 130, first


@pytest.mark.parametrize("path", TEXTS, ids=lambda p: p.name)
def test_docs(path: Path) -> None:
    """Oracle: the list."""
    assert not faults(path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("folder", sorted({p.relative_to(ROOT).parts[:2] for p in CODE}), ids="/".join)
def test_texts_in_the_code(folder: tuple[str, ...]) -> None:
    """Oracle: the list."""
    own = [p for p in CODE if p.relative_to(ROOT).parts[:2] == folder]
    found = [(str(p), f) for p in own for text in literals(p.read_text(encoding="utf-8")) for f in faults(text)]
    assert not found


@pytest.mark.parametrize("folder", sorted({p.relative_to(ROOT).parts[:2] for p in CODE}), ids="/".join)
def test_docstrings_and_comments(folder: tuple[str, ...]) -> None:
    """Oracle: the list."""
    own = [p for p in CODE if p.relative_to(ROOT).parts[:2] == folder]
    found = [
        f"{p.relative_to(ROOT)}:{line}: {fault}"
        for p in own
        for line, text in explanations(p.read_text(encoding="utf-8"))
        for fault in faults(text)
    ]
    assert not found
