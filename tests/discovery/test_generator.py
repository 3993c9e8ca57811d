"""The generator itself: its kinematics, noise, sizes and bits, each against something it does not share."""

import ast
from pathlib import Path

import numpy as np
import pytest

from tests.discovery import translate
from tests.discovery.generator import noise
from tests.discovery.generator.campaign import KINDS, campaign
from tests.discovery.generator.cases import BY_NAME, GROUPS, Case, cases, single
from tests.discovery.generator.dataset import build, centred, floor_of, left_of, oracle_cut, rms
from tests.discovery.generator.machine import TRAVEL_MM, lever
from tests.discovery.generator.outside import OUTSIDE
from tests.discovery.generator.thermal import SENSORS, weather
from tests.discovery.generator.truth import Truth, same_component
from tests.discovery.generator.truths import TRUTHS

HERE = Path(__file__).parent


def test_nothing_in_the_generator_imports_the_program() -> None:
    """Oracle: the syntax tree of every file."""
    files = sorted((HERE / "generator").glob("*.py"))
    assert len(files) > 3
    for path in files:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not [n for n in names if n.split(".")[0] in ("rtec", "rtec_drivers")], path.name


@pytest.mark.parametrize("kind", KINDS)
def test_arms_written_by_hand_are_those_of_the_chain(kind: str) -> None:
    """Oracle: the program's chain and instruments on the translated machine, at random poses, every component."""
    machine = translate.the_machine()
    dataset = build(Case("clean", 5, kind, "white"))
    instrument = translate.measurement_of(dataset).instrument
    rng = np.random.default_rng(3)
    pose = {a: rng.uniform(*TRAVEL_MM[a], 40) for a in "XYZ"}
    stacked = np.stack([pose[a.name] for a in machine.axes], axis=1)
    for component in machine.components:
        if component.endswith(("0tool", "0table")):
            continue  # the generator has no errors there
        mine = np.stack([lever(component, pose, column) for column in dataset.campaign.columns])
        np.testing.assert_allclose(mine, instrument.arms_of(machine, stacked, component), atol=1e-12)


def test_the_same_case_gives_the_same_bits_and_another_seed_others() -> None:
    """Oracle: the first time."""
    case = single(41, BY_NAME["cyclic_screw"])
    one, two, three = build(case), build(case), build(single(42, BY_NAME["cyclic_screw"]))
    for a, b in ((one.readings, two.readings), (one.clean, two.clean), (one.hidden, two.hidden)):
        assert a.tobytes() == b.tobytes()
    assert all(one.channels[k].tobytes() == two.channels[k].tobytes() for k in one.channels)
    assert one.readings.tobytes() != three.readings.tobytes()


@pytest.mark.parametrize("truth", [*TRUTHS, *OUTSIDE], ids=lambda t: t.name)
def test_hidden_effects_have_the_stated_size_and_can_be_seen(truth: Truth) -> None:
    """Oracle: the sizes that the benchmark states (1-3 µm), and least squares with the true shape.

    The share that known errors leave is larger than what the fit of the true shape misses by: it can be found.
    """
    for seed in (7, 8):
        group = "singles" if truth in TRUTHS else "outside"
        dataset = build(Case(group, seed, truth.kind, "ou", (truth.name,)))
        moving = centred(dataset.hidden[0])
        seen = moving.std(axis=1) > 1e-6
        assert 0.999 <= rms(moving[seen]) <= 3.001
        before, oracle = oracle_cut(dataset)
        assert left_of(dataset, 0) > 0.15
        assert oracle < before


def test_known_errors_leave_nothing_where_nothing_is_hidden() -> None:
    """Oracle: what is written down as clean is in the span of the base, to rounding."""
    for kind in KINDS:
        dataset = build(Case("clean", 11, kind, "white"))
        flat = np.concatenate(
            [
                dataset.base_columns.reshape(len(dataset.base), -1).T,
                np.kron(np.eye(len(dataset.clean)), np.ones((dataset.clean.shape[1], 1))),
            ],
            axis=1,
        )
        y = dataset.clean.ravel()
        assert rms(y - flat @ np.linalg.lstsq(flat, y, rcond=None)[0]) < 1e-9
        assert not dataset.hidden.any()


def test_the_users_model_is_near_the_truth() -> None:
    """Oracle: the true curve; the model is fitted to noisy readings through noisy, coarse sensors."""
    for kind in KINDS:
        dataset = build(Case("clean", 12, kind, "white"))
        measurement = translate.measurement_of(dataset)
        said = translate.said_by(translate.base_model(dataset, measurement), measurement)
        assert rms(centred(said - dataset.clean)) < 0.35
        assert rms(centred(dataset.clean)) > 0.5


def test_runs_left_out_are_whole_and_empty_for_the_method() -> None:
    """Oracle: counting."""
    dataset = build(single(3, BY_NAME["backlash"]))
    measurement = translate.measurement_of(dataset)
    empty = np.isnan(measurement.matrix()).all(axis=0)
    runs = np.unique(dataset.campaign.run[empty])
    assert len(runs) == 4
    assert not np.isin(dataset.campaign.run[~empty], runs).any()
    assert 800 <= np.isfinite(measurement.matrix()).sum() <= 1000
    other = translate.measurement_of(dataset, unseen=True)
    assert (np.isnan(other.matrix()).all(axis=0) == ~empty).all()


def test_distance_since_reversal_is_that_of_the_program() -> None:
    """Oracle: the program's own derived channel on the recorded positions and directions."""
    dataset = build(single(9, BY_NAME["lost_motion"]))
    axis = dataset.campaign.axis
    program = translate.measurement_of(dataset).state().value(f"s_{axis.lower()}")
    mine = dataset.campaign.since_mm[axis]
    later = dataset.campaign.run > 1
    np.testing.assert_allclose(mine[later], program[later], atol=1e-9)


def test_sensors_are_collinear_but_no_copies() -> None:
    """Oracle: what the benchmark states: eight sensors that warm together, 0.03 K of noise and a coarse converter."""
    dataset = build(Case("clean", 21, "laser", "white"))
    shown = np.stack([dataset.channels[s] for s in SENSORS])
    clean = np.stack([dataset.world.shown(s) + 20.0 for s in SENSORS])
    off = shown - clean
    assert 0.03 < off.std() < 0.045
    np.testing.assert_allclose(shown / 0.0625, np.round(shown / 0.0625), atol=1e-9)
    days = [weather(np.random.default_rng(s), False) for s in range(12)]
    together = np.mean([np.corrcoef([d.sensor[s] for s in SENSORS]) for d in days], axis=0)
    slow = [SENSORS.index(s) for s in ("T_head", "T_front", "T_back", "T_bed")]
    assert together[np.ix_(slow, slow)].min() > 0.55
    assert np.abs(together - np.eye(8)).max() < 0.99


def test_the_floor_is_the_noise() -> None:
    """Oracle: the noise alone in the runs left out, by hand."""
    dataset = build(Case("clean", 31, "laser", "white"))
    good = ~dataset.outlier[0]
    mean = dataset.noise[0][good & ~dataset.unseen].mean()
    by_hand = np.sqrt(np.mean((dataset.noise[0][good & dataset.unseen] - mean) ** 2))
    assert floor_of(dataset) == pytest.approx(by_hand, rel=1e-9)


def test_components_that_no_reading_tells_apart() -> None:
    """Oracle: kinematics in words. A displacement is one wherever it comes from; a turn's arm depends on the place."""
    line = campaign(np.random.default_rng(1), "laser", "X", False)
    assert same_component(line, "EXX", "EX0spindle")
    assert not same_component(line, "EXX", "EBX")
    assert not same_component(line, "EBX", "EBZ")
    assert not same_component(line, "EXX", "EYX")
    drift = campaign(np.random.default_rng(1), "drift", "X", False)
    assert same_component(drift, "EZ0spindle", "EZZ")
    assert not same_component(drift, "EB0spindle", "EX0spindle")


def test_cases_are_many_enough() -> None:
    """Oracle: the whole benchmark wants at least 300 sets of each noise with nothing hidden, and every effect often."""
    all_of = list(cases(range(1000, 1300)))
    assert {c.group for c in all_of} == set(GROUPS)
    clean = [c for c in all_of if c.group == "clean"]
    assert all(sum(c.noise == form for c in clean) >= 300 for form in noise.FORMS)
    counts = [sum(c.hidden == (t.name,) and c.group == "singles" for c in all_of) for t in TRUTHS]
    assert min(counts) >= 7
    assert len({c.label for c in all_of}) == len(all_of)


def test_every_other_name_has_its_reason() -> None:
    """Oracle: the list itself; names are of the catalogue, reasons are words, nothing stands twice."""
    assert len({t.name for t in TRUTHS}) == len(TRUTHS)
    for truth in TRUTHS:
        assert all(len(s.why) > 15 for s in truth.same)
        pairs = [(s.effect, s.component) for s in truth.same]
        assert len(set(pairs)) == len(pairs)
        assert (truth.name, "") not in pairs
