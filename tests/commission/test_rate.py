"""The age that a run file allows its counts. Oracle: docs/init.md; the run file that `rtec init` writes, read again."""

from pathlib import Path

import pytest

from rtec.cli.main import status
from rtec.tomlfile import read_toml

ANSWERS = """\
template = "lathe"
sensors = []
[role]
counts = "readout"
actuator = "offsets"
[device.readout]
driver = "{driver}"
max_speed_mm_s = {{X = 400.0, Z = 400.0}}
{options}
[device.offsets]
driver = "ascii_offset"
tcp = {{host = "127.0.0.1", port = 1}}
command = ["{{X:.4f}} {{Z:.4f}}"]
unit = "mm"
resolution_um = 0.1
"""
OPTIONS = {
    "zmq_link": "state = 'ipc://state'",
    "ascii_lines": """\
port = "/dev/absent"
patterns = ['X(?P<X>\\S+) Z(?P<Z>\\S+)']
units = {X = "mm", Z = "mm"}
""",
}


@pytest.mark.parametrize(
    ("driver", "more", "age_s"),
    [
        ("zmq_link", [], 0.005),
        ("zmq_link", ["rate_hz=4000"], 0.005),
        ("zmq_link", ["rate_hz=200"], 0.025),
        ("zmq_link", ["rate_hz=30"], 0.167),
        ("zmq_link", ["rate_hz=200", "counts_max_age_s=0.01"], 0.01),
        ("ascii_lines", [], 0.25),
        ("ascii_lines", ["rate_hz=10"], 0.5),
    ],
)
def test_the_counts_may_be_five_cycles_old_at_least(tmp_path: Path, driver: str, more: list[str], age_s: float) -> None:
    answers = tmp_path / "answers.toml"
    answers.write_text(ANSWERS.format(driver=driver, options=OPTIONS[driver]), encoding="utf-8")
    settings = [word for pair in more for word in ("--set", pair)]
    assert status(["init", str(tmp_path / "new"), "--answers", str(answers), "--no-check", *settings]) == 0
    assert read_toml(tmp_path / "new" / "run.toml")["guard"]["counts_max_age_s"] == age_s
