"""The whole story on a machine that LinuxCNC runs: `make linuxcnc`, or `python -m tests.tutorial.linuxcnc FOLDER`.

The simulated mill has hidden errors in HAL: worn screws, play, axes that warm with their motion, and a head whose scale
warms with the spindle. A reflector at the tool is read at dwells, through LinuxCNC, cold and warm, the spindle off: the
first model. A part programme that turns the spindle then runs without rtec and with it. The machine is measured once
more with the spindle on, the residual diagnosed, the named effect added, and the programme runs again. Truth is what
LinuxCNC's `sampler` recorded. `FOLDER --figure docs/figures` draws the figure of `docs/linuxcnc.md`.
"""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rtec import api
from rtec.metrology.files.load import write_files
from rtec.report.figures import GREY, OFF, ON, as_png, room_above, stacked
from tests.support.linuxcnc_loop import Floats, dwell_means, run_files, start_daemon, until_pins
from tests.support.linuxcnc_session import CONFIGS, ROOT, Session, why_not

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MplFigure

AXES = "XYZ"
SENSORS = ("T_x", "T_y", "T_z", "T_spindle")
HIDDEN = [
    ("z-expansion,spindle-growth", "z-expansion,spindle-growth,head-scale"),
    ("addf spindle-growth servo-thread", "addf spindle-growth servo-thread\naddf head-scale servo-thread"),
    ("setp spindle-growth.in1 0", "setp spindle-growth.in1 2.3e-5"),
    (
        "net spindle-grown spindle-growth.out => z-spindle.in1",
        "net head-strain spindle-growth.out => head-scale.in0\nnet z-drive-pos => head-scale.in1\n"
        "net spindle-grown head-scale.out => z-spindle.in1",
    ),
]
"""The effect that the first model lacks: the scale of Z lies on the aluminium head, 23 µm/m·K with the spindle."""
NOISE_UM = 0.2
FIGURE = "linuxcnc-story.png"
STAGES = ("without rtec", "first model", "effect added")


@dataclass(frozen=True)
class Plan:
    """How much is measured and made.

    Attributes:
        step_mm: distance of the places along each axis.
        rest_s: so long the machine cools before it is measured.
        heights_mm: of the job.
    """

    step_mm: float = 18.0
    rest_s: float = 12.0
    heights_mm: tuple[float, ...] = (-70.0, 70.0)

    @property
    def places(self) -> Floats:
        """Places along an axis, mm."""
        return np.arange(-90.0, 90.1, self.step_mm)

    def first_effects(self) -> list[str]:
        """What a user who knows screws, play and heat fits first."""
        knots = ",".join(f"{q:g}" for q in self.places)
        return [
            text
            for a in AXES
            for text in (
                f"piecewise_position:E{a}{a}:knots_mm=[{knots}]",
                f"backlash:E{a}{a}",
                f"axis_expansion:E{a}{a}:sensor=T_{a.lower()}",
            )
        ]

    def diagonal(self) -> Floats:
        """All axes together, there and back, (n, 3)."""
        stops = np.r_[self.places, self.places[-2::-1]]
        return np.column_stack([stops] * 3)

    def lines(self) -> Floats:
        """Each axis by itself, there and back, at two places of the others, (n, 3)."""
        ends = self.places[:: len(self.places) // 5]
        stops = np.r_[ends, ends[-2::-1]]
        out = []
        for others in (-60.0, 60.0):
            for k in range(len(AXES)):
                line = np.full((len(stops), 3), others)
                line[:, k] = stops
                out.append(line)
        return np.concatenate(out)

    def job(self) -> str:
        """The part programme: a pocket's corners at some heights, the spindle on."""
        corners = ((-50, -50), (50, -50), (50, 50), (-50, 50))
        return (
            "G21 G90 G64 P0.001\nM3 S3000\nG0 X-60 Y-60 Z-80\n"
            + "".join(f"G1 F6000 X{x} Y{y} Z{z}\nG4 P0.3\n" for z in self.heights_mm for x, y in corners)
            + "M5\nM2\n"
        )


def measuring(stops: Floats, rest_s: float = 0.0, spindle: bool = False) -> str:
    """A programme that dwells at each place, after a rest; with the spindle, it turns from the beginning on."""
    return (
        "G21 G90 G64 P0.001\n"
        + ("M3 S3000\n" if spindle else "")
        + f"G4 P{rest_s:g}\n"
        + "".join(f"G1 F6000 X{x:g} Y{y:g} Z{z:g}\nG4 P0.12\n" for x, y, z in stops.tolist())
        + "M2\n"
    )


WARM_UP = "G21 G90\n" + "G0 X80 Y80 Z80\nG0 X-80 Y-80 Z-80\n" * 3 + "G0 X-95 Y-95 Z-95\nM2\n"


class Story:
    """One machine, its measurements, and how its errors fall.

    Args:
        folder: files are written there.
        plan: how much.
        progress: is told what is being done.
    """

    def __init__(self, folder: Path, plan: Plan, progress: bool = True) -> None:
        self.folder, self.plan, self._progress = folder.resolve(), plan, progress
        self.folder.mkdir(parents=True, exist_ok=True)
        self.machine = CONFIGS / "mill-machine.toml"
        self.finding = self.sentence = ""
        self._rng = np.random.default_rng(1)

    def tell(self) -> dict[str, Floats]:
        """Do it all; give the error at each dwell of the job, µm, (dwells, 3), by stage."""
        first, second = self.folder / "first.toml", self.folder / "second.toml"
        plan, out = self.plan, dict[str, Floats]()
        with Session("mill", {"mill-plant.hal": HIDDEN}) as mill:
            self._mill = mill
            mill.state("estop_reset")
            mill.state("on")
            mill.home()
            mill.mdi("G0 X-95 Y-95 Z-95")
            self._say("measuring: spindle off, cold, then warm")
            cold = self._record(measuring(plan.diagonal(), plan.rest_s))
            self._record(WARM_UP)
            still = self._measured("spindle-off", [cold, self._record(measuring(plan.diagonal()))])
            fitted = api.fit(self.machine, [still], effects=plan.first_effects(), out=first)
            self._say(f"fitted: first.toml, {len(fitted.model.effects)} effects")
            self._say("part programme: without rtec, then with the first model")
            out[STAGES[0]] = self._job()
            with self._corrected(first):
                out[STAGES[1]] = self._job()
            self._say("measuring: spindle on")
            mill.mdi("G0 X-95 Y-95 Z-95")
            turning = self._measured(
                "spindle-on",
                [self._record(measuring(s, 8.0, spindle=True)) for s in (plan.diagonal(), plan.lines())],
            )
            diagnosis = api.diagnose(first, [still, turning], machine=self.machine)
            self.sentence, finding = diagnosis.sentence, diagnosis.findings[0]
            self._say(f"diagnosed: {diagnosis.sentence}")
            added = api.add(first, [still, turning], finding, machine=self.machine, out=second)
            self.finding = added.model.effects[-1].label
            self._say(f"added: {self.finding}, second.toml; part programme again")
            with self._corrected(second):
                out[STAGES[2]] = self._job()
        return out

    def _record(self, programme: str) -> Floats:
        """Run a programme; give what the sampler saw: number, commanded, true, temperatures, in position."""
        mill = self._mill
        (mill.folder / "job.ngc").write_text(programme)
        mill.record(1, "job.txt")
        mill.run("job.ngc")
        mill.stop_record(1)
        return mill.recorded("job.txt")

    def _job(self) -> Floats:
        """Errors of the part programme at its dwells, µm, (dwells, 3)."""
        return 1e3 * (np.array([d[4:7] - d[1:4] for d in dwell_means(self._record(self.plan.job()), 250)]))

    def _measured(self, name: str, recordings: list[Floats]) -> Path:
        """Write the readings of a reflector at the tool, one a dwell, one run a recording."""
        rows = []
        for run, recording in enumerate(recordings, 1):
            for d in dwell_means(recording, 100):
                reading = 1e3 * (d[4:7] - d[1:4]) + self._rng.normal(0.0, NOISE_UM, 3)
                rows.append([run, d[0] * 1e-3, *np.round(d[1:4], 4), *np.round(d[7:11], 2), *np.round(reading, 2)])
        table = np.array(rows)
        names = ["run", "time_s", "x_mm", "y_mm", "z_mm", *(f"{s}_degc" for s in SENSORS)]
        names += [f"reading_{a.lower()}_um" for a in AXES]
        columns = {n: table[:, k].astype(np.int64) if n == "run" else table[:, k] for k, n in enumerate(names)}
        path = self.folder / f"{name}.csv"
        write_files(path, columns, {"instrument": "tool_tip", "machine": "linuxcnc-mill"}, {"zero": "none"})
        return path

    @contextmanager
    def _corrected(self, model: Path) -> Iterator[None]:
        """`rtec run` with a model, as a user starts it, and faded away before it ends."""
        mill = self._mill
        run_file = run_files(mill, (('"mill-model.toml"', f'"{model}"'),))
        pins = [f"rtec.offset-{a.lower()}" for a in AXES]
        run = start_daemon(mill, run_file, self.folder / f"{model.stem}.log")
        env = {**os.environ, "RUNTIME_DIRECTORY": str(mill.folder)}
        try:
            until_pins(mill, pins, lambda mm: max(map(abs, mm)) > 1e-4)
            yield
            fade = [sys.executable, "-m", "rtec.cli.main", "ctl", "fade", str(run_file)]
            subprocess.run(fade, env=env, check=True, capture_output=True)
            until_pins(mill, pins, lambda mm: max(map(abs, mm)) < 1e-6)
        finally:
            run.send_signal(signal.SIGTERM)
            run.wait(30)

    def _say(self, text: str) -> None:
        if self._progress:
            say(text)


def table(errors: Mapping[str, Floats]) -> str:
    """Largest error at dwells by axis and as a length, µm, a line a stage."""
    lines = [f"{'largest error at dwells, µm':<30}{'X':>8}{'Y':>8}{'Z':>8}{'length':>9}"]
    for name, e in errors.items():
        largest = np.abs(e).max(axis=0)
        lines.append(f"{name:<30}" + "".join(f"{v:8.2f}" for v in largest) + f"{length_um(e).max():9.2f}")
    return "\n".join(lines)


def length_um(errors: Floats) -> Floats:
    """Length of the error at each dwell, µm."""
    return np.asarray(np.linalg.norm(errors, axis=1))


@as_png
def figure(errors: Mapping[str, Floats], finding: str) -> "MplFigure":
    """The error at each dwell of the part programme, stage by stage."""
    drawn, (ax,) = stacked(5.0)
    labels = dict(zip(STAGES, ("without rtec", "with the first model", f"with {finding} added"), strict=True))
    for name, colour in zip(STAGES, (GREY, OFF, ON), strict=True):
        e = length_um(errors[name])
        at = np.arange(1, len(e) + 1)
        ax.plot(at, e, "o-", color=colour, label=f"{labels[name]}: at most {e.max():.1f} µm")
    ax.set_xlabel("dwell of the part programme")
    ax.set_ylabel("error at the tool, µm")
    ax.set_ylim(bottom=0.0)
    room_above(ax, 0.45)
    ax.set_title("A mill that LinuxCNC runs: the same programme three times")
    ax.legend(loc="upper left", frameon=False)
    return drawn


def say(text: str) -> None:
    """Print a line."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def main(words: list[str]) -> int:
    """Tell it: progress, a table, the figure; 2 where LinuxCNC is not there."""
    why = why_not()
    if why:
        say(why)
        return 2
    folder = Path(words[0]) if words else ROOT / "out" / "linuxcnc"
    story = Story(folder, Plan())
    errors = story.tell()
    say("\n" + table(errors))
    figures = {
        name: {"largest_um": np.abs(e).max(axis=0).tolist(), "dwells_um": e.tolist()} for name, e in errors.items()
    }
    (folder / "result.json").write_text(json.dumps(figures, indent=2), encoding="utf-8")
    to = Path(words[2]) if words[1:2] == ["--figure"] else folder
    (to / FIGURE).write_bytes(figure(errors, story.finding))
    say(f"\n{to / FIGURE}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
