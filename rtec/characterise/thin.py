"""Fewer readings of a long measurement, for choosing; what is chosen is fitted to all of them."""

from dataclasses import replace

import numpy as np

from rtec.characterise.source import Source

GOLDEN = (5.0**0.5 - 1.0) / 2.0


def thinned(source: Source, most: int) -> Source:
    """At most so many instants, one from each of equal stretches at a place that never repeats.

    A fixed stride would fall in step with a screw's pitch. Directions stay those of the whole; lags hold because
    temperatures are slow against the stride.
    """
    m = source.measurement
    n = len(m)
    if n <= most:
        return source
    place = (np.arange(most) + (np.arange(most) * GOLDEN) % 1.0) * (n / most)
    rows = np.unique(np.concatenate([np.minimum(place.astype(np.int64), n - 1), source.blocks.run_edges[:-1]]))
    state = source.state
    moving = {a.direction_channel: state.value(a.direction_channel) for a in m.machine.axes if a.channel in m.channels}
    few = replace(
        m,
        run=m.run[rows],
        time_s=m.time_s[rows],
        channels={name: values[rows] for name, values in {**m.channels, **moving}.items()},
        readings={name: values[rows] for name, values in m.readings.items()},
    )
    weight = source.weight.reshape(n, -1)[rows].ravel()
    return Source(few, source.blocks.at(rows), weight)
