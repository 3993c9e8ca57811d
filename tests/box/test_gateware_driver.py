"""Parts of the box driver's suite against the gateware in the place of the box in software.

Oracle: the tests are those of `tests/drivers`; only the box is another. Left out are tests of the software box's own
switches (a processor that hangs, a count of the commands that it took), those whose encoders jump, and long ones.
"""

import pytest

from tests.drivers import test_serial_box as suite
from tests.support import box_rig
from tests.support.gateware import GatewareBox, missing

pytestmark = pytest.mark.skipif(bool(missing()), reason=missing())


@pytest.fixture(autouse=True)
def _gateware(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(box_rig, "BoxSimulator", GatewareBox)


bench = suite.bench

for _name in (
    "test_axes_in_another_order",
    "test_one_exchange_a_cycle",
    "test_a_late_answer_is_an_older_reading",
    "test_half_a_frame_costs_one_cycle",
    "test_babbling_garbage_before_every_answer_is_passed_over",
    "test_the_box_holds_what_it_has_while_nobody_commands",
    "test_a_fault_of_an_encoder_holds_until_ordered",
    "test_the_wrong_box",
    "test_a_silent_port_at_the_start",
    "test_a_number_that_does_not_fit_is_not_sent",
    "test_before_and_after",
):
    globals()[_name] = getattr(suite, _name)
