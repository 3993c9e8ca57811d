"""What a free choice asserts; the quick form of `free_proof`."""

from pathlib import Path

import pytest

from tests.characterise.free_proof import judge, kept, main


def test_nothing_false_is_asserted_of_whole_machines(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the truth, by exact transforms; a machine that the file has already is not judged again."""
    to = tmp_path / "free.jsonl"
    line = (
        '{"kind": "whole", "seed": 3, "z": [["made up", 0.5]], "false": [], "missed": [], "open": [], "verdict": true}'
    )
    to.write_text(line + "\n" + line.replace("3", "2")[:40])
    main(["--machines", "3", "--first", "1", "--only", "whole", "--to", str(to)])
    assert "whole: 3 machines" in capsys.readouterr().out
    judged = kept(to).values()
    assert ("made up", 0.5) in kept(to)["whole", 3].z
    assert not any(j.false or j.missed or not j.verdict for j in judged)
    assert all(abs(far) < 4.0 for j in judged for _, far in j.z)


@pytest.mark.parametrize("seed", [300037, 300069])
def test_no_degree_that_is_not_sure_and_no_pieces_for_a_bend(seed: int) -> None:
    """Oracle: the truth. A twist had a second degree, 1.4 standard errors from zero; a bend was made of pieces."""
    judged = judge("whole", seed)
    assert not judged.false
    assert not judged.missed
