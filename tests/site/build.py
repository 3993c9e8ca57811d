"""Builds the documentation as a site: `python -m tests.site.build out/docs`, which is `make docs`.

The pages are those of `docs`, with README, CONTRIBUTING and CHANGELOG beside them and a page of the Python API made of
its docstrings. Zensical builds them; a link that leads nowhere, or a warning, fails. Nothing in the site has an address
outside of it.
"""

import functools
import inspect
import json
import re
import shutil
import subprocess
import sys
import tempfile
from base64 import b64decode
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import tomli_w

import rtec
from rtec.characterise.result import Characterisation
from rtec.diagnosis.compare.result import Comparison
from rtec.diagnosis.extend.add import Added
from rtec.diagnosis.extend.improve import Improved
from rtec.diagnosis.plan.answer import Answer
from rtec.diagnosis.result import Diagnosis
from rtec.effects import Effect
from rtec.machine import Machine
from rtec.metrology.ball_bar.diagnosis import BallBarDiagnosis
from rtec.metrology.grid.compare import GridEvaluation
from rtec.metrology.importing import Imported
from rtec.metrology.measurement import Measurement
from rtec.metrology.procedures.drift import Drift
from rtec.metrology.procedures.iso230_2 import PositioningTests
from rtec.metrology.procedures.straightness import ParallelismResult, StraightnessResult
from rtec.model import Model
from rtec.model.history import History
from rtec.playback.replay import Replayed
from rtec.result import Result
from rtec.sim.campaign.campaign import Simulated

ROOT = Path(__file__).parents[2]
SECTIONS: Mapping[str, Sequence[str]] = {
    "Tutorials": (
        "tutorial.md", "campaign.md", "studio.md", "python.md", "notebooks/predict-and-plot.md",
        "notebooks/files-to-a-missing-effect.md", "notebooks/write-an-effect.md",
    ),
    "How-to": (
        "runbook.md", "init.md", "service.md", "control.md", "telemetry.md", "mqtt.md", "mtconnect.md",
        "opcua.md", "measurements.md", "procedures.md", "fit.md", "compare.md", "diagnose.md", "plan.md", "ball-bar.md",
        "grid-encoder.md", "tables.md", "linuxcnc.md", "write-an-effect.md", "write-a-driver.md", "hil.md",
    ),
    "Reference": (
        "reference/keys.md", "reference/api.md", "files.md", "effects.md", "instruments.md", "drivers.md",
        "ascii-offset.md", "can.md", "modbus.md", "zmq-link.md", "rtec-box-link.md", "thermocouples.md", "benchmark.md",
        "changes.md",
    ),
    "Explanation": (
        "architecture.md", "pulse-insertion.md", "real-time.md", "encoder-box.md", "threats.md", "contributing.md",
        "adr/README.md",
    ),
}  # fmt: skip
"""By what a reader wants: to learn, to do, to look up, to understand."""
BESIDE = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changes.md"}
"""Pages of the project's root, by their name in the site."""
CLASSES: tuple[type, ...] = (Model, Measurement, Machine, Result, Effect)
RESULTS: tuple[type, ...] = (
    Simulated,
    Imported,
    Characterisation,
    Comparison,
    Diagnosis,
    Added,
    Improved,
    History,
    Answer,
    BallBarDiagnosis,
    GridEvaluation,
    PositioningTests,
    StraightnessResult,
    ParallelismResult,
    Drift,
    Replayed,
)
LISTS = {"Args:": "Arguments", "Returns:": "Returns", "Raises:": "Errors", "Attributes:": "Attributes"}
DOWNLOAD = "download it"
LINK = re.compile(r"(?<!!)\[([^\]]*)\]\(([^)#\s]+)(#[^)]*)?\)")


def pages() -> list[Path]:
    """The pages of `docs`, decisions too."""
    return sorted((ROOT / "docs").rglob("*.md"))


def gather(folder: Path) -> None:
    """Lay out the site's sources: a notebook becomes a page, a link to a file that is no page becomes its name."""
    shutil.copytree(ROOT / "docs", folder, dirs_exist_ok=True)
    for notebook in sorted((folder / "notebooks").glob("*.ipynb")):
        notebook.with_suffix(".md").write_text(notebook_page(notebook), encoding="utf-8")
    for name, page in BESIDE.items():
        text = (ROOT / name).read_text(encoding="utf-8")
        (folder / page).write_text(text.replace("](docs/", "]("), encoding="utf-8")
    (folder / "reference").mkdir(exist_ok=True)
    (folder / "reference" / "api.md").write_text(api_page(), encoding="utf-8")
    for path in folder.rglob("*.md"):
        text = path.read_text(encoding="utf-8")
        path.write_text(LINK.sub(functools.partial(_link, path.parent), text), encoding="utf-8")


def _link(here: Path, found: re.Match[str]) -> str:
    words, target = found[1], found[2]
    if (moved := BESIDE.get(target.removeprefix("../"))) is not None:
        return f"[{words}]({moved})"
    if target.endswith(".ipynb") and words != DOWNLOAD:
        return f"[{words}]({target.removesuffix('.ipynb')}.md)"
    inside = (here / target).is_file() or "://" in target
    return found[0] if inside else f"`{words.strip('`')}`"


def notebook_page(path: Path) -> str:
    """A notebook as Markdown: its texts, its code, and what the code printed; figures are written beside it."""
    head, *rest = json.loads(path.read_text(encoding="utf-8"))["cells"]
    out = ["".join(head["source"]), f"This page is a notebook that runs as it is: [{DOWNLOAD}]({path.name})."]
    for number, cell in enumerate(rest):
        text = "".join(cell["source"])
        out.append(text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```")
        for k, output in enumerate(cell.get("outputs", ())):
            out.append(_printed(output, path.with_name(f"{path.stem}-{number}-{k}.png")))
    return "\n\n".join(out) + "\n"


def _printed(output: Mapping[str, Any], figure: Path) -> str:
    """One output of a cell: a figure, a table or text."""
    data = output.get("data", {})
    if "image/png" in data:
        figure.write_bytes(b64decode("".join(data["image/png"])))
        return f"![figure of the cell above]({figure.name})"
    if "text/html" in data:
        # Markdown ends a block of HTML at an empty line, and takes indented lines for code.
        lines = re.sub(r"<style.*?</style>", "", "".join(data["text/html"]), flags=re.DOTALL).splitlines()
        return "\n".join(line.strip() for line in lines if line.strip())
    return f"```text\n{''.join(output.get('text') or data['text/plain']).rstrip()}\n```"


def config(source: Path, out: Path) -> str:
    """The site's settings: no address outside of it, pages that open as files, too."""
    nav: list[dict[str, object]] = [{"rtec": "index.md"}]
    for section, names in SECTIONS.items():
        nav.append({section: list(names)})
    nav[-1] = {"Explanation": [*SECTIONS["Explanation"], {"Decisions": [f"adr/{p.name}" for p in decisions()]}]}
    colours = [
        {"scheme": "default", "toggle": {"icon": "lucide/sun", "name": "Dark"}},
        {"scheme": "slate", "toggle": {"icon": "lucide/moon", "name": "Light"}},
    ]
    features = ["content.code.copy", "navigation.sections", "navigation.top", "search.highlight", "toc.follow"]
    extensions = {
        "admonition": {},
        "attr_list": {},
        "tables": {},
        "toc": {"permalink": True},
        "pymdownx": {"highlight": {"pygments_lang_class": True}, "superfences": {}, "inlinehilite": {}},
    }
    project = {
        "site_name": "rtec",
        "site_description": "Makes machine tools more accurate than they were built",
        "docs_dir": source.name,
        "site_dir": str(out),
        "use_directory_urls": False,
        "nav": nav,
        "extra": {"generator": False},
        "extra_css": ["look.css"],
        "theme": {"language": "en", "font": False, "features": features, "palette": colours},
        "markdown_extensions": extensions,
    }
    return tomli_w.dumps({"project": project})


def decisions() -> list[Path]:
    """The pages of decisions, oldest first."""
    return sorted(p for p in (ROOT / "docs" / "adr").glob("*.md") if p.name != "README.md")


def api_page() -> str:
    """The Python API from its docstrings."""
    out = ["# Python API", "", "Every function of `import rtec`; [Python](../python.md) shows them at work.", ""]
    for name in rtec.__all__:
        thing = getattr(rtec, name)
        if inspect.isfunction(thing):
            out += _function(f"rtec.{name}", thing, "##")
    out += ["## Results", "", "What `import rtec` gives back; each is a dataclass.", ""]
    for kind in RESULTS:
        out += _class(kind, methods=False)
    for kind in CLASSES:
        out += _class(kind, methods=True)
    return "\n".join(out) + "\n"


def _class(kind: type, *, methods: bool) -> Iterator[str]:
    yield from (f"### `{kind.__name__}`", "", *_docstring(kind), "")
    for name, thing in vars(kind).items() if methods else ():
        if inspect.isfunction(thing) and not name.startswith("_") and thing.__doc__:
            yield from _function(f"{kind.__name__}.{name}", thing, "####")


def _function(name: str, function: object, mark: str) -> Iterator[str]:
    assert callable(function)
    signature = str(inspect.signature(function)).replace("'", "")
    signature = re.sub(r"(\w+\.)+(?=[A-Z])", "", signature)
    lines = signature if len(signature) < 90 else re.sub(r", (?=\*\*?\w*|\w+: )", ",\n    ", signature)
    yield from (f"{mark} `{name}`", "", "```python", f"{name}{lines}", "```", "", *_docstring(function), "")


def _docstring(thing: object) -> Iterator[str]:
    """A docstring of ours as Markdown: its lists of arguments, attributes and errors as lists."""
    for line in (inspect.getdoc(thing) or "").splitlines():
        if line in LISTS:
            yield from ("", f"**{LISTS[line]}**", "")
        elif found := re.match(r"    ([\w*, ]+): (.*)", line):
            yield f"- `{found[1]}`: {found[2]}"
        elif line.startswith("     "):
            yield f"  {line.strip()}"
        else:
            yield line.strip()


LOOK = """\
/* A key is read, and copied, in one piece; tables of pandas look like the others. */
.md-typeset td:first-child code { white-space: nowrap; }
.md-typeset table.dataframe { border-collapse: collapse; border: 0.05rem solid var(--md-typeset-table-color); }
.md-typeset table.dataframe :is(th, td) { padding: 0.4em 1em; border: 0.05rem solid var(--md-typeset-table-color); }
"""


def build(out: Path) -> str:
    """Build the site; gives what Zensical printed.

    Raises:
        RuntimeError: a link leads nowhere, or Zensical warns.
    """
    out = out.resolve()
    with tempfile.TemporaryDirectory() as scratch:
        source = Path(scratch) / "pages"
        gather(source)
        (source / "look.css").write_text(LOOK, encoding="utf-8")
        settings = Path(scratch) / "zensical.toml"
        settings.write_text(config(source, Path(scratch) / "site"), encoding="utf-8")
        program = Path(sys.executable).with_name("zensical")
        words = [str(program), "build", "--strict", "--config-file", str(settings)]
        done = subprocess.run(words, cwd=scratch, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"zensical ended with {done.returncode}:\n{done.stdout}{done.stderr}")
        shutil.rmtree(out, ignore_errors=True)
        shutil.copytree(Path(scratch) / "site", out)
    return done.stdout + done.stderr


if __name__ == "__main__":
    build(Path(sys.argv[1]))
    sys.stdout.write(f"{sys.argv[1]}/index.html\n")
