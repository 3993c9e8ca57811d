"""Parts of `make linuxcnc` that need no LinuxCNC: dwells of a recording, the table, the figure."""

import numpy as np
import pytest

from tests.support.linuxcnc_loop import dwell_means
from tests.tutorial.linuxcnc import STAGES, Plan, figure, length_um, measuring, table


def test_the_mean_of_each_dwells_second_half() -> None:
    """Oracle: a recording by hand: 100 rows at 1 mm, 30 in motion, 200 at 2 mm; the error settles in the first half."""
    rows = np.zeros((330, 12))
    rows[:, 0] = np.arange(330)
    rows[:100, 1], rows[100:130, 1], rows[130:, 1] = 1.0, np.linspace(1.01, 1.99, 30), 2.0
    rows[:, 4] = rows[:, 1] + 0.001
    rows[:50, 4] += 9.0
    rows[130:230, 4] += 9.0
    found = dwell_means(rows, 100)
    assert [float(d[1]) for d in found] == [1.0, 2.0]
    assert [float(d[4] - d[1]) for d in found] == pytest.approx([0.001, 0.001])
    assert len(dwell_means(rows, 150)) == 1


def test_what_is_measured_and_made() -> None:
    """Law: each axis is measured alone at two places of the others, over its whole travel, in both directions."""
    plan = Plan()
    lines = plan.lines()
    for k in range(3):
        others = [i for i in range(3) if i != k]
        alone = [line for line in np.split(lines, 6) if (np.ptp(line[:, others], axis=0) == 0).all()]
        assert len(alone) == 2
        assert all((line[0, k], line[:, k].max(), line[-1, k]) == (-90.0, 90.0, -90.0) for line in alone)
    assert measuring(plan.diagonal(), 3.0).count("G4") == 1 + len(plan.diagonal())
    assert plan.job().count("G4") == 8


def test_the_table_and_the_figure() -> None:
    """Oracle: lengths by hand; a line of the table fits 80 columns."""
    errors = {name: np.array([[3.0, 4.0, 0.0], [0.0, 0.0, 1.0]]) / (k + 1) for k, name in enumerate(STAGES)}
    assert length_um(errors["without rtec"]).tolist() == [5.0, 1.0]
    text = table(errors)
    assert text.splitlines()[1].split()[-4:] == ["3.00", "4.00", "1.00", "5.00"]
    assert max(map(len, text.splitlines())) <= 80
    assert figure(errors, "an effect")[1:4] == b"PNG"
