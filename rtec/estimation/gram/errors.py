"""Standard errors of a fit of any number of readings: the sandwich of `plain`, under the noise that the fit leaves.

Of very many readings so many tell the noise that goes on from reading to reading; the white part counts all of them.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rtec.estimation.gram.source import Source, kept_rows, thinned
from rtec.estimation.gram.stream import Columns, design
from rtec.estimation.noise import Noise, Whitener, find_noise
from rtec.estimation.plain import sandwich
from rtec.estimation.readings import read

Floats = NDArray[np.float64]

READINGS = 8000
"""So many readings of all measurements are looked at, about."""
STEPS = 40


def standard_errors(sources: Sequence[Source], terms: Columns, left: Sequence[Floats]) -> Floats:
    """Standard errors of all columns of a fit, then of its explicit nuisances, (columns,).

    Args:
        sources: measurements with the weights of the fit.
        terms: whose columns, with slopes of their parameters.
        left: residuals, unknowns of each run taken out, a (readings, n) for each source; NaN where none or left out.
    """
    most = [max(READINGS // (len(sources) * s.count), 1) for s in sources]
    few = [thinned(s, n) for s, n in zip(sources, most, strict=True)]
    lanes = [values[:, kept_rows(s, n)] for s, n, values in zip(sources, most, left, strict=True)]
    shown = read([replace(s.measurement, name=str(i)) for i, s in enumerate(few)], smooth=False)
    at = [(s.source, s.row * few[s.source].count + s.lane) for s in shown.series]
    columns = design(few, terms)
    white = np.concatenate([columns[i][place] for i, place in at])
    rows = np.concatenate([few[i].weight[place] for i, place in at])
    values = np.concatenate([lanes[s.source][s.lane, s.row] for s in shown.series])
    counts = np.isfinite(values) & (rows > 0.0)
    readings = replace(shown, values=np.nan_to_num(values)).without(~counts)
    white, rows = white[counts], rows[counts]
    noise = find_noise(readings, white / rows[:, None], STEPS)
    # Each reading stands for so many: its weight counts so often, what is white in it by so much less.
    share = [len(sources[s.source].measurement) / len(few[s.source].measurement) for s in readings.series]
    lessened = [_averaged(n, f) for n, f in zip(noise.noises, share, strict=True)]
    often = np.sqrt(np.array(share))[readings.series_of]
    less = Whitener(readings, tuple(lessened), noise.wides)
    whole = sandwich(white * often[:, None], rows * often, less, np.zeros(white.shape[1]))
    return np.asarray(np.sqrt(np.maximum(np.diag(whole), 0.0)))


def _averaged(noise: Noise, count: float) -> Noise:
    """Noise of the mean of so many readings next to each other: drift and offset they have in common."""
    sigma = noise.sigma / np.sqrt(count)
    return replace(noise, sigma=float(sigma), drift=noise.drift * count, offset=noise.offset * count)
