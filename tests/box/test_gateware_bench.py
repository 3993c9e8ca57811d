"""The gateware in the place of the box in software, with the real clock: a process, and `rtec hil`.

The box driver's suites run on it too: on a virtual clock and on a pseudo terminal in `tests/drivers`, and those of
`tests/hil` by `make gateware`.
"""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from rtec.loop.clock import RealClock
from rtec_drivers.box.driver import SerialBoxDriver
from rtec_drivers.hil.bus_run import run_on_buses
from rtec_drivers.hil.findings import checks_of
from rtec_drivers.hil.wiring import read_wiring
from tests.support import hil_rig
from tests.support.box_rig import options
from tests.support.conformance import MACHINE, soon
from tests.support.gateware import REAL_CLOCK, library, missing

pytestmark = [
    pytest.mark.xdist_group("real-clock"),
    pytest.mark.skipif(bool(missing()), reason=missing()),
]
CLOCK = RealClock()


def test_a_process_takes_the_place_of_the_box_in_software(tmp_path: Path) -> None:
    """Oracle: the command's own words, and what the driver reads back: the axes move, the counts are inserted."""
    command = [sys.executable, "-m", "rtec_drivers.box.gateware", str(tmp_path / "box"), "--library"]
    with subprocess.Popen(
        [*command, str(library(**REAL_CLOCK))], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        given = options(port=str(tmp_path / "box"), timeout_ms=20.0)
        with SerialBoxDriver(given, MACHINE, CLOCK) as driver:
            counts, wanted, has = (np.zeros(2, np.int64) for _ in range(3))

            def inserted() -> bool:
                driver.read_counts(counts)
                wanted[:] = (5, -3)
                driver.apply(wanted)
                driver.read_output(has)
                return has.tolist() == [5, -3]

            assert soon(CLOCK, inserted)
            before = counts.copy()
            assert soon(CLOCK, lambda: inserted() and bool((counts != before).all()))
        process.stdin.close()  # type: ignore[union-attr]
        assert process.wait(30) == 0


def test_the_bench_runs_on_the_gateware(tmp_path: Path) -> None:
    """One corrected run of the daemon. Oracle: the bench's checks: ledger, log, jumps; and counts at the machine."""
    wiring = read_wiring(hil_rig.short(tmp_path, settle_s=1.0), library(**REAL_CLOCK))
    run = run_on_buses(wiring, tmp_path, "on", 3.0, (), 10, lambda *_: None)
    checks = {check.name: check for check in checks_of("on", run, (), judged=False)}
    assert checks.keys() >= {"on: ledger exact", "on: no jump", "on: log complete and replayed bit by bit"}
    assert [check for check in checks.values() if not check.good] == []
    assert run.far_counts["machine"]["commands"] > 100
    assert any(run.far_counts["machine"]["inserted"])


def test_gateware_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    """Before anything is started, with a way out."""
    for wrong, words in ((library(AXES=3, **REAL_CLOCK), "sim AXES=2` makes another"), (tmp_path, "sim` makes one")):
        done = hil_rig.rtec("hil", hil_rig.SHIPPED, "--gateware", wrong)
        assert (done.returncode, words in " ".join(done.stderr.split())) == (2, True), done.stderr
