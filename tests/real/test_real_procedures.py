"""Procedures on recordings made by others; oracle: the figures that their own reports print, and independent sums.

The recordings are not part of the project; see `tests/support/real_data.py`.
"""

import re
from collections.abc import Iterable

import numpy as np
import pytest

from rtec.metrology.procedures.drift import spindle_drift
from rtec.metrology.procedures.iso230_2 import Positioning, TwoWay, positioning
from rtec.metrology.procedures.tables import read_dat, read_table
from rtec.metrology.readers.base import SourceOptions
from rtec.metrology.readers.json_lines import read as read_json
from rtec.metrology.readers.twincat_scope import read as read_scope
from tests.support.cyclic_turns import cyclic_error
from tests.support.lag_fit import lag_model
from tests.support.real_data import real_file

SETS = {
    "b02-x_target_x.md_ISO230.dat": "b02-x_x_iso230_2_report.md",
    "muts-target_x_report_ILD50.md_ISO230.dat": "muts-target_x_report_ILD50.md",
    "ecmccomgui-example_data_ISO230_2.dat": "ecmccomgui-example_report_ISO230_2.md",
}
CHECKED_MM = {
    "b02-x_target_x.md_ISO230.dat": {"B": 0.03358, "M": 0.09365, "A": 0.13527, "E": 0.12285, "R": 0.05516},
    "muts-target_x_report_ILD50.md_ISO230.dat": {"B": 0.03505, "M": 0.02676, "A": 0.20114, "E": 0.05703, "R": 0.20114},
}
ROUNDING_MM = 1e-5


def both(name: str) -> tuple[Positioning, TwoWay, dict[str, float]]:
    """Our result, its bidirectional part, and the numbers that the published report prints, mm."""
    result = positioning(read_dat(real_file("iso230_positioning", name), swap=True))
    text = real_file("iso230_positioning", SETS[name]).read_text(encoding="utf-8")
    printed = {k: float(v) for k, v in re.findall(r"^\**(\w+) = (-?[\d.]+) \[mm\]", text, re.MULTILINE)}
    assert result.both
    return result, result.both, printed


@pytest.mark.parametrize("name", CHECKED_MM)
def test_checked_figures(name: str) -> None:
    _, result, _ = both(name)
    for key, value in CHECKED_MM[name].items():
        assert getattr(result, f"{key}_um") / 1e3 == pytest.approx(value, abs=ROUNDING_MM), key


@pytest.mark.parametrize("name", SETS)
def test_what_the_reports_have_right(name: str) -> None:
    """The reports' forward is the files' BWD: swapped, all that they compute after the standard agrees."""
    result, two, printed = both(name)
    assert result.up
    assert result.down
    found = {
        "B": two.B_um, "B_avg": two.B_mean_um, "M": two.M_um, "A": two.A_um,
        "R_fwd": result.up.R_um, "R_bwd": result.down.R_um,
        "E_fwd": result.up.E_um, "E_bwd": result.down.E_um,
        "A_fwd": result.up.A_um, "A_bwd": result.down.A_um,
    }  # fmt: skip
    for key, value in found.items():
        assert value / 1e3 == pytest.approx(printed[key], abs=ROUNDING_MM), key


@pytest.mark.parametrize("name", SETS)
def test_the_two_errors_of_the_reports(name: str) -> None:
    """Their E takes max(all means) - max(min↑, min↓); their R is max(R↑, R↓) without the reversal term."""
    result, two, printed = both(name)
    assert result.up
    assert result.down
    up, down = result.up, result.down
    wrong_e = max(up.mean_um.max(), down.mean_um.max()) - max(up.mean_um.min(), down.mean_um.min())
    assert wrong_e / 1e3 == pytest.approx(printed["E"], abs=ROUNDING_MM)
    assert max(up.R_um, down.R_um) / 1e3 == pytest.approx(printed["R"], abs=ROUNDING_MM)
    assert two.E_um / 1e3 > printed["E"] + ROUNDING_MM
    assert two.R_um >= max(up.R_um, down.R_um)


def test_r_of_the_first_set_is_twice_what_the_report_says() -> None:
    _, two, printed = both("b02-x_target_x.md_ISO230.dat")
    assert two.R_um / 1e3 > 1.9 * printed["R"]


def test_directions_of_the_file_are_kept_unless_swapped() -> None:
    """First values of file and report: FWD of the file stands in the report's table "backward"."""
    name = "b02-x_target_x.md_ISO230.dat"
    path = real_file("iso230_positioning", name)
    assert read_dat(path).up_um[0, 0] == pytest.approx(-49.226, abs=1e-3)
    assert read_dat(path, swap=True).up_um[0, 0] == pytest.approx(-18.52, abs=1e-2)


def test_drift_in_the_first_set() -> None:
    """Oracle: the cycle means by a plain average; they fall in every cycle, by 5.6 µm in all."""
    path = real_file("iso230_positioning", "b02-x_target_x.md_ISO230.dat")
    visits = read_dat(path)
    plain = np.concatenate([visits.up_um, visits.down_um]).mean(axis=0)
    r = positioning(visits, 5.0)
    assert r.drift
    np.testing.assert_allclose(r.drift.cycle_um, plain - plain.mean())
    assert (np.diff(plain) < 0).all()
    assert r.drift.is_drift
    assert r.drift.R_without_um < 0.75 * r.drift.R_um
    assert any("multiples of the pitch" in w for w in r.warnings)


def test_resolver_harmonics_and_delay() -> None:
    """Harmonic 4 at about 8.1°, a delay and no reversal.

    Oracle: at equal places at steady speed the readings of both ways, averaged over whole periods of the fourth
    harmonic, differ by -2 · speed · delay and nothing else; that needs no harmonics at all.
    """
    table = read_scope(real_file("resolver_cyclic", "ResolverCiclicError2.csv"), SourceOptions())[0]
    time, position, speed, reading = (np.asarray(table.columns[n], dtype=np.float64) for n in _names(table.columns))
    r = cyclic_error(time, position, reading)
    assert [h.order for h in sorted(r.harmonics, key=lambda h: -h.amplitude.value)[:5]] == [4, 8, 2, 12, 1]
    assert r.strongest.amplitude.value == pytest.approx(8.1, abs=0.15)
    assert not r.reversal_deg.is_real
    assert abs(r.reversal_deg.value) < 0.03
    assert r.delay_s.se < 0.001
    steady = np.abs(speed) > 35.99
    error, grid = reading - position, np.arange(45.0, 315.0, 0.5)
    ways = []
    for sign in (1, -1):
        rows = steady & (np.sign(speed) == sign)
        order = np.argsort(position[rows])
        ways.append(np.interp(grid, position[rows][order], error[rows][order]))
    by_hand = -float((ways[0] - ways[1]).mean()) / 72.0
    assert r.delay_s.value == pytest.approx(by_hand, abs=0.0015)
    assert 0.0325 < by_hand < 0.0365


def _names(columns: Iterable[str]) -> list[str]:
    """Time, reference, velocity, resolver, however the reader tells the two positions apart."""
    names = list(columns)
    return [next(n for n in names if part in n) for part in ("time", "Internal Counter", "Velocity", "Resolver")]


def test_probe_lag() -> None:
    """At once and late expansion with the bed: at or below 4.6 µm; at once alone leaves 21 µm."""
    table = read_json(real_file("probe_thermal", "probe_accuracy_superpinda.json"), SourceOptions())[0]
    ts, z, bed, nozzle = (np.asarray(table.columns[n], dtype=np.float64) for n in ("ts", "z", "btemp", "etemp"))
    probe = ~np.isnan(z)
    time = ts[probe] - ts[0]
    warm = {n: np.interp(ts[probe], ts[~np.isnan(v)], v[~np.isnan(v)]) for n, v in (("bed", bed), ("nozzle", nozzle))}
    reading_um = 1e3 * z[probe]
    at_once = lag_model(time, reading_um, warm, ["bed"], [])
    late = lag_model(time, reading_um, warm, ["bed"], ["bed"])
    assert at_once.rms_um > 20
    assert late.rms_um <= 4.6
    assert any("factor" in w for w in late.words)  # 47 minutes do not tell a time constant of 40 well
    full = lag_model(time, reading_um, warm, ["bed"], ["bed", "nozzle"])
    assert full.rms_um < 3.1
    assert full.tau_s["bed"].value == pytest.approx(830, abs=2 * full.tau_s["bed"].se)


def test_spindle_drift_over_two_days() -> None:
    """Speeds and hours of the phases as the file's README has them; every 4 h phase of ch3 is described to 1.5 µm."""
    table = read_table(real_file("spindle_thermal", "caiviac_spindle_thermal_15s_to_60s.csv"))
    probes = {"radial1": table["ch1_um"], "radial2": table["ch3_um"]}
    r = spindle_drift("caiviac", table["time_s"], table["spindle_rpm"], probes, 100.0)
    assert [p.rpm for p in r.phases if p.hours > 3] == [1250, 0, 2500, 0, 3750, 0, 5000, 0, 3500, 0]
    assert r.traces[2].name == "tilt"
    fits = [f.approach for f in r.traces[1].fits if r.phases[f.phase].hours > 3]
    assert all(a and (a.pair.rms if a.pair else a.rms) < 1.5 for a in fits)
    assert all(a and 3600 < a.tau_s < 5 * 3600 for a in fits)
    short = [f for f in r.traces[1].fits if r.phases[f.phase].hours < 1.5 and f.approach]
    assert all(f.approach and np.isinf(f.approach.tau_high_s) for f in short)
