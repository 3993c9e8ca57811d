"""The gateware's inserter against the insertion in software: the same lines, bit for bit, for the same samples.

Oracle: `rtec.correction.insertion`, whose own oracle is a corrector that looks at every sample (`tests/correction`).
"""

import numpy as np
import pytest
from hypothesis import given, settings

from rtec.correction.insertion import InsertionSettings, correct_capture
from tests.correction.test_insertion import Case, cases
from tests.support.gateware import insert, missing

pytestmark = pytest.mark.skipif(bool(missing()), reason=missing())
laws = settings(max_examples=60, deadline=None, derandomize=True)


@pytest.mark.parametrize("separation", [3, 8])
@laws
@given(case=cases())
def test_lines_and_ledger_are_those_of_the_software(separation: int, case: Case) -> None:
    """Any motion, illegal transitions too, any targets, rates and both modes."""
    limits = InsertionSettings(separation, case.settings.min_insertion_interval_samples, case.settings.mode)
    same = Case(case.a, case.b, case.z, case.at, case.targets, limits)
    wanted = np.array([same.target_of(i) for i in range(len(case.a))], np.int32)
    wanted[0] = 0  # before the second sample nothing can be inserted
    software, ledger = correct_capture(case.a, case.b, case.z, limits, target_at=case.at, target_counts=case.targets)
    a, b, z, raw, inserted = insert(
        (case.a, case.b, case.z),
        wanted,
        separation,
        whole_cycles=limits.mode == "cycle",
        interval=limits.min_insertion_interval_samples,
    )
    np.testing.assert_array_equal(a, software.a)
    np.testing.assert_array_equal(b, software.b)
    np.testing.assert_array_equal(z, case.z)
    assert (raw, inserted) == (ledger.raw_counts, ledger.inserted_counts)
