"""Every command that a page shows runs as it is printed, or the block says that it is not to be run.

The fence says which: `bash` is run here, the blocks of a page in order, in a folder that only `rtec init --example`
has filled; `sh` is run by the page's own test; `text` is output, or commands for files and devices of the reader's.
Oracle: exit status 0, and for a block of `text` right below a block of commands the output itself.
"""

import re
import shlex
from pathlib import Path

import pytest

from tests.tutorial.tutorial import run

ROOT = Path(__file__).parents[2]
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")])
FENCE = re.compile(r"^ *```([\w-]*)\n(.*?)^ *```$", re.MULTILINE | re.DOTALL)
KINDS = {"bash", "sh", "text", "toml", "json", "python", "py", "ini", "hal"}
OWN = {
    "tutorial.md": "tests/tutorial/test_tutorial.py",
    "campaign.md": "tests/tutorial/campaign.py",
    "write-an-effect.md": "tests/effects/test_write_an_effect.py",
}
"""Pages whose `sh` blocks another test runs."""
ELSEWHERE = {"rtec demo": "tests/demo/test_demo.py"}
"""Commands that take long, and the test that runs them."""


def fences(page: Path) -> list[tuple[str, str]]:
    """Kind and text of every fenced block."""
    return FENCE.findall(page.read_text(encoding="utf-8"))


def commands(text: str) -> list[str]:
    """The commands of a block, continued lines joined."""
    lines = text.replace("\\\n", " ").splitlines()
    return [shlex.join(shlex.split(line, comments=True)) for line in lines]


def plain(text: str) -> str:
    """Without digits and line ends: what a machine's linear algebra may change, and the width of a terminal."""
    return re.sub(r"\d+", "#", " ".join(text.split()))


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_every_block_says_what_it_is(page: Path) -> None:
    """Oracle: the kinds above, and the tests that run what is not run here."""
    for kind, text in fences(page):
        assert kind in KINDS, f"{page.name}: ```{kind}: {text[:60]}"
        assert kind != "sh" or page.name in OWN, f"{page.name}: no test runs its ```sh"
    for other in (*OWN.values(), *ELSEWHERE.values()):
        assert (ROOT / other).is_file()


@pytest.mark.parametrize("page", [p for p in PAGES if any(k == "bash" for k, _ in fences(p))], ids=lambda p: p.name)
def test_every_command_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Oracle: exit status; a block of text right below a block of commands is what its commands print."""
    monkeypatch.setenv("COLUMNS", "120")  # as wide as the pages
    assert run("rtec init --example", tmp_path)
    printed, blocks = "", fences(page)
    for k, (kind, text) in enumerate(blocks):
        if kind == "bash":
            wanted = [c for c in commands(text) if c not in ELSEWHERE]
            assert all(c.startswith("rtec ") for c in wanted), text
            printed = "".join(run(c, tmp_path) for c in wanted)
        elif kind == "text" and k and blocks[k - 1][0] == "bash" and f"```\n\n```text\n{text}" in page.read_text():
            assert plain(text) in plain(printed), text
