"""The measurement of the servo thread's latency, in short; what a busy computer does to it is not judged."""

import numpy as np
import pytest

from tests.bench.linuxcnc import measured
from tests.support.linuxcnc_session import why_not

pytestmark = [pytest.mark.xdist_group("others"), pytest.mark.skipif(bool(why_not()), reason=why_not() or "")]


def test_every_servo_period_counts_without_rtec_and_with_it() -> None:
    """Oracle: LinuxCNC's servo period of 1 ms; its own component says how late each was."""
    for late_us in measured(1, 2.0):
        assert 1500 < len(late_us) < 10_000
        assert np.isfinite(late_us).all()
        assert late_us.max() > 0.0
