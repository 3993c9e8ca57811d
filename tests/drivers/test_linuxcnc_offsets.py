"""External offsets: LinuxCNC counts them from enable, and forgets them when the machine goes off; rtec says so."""

from collections.abc import Iterator

import numpy as np
import pytest

from tests.support.linuxcnc_loop import LoopThread
from tests.support.linuxcnc_session import Session, why_not

pytestmark = [pytest.mark.xdist_group("others"), pytest.mark.skipif(bool(why_not()), reason=why_not() or "")]

AXES = ("x", "z")
PLACES = ("G0 X-60 Z60", "G0 X60 Z-60")
STEP_UM, WINDOW = 0.3, 10
"""So much further than commanded may the tool move in a servo period, µm, on the average of a few of them: rtec's slew
limit, and the plant's errors. Two of rtec's cycles may fall into one servo period, as neither waits for the other."""
LATE = 0.005
"""Share of the periods in which more of them may: on a busy PC LinuxCNC's servo thread waits, and rtec goes on."""


@pytest.fixture(scope="module")
def lathe() -> Iterator[Session]:
    with Session("lathe") as session:
        session.state("estop_reset")
        session.state("on")
        session.home()
        yield session


def z_error_um(lathe: Session) -> float:
    """Error of the tool along Z now, µm. Z has no play; in X an offset that moves the axis back is lost in it."""
    return abs(1e3 * (lathe.gets("z-tip") - lathe.gets("z-commanded")))


def small(lathe: Session) -> bool:
    """Below a twentieth of what it was?"""
    return z_error_um(lathe) < 0.5


def test_they_correct_and_what_machine_off_clears_is_said(lathe: Session) -> None:
    """Oracle: LinuxCNC's own pins and sampler.

    Without rtec 10 µm and more; with it a twentieth. Machine off: LinuxCNC's offset is zero, its joints have not moved,
    the loop waits; the order to resume makes it right again. No jump in all of that.
    """
    before = 0.0
    for place in PLACES:
        lathe.mdi(place)
        before = max(before, z_error_um(lathe))
    assert before > 10.0
    lathe.record(1, "offsets.txt")
    with LoopThread(lathe) as thread:
        for place in (*PLACES, *PLACES):
            lathe.mdi(place)
            lathe.until(lambda: small(lathe))
        stands_at, offset = lathe.position(), lathe.gets("x-offset")
        assert abs(offset) > 1e-2
        lathe.state("off")
        lathe.state("on")
        lathe.until(lambda: "cleared the external offsets" in thread.loop.stats.last_error)
        assert thread.loop.waits
        assert lathe.gets("x-offset") == 0.0
        assert np.allclose(lathe.position(), stands_at, atol=3e-3)  # the last moment's correction
        thread.order_resume()
        lathe.until(lambda: not thread.loop.waits)
        lathe.mdi(PLACES[0])
        lathe.until(lambda: small(lathe))
        lathe.joints(True)
        lathe.joints(False)
        lathe.jog(0, 50.0, 5.0)
        lathe.until(lambda: small(lathe))
    lathe.stop_record(1)
    rows = lathe.recorded("offsets.txt")
    n = len(AXES)
    for periods, factor in ((1, 2), (WINDOW, WINDOW)):
        following = rows[periods:, 0] - rows[:-periods, 0] == periods
        moved_um = 1e3 * (rows[periods:] - rows[:-periods])[following]
        commanded_um, tip_um = (np.abs(moved_um[:, 1 + k : 1 + k + n]) for k in (0, n))
        further_um = tip_um - commanded_um
        assert np.mean(further_um >= factor * STEP_UM) < LATE
        assert further_um.max() < 0.5 * before  # a jump would be the whole correction at once
