"""An instrument that drifts from run to run, beside an effect along the runs.

Oracle: what was simulated; another day.
"""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.diagnosis.compare.compare import compare
from rtec.diagnosis.extend.add import add
from rtec.diagnosis.extend.improve import improve
from rtec.diagnosis.search.diagnose import diagnose
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from rtec.sim.campaign.truth import effect_from_text
from tests.support import proof
from tests.support.diagnosis_examples import NOISE_UM, laser, small_machine
from tests.support.warming import warming

Floats = NDArray[np.float64]

HIDDEN = {
    "scale": "scale,component=EXX,axis=X,k=8",
    "backlash": "backlash,component=EXX,axis=X,B=1.2",
    "cyclic_screw": "cyclic_screw,component=EXX,axis=X,harmonics=1,s1=0.7,c1=0,pitch=5",
}


def drifting(m: Measurement, form: str) -> Measurement:
    """The readings with a drift of some micrometres over the day, which no channel records."""
    share = (m.time_s - m.time_s[0]) / (m.time_s[-1] - m.time_s[0])
    um: dict[str, Floats] = {
        "warms up": 4.0 * (1.0 - np.exp(-5.0 * share)),
        "rises": 3.0 * share,
        "swings": 2.0 * np.sin(7.0 * share + 12.0),
    }
    return replace(m, readings={k: v + um[form] for k, v in m.readings.items()})


@pytest.mark.parametrize(
    ("effect", "form", "seed"),
    [("scale", "warms up", 4), ("scale", "rises", 12), ("backlash", "warms up", 12), ("cyclic_screw", "swings", 12)],
)
def test_the_effect_is_named_beside_the_drift(effect: str, form: str, seed: int) -> None:
    """The drift is most of the error on held-out runs. It had led to other effects, or to none of the catalogue."""
    d = diagnose(Model(small_machine()), [drifting(laser([HIDDEN[effect]], seed), form)], draws=50)
    first = d.findings[0]
    assert first.accepted
    assert (first.effect.effect, first.effect.component) == (effect, "EXX")
    assert not {"mount_expansion", "ambient_drift", "axis_expansion"} & {f.effect.effect for f in d.group}


def test_what_is_written_beside_it_meets_another_day() -> None:
    hidden = HIDDEN["backlash"]
    done = improve(Model(small_machine()), [drifting(laser([hidden], 12), "warms up")], draws=50)
    assert [s.labels for s in done.steps] == [("backlash(EXX, X)",)]
    assert compare(done.model, [laser([hidden], 112)]).judged.residual < 1.1 * NOISE_UM


@pytest.mark.parametrize("form", ["warms up", "rises", "swings"])
def test_the_drift_alone_is_no_effect(form: str) -> None:
    assert not diagnose(Model(small_machine()), [drifting(laser([], 21), form)], draws=50).group


@pytest.mark.parametrize(
    ("seed", "k", "um", "tau_s", "step_degc"),
    proof.few(
        [(48, 4.0, 4.0, 1500.0, 0.0625), (374, 2.0, 4.0, 8000.0, 0.25), (207, 4.0, 4.0, 4000.0, 0.0625),
         (117, 4.0, -8.0, 8000.0, 0.0625)], 2,
    ),
)  # fmt: skip
def test_a_shift_beside_an_instrument_that_warms_up(
    seed: int, k: float, um: float, tau_s: float, step_degc: float
) -> None:
    """Both together make a surface over two temperatures, or one and the time: it had been "not in the catalogue"."""
    days = warming(seed, 10, grows=False)
    quiet, m = days.other, days.given
    empty = [
        effect_from_text(text, m.machine)
        for text in ("scale,component=EXX,axis=X,k=1", "backlash,component=EXX,axis=X,B=1")
    ]
    known = add(Model(m.machine), empty, [quiet]).model
    moved = k * (m.channels["T_nut"] - m.channels["T_nut"][0])
    moved += um * (1.0 - np.exp(-(m.time_s - m.time_s[0]) / tau_s))
    channels = {c: np.round(v / step_degc) * step_degc if c.startswith("T_") else v for c, v in m.channels.items()}
    d = diagnose(
        known, [replace(m, readings={c: v + moved for c, v in m.readings.items()}, channels=channels)], draws=50
    )
    assert d.verdict == "missing_effect"
    assert d.findings[0].accepted
    assert d.findings[0].effect.label == "mount_expansion(EXX, T_nut)"
