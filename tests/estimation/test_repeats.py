"""Which readings repeat each other. Oracle: by hand."""

import numpy as np
import pytest

from rtec.estimation.floor import group_differences
from rtec.estimation.readings import row_codes


def test_groups_of_repeats_are_of_one_pose_near_in_temperature_and_one_of_each_run() -> None:
    """Pose 0: runs 1, 1, 2 near each other, then run 3 warmer; pose 1: runs 1 and 2."""
    pose, run = np.array([0, 0, 1, 0, 1, 0]), np.array([1, 1, 1, 2, 2, 3])
    warm = np.array([[20.0], [20.1], [20.0], [20.2], [20.29], [20.31]])
    values = np.array([1.0, 9.0, 5.0, 2.0, 8.0, 7.0])
    order = np.argsort(pose, kind="stable")
    square, freedom, held = group_differences(order, pose, run, warm, values)
    assert (freedom, held) == (2, 4)
    assert square == pytest.approx(0.5 + 4.5)
    square, freedom, held = group_differences(order, pose, run, warm[:, :0], values)
    assert (freedom, held) == (3, 5)
    assert square == pytest.approx(np.var([1.0, 2.0, 7.0]) * 3 + 4.5)


def test_rows_have_one_number_where_they_are_alike() -> None:
    """Minus zero is zero."""
    codes = row_codes(np.array([[1.0, 1.0, -0.0, 0.0, 1.0], [2.0, 3.0, 5.0, 5.0, 2.0]]))
    assert codes[0] == codes[4]
    assert codes[2] == codes[3]
    assert len(set(codes.tolist())) == 3
