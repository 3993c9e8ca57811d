"""Two probes whose plugs are exchanged, in one file or in all. Oracle: the same readings under their right names."""

from dataclasses import replace

import pytest

from rtec.diagnosis.search.diagnose import diagnose
from rtec.metrology.measurement import Measurement
from tests.diagnosis.test_warm_start import day, known

pytestmark = pytest.mark.xdist_group("warm-start")


def exchanged(m: Measurement) -> Measurement:
    x, z = m.readings["reading_x_um"], m.readings["reading_z_um"]
    return replace(m, readings={"reading_x_um": z, "reading_z_um": x})


@pytest.mark.parametrize("wrong", [(True, False), (True, True)], ids=["one", "all"])
def test_exchanged_probes_are_asked_about(wrong: tuple[bool, ...]) -> None:
    """With both files wrong it had been a tilt of the other sign, and "no effect is missing"."""
    files = [exchanged(day(20 + i)) if w else day(20 + i) for i, w in enumerate(wrong)]
    names = " and ".join(m.name for m, w in zip(files, wrong, strict=True) if w)
    answer = diagnose(known(), files, draws=50)
    assert [d.kind for d in answer.doubts if d.fatal] == ["swapped_readings"]
    assert answer.sentence.lower().startswith(f"with reading_x_um and reading_z_um of {names} exchanged")


def test_right_probes_are_not() -> None:
    assert diagnose(known(), [day(20), day(21)], draws=50).verdict == "nothing_missing"
