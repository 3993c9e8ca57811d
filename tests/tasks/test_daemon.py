"""What a front end knows of a daemon. Oracle: the run file as the daemon itself reads it."""

from pathlib import Path

import pytest

from rtec.errors import RtecError
from rtec.loop.run_file import load_setup
from rtec.tasks.daemon import limits_of
from tests.studio.studio_rig import live_config


def test_limits_are_those_that_the_daemon_reads(tmp_path: Path) -> None:
    """A run file that the daemon refuses has no limits, even if the table of one axis could be read."""
    config = live_config(tmp_path / "run")
    limits = load_setup(config).file.limits
    assert limits_of(config) == {axis: (v.warning_um, v.stop_um) for axis, v in limits.items()}
    assert set(limits) == {"X", "Z"}
    config.write_text(config.read_text(encoding="utf-8").replace("slew_um_s", "slew"), encoding="utf-8")
    with pytest.raises(RtecError, match="slew"):
        load_setup(config)
    assert limits_of(config) == {}
