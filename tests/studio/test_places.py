"""What a page says of an answer, and where it says what went wrong. Oracle: the verdicts of the diagnosis."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args

import pytest

from rtec.diagnosis.result import Verdict
from rtec.studio.pages.diagnose import verdict
from rtec.studio.parts.session import blamed
from rtec.wording import odds


def _answer(name: str, *, out_of_date: bool = False, together: tuple[str, ...] = ()) -> Any:
    return SimpleNamespace(verdict=name, out_of_date=out_of_date, together=together)


def test_every_verdict_has_its_own_heading() -> None:
    """Oracle: the list of verdicts in the diagnosis; only one that nothing is missing is a good one."""
    headings = {name: verdict(_answer(name)) for name in get_args(Verdict)}
    assert len({text for text, _ in headings.values()}) == len(headings)
    assert [name for name, (_, kind) in headings.items() if kind == "good"] == ["nothing_missing"]
    assert headings["undecided"] == ("These readings do not decide what is missing", "open")


def test_old_numbers_and_several_effects_are_said_before_the_verdict() -> None:
    """A model whose numbers are out of date is not shown as a good one."""
    assert "out of date" in verdict(_answer("nothing_missing", out_of_date=True))[0]
    assert verdict(_answer("nothing_missing", out_of_date=True))[1] == "bad"
    assert verdict(_answer("unknown_effect", together=("a", "b")))[0] == "Several effects are missing"


@pytest.mark.parametrize(
    ("p", "text"),
    [(0.5, "1 to 1"), (0.9, "9 to 1"), (0.93, "13 to 1"), (0.2, "1 to 4"), (0.6, "1.5 to 1"),
     (1.0, "more than 1000 to 1"), (0.0, "1 to more than 1000")],
)  # fmt: skip
def test_odds_of_a_probability(p: float, text: str) -> None:
    """Oracle: p / (1 - p) by hand."""
    assert odds(p) == text


def test_a_message_belongs_to_the_field_of_its_option() -> None:
    """As the command line words it, without the option that the page does not have."""
    fields = {"--expr": "own", "--param": "params"}
    assert blamed("--expr: no channel 'xx'", fields, "add") == ("no channel 'xx'", "own")
    assert blamed("--param 'p': write p=1:0..2", fields, "add") == ("--param 'p': write p=1:0..2", "params")
    assert blamed("laser.csv: row 3: no number", fields, "add") == ("laser.csv: row 3: no number", "add")


def test_the_first_page_is_there_without_what_only_others_need() -> None:
    """Oracle: the modules of a fresh interpreter; the compiled loop alone takes a third of the start."""
    needed = "rtec.studio.server.app, rtec.studio.pages.measurements, rtec.studio.pages.live"
    script = f"import {needed}, sys; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout.split()
    assert {"numpy", "numba", "scipy", "matplotlib", "pyarrow", "rtec.loop", "rtec.effects"} & set(loaded) == set()


def test_the_server_answers_before_it_has_loaded_what_makes_the_pages() -> None:
    """Oracle: the modules of a fresh interpreter; these take longer than all before the first answer."""
    script = "import rtec.studio.server.front, sys; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout.split()
    assert {"nicegui", "fastapi", "pydantic", "socketio", "jinja2", "numpy"} & set(loaded) == set()


ASK = """
import http.client, os, sys, threading
from pathlib import Path
from rtec.studio.server.address import Address, open_port
from rtec.studio.server.front import serve
opened = open_port(Address("127.0.0.1", 0, "a-token-for-tests-only"))

def ask():
    server = http.client.HTTPConnection("127.0.0.1", opened.port)
    server.request("GET", "/", headers={"Cookie": f"rtec-studio-{opened.port}=a-token-for-tests-only"})
    page = server.getresponse().read()
    print(b"Drop files here" in page, *sys.modules, flush=True)
    os._exit(0)

threading.Thread(target=ask).start()
serve(Path(sys.argv[1]), opened)
"""


def test_the_first_page_is_made_without_models_of_an_old_form(tmp_path: Path) -> None:
    """FastAPI would load them for the place for files. Oracle: the modules of the server when it has sent the page."""
    asked = subprocess.run([sys.executable, "-c", ASK, tmp_path], capture_output=True, text=True, check=True)
    sent, *loaded = asked.stdout.split()
    assert sent == "True"
    assert {"pydantic.v1.main", "numpy"} & set(loaded) == set()
