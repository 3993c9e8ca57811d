"""A refit of a least-squares optimum changes no prediction by more than its error; run it for the whole proof.

`python -m tests.estimation.refit_proof 200` draws machines and forms of drift at random. The optimum is numpy's; the
error of a prediction comes from numpy's refits without one stretch of the record after another (jackknife).
"""

import sys
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtec.diagnosis.extend.add import add
from rtec.effects import Effect
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect, Model
from tests.support.characterise_examples import Probe, ProbeSetup, effect, measurement, runs

Floats = NDArray[np.float64]
FORMS = ("white", "walk", "memory", "sine", "warm-up", "uneven", "steps", "missing effect")
POOL = (
    effect("scale", "EXX", axis="X"),
    effect("backlash", "EXX", axis="X"),
    effect("polynomial_position", "EXX", axis="X", degrees=[2, 3]),
    effect("axis_expansion", "EXX", axis="X", sensor="T_bed"),
    effect("axis_expansion", "EXX", axis="X", sensor="T_column"),
    effect("mount_expansion", "EXX", sensor="T_spindle"),
    effect("mount_expansion", "EXX", sensor="T_air"),
)
STRETCHES = 10


class Case(NamedTuple):
    """Readings, what is fitted to them, its columns, (n, p), and those of what nobody knows, (n, q)."""

    measured: Measurement
    effects: list[Effect]
    columns: Floats
    unknown: Floats


def drift(form: str, m: Measurement, size_um: float, rng: np.random.Generator) -> Floats:
    """What the effects do not describe, µm."""
    t, n = m.time_s, len(m)
    hours, white = t / 3600.0, rng.standard_normal(n)
    if form == "walk":
        walk = np.cumsum(white)
        return np.asarray(size_um * (walk - walk.mean()) / walk.std())
    if form == "memory":
        keep = np.exp(-float(np.median(np.diff(t))) / 10.0 ** rng.uniform(2.0, 4.5))
        out = np.zeros(n)
        for i in range(1, n):
            out[i] = keep * out[i - 1] + np.sqrt(1.0 - keep**2) * white[i]
        return size_um * out
    if form == "sine":
        return np.asarray(size_um * np.sin(2.0 * np.pi * hours / rng.uniform(0.5, 10.0) + rng.uniform(0.0, 6.0)))
    if form == "warm-up":
        return np.asarray(2.0 * size_um * (1.0 - np.exp(-hours / rng.uniform(0.3, 5.0))))
    if form == "uneven":
        return np.asarray(size_um * white * np.where(m.run % 2 == 0, 3.0, 0.3))
    if form == "steps":
        return np.asarray(size_um * rng.standard_normal(int(m.run.max()) + 1)[m.run])
    if form == "missing effect":
        return np.asarray(size_um * (m.channels["x"] / 100.0) ** 2 * (m.channels["T_spindle"] - 20.0) / 10.0)
    return np.zeros(n)


def case(seed: int) -> Case:
    """One machine at random."""
    rng = np.random.default_rng(seed)
    count, length = int(rng.integers(6, 30)), int(rng.integers(15, 45))
    probe = Probe(ProbeSetup(zero="run" if rng.random() < 0.5 else "setup"), component="EXX")
    noise, hours = float(rng.uniform(0.1, 0.6)), float(rng.uniform(1.0, 30.0))
    m = measurement(runs([length] * count), instrument=probe, seed=seed, noise_um=noise, hours=hours)
    chosen = sorted(rng.choice(len(POOL), int(rng.integers(1, 5)), replace=False))
    effects, state = [POOL[i] for i in chosen], m.state()
    basis = [b for e in effects for b in e.basis(m.machine, state, {})]
    columns = np.stack([np.broadcast_to(np.asarray(b, dtype=np.float64), (len(m),)) for b in basis], axis=1)
    size = rng.standard_normal(columns.shape[1]) * rng.uniform(0.3, 3.0) / np.maximum(columns.std(axis=0), 1e-9)
    more = drift(FORMS[seed % len(FORMS)], m, float(10.0 ** rng.uniform(-1.0, 0.7)), rng)
    values = m.matrix()[0] + columns @ size + more
    each = (m.run[:, None] == np.unique(m.run)).astype(np.float64)
    unknown = each if probe.setup.zero == "run" else np.ones((len(m), 1))
    m = Measurement(m.name, probe, m.machine, m.run, m.time_s, m.channels, {"reading_um": values})
    return Case(m, effects, columns, unknown)


def least_squares(c: Case, keep: NDArray[np.bool_]) -> Floats:
    """Coefficients of some of the readings, (p,)."""
    unknown = c.unknown[keep]
    design = np.concatenate([c.columns[keep], unknown[:, unknown.any(axis=0)]], axis=1)
    return np.asarray(np.linalg.lstsq(design, c.measured.matrix()[0][keep], rcond=None)[0][: c.columns.shape[1]])


def moved(seed: int) -> float:
    """How far a refit moves any prediction, in its standard errors."""
    c = case(seed)
    n = len(c.measured)
    best = least_squares(c, np.ones(n, dtype=bool))
    label = np.arange(n) * STRETCHES // n
    off = np.array([least_squares(c, label != k) - best for k in range(STRETCHES)])
    spread = (STRETCHES - 1) / STRETCHES * off.T @ off
    errors = np.sqrt(np.diag(spread))
    fitted, at = [], 0
    for e in c.effects:
        names = [p.name for p in e.coefficients(c.measured.machine)]
        part = slice(at, at + len(names))
        values, known = (dict(zip(names, map(float, v[part]), strict=True)) for v in (best, errors))
        fitted.append(FittedEffect(e, values, {}, known))
        at += len(names)
    model = Model(c.measured.machine, tuple(fitted), measurements={c.measured.name: c.measured.sha256})
    after = add(model, [], [c.measured]).model
    now = np.array([v for f in after.effects for v in f.values.values()])
    seen = c.columns - c.unknown @ np.linalg.lstsq(c.unknown, c.columns, rcond=None)[0]
    error = np.sqrt(np.einsum("ij,jk,ik->i", seen, spread, seen))
    return float((np.abs(seen @ (now - best)) / np.maximum(error, 1e-12)).max())


def main(count: int) -> int:
    """Print the largest move of each form of drift; how many exceed one standard error."""
    found = [(FORMS[seed % len(FORMS)], moved(seed)) for seed in range(count)]
    for form in FORMS:
        mine = [m for f, m in found if f == form]
        if mine:
            sys.stdout.write(f"{form}: {len(mine)} machines, largest move {max(mine):.2f} standard errors\n")
    return sum(m > 1.0 for _, m in found)


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 200) > 0)
