"""Devices of a run file. Oracle: the ports that a driver has, and the roles that it is given."""

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rtec.correction.sinks import OriginOffsetSink
from rtec.errors import ConfigError, DriverUnavailable
from rtec.loop import devices
from rtec.loop.clock import VirtualClock
from rtec.tomlfile import Strict
from rtec_drivers.sim import SimDriver
from tests.support.setups import setup


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


@pytest.mark.parametrize(("most_um", "fits"), [((100.0, 99.0), True), ((99.9, 100.0), False)])
def test_an_actuator_that_takes_less_than_the_run_may_ask_for_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most_um: tuple[float, float], fits: bool
) -> None:
    """It knows that once it is open. Oracle: stop_um of the run file, 100 µm of X; Z has max_um."""
    made = setup(tmp_path)
    assert made.file.limits["X"].stop_um == 100.0
    sink = OriginOffsetSink(resolution_um=0.1, max_um=50.0)
    made = replace(made, file=made.file.model_copy(update={"output": {**made.file.output, "Z": sink}}))
    monkeypatch.setattr(SimDriver, "most_um", property(lambda _: most_um), raising=False)
    with ExitStack() as stack:
        box = devices.make_devices(setup(tmp_path), VirtualClock())
        if fits:
            assert devices.open_ports(made, box, stack).names["output"] == ("box",)
            return
        with pytest.raises(DriverUnavailable) as refused:
            devices.open_ports(made, box, stack)
    assert str(refused.value).startswith("[device.box] it takes at most 99.9 µm of axis X, and stop_um is 100: lower")
