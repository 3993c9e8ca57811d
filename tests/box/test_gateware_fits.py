"""The table of what fits, and that it fails where a clock is too slow. Oracle: lines as nextpnr 0.4 writes them."""

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

BOARDS = Path(__file__).parents[2] / "drivers" / "box" / "boards"
LOG = """\
Info: \t         ICESTORM_LC:  3678/ 5280    69%
Info: Max frequency for clock 'clk_12mhz$SB_IO_IN_$glb_clk': 30.93 MHz (PASS at 25.00 MHz)
Info: Max frequency for clock 'clk_12mhz$SB_IO_IN_$glb_clk': {mhz} MHz (PASS at 25.00 MHz)
"""


@pytest.fixture(scope="module")
def table() -> ModuleType:
    spec = importlib.util.spec_from_file_location("table", BOARDS / "table.py")
    assert spec is not None
    assert spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


@pytest.mark.parametrize(("mhz", "status"), [("27.78", 0), ("25.00", 0), ("24.99", 1)])
def test_the_clock_after_routing_counts(
    table: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str], mhz: str, status: int
) -> None:
    (tmp_path / "icebreaker.nextpnr").write_text(LOG.format(mhz=mhz), encoding="utf-8")
    assert table.main(tmp_path) == status
    said = capsys.readouterr().out
    assert "3678 of   5280 (70 %)" in said
    assert ("below 25 MHz" in said) is bool(status)


def test_a_log_that_says_nothing_is_no_pass(table: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "hx8k.nextpnr").write_text("ERROR: no\n", encoding="utf-8")
    assert table.main(tmp_path) == 1


@pytest.mark.parametrize("board", ["icebreaker", "upduino", "hx8k"])
def test_every_port_of_a_board_has_a_pin_of_its_own(board: str) -> None:
    """Oracle: the ports of its top, bit by bit."""
    pins = [line.split()[1:3] for line in (BOARDS / f"{board}.pcf").read_text().splitlines() if line.startswith("set_")]
    bits = {f"{name}[{k}]" for name in ("a", "b", "z", "a_out", "b_out", "z_out") for k in range(3)}
    assert {name for name, _ in pins} == bits | {"clk_12mhz", "rx", "tx", "relay"}
    assert len({pin for _, pin in pins}) == len(pins)
