"""Laser, ball bar and plates in one fit; the quick form of `joint_proof`."""

from pathlib import Path

import numpy as np
import pytest

from tests.characterise.joint_proof import kept, main


def test_numbers_of_a_joint_fit_are_within_their_errors(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the truth, by exact transforms; of some 20 numbers none is beyond four standard errors, and their root
    mean square is what chance allows (99.8 % of 20 normal numbers are between 0.6 and 1.5). A machine that the file has
    already, here one that cannot be, is not drawn again."""
    to = tmp_path / "proof.jsonl"
    to.write_text('[3, [["scale:EXX", 0.25]]]\n[2, [["sca')
    main(["4", "--to", str(to)])
    assert "4 machines" in capsys.readouterr().out
    found = kept(to)
    assert found[3] == [("scale:EXX", 0.25)]
    z = np.array([v for numbers in found.values() for _, v in numbers])
    assert len(z) >= 15
    assert np.abs(z).max() < 4.0
    assert 0.6 < np.sqrt(np.mean(z**2)) < 1.5
