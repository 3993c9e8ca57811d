"""The status for Prometheus. Oracles: the figures that went in; the format's grammar as a pattern; `http.client`."""

import http.client
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rtec.control.desk import Desk
from rtec.control.prometheus import Endpoint, metrics
from rtec.errors import ConfigError
from rtec.loop.clock import VirtualClock
from rtec.loop.run_file import ControlTable
from rtec.tomlfile import validated
from tests.support import setups
from tests.support.control_rig import FakeDaemon, free_place

LINE = re.compile(
    r'rtec_[a-z_]+(\{[a-z]+="(\\.|[^"\\\n])*"\})? [-+0-9.e]+|# (HELP rtec_[a-z_]+ .+|TYPE rtec_[a-z_]+ \w+)'
)


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    daemon = FakeDaemon(setups.setup(tmp_path_factory.mktemp("run")))
    daemon.status.devices = {'box "1"\n\\': ["silent"]}
    return Desk(daemon, VirtualClock(2_000_000_001), {}).status()


def test_every_line_is_of_the_format_and_has_its_figure(found: dict[str, Any]) -> None:
    lines = metrics(found).splitlines()
    assert [line for line in lines if not LINE.fullmatch(line)] == []
    for expected in (
        'rtec_requested_um{axis="Z"} -2.5',
        'rtec_applied_um{axis="X"} 1.25',
        'rtec_temperature_celsius{sensor="T_bed"} 21.25',
        'rtec_mode{mode="on"} 1',
        'rtec_mode{mode="hold"} 0',
        'rtec_device_trouble{device="box \\"1\\"\\n\\\\"} 1',
        "rtec_cycles_total 7200000",
        "rtec_deadline_misses_total 3",
        "rtec_status_age_seconds 2",
    ):
        assert expected in lines
    assert not [line for line in lines if "nan" in line or ("T_air" in line and "celsius" in line)]


@pytest.fixture
def place(found: dict[str, Any]) -> Iterator[str]:
    place = free_place()
    with Endpoint(place, lambda: found):
        yield place


def test_by_http(place: str, found: dict[str, Any]) -> None:
    """Only this path, only to be read; the place is taken while it is served."""
    for method, path, status in (("GET", "/metrics", 200), ("GET", "/", 404), ("POST", "/metrics", 501)):
        connection = http.client.HTTPConnection(place, timeout=20)
        connection.request(method, path)
        answer = connection.getresponse()
        assert answer.status == status
        body = answer.read().decode()
        connection.close()
        if status == 200:
            assert body == metrics(found)
    with pytest.raises(ConfigError, match="cannot listen there"), Endpoint(place, lambda: found):
        pass


@pytest.mark.parametrize("other", ["0.0.0.0:9464", "192.168.10.5:9464", "mill:9464", "9464"])
def test_it_does_not_leave_this_computer(other: str) -> None:
    with pytest.raises(ConfigError, match=r"prometheus: .*(loopback|host:port)"):
        validated(ControlTable, {"prometheus": other}, "run.toml")


def test_the_package_does_not_need_it(tmp_path: Path) -> None:
    """Off unless it is asked for."""
    assert setups.setup(tmp_path).file.control.prometheus is None
