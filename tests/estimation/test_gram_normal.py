"""Normal equations gathered in chunks, against explicit columns and explicit refits with numpy's least squares."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rtec.effects.state import State
from rtec.estimation.gram import stream
from rtec.estimation.gram.normal import Normal, solve
from rtec.estimation.gram.source import Source
from rtec.estimation.gram.stream import Term, Walk, gather, predict
from rtec.estimation.held_out import cut
from rtec.metrology.measurement import Measurement
from tests.support.characterise_examples import MACHINE, Probe, ProbeSetup, Tip, effect, measurement, runs

Floats = NDArray[np.float64]
TERMS = [
    Term(effect("scale", "EXX", axis="X")),
    Term(effect("backlash", "EXX", axis="X")),
    Term(effect("axis_expansion", "EXX", axis="X", sensor="T_bed")),
    Term(effect("mount_expansion", "EXX", sensor="T_spindle", lag=True), {"tau": 900.0}),
]
TIP_TERMS = [
    *TERMS,
    Term(effect("polynomial_position", "EBZ", axis="Z", degrees=[1, 2])),
    Term(effect("scale", "EZZ", axis="Z")),
]


def columns_by_hand(m: Measurement, terms: list[Term]) -> Floats:
    """Design without nuisances, (n · readings, columns): the effects' basis on the whole state, times the arms."""
    state = m.state()
    arms = m.instrument.arms(MACHINE, state.positions_mm())
    out = []
    for term in terms:
        arm = arms[:, :, MACHINE.components.index(term.effect.component)]
        for basis in term.effect.basis(MACHINE, state, term.theta):
            out.append((arm * np.broadcast_to(basis, (len(m),))).T.ravel())
    return np.stack(out, axis=1)


def nuisance_columns(m: Measurement) -> Floats:
    """One column for each nuisance and run."""
    out = []
    for nuisance in m.instrument.nuisance(m.state(), m.run):
        flat = nuisance.values.T.ravel()
        run = np.repeat(m.run, len(nuisance.values))
        out += [flat] if nuisance.per == "setup" else [flat * (run == r) for r in np.unique(m.run)]
    return np.stack(out, axis=1) if out else np.zeros((m.matrix().size, 0))


def by_lstsq(m: Measurement, terms: list[Term], keep: NDArray[np.bool_] | None = None) -> Floats:
    """Coefficients with explicit nuisance columns."""
    design = np.concatenate([columns_by_hand(m, terms), nuisance_columns(m)], axis=1)
    y = m.matrix().T.ravel()
    here = np.isfinite(y) & (True if keep is None else keep)
    size = np.linalg.norm(design[here], axis=0)
    size = np.where(size > 0, size, 1.0)
    found = np.linalg.lstsq(design[here] / size, y[here], rcond=1e-10)[0] / size
    return np.asarray(found[: columns_by_hand(m, terms).shape[1]])


def gathered(m: Measurement, terms: list[Term], leave_out_h: float | None = None) -> Normal:
    return gather([Source.of(m, cut(m, leave_out_h))], terms)


@pytest.mark.parametrize("slope", ["none", "run", "setup"])
@pytest.mark.parametrize("zero", ["run", "setup"])
@pytest.mark.parametrize("chunk", [16, 100, 8192])
def test_projection_is_the_fit_with_explicit_columns(
    zero: str, slope: str, chunk: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Oracle: numpy's least squares with a column for the zero (and slope) of every run."""
    monkeypatch.setattr(stream, "CHUNK", chunk)
    probe = Probe(ProbeSetup.model_validate({"zero": zero, "slope": slope}), component="EXX")
    terms = TERMS[1:] if slope != "none" else TERMS
    m = measurement(runs([40, 23, 60, 41, 5, 80, 33, 40]), instrument=probe)
    values = gathered(m, terms).values()[: len(terms)]
    np.testing.assert_allclose(values, by_lstsq(m, terms), rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("chunk", [30, 8192])
def test_several_readings_and_gaps(chunk: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Oracle: numpy's least squares on the readings that are there."""
    monkeypatch.setattr(stream, "CHUNK", chunk)
    m = measurement(runs([30, 40, 25, 60, 44, 40, 31]), instrument=Tip(ProbeSetup()))
    rng = np.random.default_rng(4)
    readings = {c: np.where(rng.uniform(size=len(m)) < 0.2, np.nan, v) for c, v in m.readings.items()}
    m = replace(m, readings=readings)
    normal = gathered(m, TIP_TERMS)
    np.testing.assert_allclose(normal.values(), by_lstsq(m, TIP_TERMS), rtol=1e-6, atol=1e-9)
    assert normal.readings.sum() == np.isfinite(m.matrix()).sum()


def test_runs_longer_than_a_stretch_get_columns_of_their_own() -> None:
    """Oracle: as above; two long runs cut into stretches of an hour."""
    m = measurement(runs([300, 260]))
    normal = gathered(m, TERMS, 1.0)
    assert len(normal.gram) == 8
    assert len(normal.extra) == 2
    np.testing.assert_allclose(normal.values()[:4], by_lstsq(m, TERMS), rtol=1e-7)


@settings(max_examples=40, deadline=None)
@given(
    lengths=st.lists(st.integers(1, 50), min_size=6, max_size=14),
    chunk=st.integers(3, 90),
    slope=st.sampled_from(["none", "run"]),
)
def test_any_runs_any_chunk(lengths: list[int], chunk: int, slope: str) -> None:
    """Oracle: the same sums with everything in one chunk, whole runs projected by numpy's QR."""
    probe = Probe(ProbeSetup.model_validate({"zero": "run", "slope": slope}), component="EXX")
    m = measurement(runs(lengths), instrument=probe)
    terms = TERMS[1:]
    design = np.concatenate([columns_by_hand(m, terms), m.readings["reading_um"][:, None]], axis=1)
    for r in np.unique(m.run):
        rows = m.run == r
        nuisance = np.stack([n.values[0, rows] for n in m.instrument.nuisance(m.state(), m.run)], axis=1)
        u, s, _ = np.linalg.svd(nuisance, full_matrices=False)
        u = u[:, s > 1e-8 * s[0]]
        design[rows] -= u @ (u.T @ design[rows])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stream, "CHUNK", chunk)
        total = gathered(m, terms).total
    size = np.sqrt(np.diag(gathered(m, terms).total) + 1.0)
    np.testing.assert_allclose(total / np.outer(size, size), design.T @ design / np.outer(size, size), atol=1e-8)


def test_lags_are_those_of_the_whole_state_bit_for_bit() -> None:
    """Oracle: `State.lagged` over everything at once; for a channel that several ask for, at two time constants, and
    for what is worked out of channels anew in each window."""
    m = measurement(runs([70, 80, 50]))
    state: State = m.state()
    rise = state.rise("T_spindle")
    whole = [
        state.lagged(rise, 700.0),
        state.lagged(rise, 700.0),
        state.lagged(rise, 90.0),
        state.lagged(2 * rise, 90.0),
    ]
    walk, parts = Walk(state), []
    for start, stop in ((0, 13), (13, 14), (14, 150), (150, 200)):
        walk.move(start, stop)
        first = walk.begin(3).lagged(walk.rise("T_spindle"), 700.0)
        walk.begin(4)
        more = [walk.lagged(walk.rise("T_spindle"), tau_s) for tau_s in (700.0, 90.0)]
        parts.append([first, *more, walk.lagged(2 * walk.rise("T_spindle"), 90.0)])
    assert np.array_equal(np.concatenate(parts, axis=1), np.stack(whole))


def test_held_out_error_is_that_of_refits() -> None:
    """Oracle: for each fold, numpy's least squares without its runs, then its own zeros taken out of what is left."""
    m = measurement(runs([30, 22, 41, 35, 28, 30, 44, 25, 39, 30, 31, 20]), noise_um=1.0)
    source = Source.of(m)
    normal = gather([source], TERMS)
    out, inside = normal.held_out()
    edges, fold = source.blocks.edges, source.blocks.fold
    label = np.concatenate([np.full(edges[i + 1] - edges[i], fold[i]) for i in range(len(fold))])
    design, y = columns_by_hand(m, TERMS), m.readings["reading_um"]
    full = by_lstsq(m, TERMS)
    for i, f in enumerate(np.unique(fold)):
        for found, values in ((out, by_lstsq(m, TERMS, label != f)), (inside, full)):
            left = (y - design @ values)[label == f]
            run = m.run[label == f]
            left = left - np.array([left[run == r].mean() for r in run])
            assert found[i] == pytest.approx(float(left @ left), rel=1e-6)
    assert out.sum() > inside.sum()


def test_standard_errors_are_those_of_leaving_out_blocks() -> None:
    """Oracle: refits by numpy without each block; the jackknife formula written out."""
    m = measurement(runs([30, 22, 41, 35, 28, 30, 44, 25]), noise_um=1.0)
    normal = gathered(m, TERMS)
    values = normal.values()
    blocks = len(normal.gram)
    assert blocks == 8
    refits = np.stack([by_lstsq(m, TERMS, m.run != r) for r in range(1, 9)])
    spread = np.sqrt((blocks - 1) / blocks * ((refits - values) ** 2).sum(axis=0))
    np.testing.assert_allclose(np.sqrt(np.diag(normal.covariance(values))), spread, rtol=1e-6)


def test_standard_errors_hold_under_drift() -> None:
    """Oracle: the spread of the estimates over 150 draws of noise with a correlation far longer than the readings.

    The formula for independent noise is shown to be much too small there, so the test would see it.
    """
    m = measurement(runs([40] * 20), noise_um=0.0)
    probe = Probe(ProbeSetup(zero="setup"), component="EXX")
    m = replace(m, instrument=probe)
    terms = [TERMS[0], TERMS[3]]
    found, told, naive = [], [], []
    design = np.concatenate([columns_by_hand(m, terms), np.ones((len(m), 1))], axis=1)
    unit = np.sqrt(np.diag(np.linalg.inv(design.T @ design)))[:2]
    for seed in range(150):
        rng = np.random.default_rng(seed)
        drift = np.concatenate([_walk(rng, 40, 0.98) for _ in range(20)])
        one = replace(m, readings={"reading_um": drift + 0.1 * rng.standard_normal(len(m))})
        normal = gathered(one, terms)
        values = normal.values()
        found.append(values[:2])
        told.append(np.sqrt(np.diag(normal.covariance(values)))[:2])
        naive.append(unit * np.sqrt(normal.squares(values) / normal.freedom))
    real = np.std(found, axis=0)
    ratio = np.mean(told, axis=0) / real
    assert np.all((ratio > 0.8) & (ratio < 1.35)), ratio
    assert np.all(np.mean(naive, axis=0)[1] < 0.5 * real[1])


def _walk(rng: np.random.Generator, n: int, keep: float) -> Floats:
    out = np.empty(n)
    value = rng.standard_normal()
    for i in range(n):
        value = keep * value + np.sqrt(1 - keep * keep) * rng.standard_normal()
        out[i] = value
    return out


def test_condition_number() -> None:
    """Oracle: singular values of the scaled, projected design."""
    m = measurement(runs([30, 22, 41, 35, 28, 30, 44, 25]))
    design = columns_by_hand(m, TERMS)
    for r in np.unique(m.run):
        design[m.run == r] -= design[m.run == r].mean(axis=0)
    s = np.linalg.svd(design / np.linalg.norm(design, axis=0), compute_uv=False)
    assert gathered(m, TERMS).condition() == pytest.approx(s[0] / s[-1], rel=1e-6)


def test_prediction_is_the_design_times_the_coefficients(monkeypatch: pytest.MonkeyPatch) -> None:
    """Oracle: the design by hand."""
    monkeypatch.setattr(stream, "CHUNK", 37)
    m = measurement(runs([30, 40, 25, 60, 44, 40, 31]), instrument=Tip(ProbeSetup()))
    values = np.arange(1.0, 8.0)
    expected = columns_by_hand(m, TIP_TERMS) @ values
    np.testing.assert_allclose(predict(Source.of(m), TIP_TERMS, values), expected, rtol=1e-10, atol=1e-12)


def test_solve_of_a_column_that_is_not_there_is_zero() -> None:
    """Oracle: algebra; a column of zeros takes no part."""
    gram = np.diag([4.0, 0.0, 9.0])
    gram[0, 2] = gram[2, 0] = 2.0
    np.testing.assert_allclose(solve(gram[None])[0], [0.5, 0.0], atol=1e-12)


def test_sums_of_a_fold_are_those_of_its_blocks() -> None:
    """Oracle: the equations block by block of two sources, summed; the held-out squares of both together."""
    measured = [measurement(runs([30, 22, 41, 35, 28, 30, 44, 25]), noise_um=1.0, seed=s, name=f"{s}") for s in (1, 2)]
    sources = [Source.of(m) for m in measured]
    apart, together = gather(sources, TERMS), gather(sources, TERMS, by_fold=True)
    np.testing.assert_allclose(together.gram, apart.by_fold, rtol=1e-12, atol=1e-9)
    np.testing.assert_array_equal(together.fold, apart.fold_numbers)
    assert together.freedom == apart.freedom
    for mine, parts in zip(together.held_out(), apart.held_out(), strict=True):
        by_fold = np.bincount([c.fold for c in apart.cells], parts)
        np.testing.assert_allclose(mine, by_fold, rtol=1e-9)
