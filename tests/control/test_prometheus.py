"""The status for Prometheus. Oracles: the figures that went in; the format's grammar as a pattern; `http.client`."""

import http.client
import json
import re
import shutil
import socket
import struct
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rtec.control.desk import Desk
from rtec.control.prometheus import metrics
from rtec.control.server import MOST_SCRAPES, Control
from rtec.errors import ConfigError
from rtec.loop.clock import RealClock, VirtualClock
from rtec.loop.run_file import ControlTable
from rtec.tomlfile import validated
from tests.support import setups
from tests.support.conformance import soon
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
        'rtec_device_trouble{device="box \\"1\\"\\\\n\\\\"} 1',
        "rtec_cycles_total 7200000",
        "rtec_deadline_misses_total 3",
        "rtec_status_age_seconds 2",
    ):
        assert expected in lines
    assert not [line for line in lines if "nan" in line or ("T_air" in line and "celsius" in line)]


def control(folder: Path, place: str) -> Control:
    setup = setups.setup(folder)
    file = setup.file.model_copy(update={"control": ControlTable(local=False, prometheus=place)})
    return Control(replace(setup, file=file), FakeDaemon(setup), RealClock())


@pytest.fixture
def place(tmp_path: Path) -> Iterator[str]:
    place = free_place()
    with control(tmp_path, place):
        yield place


def get(place: str, method: str, path: str) -> tuple[int, str]:
    connection = http.client.HTTPConnection(place, timeout=20)
    connection.request(method, path)
    answer = connection.getresponse()
    body = answer.read().decode()
    connection.close()
    return answer.status, body


def test_by_http(place: str) -> None:
    """Only this path, only to be read."""
    assert [get(place, *what)[0] for what in (("GET", "/"), ("POST", "/metrics"))] == [404, 501]
    assert get(place, "GET", "/metrics?x=1")[0] == 200
    status, body = get(place, "GET", "/metrics")
    assert status == 200
    assert [line for line in body.splitlines() if not LINE.fullmatch(line)] == []


def test_the_correction_goes_on_where_another_program_has_the_place_and_it_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Oracle: the other program's answer, then ours; said once, not every time."""
    monkeypatch.setattr("rtec.control.server.HTTP_AGAIN_S", 0.02)
    place = free_place()
    host, port = place.split(":")
    taken = socket.create_server((host, int(port)))
    made = control(tmp_path, place)
    with made:
        daemon = made.desk.daemon
        assert isinstance(daemon, FakeDaemon)
        (said,) = daemon.notes
        assert said.startswith(f"[control] prometheus {place}: cannot listen there: Address already in use")
        taken.close()
        soon(RealClock(), lambda: _answers(place))
        assert daemon.notes == [said]


def _answers(place: str) -> bool:
    with suppress(OSError):
        return get(place, "GET", "/metrics")[0] == 200
    return False


def test_a_web_page_under_a_name_of_its_own_reads_nothing(place: str) -> None:
    """Oracle: RFC 9110, 15.5.20."""
    host, port = place.split(":")
    with socket.create_connection((host, int(port))) as line:
        line.sendall(b"GET /metrics HTTP/1.1\r\nHost: evil.example\r\n\r\n")
        assert line.makefile("rb").readline() == b"HTTP/1.1 421 Misdirected Request\r\n"


def test_slow_clients_keep_nobody_out(place: str) -> None:
    """More of them than there are places; each says half a request. Oracle: the scrape behind them."""
    host, port = place.split(":")
    with ExitStack() as opened:
        for _ in range(2 * MOST_SCRAPES):
            slow = opened.enter_context(socket.create_connection((host, int(port))))
            slow.sendall(b"GET /metrics HTTP/1.1\r\n")
        assert get(place, "GET", "/metrics")[0] == 200


def test_a_flood_dead_clients_and_a_restart(tmp_path: Path) -> None:
    """Garbage, requests without an end, clients that leave in the midst, and others that stay and say nothing: the
    scrape behind them is answered; so it is after a restart at the same place."""
    place = free_place()
    host, port = place.split(":")
    for _ in range(2):
        with control(tmp_path, place), ExitStack() as opened:
            for text in (b"\0" * 100_000, b"GET " + b"x" * 1_000_000, b"GET /metrics HTTP/1.1\r\n\r\n" * 1000, b""):
                flood = opened.enter_context(socket.create_connection((host, int(port))))
                flood.setblocking(False)
                with suppress(OSError):
                    flood.send(text)
            for _ in range(MOST_SCRAPES):
                with socket.create_connection((host, int(port))) as gone:
                    gone.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                    gone.sendall(b"GET /metrics HTTP/1.1\r\n\r\n")
                opened.enter_context(socket.create_connection((host, int(port))))
            assert get(place, "GET", "/metrics")[0] == 200


@pytest.mark.parametrize("other", ["0.0.0.0:9464", "192.168.10.5:9464", "mill:9464", "9464", "127.0.0.1:99999"])
def test_it_does_not_leave_this_computer(other: str) -> None:
    with pytest.raises(ConfigError, match=r"prometheus: .*(loopback|host:port)"):
        validated(ControlTable, {"prometheus": other}, "run.toml")


def test_the_package_does_not_need_it(tmp_path: Path) -> None:
    """Off unless it is asked for."""
    assert setups.setup(tmp_path).file.control.prometheus is None


def promtool(*arguments: str, text: str = "") -> str:
    """What Prometheus' own tool says, standard error included; it must agree."""
    tool = shutil.which("promtool")
    if tool is None:
        pytest.skip("promtool is not installed (Debian: prometheus)")
    done = subprocess.run([tool, *arguments], input=text, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def test_prometheus_own_tool_finds_no_fault(found: dict[str, Any]) -> None:
    """Oracle: `promtool check metrics`, which reads the text and knows the customs of names."""
    assert promtool("check", "metrics", text=metrics(found)).strip() == ""


def panels() -> dict[str, list[str]]:
    """The queries of each panel of the dashboard."""
    board = json.loads((Path(__file__).parents[2] / "configs" / "grafana" / "rtec.json").read_text(encoding="utf-8"))
    return {panel["title"]: [target["expr"] for target in panel["targets"]] for panel in board["panels"]}


def test_the_dashboard_asks_for_what_is_there(found: dict[str, Any]) -> None:
    """Oracle: the names that the daemon itself announces."""
    known = {**found["status"], "spindle_rpm": 1200.0, "faults": {"log": 1}}
    compared = {**found["left"], "axes": {"X": {"rms_um": 0.5}}}
    announced = set(re.findall(r"# TYPE (rtec_\w+)", metrics({**found, "status": known, "left": compared})))
    asked = {name for queries in panels().values() for query in queries for name in re.findall(r"rtec_\w+", query)}
    assert len(panels()) == 9
    assert asked <= announced
    assert announced - asked <= {"rtec_cycles_total", "rtec_reloads_total", "rtec_control_requests_total"}


def test_the_dashboards_queries_are_promql(tmp_path: Path) -> None:
    """Oracle: `promtool check rules`, with each query as a rule."""
    queries = [query.replace("$job", "mill") for of_panel in panels().values() for query in of_panel]
    rules = [{"record": f"rtec:panel:{i}", "expr": query} for i, query in enumerate(queries)]
    path = tmp_path / "rules.json"
    path.write_text(json.dumps({"groups": [{"name": "rtec", "rules": rules}]}), encoding="utf-8")
    assert f"SUCCESS: {len(queries)} rules found" in promtool("check", "rules", str(path))
