"""The fit on a spindle's warm-up measured by others: chosen inside the first 32.1 h, judged on the last 14.2 h.

Nothing of the last part is given to the program; sensors, lags and what was left over come from the first alone.

How blind this is: the unseen error of ch3 and ch5 at 32.1 h was printed while rules of the choice were set, so what is
asserted of these two there is a record, not a proof. Nobody had looked at ch1, ch2 and ch4, nor at any other
division of the record, before the rules were settled; of these the tests below ask for no more than that the choice
does as well as the simple model that a person would have taken from the same hours.
"""

from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.characterise import Characterisation, characterise, read_wanted
from rtec.machine import Machine, machine_from
from rtec.metrology.measurement import Measurement
from tests.support import proof
from tests.support.characterise_examples import Probe, ProbeSetup
from tests.support.real_data import real_file

pytestmark = pytest.mark.xdist_group("real-fit")  # what is fitted once is used by all of them

Floats = NDArray[np.float64]
SPLIT_H = 32.1
SENSORS = [f"T{i}" for i in range(1, 17)]
COMPONENT = "EX0spindle"
"""The source does not say which way each probe looks; any shift of the spindle serves."""
CHANNELS = ("ch1", "ch2", "ch3", "ch4", "ch5")
OTHER_SPLITS_H = (20.0, 24.0, 28.0, 36.0, 40.0)
"""Set before anything was computed at them; the suite takes every other one."""
SPEED = f"spindle_growth:{COMPONENT}"
SIXTEEN = f"mount_expansion:{COMPONENT}:sensor=*"


def machine() -> Machine:
    return machine_from(
        {
            "machine": {"name": "spindle", "tool_chain": ["Z"], "work_chain": ["spindle"]},
            "axis": {"Z": {"direction": "Z", "travel_mm": [0.0, 100.0], "counts_per_mm": 1000.0}},
            "link": {"spindle": {}},
            "temperature": {s: {} for s in SENSORS},
        },
        "test",
    )


@cache
def table_of_the_record() -> dict[str, Floats]:
    """The whole record, by column name."""
    path = real_file("spindle_thermal", "caiviac_spindle_thermal_15s_to_60s.csv")
    table = np.genfromtxt(path, delimiter=",", names=True)
    return {name: np.asarray(table[name], dtype=np.float64) for name in table.dtype.names or ()}


@cache
def recorded(channel: str, until_h: float = np.inf) -> Measurement:
    """All of it, or the first hours."""
    table = table_of_the_record()
    rows = table["time_s"] < until_h * 3600.0
    degc = {s: table[f"t{i + 1}_C"][rows] for i, s in enumerate(SENSORS)}
    return Measurement(
        name=channel,
        instrument=Probe(ProbeSetup(zero="setup"), component=COMPONENT),
        machine=machine(),
        run=np.ones(int(rows.sum()), dtype=np.int64),
        time_s=table["time_s"][rows],
        channels={**degc, "spindle_rpm": table["spindle_rpm"][rows]},
        readings={"reading_um": table[f"{channel}_um"][rows]},
    )


def unseen_rms_um(result: Characterisation, whole: Measurement, split_h: float = SPLIT_H) -> float:
    """Of readings minus prediction in the last part; the zero is that of the first part."""
    state = whole.state()
    predicted = result.model.components(state)[:, whole.machine.components.index(COMPONENT)]
    left = whole.readings["reading_um"] - predicted
    first = whole.time_s < split_h * 3600.0
    left -= left[first].mean()
    return float(np.sqrt(np.mean(left[~first] ** 2)))


@lru_cache(maxsize=8)
def fitted(channel: str, effects: str | None = None, split_h: float = SPLIT_H) -> Characterisation:
    m = recorded(channel, split_h)
    return characterise([m], wanted=read_wanted(effects, m.machine) if effects else None)


class Judged(NamedTuple):
    """Unseen rms of the choice, of speed alone, of 16 temperatures at once, and which of these two looked better."""

    chosen: float
    speed: float
    sixteen: float
    picked: float
    """Of the simple model with the smaller left-out error in the hours that were given."""


@cache
def judged(channel: str, split_h: float) -> Judged:
    whole = recorded(channel)
    chosen, speed, sixteen = (fitted(channel, e, split_h) for e in (None, SPEED, SIXTEEN))
    unseen, alone, all_of_them = (unseen_rms_um(r, whole, split_h) for r in (chosen, speed, sixteen))
    picked = alone if speed.held_out_rms < sixteen.held_out_rms else all_of_them
    return Judged(unseen, alone, all_of_them, picked)


@pytest.mark.parametrize("channel", CHANNELS)
def test_choice_is_as_good_as_the_simple_model_that_looked_better(channel: str) -> None:
    """Oracle: the last 14.2 h, and two simple models fitted to the same first part.

    The better of the two is told by their left-out errors in the first part, as for the choice itself. (On ch2
    the 16 temperatures, which are over-fitted, happen to do better afterwards, 3.5 µm against 4.5: nothing in
    the first part says so, and speed alone looked better, which does worse.)
    """
    rms = judged(channel, SPLIT_H)
    assert rms.chosen <= rms.picked
    assert rms.chosen <= rms.speed


def test_choice_is_as_good_at_most_other_divisions_of_the_record() -> None:
    """Oracle: the same comparison where the record is divided elsewhere, 25 times in `make proof`.

    Not everywhere: 24 h hold three speeds only, and the speeds that come later are beyond what was seen. Were the
    choice no better than the simple models, 18 of 25 would come by chance in one case of fifty (the 25 are not
    independent, so that is a bound of common sense, not of statistics).
    """
    rms = [judged(channel, split) for split in OTHER_SPLITS_H[:: proof.of(1, 4)] for channel in CHANNELS]
    least = 18 / 25 * len(rms)
    assert sum(r.chosen <= r.picked for r in rms) >= least
    assert sum(r.chosen <= r.speed for r in rms) >= least


def test_ch3_holds_on_hours_it_never_saw() -> None:
    """Oracle: the last 14.2 h; speed alone gives 17 µm there, one lagged temperature with it 8.5."""
    result = fitted("ch3")
    assert unseen_rms_um(result, recorded("ch3")) <= 8.5
    assert len(result.model.effects) <= 4


def test_ch5_is_undecided() -> None:
    """Oracle: README of the data: near-equal choices lead to errors from 4 to 12 µm on the unseen part."""
    result = fitted("ch5")
    said = [w.text for w in result.warnings if w.code == "undecided"]
    assert any("near-equal choices" in text for text in said)
    assert len(result.undecided) >= 2
    assert all(r.held_out <= 1.02 * r.chosen_held_out for r in result.undecided)


@pytest.mark.parametrize("channel", ["ch3", "ch5"])
def test_sixteen_temperatures_are_over_fitted(channel: str) -> None:
    """Oracle: the unseen part is met more than twice as badly as the part that was fitted."""
    result = fitted(channel, SIXTEEN)
    assert len(result.model.effects) == 16
    codes = {w.code for w in result.warnings}
    assert {"over_fitted", "collinear", "ill_conditioned"} <= codes
    assert unseen_rms_um(result, recorded(channel)) > 2 * result.inside_rms
    # What the program says it would be, from the first part alone, is nearer the truth than the error in sample.
    assert result.held_out_rms > 1.5 * result.inside_rms


def test_left_out_blocks_are_those_of_the_readme() -> None:
    """Oracle: 32.1 h in stretches of 4 h, the last of 4.1 h."""
    result = fitted("ch3")
    assert result.measurements[0].blocks == "8 stretches of time"
