"""The simulated machine behind the driver ports."""

import importlib
from pathlib import Path

import numpy as np
import pytest

from rtec.errors import ConfigError, DriverUnavailable
from rtec.loop.clock import VirtualClock
from rtec.loop.ports import Actuator, CountSource, SpindleSource, TemperatureSource
from rtec.machine import load_machine
from rtec.sim.machine import SimulatedMachine
from rtec.sim.truth import load_truth
from rtec.tomlfile import validated
from rtec_drivers.registry import DRIVERS
from rtec_drivers.sim import SimDriver, SimOptions

CONFIGS = Path(__file__).parents[2] / "configs"
MACHINE = load_machine(CONFIGS / "machines" / "turning-centre.toml")
TRUTH = "sim/turning-centre.toml"
PROGRAM = "S900 M3\nG0 X40 Z80\nG1 X100 F3000"
START_NS = 123_456_000_000
MS = 1_000_000


def driver(clock: VirtualClock, **options: object) -> SimDriver:
    return SimDriver(validated(SimOptions, {"truth": TRUTH, **options}, "run.toml"), MACHINE, clock, CONFIGS)


def test_it_is_in_the_registry_and_has_all_four_ports() -> None:
    """Oracle: the registry's own words lead to the class; runtime_checkable protocols."""
    module, name = DRIVERS["sim"]
    assert getattr(importlib.import_module(module), name) is SimDriver
    sim = driver(VirtualClock())
    for port in (CountSource, TemperatureSource, SpindleSource, Actuator):
        assert isinstance(sim, port)


def test_every_registered_driver_can_be_imported() -> None:
    """Oracle: import."""
    for module, name in DRIVERS.values():
        assert isinstance(getattr(importlib.import_module(module), name), type)


def test_it_follows_the_clock_as_the_bare_machine_does() -> None:
    """Oracle: a SimulatedMachine advanced by hand over the same span."""
    clock = VirtualClock(START_NS)
    bare = SimulatedMachine(MACHINE, load_truth(CONFIGS / TRUTH), 4)
    bare.load_program(PROGRAM, repeat=True)
    counts, degc, stamps = np.zeros(2, np.int64), np.full(8, np.nan), np.zeros(8, np.int64)
    with driver(clock, seed=4, program=PROGRAM) as sim:
        for ms in (0, 1, 700, 1900, 9000):
            clock.sleep_until_ns(START_NS + ms * MS)
            bare.advance_to(ms * MS)
            latched = sim.read_counts(counts)
            sim.read_temperatures(degc, stamps)
            assert latched == START_NS + ms * MS
            np.testing.assert_array_equal(counts, bare.raw_counts)
            np.testing.assert_array_equal(degc, bare.temperatures()[0])
            assert np.all(stamps == START_NS + ms // 1000 * 1000 * MS)
            assert sim.read_spindle() == bare.spindle_rpm
    assert np.any(counts > 0)


@pytest.mark.parametrize(
    ("actuator", "sign"), [("pulse", -1), ("following_error", 1), ("phase", 1), ("origin_offset", 1)]
)
def test_what_each_actuator_does_to_the_slide(actuator: str, sign: int) -> None:
    """Oracle: 10 units of output move the slide by ∓10 counts of pulses, or 10 · 2 µm of offset."""
    clock = VirtualClock(START_NS)
    unit_um = 1e3 / MACHINE.axes[0].counts_per_mm if actuator == "pulse" else 2.0
    output = np.zeros(2, np.int64)
    with driver(clock, actuator=actuator, unit_um=unit_um) as sim:
        before = sim.machine.actual_mm
        sim.apply(np.array([10, 0]))
        sim.apply(np.array([10, 0]))  # absolute: repeating changes nothing
        clock.sleep_until_ns(START_NS + 2000 * MS)
        sim.read_counts(np.zeros(2, np.int64))
        sim.read_output(output)
        moved_um = (sim.machine.actual_mm - before) * 1e3
        np.testing.assert_array_equal(output, [10, 0])
        # From the middle of its play the slide may give up half of it, 1.5 µm, and the loop half a count or so.
        assert abs(moved_um[0] - sign * 10 * unit_um) < 2.5
        assert abs(moved_um[1]) < 0.2
        sim.hold()
        sim.read_output(output)
        np.testing.assert_array_equal(output, [10, 0])


def test_warm_up_is_over_before_the_run_begins() -> None:
    """Oracle: a machine that worked for two hours; stamps still start at the clock."""
    clock = VirtualClock(START_NS)
    degc, stamps, counts = np.zeros(8), np.zeros(8, np.int64), np.zeros(2, np.int64)
    with driver(clock, warm_up_s=7200.0, warm_up_rpm=2500.0) as sim:
        sim.read_temperatures(degc, stamps)
        assert degc[0] > 35
        assert np.all(stamps == START_NS)
        assert sim.read_counts(counts) == START_NS
        assert sim.read_spindle() == 2500.0


def test_programs_come_from_a_file_too(tmp_path: Path) -> None:
    """Oracle: the same counts as with the text itself."""
    (tmp_path / "part.nc").write_text(PROGRAM)
    rows = []
    for options in ({"program": PROGRAM}, {"program_file": str(tmp_path / "part.nc")}):
        clock, counts = VirtualClock(), np.zeros(2, np.int64)
        with driver(clock, **options) as sim:
            clock.sleep_until_ns(800 * MS)
            sim.read_counts(counts)
        rows.append(counts)
    np.testing.assert_array_equal(rows[0], rows[1])
    assert np.all(rows[0] > 0)


def test_wrong_options_are_told() -> None:
    """Oracle: the messages."""
    clock = VirtualClock()
    with pytest.raises(ConfigError, match="not both"):
        driver(clock, program="G0 X1", program_file="x.nc")
    with pytest.raises(ConfigError, match=r"unknown key 'sed'; did you mean 'seed'"):
        driver(clock, sed=1)
    with pytest.raises(ConfigError, match=r"nowhere\.toml: no such file"):
        SimDriver(SimOptions(truth=Path("nowhere.toml")), MACHINE, clock, CONFIGS)
    with pytest.raises(ConfigError, match=r"absent\.nc: cannot be read"):
        driver(clock, program_file="absent.nc")
    with pytest.raises(DriverUnavailable, match="not entered"):
        driver(clock).read_spindle()
