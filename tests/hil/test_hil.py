"""`rtec hil` as a user starts it: real ports, real processes, the real clock; only what must be so is asserted.

Other tests share the processors. So each run is `--shared`: how long something took is reported and not judged. Here
too only what came about is asserted, in which order, and for how long at least.
"""

import json
import signal
from pathlib import Path
from typing import Any

import pytest

from rtec.log.reader import LogReader
from tests.support import hil_rig
from tests.support.command import here
from tests.support.modbus_peer import until
from tests.support.setups import CONFIGS

pytestmark = pytest.mark.xdist_group("real-clock")


def _failed(facts: dict[str, Any]) -> list[dict[str, Any]]:
    return [check for check in facts["checks"] if check["judged"] and not check["passed"]]


def test_improvement_as_in_the_all_simulated_run(tmp_path: Path) -> None:
    """Oracle: the loop on a virtual clock with the simulated machine as its one device. Within 10 %."""
    config = hil_rig.short(tmp_path, settle_s=1.0, off_s=8.0, on_s=8.0)
    done = hil_rig.rtec(
        "hil", config, "--shared", "--json", "--report", tmp_path / "out", env=hil_rig.environment(tmp_path / "t")
    )
    facts = hil_rig.facts_of(done)
    assert not _failed(facts)
    assert done.returncode == 0
    if facts["compared_s"] > 5.0:  # this PC let the correction follow for long enough
        assert facts["simulated"]["factor"] > 5.0
        assert facts["factor_ratio"] == pytest.approx(1.0, abs=0.10)
    assert facts["wiring"].keys() == {"box", "thermocouples", "sensors"}
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [
        "hil-on.arrows",
        "report.html",
        "result.json",
        "tip-error.png",
    ]
    assert hil_rig.nothing_left(tmp_path / "t")


@pytest.fixture(scope="module")
def faulted(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """One run with a fault on every bus: by name what each did, and the whole result."""
    folder = tmp_path_factory.mktemp("faulted")
    config = hil_rig.short(folder, settle_s=1.0)
    faults = ("box-reset@2s+1s", "can-open@4s+4s", "modbus-silent@5s+4s", "box-unplugged@7s+1s")
    options = [word for fault in faults for word in ("--fault", fault)]
    done = hil_rig.rtec(
        "hil", config, "--off", 2, "--on", 3, *options, "--shared", "--json", env=hil_rig.environment(folder / "t")
    )
    facts = hil_rig.facts_of(done)
    return {"facts": facts, **{f["order"]["name"]: f for f in facts["faults"]}}


def test_whatever_happens_ledger_log_and_limits_are_kept(faulted: dict[str, Any]) -> None:
    """The run lasts as long as its faults need; the correction follows again after all of them."""
    facts = faulted["facts"]
    assert not _failed(facts)
    assert facts["on_s"] == 17.0
    assert facts["on_timing"]["cycles"] == 17_000
    assert {c["name"] for c in facts["checks"]} >= {
        "corrected: ledger exact",
        "corrected: the machine was given what was commanded",
        "corrected: no jump",
        "corrected: log complete and replayed bit by bit",
        "corrected: correction follows again",
        "corrected: held only for faults",
    }


def test_a_box_that_started_anew_waits_for_the_order(faulted: dict[str, Any]) -> None:
    """Held from the reset until the operator's order, half a second after its end."""
    found = faulted["box-reset"]
    assert "restarted" in found["told"]["box"]
    assert "ordered to resume" in found["told"]["box"]
    assert found["noticed_s"] + found["held_s"] > 1.4
    assert not found["recovered_s"] < 0.4  # the order comes half a second behind its end
    # Its ledger is zero meanwhile: the machine is as wrong as without correction, some 20 µm.
    assert found["largest_um"] > 10.0


def test_a_silent_slave_ages_its_own_channels_only(faulted: dict[str, Any]) -> None:
    """The other slave on the line and the other bus stay fresh; the correction holds once its values are stale."""
    found = faulted["modbus-silent"]
    assert "slave 1 (headstock): no answer" in found["told"]["thermocouples"]
    ages = found["oldest_s"]
    silent = {"T_spindle_front", "T_spindle_rear", "T_headstock"}
    assert all(ages[name] > 3.5 for name in silent)
    others = {"T_bed", "T_carriage", "T_z_nut", "T_air"}
    assert max(ages[name] for name in others) < min(ages[name] for name in silent)
    assert found["held_s"] > 1.5


def test_an_open_thermocouple_is_told_by_name(faulted: dict[str, Any]) -> None:
    found = faulted["can-open"]
    assert "T_x_nut: open circuit" in found["told"]["sensors"]
    assert found["oldest_s"]["T_x_nut"] > 3.5
    assert found["oldest_s"]["T_z_nut"] < found["oldest_s"]["T_x_nut"]


def test_a_pulled_cable_is_found_again_under_its_new_name(faulted: dict[str, Any]) -> None:
    found = faulted["box-unplugged"]
    assert "no such port" in found["told"]["box"] or "gone" in found["told"]["box"]
    assert found["held_s"] > 0.9


def test_a_short_soak(tmp_path: Path) -> None:
    """Half a minute with faults by chance: resources flat, ledger exact; the page and its facts say so."""
    config = hil_rig.short(tmp_path)
    done = hil_rig.rtec(
        "hil", config, "--soak", 0.5, "--seed", 7, "--shared", "--json", env=hil_rig.environment(tmp_path / "t")
    )
    facts = hil_rig.facts_of(done)
    assert not _failed(facts)
    assert {c["name"] for c in facts["checks"] if not c["judged"]} == {
        "soak: the machine was given what was commanded",
        "soak: held only for faults",
        "soak: correction follows at the end",
        "memory flat",
        "no deadline lost to our own code",
    }
    assert facts["duration_s"] == facts["ordered_s"] == 30.0
    assert not facts["stopped"]
    assert {r["process"] for r in facts["resources"]} == {"supervisor", "loop"}
    assert {f["name"] for f in facts["faults"]} >= {"box-unplugged", "modbus-unplugged", "can-unplugged"}
    assert hil_rig.nothing_left(tmp_path / "t")


@pytest.mark.parametrize(
    ("number", "sign"),
    [
        (signal.SIGINT, "simulated.toml"),
        (signal.SIGINT, "port-box"),
        (signal.SIGINT, "hil-off.arrows"),
        (signal.SIGTERM, "hil-off.arrows"),
        (signal.SIGKILL, "port-box"),
        (signal.SIGKILL, "hil-off.arrows"),
    ],
)
def test_nothing_is_left_behind(tmp_path: Path, number: signal.Signals, sign: str) -> None:
    """Ctrl-C, a polite and an impolite end: before the buses, while they start, while the daemon runs and logs."""
    # What is simulated before the buses is short, the run that is interrupted is not.
    config, folder = hil_rig.short(tmp_path, settle_s=1.0, off_s=10.0, on_s=2.0), tmp_path / "t"
    process = hil_rig.start(folder, sign, "hil", config)
    status, said = hil_rig.interrupt(process, number)
    assert status == {signal.SIGINT: 130, signal.SIGTERM: 130, signal.SIGKILL: -9}[number], said
    assert number is signal.SIGKILL or "Traceback" not in said
    assert hil_rig.nothing_left(folder)


@pytest.mark.parametrize("long", [False, True])
def test_ctrl_c_in_the_corrected_run_gives_the_verdict_until_then(tmp_path: Path, long: bool) -> None:
    """Oracle: the log that is kept; its rows are the cycles of the result. A fault in progress is no failure."""
    config, folder = hil_rig.short(tmp_path, settle_s=0.5, off_s=2.0, on_s=60.0), tmp_path / "t"
    arguments = ("--soak", 10) if long else ("--fault", "modbus-silent@1s+50s")
    report = tmp_path / "out"
    process = hil_rig.start(folder, "port-box", "hil", config, *arguments, "--shared", "--report", report)
    assert until(lambda: (report / "hil-on.arrows").exists() and (report / "hil-on.arrows").stat().st_size > 4e5, 60.0)
    status, said = hil_rig.interrupt(process, signal.SIGINT)
    assert (status, "Traceback" in said) == (130, False), said
    facts = json.loads((report / "result.json").read_text(encoding="utf-8"))
    assert facts["stopped"]
    assert not _failed(facts)
    cycles = (facts["timing"] if long else facts["on_timing"])["cycles"]
    with LogReader(report / "hil-on.arrows") as log:
        assert sum(len(samples) for samples, _ in log.blocks()) == cycles
    assert "topped after" in (report / "report.html").read_text(encoding="utf-8")
    assert hil_rig.nothing_left(folder)


def test_messages(tmp_path: Path) -> None:
    """What cannot be is said before anything starts, with a way on."""
    config = hil_rig.short(tmp_path)
    for arguments, words in (
        (("--fault", "modbus-silnt@3s"), "did you mean 'modbus-silent'?"),
        (("--fault", "modbus-silent"), "write NAME@30s"),
        (("--off", 3), "give at least 5 s"),
    ):
        done = here("hil", config, *arguments)
        assert (done.returncode, words in done.stderr) == (2, True), done.stderr
        assert "Traceback" not in done.stderr
    plain = here("hil", CONFIGS / "turning-centre-sim.toml")
    assert plain.returncode == 2
    assert "[hil] is missing" in plain.stderr


def test_list_of_faults() -> None:
    listed = here("hil", "--fault", "list")
    assert listed.returncode == 0, listed.stderr
    for name in ("box-unplugged", "box-count-jump", "modbus-late", "can-bus-off"):
        assert name in listed.stdout
