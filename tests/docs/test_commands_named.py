"""Every command that README and pages name in running text exists, with the options that stand beside it."""

import re
from pathlib import Path

import pytest

from tests.cli.test_examples import COMMANDS

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
GROUPS = {path[:k] for path in COMMANDS for k in range(1, len(path))}


def wrong(said: str) -> str:
    """What is wrong with the words behind `rtec`; "" where nothing is."""
    words = said.split()
    path: tuple[str, ...] = (words[0],)
    while path in GROUPS and len(words) > len(path) and re.fullmatch(r"[a-z][a-z-]*", words[len(path)]):
        path = (*path, words[len(path)])
    if path in GROUPS:
        return ""
    if path not in COMMANDS:
        return f"no command {' '.join(path)!r}"
    known = {o for p in COMMANDS[path].params for o in (*p.opts, *p.secondary_opts)} | {"--help", "-h"}
    unknown = [o for o in re.findall(r"(?<!\S)--[a-z][a-z-]*", said) if o not in known]
    return f"{' '.join(path)} has no option {unknown[0]}" if unknown else ""


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_what_a_page_names_is_there(page: Path) -> None:
    """Oracle: the commands' own declarations."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
    said = re.findall(r"`rtec ([a-z][^`]*)`", text)
    faults = [f"`rtec {' '.join(s.split())}`: {w}" for s in said if (w := wrong(" ".join(s.split())))]
    assert faults == []


def test_a_command_that_is_none_is_found() -> None:
    assert wrong("ctl off") == "no command 'ctl off'"
    assert wrong("fit --efects x") == "fit has no option --efects"
