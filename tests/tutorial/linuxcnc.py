"""The whole story on a machine that LinuxCNC runs: `python -m tests.tutorial.linuxcnc FOLDER` (`make linuxcnc`).

The simulated mill has hidden errors in HAL: worn screws, play, axes that warm with their motion, and a spindle that
grows by 0.8 µm/°C. A reflector at the tool is read at dwells, through LinuxCNC, cold and warm with the spindle off: the
first model. Then a part programme with the spindle on runs without rtec and with it. The residual is measured and
diagnosed, the named effect is added, and the programme runs again. Truth is what LinuxCNC's `sampler` recorded.
"""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from rtec import api
from rtec.metrology.files.save import write_files
from tests.support.linuxcnc_loop import Floats, dwell_errors_um
from tests.support.linuxcnc_session import CONFIGS, ROOT, Session, why_not

AXES = "XYZ"
SENSORS = ("T_x", "T_y", "T_z", "T_spindle")
GROWTH = ("setp spindle-growth.in1 0", "setp spindle-growth.in1 -0.0008")
NOISE_UM = 0.2
PLACES = np.arange(-90.0, 91.0, 15.0)
DWELL_ROWS = 60
KNOTS = ",".join(f"{q:g}" for q in PLACES)
FIRST = [
    text
    for a in AXES
    for text in (
        f"piecewise_position:E{a}{a}:knots_mm=[{KNOTS}]",
        f"backlash:E{a}{a}",
        f"axis_expansion:E{a}{a}:sensor=T_{a.lower()}",
    )
]
WARM_UP = "G21 G90\n" + "G0 X80 Y80 Z80\nG0 X-80 Y-80 Z-80\n" * 2 + "M2\n"
SPINDLE_ON = "G21 G90\nM3 S3000\nG4 P4\nG0 X-90 Y-90 Z-90\nM2\n"
JOB = (
    "G21 G90 G64 P0.001\nM3 S3000\n"
    + "".join(
        f"G1 F4000 X{x} Y{y} Z{z}\nG4 P0.2\n"
        for z in (-60, 0, 60)
        for x, y in ((-50, -50), (50, -50), (50, 50), (-50, 50))
    )
    + "M5\nM2\n"
)


def there_and_back(rest_s: float = 0.0) -> str:
    """A programme that dwells at every place in both directions, and rests before."""
    stops = [*PLACES, *PLACES[-2::-1]]
    return (
        f"G21 G90 G64 P0.001\nG4 P{rest_s:g}\n"
        + "".join(f"G1 F6000 X{q:g} Y{q:g} Z{q:g}\nG4 P0.1\n" for q in stops)
        + "M2\n"
    )


def record(mill: Session, programme: str) -> Floats:
    """Run a programme; give what the sampler saw: number, commanded, true, temperatures, in position."""
    (mill.folder / "job.ngc").write_text(programme)
    mill.record(1, "job.txt")
    mill.run("job.ngc")
    mill.stop_record(1)
    return mill.recorded("job.txt")


def measured(path: Path, recordings: list[Floats], rng: np.random.Generator) -> Path:
    """Write the readings of a reflector at the tool, one a dwell, one run a recording."""
    rows = []
    for run, recording in enumerate(recordings, 1):
        place = recording[:, 1:4]
        stands = np.r_[False, np.all(np.diff(place, axis=0) == 0.0, axis=1)]
        begins = np.flatnonzero(~stands)
        ends = np.r_[begins[1:], len(recording)]
        for a, b in zip(begins, ends, strict=True):
            if b - a > DWELL_ROWS:
                part = recording[b - DWELL_ROWS // 2 : b].mean(axis=0)
                reading = 1e3 * (part[4:7] - part[1:4]) + rng.normal(0.0, NOISE_UM, 3)
                rows.append(
                    [run, part[0] * 1e-3, *np.round(part[1:4], 4), *np.round(part[7:11], 2), *np.round(reading, 2)]
                )
    table = np.array(rows)
    names = ["run", "time_s", "x_mm", "y_mm", "z_mm", *(f"{s}_degc" for s in SENSORS)]
    names += [f"reading_{a.lower()}_um" for a in AXES]
    columns = {n: table[:, k].astype(np.int64) if n == "run" else table[:, k] for k, n in enumerate(names)}
    write_files(path, columns, {"instrument": "tool_tip", "machine": "linuxcnc-mill"}, {"zero": "none"})
    return path


@contextmanager
def corrected(mill: Session, model: Path) -> Iterator[None]:
    """`rtec run` with a model, as a user starts it."""
    text = (CONFIGS / "mill.toml").read_text()
    text = text.replace('"mill-machine.toml"', f'"{CONFIGS / "mill-machine.toml"}"')
    run_file = mill.folder / "mill.toml"
    run_file.write_text(text.replace('"mill-model.toml"', f'"{model.resolve()}"'))
    env = {**os.environ, "RUNTIME_DIRECTORY": str(mill.folder)}
    with (mill.folder / "rtec.log").open("w") as log:
        run = subprocess.Popen([sys.executable, "-m", "rtec.cli.main", "run", str(run_file)], stderr=log, env=env)
        try:
            for _ in range(6):
                try:
                    mill.until(lambda: abs(mill.gets("rtec.offset-x")) > 1e-5)
                    break
                except AssertionError:
                    continue
            yield
        finally:
            run.send_signal(signal.SIGTERM)
            run.wait(20)


def job(mill: Session) -> Floats:
    """Errors of the job at its dwells, µm, (samples, 3), and where it was: both ways in once, then recorded."""
    mill.mdi("G0 X-60 Y-60 Z-70")
    mill.mdi("G0 X-50 Y-50 Z-60")
    mill.mdi("G0 X-60 Y-60 Z-70")
    return dwell_errors_um(record(mill, JOB), len(AXES))


def story(folder: Path) -> dict[str, Floats]:
    """Do it all; give the errors of the job by what corrected it."""
    rng = np.random.default_rng(1)
    machine = CONFIGS / "mill-machine.toml"
    folder.mkdir(parents=True, exist_ok=True)
    first, second = folder / "first.toml", folder / "second.toml"
    out: dict[str, Floats] = {}
    with Session("mill", {"mill-plant.hal": [GROWTH]}) as mill:
        mill.state("estop_reset")
        mill.state("on")
        mill.home()
        mill.mdi("G0 X-95 Y-95 Z-95")
        cold = record(mill, there_and_back(12.0))
        record(mill, WARM_UP)
        warm = record(mill, there_and_back())
        still = measured(folder / "spindle-off.csv", [cold, warm], rng)
        fitted = api.fit(machine, [still], effects=FIRST, out=first, report=folder / "fit")
        say(f"first model: {len(fitted.model.effects)} effects, {first}")
        out["without rtec"] = job(mill)
        with corrected(mill, first):
            out["first model"] = job(mill)
        record(mill, SPINDLE_ON)
        turning = measured(
            folder / "spindle-on.csv", [record(mill, there_and_back()), record(mill, there_and_back())], rng
        )
        diagnosis = api.diagnose(first, [still, turning], machine=machine, report=folder / "diagnosis")
        say(str(diagnosis))
        finding = diagnosis.findings[0]
        added = api.add(first, [still, turning], finding, machine=machine, out=second)
        say(f"added: {added.model.effects[-1].label}")
        with corrected(mill, second):
            out["effect added"] = job(mill)
    return out


def say(text: str) -> None:
    """Print a line."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def main(folder: Path) -> int:
    """Tell it: a table, and the figures of fit and diagnosis."""
    why = why_not()
    if why:
        say(why)
        return 2
    errors = story(folder)
    figures = {name: {a: float(np.abs(e[:, k]).max()) for k, a in enumerate(AXES)} for name, e in errors.items()}
    say(f"\nLargest error at dwells, µm   {'X':>7}{'Y':>7}{'Z':>7}")
    for name, by_axis in figures.items():
        say(f"{name:<29} " + "".join(f"{v:7.2f}" for v in by_axis.values()))
    (folder / "result.json").write_text(json.dumps(figures, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "out" / "linuxcnc"))
