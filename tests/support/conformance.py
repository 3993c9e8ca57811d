"""The laws of `rtec.loop.ports`, run over every driver.

A driver's test file makes a subclass of `DriverLaws` whose name starts with `Test`, and gives it a fixture `rig`: the
driver's class, options that work, and a device (simulated, on a real bus) that is there while the fixture lives.

    class TestMyDriver(DriverLaws):
        @pytest.fixture
        def rig(self, tmp_path: Path) -> Iterator[Rig]:
            with my_simulated_device(tmp_path) as device:
                yield Rig(MyDriver, {"port": device.name}, misspelt="prot", nearest="port")
"""

import math
import threading
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest

from rtec.correction.sinks import PulseSink, Sink
from rtec.errors import ConfigError, DriverError, DriverUnavailable
from rtec.loop.clock import Clock, RealClock
from rtec.loop.ports import Actuator, CountSource, SpindleSource, TemperatureSource
from rtec.machine import Machine, load_machine
from rtec.tomlfile import Strict, validated
from rtec_drivers.registry import DRIVERS

CONFIGS = Path(__file__).parents[2] / "configs"
MACHINE = load_machine(CONFIGS / "machines" / "turning-centre.toml")
MS = 1_000_000
PATIENCE_NS = 60_000 * MS
T = TypeVar("T")


@dataclass
class Rig:
    """A driver and what it needs to be tried.

    Attributes:
        kind: the driver's class.
        options: its table in a run file, without the key `driver`.
        misspelt, nearest: a key that it does not know, and the one that it should be told instead.
        clock, machine, base: what it is constructed with.
        sensors: names of the sensors that this device has.
        takes: a sink that it takes, if it is an actuator; and those that it must refuse.
        output: a command that it can carry out.
        missing: options with which entering must fail, because nothing is there; None where that cannot be.
        roles: the capabilities that are tried; those that the class has where not given.
        device_inside: the device lives in the driver, so that another driver would have another one.
    """

    kind: Any
    options: Mapping[str, Any]
    misspelt: str
    nearest: str
    clock: Clock = field(default_factory=RealClock)
    machine: Machine = MACHINE
    base: Path = CONFIGS
    sensors: Sequence[str] = ()
    takes: Sink | None = None
    wrong_sinks: Sequence[Sink] = ()
    output: Sequence[int] = (3, -5)
    missing: Mapping[str, Any] | None = None
    roles: Sequence[type] | None = None
    device_inside: bool = False

    def make(self, **more: Any) -> Any:
        """Construct it."""
        options = validated(self.kind.options_model, {**self.options, **more}, "run.toml")
        return self.kind(options, self.machine, self.clock, self.base)

    def can(self, role: type) -> bool:
        """Is this capability tried?"""
        return role in self.roles if self.roles is not None else issubclass(self.kind, role)

    def needs(self, role: type) -> None:
        """Skip the test of a capability that it has not."""
        if not self.can(role):
            pytest.skip(f"{self.kind.__name__} is no {role.__name__}")

    def soon(self, action: Callable[[], T]) -> T:
        """Do it until it succeeds; a real device may need a moment."""
        return soon(self.clock, action)


def soon(clock: Clock, action: Callable[[], T]) -> T:
    """Do something every millisecond until it neither fails nor gives None; give what it gives.

    Raises:
        DriverError: its last one, after a minute.
        AssertionError: it still gave None or False.
    """
    end_ns = clock.now_ns() + PATIENCE_NS
    while True:
        late = clock.now_ns() > end_ns
        try:
            result = action()
        except DriverError:
            if late:
                raise
        else:
            if result is not None and result is not False:
                return result
            assert not late, "nothing within a minute"
        clock.sleep_until_ns(clock.now_ns() + MS)


def open_files() -> int:
    """How many files this process has open."""
    return len(list(Path("/proc/self/fd").iterdir()))


def gives_back(files: int, threads: int) -> bool:
    """Are no more files open and threads alive, soon? The far end, in this process too, may need a moment."""
    return soon(RealClock(), lambda: open_files() <= files and threading.active_count() <= threads)


class DriverLaws:
    """One test a law; the oracle of each is the contract in `rtec/loop/ports.py`."""

    def test_its_class_says_what_it_is(self, rig: Rig) -> None:
        module, name = rig.kind.__module__, rig.kind.__name__
        assert (module, name) in DRIVERS.values()
        assert rig.kind.__doc__
        assert issubclass(rig.kind.options_model, Strict)
        assert rig.kind.options_model.__doc__
        assert any(issubclass(rig.kind, role) for role in (CountSource, TemperatureSource, SpindleSource, Actuator))

    def test_its_example_is_read(self, rig: Rig) -> None:
        if not hasattr(rig.kind, "EXAMPLE"):
            pytest.skip(f"{rig.kind.__name__} has no EXAMPLE")
        tables = tomllib.loads(rig.kind.EXAMPLE)["device"]
        for table in tables.values():
            driver = table.pop("driver")
            assert DRIVERS[driver] == (rig.kind.__module__, rig.kind.__name__)
            validated(rig.kind.options_model, table, "EXAMPLE")

    def test_a_wrong_key_is_told_with_the_nearest(self, rig: Rig) -> None:
        with pytest.raises(ConfigError, match=rf"unknown key '{rig.misspelt}'; did you mean '{rig.nearest}'"):
            rig.make(**{rig.misspelt: 1})

    def test_constructing_opens_nothing(self, rig: Rig) -> None:
        files, threads = open_files(), threading.active_count()
        rig.make()
        assert open_files() <= files
        assert threading.active_count() <= threads

    def test_it_does_nothing_before_it_is_entered(self, rig: Rig) -> None:
        driver = rig.make()
        for _, call in _calls(rig, driver):
            with pytest.raises(DriverUnavailable):
                call()

    def test_readings_carry_their_instant(self, rig: Rig) -> None:
        start_ns = rig.clock.now_ns()
        with rig.make() as driver:
            if rig.can(CountSource):
                _check_counts(rig, driver, start_ns)
            if rig.can(TemperatureSource):
                _check_temperatures(rig, driver, start_ns)
            if rig.can(SpindleSource):
                assert np.isfinite(rig.soon(driver.read_spindle))

    def test_a_command_is_absolute_and_stands_after_leaving(self, rig: Rig) -> None:
        rig.needs(Actuator)
        has = np.zeros(len(rig.machine.axes), np.int64)
        wanted = np.array(rig.output, np.int64)
        with rig.make() as driver:
            rig.soon(lambda: self._carried_out(rig, driver, wanted))
            driver.apply(wanted)
            rig.soon(lambda: self._carried_out(rig, driver, wanted))
        with driver if rig.device_inside else rig.make() as again:
            rig.soon(lambda: bool(again.read_output(has) is None and np.array_equal(has, wanted)))

    @staticmethod
    def _carried_out(rig: Rig, driver: Any, wanted: "np.ndarray[Any, np.dtype[np.int64]]") -> bool:
        """Does the device itself say so? The command is repeated every cycle, as the loop does."""
        has = np.zeros(len(rig.machine.axes), np.int64)
        if rig.can(CountSource):
            driver.read_counts(has)
        driver.apply(wanted)
        driver.read_output(has)
        return bool(np.array_equal(has, wanted))

    def test_it_refuses_a_sink_that_is_not_its_own(self, rig: Rig) -> None:
        rig.needs(Actuator)
        driver = rig.make()
        assert driver.refuses(rig.takes or PulseSink()) == ""
        assert rig.wrong_sinks, "the rig names no sink that must be refused"
        for sink in rig.wrong_sinks:
            assert driver.refuses(sink)

    def test_leaving_gives_everything_back_and_it_opens_again(self, rig: Rig) -> None:
        files, threads = open_files(), threading.active_count()
        driver = rig.make()
        for _ in range(3):
            with driver:
                for role, call in _calls(rig, driver):
                    if role is not Actuator:
                        rig.soon(call)
            assert gives_back(files, threads)
            for _, call in _calls(rig, driver):
                with pytest.raises(DriverUnavailable):
                    call()

    def test_an_error_inside_still_closes(self, rig: Rig) -> None:
        files, threads = open_files(), threading.active_count()
        with pytest.raises(ZeroDivisionError), rig.make():
            raise ZeroDivisionError
        assert gives_back(files, threads)

    def test_where_nothing_is_there_entering_says_so_and_leaves_nothing_open(self, rig: Rig) -> None:
        if rig.missing is None:
            pytest.skip(f"{rig.kind.__name__} cannot be missing")
        files, threads = open_files(), threading.active_count()
        with pytest.raises(DriverError) as told, rig.make(**rig.missing):
            pass
        assert str(told.value)
        assert gives_back(files, threads)


def _calls(rig: Rig, driver: Any) -> list[tuple[type, Callable[[], Any]]]:
    """What the loop calls, by capability; each gives something that is not None."""
    counts = np.zeros(len(rig.machine.axes), np.int64)
    degc = np.full(len(rig.machine.sensors), np.nan)
    times = np.zeros(len(rig.machine.sensors), np.int64)
    calls: list[tuple[type, Callable[[], Any]]] = [
        (CountSource, lambda: driver.read_counts(counts)),
        (TemperatureSource, lambda: driver.read_temperatures(degc, times) is None),
        (SpindleSource, lambda: math.isfinite(driver.read_spindle())),
        (Actuator, lambda: driver.apply(counts) is None),
    ]
    return [(role, call) for role, call in calls if rig.can(role)]


AGO_MS = 500
"""Counts that are older than this, when it is opened, do not come."""


def _check_counts(rig: Rig, driver: Any, start_ns: int) -> None:
    counts = np.zeros(len(rig.machine.axes), np.int64)
    last_ns = start_ns - AGO_MS * MS  # counts that were latched before it was opened may come first
    for _ in range(20):
        instant_ns = rig.soon(lambda: driver.read_counts(counts))
        assert last_ns <= instant_ns <= rig.clock.now_ns()
        last_ns = instant_ns
        rig.clock.sleep_until_ns(rig.clock.now_ns() + MS)
    assert last_ns > start_ns


def _check_temperatures(rig: Rig, driver: Any, start_ns: int) -> None:
    """Sensors that the device has get a value and an instant; the others stay as they were."""
    names = rig.machine.sensor_names
    degc, times = np.full(len(names), np.nan), np.zeros(len(names), np.int64)
    mine = [names.index(n) for n in rig.sensors]
    assert mine, "the rig names no sensor"

    def fresh() -> bool:
        driver.read_temperatures(degc, times)
        return bool(np.all(times[mine] >= start_ns))

    rig.soon(fresh)
    assert np.all(np.isfinite(degc[mine]))
    assert np.all(times[mine] <= rig.clock.now_ns())
    others = np.setdiff1d(np.arange(len(names)), mine)
    assert np.all(np.isnan(degc[others]))
    assert np.all(times[others] == 0)
