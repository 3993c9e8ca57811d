"""Devices of a run file. Oracle: the ports that a driver has, and the roles that it is given."""

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rtec.errors import ConfigError, DriverUnavailable
from rtec.loop import devices
from rtec.loop.clock import VirtualClock
from rtec.loop.run_file import load_setup
from rtec.tomlfile import Strict
from rtec_drivers.sim import SimDriver
from tests.support.setups import setup, tables, write


class _Thermometer:
    """A driver that reads temperatures and can do nothing else."""

    class options_model(Strict):  # noqa: N801 - the name that the registry looks for
        truth: object = None
        seed: object = None
        warm_up_s: object = None
        warm_up_rpm: object = None
        program: object = None

    def __init__(self, *given: Any) -> None:
        del given

    def read_temperatures(self, degc: object, time_ns: object) -> None:
        """Read nothing."""


def test_a_device_is_refused_a_role_that_its_driver_cannot_play(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = setup(tmp_path)
    monkeypatch.setattr(devices, "driver_class", lambda *_: _Thermometer)
    with pytest.raises(ConfigError) as refused:
        devices.make_devices(made, VirtualClock())
    said = [line.split("[role] ")[1] for line in str(refused.value).splitlines()]
    cannot = "= 'box': that device's driver cannot do this"
    assert said == [f"counts {cannot}", f"actuator {cannot}", f"spindle {cannot}"]


@pytest.mark.parametrize(
    "other",
    [{"files": {"T_bed": "a"}}, {"patterns": ["A=(?P<T_bed>[0-9.]+)"]}, {"sensor": [{"name": "T_bed", "address": 4}]}],
)
def test_a_sensor_that_two_devices_read_is_refused(tmp_path: Path, other: dict[str, Any]) -> None:
    """The correction would jump between both. Oracle: the tables, which name it twice."""
    made = setup(tmp_path)
    tables = {"one": {"driver": "sim", "sensors": ["T_bed"]}, "two": {"driver": "sim", **other}}
    role = made.file.role.model_copy(update={"temperatures": ("one", "two")})
    both = replace(made, file=made.file.model_copy(update={"role": role, "device": {**made.file.device, **tables}}))
    with pytest.raises(ConfigError, match="temperatures: 'one' and 'two' name the same sensor, T_bed; each sensor is"):
        devices.make_devices(both, VirtualClock())


@pytest.mark.parametrize(("most_um", "fits"), [((100.0, 100.0), True), ((99.9, 100.0), False)])
def test_an_actuator_that_takes_less_than_the_run_may_ask_for_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most_um: tuple[float, float], fits: bool
) -> None:
    """It knows that once it is open. Oracle: stop_um of the run file, 100 µm of both axes."""
    made = setup(tmp_path)
    assert {limits.stop_um for limits in made.file.limits.values()} == {100.0}
    monkeypatch.setattr(SimDriver, "most_um", property(lambda _: most_um), raising=False)
    with ExitStack() as stack:
        box = devices.make_devices(setup(tmp_path), VirtualClock())
        if fits:
            assert devices.open_ports(made, box, stack).names["output"] == ("box",)
            return
        with pytest.raises(DriverUnavailable) as refused:
            devices.open_ports(made, box, stack)
    assert str(refused.value).startswith("[device.box] it takes at most 99.9 µm of axis X, and stop_um is 100: lower")


@pytest.mark.parametrize(
    ("output", "most_um", "key"),
    [
        ({"kind": "origin_offset", "resolution_um": 0.1, "max_um": 99.9}, 99.9, "max_um"),
        ({"kind": "following_error", "resolution_um": 0.1, "max_um": 20.0}, 20.0, "max_um"),
        ({"kind": "phase", "range_mm": 0.05}, 50.0, "range_mm"),
        ({"kind": "origin_offset", "resolution_um": 0.1, "max_um": 100.0}, 100.0, ""),
        ({"kind": "phase"}, 100.0, ""),
        ({"kind": "pulse"}, 0.0, ""),
    ],
)
def test_a_correction_that_may_become_more_than_the_output_takes_is_refused(
    tmp_path: Path, output: dict[str, Any], most_um: float, key: str
) -> None:
    """`applied` would say what the machine does not have. Oracle: stop_um of X, 100 µm."""
    path = write(tmp_path, {**tables(tmp_path), "output": {"X": output}})
    if not key:
        load_setup(path)
        return
    with pytest.raises(ConfigError) as refused:
        load_setup(path)
    assert str(refused.value) == (
        f"{path}: [output.X] {key} allows {most_um:g} µm, and stop_um of [limits.X] is 100: the machine would have "
        f"less than is corrected. Lower stop_um to {most_um:g}, or raise {key} if the controller takes more"
    )
