"""The diagnosis on recordings made by others: which effect is missing there, and what adding it buys.

The recordings are not part of the project; see `tests/support/real_data.py`. Oracles: hours of the record that the
program is never given; the procedures of `rtec.metrology.procedures`, which share no code with the diagnosis; plain
averages.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.characterise import Characterisation
from rtec.diagnosis.extend.improve import Improved, improve
from rtec.diagnosis.result import Diagnosis
from rtec.diagnosis.search.diagnose import diagnose
from rtec.machine import machine_from
from rtec.metrology.measurement import Measurement
from rtec.metrology.procedures.iso230_2 import positioning
from rtec.metrology.procedures.tables import read_dat
from rtec.metrology.readers.base import SourceOptions
from rtec.metrology.readers.json_lines import read as read_json
from rtec.metrology.readers.twincat_scope import read as read_scope
from rtec.model import Model
from tests.real.test_real_fit import SPEED, SPLIT_H, fitted, recorded, unseen_rms_um
from tests.support.characterise_examples import Probe, ProbeSetup
from tests.support.cyclic_turns import cyclic_error
from tests.support.lag_fit import lag_model
from tests.support.real_data import real_file

pytestmark = pytest.mark.xdist_group("real-diagnosis")  # what is fitted once is used by all of them

Floats = NDArray[np.float64]
HEAT = {"mount_expansion", "ambient_drift", "spindle_growth", "coolant_expansion", "daily_drift"}
B02 = "b02-x_target_x.md_ISO230.dat"


@cache
def speed_only(channel: str) -> Characterisation:
    """The spindle's growth with its speed, fitted to the first hours."""
    return fitted(channel, SPEED)


@cache
def spindle(channel: str) -> Diagnosis:
    return diagnose(speed_only(channel).model, [recorded(channel, SPLIT_H)])


def test_a_temperature_is_missing_beside_the_speed() -> None:
    """Oracle: the README of the data: one lagged temperature beside the speed halves the error; no geometry is there
    to be blamed."""
    d = spindle("ch3")
    assert d.findings[0].accepted
    assert "sensor" in type(d.findings[0].effect).model_fields
    assert {f.effect.effect for f in d.group} <= HEAT
    assert d.findings[0].heldout_drop > 0.5


def test_adding_it_holds_on_hours_never_seen() -> None:
    """Oracle: the last 14.2 h, of which nothing is given to the program; the speed alone leaves 17 µm there."""
    start = speed_only("ch3")
    whole = recorded("ch3")
    assert unseen_rms_um(start, whole) > 15.0
    better = improve(start.model, [recorded("ch3", SPLIT_H)])
    assert better.steps
    assert "EX0spindle, T" in better.steps[0].labels[0]
    assert unseen_rms_um(replace(start, model=better.model), whole) <= 8.5


def test_ch5_is_called_ambiguous() -> None:
    """Oracle: README of the data: near-equal choices of temperatures lead to 4, 12 and 12 µm on the unseen part."""
    d = spindle("ch5")
    assert d.verdict == "ambiguous"
    assert len(d.group) > 1
    assert "cannot distinguish" in d.sentence


def resolver() -> tuple[Measurement, tuple[Floats, Floats, Floats, Floats]]:
    """One turn forward and back as a linear axis, a degree for a millimetre; the raw columns beside."""
    table = read_scope(real_file("resolver_cyclic", "ResolverCiclicError2.csv"), SourceOptions())[0]
    parts = ("time", "Internal Counter", "Velocity", "Resolver")
    names = [next(n for n in table.columns if part in n) for part in parts]
    time, place, speed, reading = (np.asarray(table.columns[n], dtype=np.float64) for n in names)
    machine = machine_from(
        {
            "machine": {"name": "resolver", "tool_chain": ["X"], "work_chain": []},
            "axis": {"X": {"direction": "X", "travel_mm": [0, 360], "counts_per_mm": 1000, "pitch_mm": 360}},
        },
        "test",
    )
    moving = np.abs(speed) > 0.5
    channels = {"x": place, "v_x": speed, "d_x": np.sign(speed)}
    measurement = Measurement(
        name="resolver",
        instrument=Probe(ProbeSetup(zero="setup"), component="EXX"),
        machine=machine,
        run=np.where(speed < 0, 2, 1)[moving].astype(np.int64),
        time_s=time[moving],
        channels={k: v[moving] for k, v in channels.items()},
        readings={"reading_um": 1e3 * (reading - place)[moving]},
    )
    return measurement, (time, place, speed, reading)


def test_harmonics_by_number_then_delay_and_no_backlash() -> None:
    """Oracle: the analysis of cyclic errors, which works in the time domain and fits no model file."""
    measurement, (time, place, _, reading) = resolver()
    better = improve(Model(measurement.machine), [measurement])
    names = [f.effect.effect for f in better.model.effects]
    assert names[:2] == ["cyclic_screw", "servo_lag"]
    assert not any("backlash" in n or "reversal" in n for n in names)
    values = better.model.effects[0].values
    order = max(range(1, 17), key=lambda k: np.hypot(values[f"s{k}"], values[f"c{k}"]))
    by_itself = cyclic_error(time, place, reading)
    assert order == by_itself.strongest.order == 4
    amplitude = np.hypot(values["s4"], values["c4"]) / 1e3
    assert amplitude == pytest.approx(by_itself.strongest.amplitude.value, rel=0.03)
    # Reading = true + τ v with τ in µm per mm/s, that is in ms. The lag of the wave itself is left to what comes after.
    delay_ms = -better.model.effects[1].values["tau"]
    assert delay_ms == pytest.approx(1e3 * by_itself.delay_s.value, rel=0.25)


def probe() -> tuple[Measurement, dict[str, Floats]]:
    """An inductive probe over a bed that heats and cools."""
    table = read_json(real_file("probe_thermal", "probe_accuracy_superpinda.json"), SourceOptions())[0]
    ts, z, bed, nozzle = (np.asarray(table.columns[n], dtype=np.float64) for n in ("ts", "z", "btemp", "etemp"))
    read = ~np.isnan(z)
    warm = {
        n: np.interp(ts[read], ts[~np.isnan(v)], v[~np.isnan(v)]) for n, v in (("T_bed", bed), ("T_nozzle", nozzle))
    }
    machine = machine_from(
        {
            "machine": {"name": "probe", "tool_chain": ["Z"], "work_chain": ["spindle"]},
            "axis": {"Z": {"direction": "Z", "travel_mm": [0.0, 100.0], "counts_per_mm": 1000.0}},
            "link": {"spindle": {}},
            "temperature": {"T_bed": {}, "T_nozzle": {}},
        },
        "test",
    )
    time, reading = ts[read] - ts[0], 1e3 * z[read]
    measurement = Measurement(
        name="probe",
        instrument=Probe(ProbeSetup(zero="setup"), component="EZ0spindle"),
        machine=machine,
        run=np.ones(int(read.sum()), dtype=np.int64),
        time_s=time,
        channels=warm,
        readings={"reading_um": reading},
    )
    return measurement, {"time": time, "reading": reading, "bed": warm["T_bed"]}


def test_a_probe_that_lags_behind_its_bed() -> None:
    """Oracle: the search for a lag, by ordinary least squares over a grid of time constants.

    At once and late with the other sign: neither is found alone, as each alone predicts left-out hours badly.
    """
    measurement, raw = probe()
    better = improve(Model(measurement.machine), [measurement])
    found = {f.effect.effect: f for f in better.model.effects}
    assert {"mount_expansion", "ambient_drift"} == set(found)
    assert all(getattr(f.effect, "sensor", None) == "T_bed" for f in found.values())
    alone = lag_model(raw["time"], raw["reading"], {"bed": raw["bed"]}, ["bed"], ["bed"])
    late = found["ambient_drift"]
    tau = alone.tau_s["bed"]
    assert abs(late.theta["tau"] - tau.value) < 2 * tau.se
    assert late.values["k"] == pytest.approx(alone.lagged_um_per_degc["bed"].value, rel=0.25)
    assert found["mount_expansion"].values["k"] == pytest.approx(alone.direct_um_per_degc["bed"].value, rel=0.25)
    assert better.steps[0].after.inside < 1.3 * alone.rms_um


def b02() -> Measurement:
    """Five cycles of an ISO 230-2 test; the file holds no times, so a stop each 20 s is supposed."""
    visits = read_dat(real_file("iso230_positioning", B02), swap=True)
    targets, cycles = visits.up_um.shape
    there, back = visits.target_mm, visits.target_mm[::-1]
    machine = machine_from(
        {
            "machine": {"name": "b02", "tool_chain": ["X"], "work_chain": []},
            "axis": {"X": {"direction": "X", "travel_mm": [-25.0, 25.0], "counts_per_mm": 1000.0}},
        },
        "test",
    )
    reading = np.concatenate([np.concatenate([visits.up_um[:, k], visits.down_um[::-1, k]]) for k in range(cycles)])
    return Measurement(
        name="b02-x",
        instrument=Probe(ProbeSetup(zero="setup"), component="EXX"),
        machine=machine,
        run=np.repeat(np.arange(1, cycles + 1), 2 * targets),
        time_s=np.arange(0.0, 20.0 * len(reading), 20.0),
        channels={
            "x": np.tile(np.concatenate([there, back]), cycles),
            "d_x": np.tile(np.repeat([1.0, -1.0], targets), cycles),
        },
        readings={"reading_um": reading},
    )


def steps_of(better: Improved) -> list[str]:
    return [label for s in better.steps for label in s.labels]


def test_drift_between_the_cycles_is_named_as_such() -> None:
    """Oracle: cycle means by a plain average, and the drift that the positioning procedure finds by itself."""
    measurement = b02()
    visits = read_dat(real_file("iso230_positioning", B02), swap=True)
    alone = positioning(visits, 5.0).drift
    assert alone is not None
    assert alone.is_drift
    better = improve(Model(measurement.machine), [measurement])
    assert any("backlash" in label for label in steps_of(better))
    fall = float(np.ptp(np.concatenate([visits.up_um, visits.down_um]).mean(axis=0)))
    for d in better.diagnoses:
        note = next(n for n in d.notes if n.startswith("drift between the runs (cycles)"))
        assert "falls steadily" in note
        said = float(note.split(" by ")[1].split(" ")[0])
        assert said == pytest.approx(fall, rel=0.1)
        assert not any("drift" in f.label for f in d.group)
