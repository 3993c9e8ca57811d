"""How far fitted numbers are from the truth in their standard errors, by `fit` and by a refit.

`python -m tests.estimation.errors_proof 300` draws machines and forms of noise at random. Oracle: the sizes that made
the readings.
"""

import sys
from collections import defaultdict

import numpy as np
from numpy.typing import NDArray

from rtec.estimation.gram.fit import estimate
from rtec.estimation.gram.source import Source
from rtec.estimation.gram.stream import Term
from rtec.estimation.joint import joint_fit
from rtec.estimation.readings import read
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect
from tests.estimation.refit_proof import POOL, drift
from tests.support.characterise_examples import Probe, ProbeSetup, measurement, runs

Floats = NDArray[np.float64]
FORMS = (
    "white", "memory", "walk", "steps", "uneven", "few white", "few memory", "few steps", "sine", "warm-up",
)  # fmt: skip


def distances(seed: int) -> tuple[str, Floats, Floats]:
    """Form of the noise, and distances from the truth in standard errors by a fit and by an ordinary refit of it."""
    rng, form = np.random.default_rng([seed, 77]), FORMS[seed % len(FORMS)]
    few = form.startswith("few")
    count, length = int(rng.integers(3, 7) if few else rng.integers(8, 30)), int(rng.integers(15, 45))
    probe = Probe(ProbeSetup(zero="run" if rng.random() < 0.5 else "setup"), component="EXX")
    noise, hours = float(rng.uniform(0.1, 0.6)), float(rng.uniform(1.0, 30.0))
    m = measurement(runs([length] * count), instrument=probe, seed=seed, noise_um=noise, hours=hours)
    pool = [e for e in POOL if e.effect != "backlash"]  # which the zero takes up where all runs go one way
    effects = [pool[i] for i in sorted(rng.choice(len(pool), int(rng.integers(1, 4)), replace=False))]
    basis = [b for e in effects for b in e.basis(m.machine, m.state(), {})]
    columns = np.stack([np.broadcast_to(np.asarray(b, dtype=np.float64), (len(m),)) for b in basis], axis=1)
    true = rng.standard_normal(columns.shape[1]) * rng.uniform(0.3, 3.0) / np.maximum(columns.std(axis=0), 1e-9)
    more = drift(form.removeprefix("few "), m, float(10.0 ** rng.uniform(-1.0, 0.7)), rng)
    values = m.matrix()[0] + columns @ true + more
    m = Measurement(m.name, probe, m.machine, m.run, m.time_s, m.channels, {"reading_um": values})
    fit = estimate([Source.of(m)], [Term(e) for e in effects])
    start = [FittedEffect(e, {p.name: 0.0 for p in e.coefficients(m.machine)}, {}) for e in effects]
    again = joint_fit(start, read([m], smooth=False)).plain
    assert again is not None
    found, errors = (np.array([v for f in again.effects for v in part(f).values()]) for part in (_values, _errors))
    return form, (fit.values[: len(true)] - true) / fit.errors[: len(true)], (found - true) / errors


def _values(fitted: FittedEffect) -> dict[str, float]:
    return dict(fitted.values)


def _errors(fitted: FittedEffect) -> dict[str, float]:
    return dict(fitted.errors)


def main(count: int) -> None:
    """Print root mean square and share within three of each form."""
    found: dict[str, list[tuple[Floats, Floats]]] = defaultdict(list)
    for seed in range(count):
        form, fit, again = distances(seed)
        found[form].append((fit, again))
        found["all"].append((fit, again))
    for form, pairs in found.items():
        for name, z in zip(("fit", "refit"), map(np.concatenate, zip(*pairs, strict=True)), strict=True):
            rms, within = float(np.sqrt(np.mean(z**2))), 100.0 * float(np.mean(np.abs(z) < 3.0))
            sys.stdout.write(f"{form:<11} {name:<6} {len(z)} numbers, rms {rms:.2f}, within three {within:.1f} %\n")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 300)
