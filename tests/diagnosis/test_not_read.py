"""Readings beside the angle of a rotary axis, which rtec does not read.

Oracle: a ball on a turning table, worked out here with rotations; the table's axis is off by known amounts, or is not.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.characterise import characterise
from rtec.diagnosis.compare.compare import compare
from rtec.diagnosis.search.diagnose import diagnose
from rtec.effects.effect_list import read_wanted
from rtec.estimation.judge import Judgement
from rtec.estimation.outliers import clean
from rtec.estimation.rotary import turned_with
from rtec.metrology.files.load import save_measurement
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from rtec.model.file import save_model
from tests.support import proof
from tests.support.command import here
from tests.support.diagnosis_examples import laser, recorded_by_laser, small_machine, write_machine

Floats = NDArray[np.float64]
MACHINE = small_machine()
MODEL = Model(MACHINE, (), name="bare")
CENTRE = np.array([100.0, 150.0])
ROUNDS = 4


def turn(angle_deg: Floats) -> Floats:
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    return np.array([[c, -s], [s, c]]).transpose(2, 0, 1)


def tip(xz_mm: Floats, error_um: Floats, angle_deg: Floats, seed: int) -> Measurement:
    """Readings of the tool tip in X and Z, 0.3 µm of noise, run by run."""
    n = len(xz_mm)
    rng = np.random.default_rng(seed)
    return Measurement(
        name=f"tip-{seed}",
        instrument=make_instrument("tool_tip", {"directions": ["X", "Z"]}, None, None, MACHINE, "test"),
        machine=MACHINE,
        run=np.arange(n) * ROUNDS // n + 1,
        time_s=np.arange(0.0, 6.0 * n, 6.0),
        channels={"x": xz_mm[:, 0], "z": xz_mm[:, 1]},
        readings={f"reading_{a}_um": error_um[:, i] + rng.normal(0.0, 0.3, n) for i, a in enumerate("xz")},
        unread={"b_deg": angle_deg},
    )


def on_a_ball(
    seed: int, pivot_um: tuple[float, float], lean_urad: float = 0.0, radii: tuple[float, ...] = (80.0,)
) -> Measurement:
    """The tool follows a ball on the table; the table's axis is off, or the table's scale of angle is."""
    once = np.arange(0.0, 361.0, 15.0)
    angle = np.concatenate([once if k % 2 == 0 else once[::-1] for k in range(ROUNDS)])
    radius = np.repeat([radii[k % len(radii)] for k in range(ROUNDS)], len(once))
    arm = radius[:, None] * np.array([1.0, 0.0])
    at = CENTRE + np.einsum("nij,nj->ni", turn(angle), arm)
    pivot = np.array(pivot_um)
    moved = pivot - np.einsum("nij,j->ni", turn(angle), pivot)
    moved += (
        1e-3 * lean_urad * np.stack([np.zeros(len(angle)), (at - CENTRE)[:, 0] * np.cos(np.deg2rad(angle))], axis=1)
    )
    return tip(at, -moved, angle, seed)


def swept(seed: int, angles: tuple[float, ...], scale_um_m: float) -> Measurement:
    """Linear axes on their own, beside a table that is indexed; the scale of X is off."""
    x = np.tile(np.linspace(10.0, 190.0, 25), ROUNDS)
    z = 60.0 + 20.0 * np.random.default_rng(seed).permutation(len(x)) % 200.0
    angle = np.array([angles[k % len(angles)] for k in range(len(x) // 5)]).repeat(5)
    return tip(np.stack([x, z], axis=1), np.stack([1e-3 * scale_um_m * x, 0.0 * x], axis=1), angle, seed)


def test_fit_goes_without_readings_that_follow_an_angle() -> None:
    """It had made nine effects of a rotary axis that is off, which spoiled what lasers had told."""
    line = laser(["scale,component=EXX,axis=X,k=12"], 1)
    off, right = on_a_ball(3, (6.0, -4.0)), on_a_ball(4, (0.0, 0.0))
    grown = {"reading_x_um": right.readings["reading_x_um"] + 12e-3 * right.channels["x"]}
    right = replace(right, readings={**right.readings, **grown})
    alone, found = characterise([line]), characterise([line, off])
    assert found.model.effects == alone.model.effects
    assert found.warnings[0].code == "not_read"
    assert found.warnings[0].text.startswith("tip-3: not in the fit, as the residual depends on b_deg (0 to 360)")
    assert [m.name for m in characterise([line, right]).measurements] == [line.name, "tip-4"]
    only = characterise([off])
    assert only.warnings[0].text.startswith("tip-3: The residual depends on b_deg")


@pytest.mark.parametrize("seed", proof.few(range(3), 1))
@pytest.mark.parametrize(
    "made",
    [
        {"pivot_um": (8.0, -6.0)},
        {"pivot_um": (0.0, 3.0), "radii": (80.0, 40.0)},
        {"pivot_um": (0.0, 0.0), "lean_urad": 50.0},
    ],
)
def test_no_effect_is_named_where_the_readings_follow_an_angle(seed: int, made: dict[str, tuple[float, float]]) -> None:
    m = on_a_ball(seed, **made)  # type: ignore[arg-type]
    found = diagnose(MODEL, [m])
    assert found.verdict == "undecided"
    assert [(d.kind, d.fatal) for d in found.doubts if d.fatal] == [("not_read", True)]
    assert not any(f.accepted for f in found.findings)
    assert "b_deg (0 to 360)" in found.sentence
    assert "rtec has no rotary axes" in found.sentence
    assert [d.kind for d in compare(MODEL, [m]).doubts if d.fatal] == ["not_read"]


@pytest.mark.parametrize("seed", proof.few(range(6), 2))
def test_noise_beside_an_angle_is_noise(seed: int) -> None:
    assert diagnose(MODEL, [on_a_ball(seed, (0.0, 0.0))]).verdict == "nothing_missing"


@pytest.mark.parametrize("seed", proof.few(range(3), 1))
@pytest.mark.parametrize("angles", [(0.0, 90.0), (0.0, 45.0, 200.0, 310.0), (-30.0, 30.0)])
def test_an_effect_of_a_linear_axis_is_named_beside_an_angle(seed: int, angles: tuple[float, ...]) -> None:
    found = diagnose(MODEL, [swept(seed, angles, 60.0)])
    assert not [d for d in found.doubts if d.kind == "not_read"]
    assert found.findings[0].accepted
    assert found.findings[0].label == "scale(EXX, X)"


def stays(seed: int, angle_of_run: Floats, error_um: Floats, readings: int = 12) -> Measurement:
    """Every run is measured at one angle; its error is that of the run, in X."""
    x = np.tile(np.linspace(10.0, 190.0, readings), len(angle_of_run))
    each = np.stack([np.repeat(error_um, readings), 0.0 * x], axis=1)
    m = tip(np.stack([x, 60.0 + 0.0 * x], axis=1), each, np.repeat(angle_of_run, readings), seed)
    return replace(m, run=np.repeat(np.arange(len(angle_of_run)) + 1, readings))


def doubted(m: Measurement) -> list[str]:
    said = turned_with(Judgement(MODEL, clean([m], MODEL.reference_degc)))
    return [said] if said else []


@pytest.mark.parametrize("seed", proof.few(range(5), 2))
@pytest.mark.parametrize("angles", [(0.0, 90.0, 180.0, 270.0), (0.0, 30.0)])
def test_a_table_indexed_between_runs_is_no_drift(seed: int, angles: tuple[float, ...]) -> None:
    """Oracle: 9 µm at 0° turn with the table; the order of the angles is drawn, so no drift has it."""
    rng = np.random.default_rng(seed)
    angle = rng.permutation(np.resize(angles, 16))
    m = stays(seed, angle, 9.0 * np.cos(np.deg2rad(angle if len(angles) > 2 else 6.0 * angle)))
    found = diagnose(MODEL, [m])
    assert [d.kind for d in found.doubts if d.fatal] == ["not_read"]
    assert "The residual depends on b_deg" in found.sentence


def numbered(m: Measurement) -> Measurement:
    """Each reading is a run of its own, as of a table that is indexed between readings."""
    return replace(m, run=np.arange(len(m.run)) + 1)


@pytest.mark.parametrize("seed", proof.few(range(2), 1))
def test_the_numbers_of_runs_decide_nothing(seed: int) -> None:
    """It had been refused by runs of a turn, and four linear effects by runs of one reading."""
    assert doubted(numbered(on_a_ball(seed, (6.0, -4.0), 20.0)))


def two_angles(seed: int, off_um: float) -> Measurement:
    """Two rotary axes at fourteen poses, three times; an offset turns with both."""
    a, c = np.array([(a, c) for a in (-90.0, 0.0, 90.0) for c in np.arange(0.0, 360.0, 72.0)][:14] * 3).T
    lean = np.cos(np.deg2rad(a)) * np.sin(np.deg2rad(c))
    error = off_um * np.stack([lean, np.sin(np.deg2rad(a))], axis=1)
    place = np.stack([100.0 + 60.0 * lean, 150.0 + 50.0 * np.sin(np.deg2rad(a))], axis=1)
    m = tip(place, error, a, seed)
    return replace(m, unread={"a_deg": a, "c_deg": c}, run=np.repeat([1, 2, 3], 14))


def test_few_poses_of_two_rotary_axes() -> None:
    assert all("a_deg" in doubted(two_angles(seed, 8.0))[0] for seed in range(3))
    assert not any(doubted(two_angles(seed, 0.0)) for seed in range(40))
    assert not any(doubted(numbered(on_a_ball(seed, (0.0, 0.0)))) for seed in range(20))


@pytest.mark.parametrize("angles", [(0.0, 90.0, 180.0, 270.0), (0.0, 30.0), tuple(np.arange(0.0, 360.0, 22.5))])
@pytest.mark.parametrize("rise", proof.few([1.0, 0.0], 1))
def test_a_drift_beside_a_table_that_is_indexed_is_none_of_its_doing(angles: tuple[float, ...], rise: float) -> None:
    """Oracle: means of runs that wander or rise, and that know nothing of the angle."""
    for seed in range(proof.of(300, 40)):
        rng = np.random.default_rng(1000 + seed)
        angle = np.resize(angles, 16)
        angle = np.sort(angle) if seed % 3 == 0 else rng.permutation(angle) if seed % 3 == 1 else angle
        drift = np.cumsum(rng.normal(rise, 2.0, 16)) if seed % 2 else rng.normal(0.0, 3.0, 16)
        assert not doubted(stays(seed, angle, drift)), seed


def with_direction(m: Measurement, own: Floats, angle_deg: Floats) -> Measurement:
    """The tip's readings with an error of its own, and directions of X and Z."""
    ways = {f"dir_{a}": np.sign(np.gradient(m.channels[a]) + 1e-9) for a in "xz"}
    readings = {n: v + own[:, i] for i, (n, v) in enumerate(m.readings.items())}
    return replace(m, channels={**m.channels, **ways}, readings=readings, unread={"b_deg": angle_deg})


def overrun() -> Floats:
    """Direction of the table that goes there and back, and overruns where it turns."""
    return np.repeat([1.0 if k % 2 == 0 else -1.0 for k in range(ROUNDS)], 25)


@pytest.mark.parametrize("seed", proof.few(range(5), 2))
def test_a_backlash_of_the_table_is_none_of_a_linear_axis(seed: int) -> None:
    """Oracle: a table that lags by 40 µrad either way, under a ball at 80 mm."""
    m = on_a_ball(seed, (0.0, 0.0))
    turned = np.deg2rad(m.unread["b_deg"])
    lag = 0.08 * 40.0 * overrun()[:, None] * np.stack([-np.sin(turned), np.cos(turned)], axis=1)
    assert "cosine, sine and direction of the angle lower it" in doubted(with_direction(m, lag, m.unread["b_deg"]))[0]


@pytest.mark.parametrize("seed", proof.few(range(5), 2))
def test_a_backlash_of_a_linear_axis_is_none_of_the_table(seed: int) -> None:
    """Oracle: X lags by 3 µm either way on the ball's circle."""
    m = on_a_ball(seed, (0.0, 0.0))
    way = np.sign(-overrun() * np.sin(np.deg2rad(m.unread["b_deg"])) + 1e-9)
    moved = with_direction(m, np.stack([3.0 * way, 0.0 * way], axis=1), m.unread["b_deg"])
    assert not doubted(replace(moved, channels={**moved.channels, "dir_x": way}))


@pytest.mark.parametrize("seed", proof.few(range(5), 2))
def test_waves_of_a_worm_are_none_of_a_screw(seed: int) -> None:
    """Oracle: a worm of 90 teeth, read at every degree of an arc, and a screw of 8 mm there."""
    angle = np.tile(np.arange(0.0, 40.0), ROUNDS)
    at = CENTRE + np.einsum("nij,j->ni", turn(angle), np.array([80.0, 0.0]))
    turned = np.deg2rad(angle)
    round_it = np.stack([-np.sin(turned), np.cos(turned)], axis=1)
    worm = tip(at, 2.0 * np.cos(90.0 * turned)[:, None] * round_it, angle, seed)
    assert "waves of about 4° lower it" in doubted(worm)[0]
    screw = 2.0 * np.stack([0.0 * turned, np.cos(2.0 * np.pi * at[:, 1] / 8.0)], axis=1)
    assert not doubted(tip(at, screw, angle, seed))


def test_every_command_says_once_what_is_not_read(tmp_path: Path) -> None:
    machine = write_machine(tmp_path)
    table = save_measurement(on_a_ball(5, (0.0, 0.0)), tmp_path / "tip.csv")
    save_model(MODEL, model := tmp_path / "bare.toml")
    for words in (
        ["fit", machine, table, "--effects", "scale:EXX", "-o", tmp_path / "fitted.toml"],
        ["compare", model, table],
        ["diagnose", model, table],
        ["improve", model, table, "--yes", "-o", tmp_path / "more.toml"],
    ):
        said = " ".join(here(*words).stdout.split())
        assert said.count("Not read: b_deg (0 to 360), which varies; rtec has no rotary axes") == 1, words


HPA_UM_PER_M = 0.268
"""Change of a wavelength in air at 20 °C with its pressure, µm per metre and hPa: Ciddor's equation."""


def laser_beside_pressure(seed: int, per_m_hpa: float, unread: str = "pressure_hpa") -> Measurement:
    """Runs along X through a morning; the pressure rises as smoothly as the nut warms up, later."""
    rng = np.random.default_rng(seed)
    x = np.tile(np.linspace(5.0, 195.0, 20), 16)
    run = np.repeat(np.arange(16) + 1, 20)
    time_s = 8.0 * np.arange(len(x)) + 900.0 * run
    warm = 6.0 * (1.0 - np.exp(-time_s / 3000.0))
    hpa = 1005.0 + 16.0 * (1.0 - np.exp(-np.maximum(time_s - 2000.0, 0.0) / 6000.0))
    error = 1e-3 * per_m_hpa * (x + 150.0) * (hpa - 1005.0)
    channels = {"x": x, "T_bed": np.round(20.0 + warm + rng.normal(0.0, 0.05, len(x)), 1)}
    reading = error + rng.normal(0.0, 0.15, len(x))
    return recorded_by_laser(seed, run, time_s, channels, reading, **{unread: np.round(hpa, 1)})


@pytest.mark.parametrize("seed", proof.few(range(4), 1))
def test_pressure_that_nothing_corrects_is_no_late_expansion(seed: int) -> None:
    """Neither does the data decide; the slope is that of physics, and a late expansion would go into the model."""
    found = diagnose(MODEL, [laser_beside_pressure(seed, HPA_UM_PER_M)])
    assert found.verdict == "undecided", found.sentence
    assert "is that of a laser's beam in air (0.268) where nothing corrects the pressure" in found.sentence
    assert not any(f.accepted for f in found.findings)


@pytest.mark.parametrize("seed", proof.few(range(4), 1))
@pytest.mark.parametrize(("slope", "column"), [(5 * HPA_UM_PER_M, "pressure_hpa"), (HPA_UM_PER_M, "humidity_percent")])
def test_a_column_of_no_such_physics_is_a_rival_and_forbids_nothing(seed: int, slope: float, column: str) -> None:
    found = diagnose(MODEL, [laser_beside_pressure(seed, slope, column)])
    doubts = [d for d in found.doubts if d.kind == "not_read"]
    assert [d.fatal for d in doubts] == [False]
    assert f"{column} (" in found.sentence
    assert "in air (0.268)" not in found.sentence


def there_and_back(seed: int, play_um: Floats, drift_um: float = 0.0) -> Measurement:
    """Twelve runs there and back along X, each with its own play, beside a pressure of the chuck in three steps."""
    rng = np.random.default_rng(seed)
    way = np.concatenate([np.linspace(5.0, 195.0, 16), np.linspace(195.0, 5.0, 16)])
    x, run = np.tile(way, 12), np.repeat(np.arange(12) + 1, 32)
    back = np.tile(np.repeat([1.0, -1.0], 16), 12)
    wander = np.cumsum(rng.normal(0.0, drift_um, 12))[run - 1]
    reading = 0.5 * back * play_um[run - 1] + wander + rng.normal(0.0, 0.4, len(x))
    bar = np.array([0.0, 30.0, 60.0] * 4)[run - 1]
    time_s = 8.0 * np.arange(len(x)) + 60.0 * run
    return recorded_by_laser(seed, run, time_s, {"x": x, "d_x": back}, reading, chuck_bar=bar)


@pytest.mark.parametrize("seed", proof.few(range(6), 2))
def test_a_reversal_that_follows_a_column_is_no_drift(seed: int) -> None:
    """Truth: play of 2.0, 3.8 and 5.6 µm. As it was, "0.70 µm is slow drift that no recorded channel explains"."""
    m = there_and_back(seed, np.array([2.0, 3.8, 5.6] * 4))
    model = characterise([there_and_back(seed + 50, np.full(12, 3.8))], wanted=read_wanted("backlash:EXX", MACHINE))
    found = diagnose(model.model, [m], draws=50)
    assert (
        "The residual follows chuck_bar (0 to 60), which rtec does not read, times the direction of X" in found.sentence
    )


@pytest.mark.parametrize("seed", proof.few(range(12), 3))
@pytest.mark.parametrize("drift_um", [0.0, 0.7])
def test_a_play_that_differs_otherwise_is_not_of_a_column(seed: int, drift_um: float) -> None:
    """Play that wanders from run to run beside a column in three steps; a column in steps goes with neither."""
    rng = np.random.default_rng(1000 + seed)
    m = there_and_back(seed, 3.8 + 1.5 * rng.standard_normal(12), drift_um)
    model = characterise([there_and_back(seed + 50, np.full(12, 3.8))], wanted=read_wanted("backlash:EXX", MACHINE))
    assert not [d for d in diagnose(model.model, [m], draws=50).doubts if d.kind == "not_read"]
