"""Devices of a run file. Oracle: the ports that a driver has, and the roles that it is given."""

from pathlib import Path
from typing import Any

import pytest

from rtec.errors import ConfigError
from rtec.loop import devices
from rtec.loop.clock import VirtualClock
from rtec.tomlfile import Strict
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
