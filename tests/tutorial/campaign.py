"""Runs the commands of `docs/campaign.md`, as a reader would, and draws the figure that it shows.

`python -m tests.tutorial.campaign docs/figures`; about five minutes.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from rtec.report.figures import GREY, ON, as_png, stacked

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MplFigure

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "campaign.md"
FIGURE = "campaign-held-out.png"
NOISE_UM = 0.3 * 3**0.5
"""Of the held-out readings, three coordinates together: `rtec simulate` puts 0.3 µm on each."""
BARS = {
    "no model": None,
    "ball bar": "bar",
    "grid": "grid",
    "drift probes": "drift",
    "laser": "laser",
    "all in one call": "all",
}


def script(text: str) -> str:
    """The shell blocks of a page, one after the other."""
    return "".join(re.findall(r"^```sh\n(.*?)^```", text, re.MULTILINE | re.DOTALL))


def run(folder: Path) -> str:
    """Run the page in a folder that gets a copy of `configs`; gives what it printed.

    Raises:
        RuntimeError: a command ended with another status than 0; with its messages.
    """
    shutil.copytree(ROOT / "configs", folder / "configs")
    path = os.pathsep.join((str(Path(sys.executable).parent), os.environ.get("PATH", "")))
    done = subprocess.run(
        ["bash", "-e", "-c", script(PAGE.read_text(encoding="utf-8"))],
        cwd=folder,
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(f"ended with {done.returncode}:\n{done.stdout}{done.stderr}")
    return done.stdout


def left_um(folder: Path) -> dict[str, float]:
    """Root mean square of what each model leaves of the held-out readings, µm, by the name of its bar."""
    out = {}
    for name, stem in BARS.items():
        table = json.loads((folder / "out" / "campaign" / f"{stem or 'all'}.json").read_text(encoding="utf-8"))
        key = "rms_measured_um" if stem is None else "rms_residual_um"
        # One entry a coordinate, with as many readings each: together they are the length of the error.
        out[name] = float(sum(m[key] ** 2 for m in table["measurements"]) ** 0.5)
    return out


@as_png
def bars(residuals_um: Mapping[str, float]) -> "MplFigure":
    """Bars, longest first."""
    figure, (ax,) = stacked(4.6)
    names = sorted(residuals_um, key=lambda n: -residuals_um[n])
    values = [residuals_um[n] for n in names]
    drawn = ax.barh(names, values, color=[ON if n == "all in one call" else GREY for n in names])
    ax.bar_label(drawn, [f"{v:.2f} µm" for v in values], padding=6)
    ax.invert_yaxis()
    ax.grid(visible=False, axis="y")
    ax.set_xlim(0.0, 1.15 * max(values))
    noise = f"noise of the probing, {NOISE_UM:.2f} µm"
    ax.axvline(NOISE_UM, color="black", linestyle=":", linewidth=2.5, label=noise)
    ax.legend(loc="lower right", frameon=False)
    ax.set_xlabel("residual at the tool tip, rms, µm")
    ax.set_title("Residual of each instrument's model on another day, elsewhere")
    return figure


def main() -> None:
    """Run the page, draw its figure."""
    with tempfile.TemporaryDirectory() as folder:
        sys.stdout.write(run(Path(folder)))
        left = left_um(Path(folder))
    for name, value in left.items():
        sys.stdout.write(f"{name}: {value:.3f} µm\n")
    to = Path(sys.argv[1])
    to.mkdir(parents=True, exist_ok=True)
    (to / FIGURE).write_bytes(bars(left))


if __name__ == "__main__":
    main()
