"""Procedures fed by measurement files rather than plain tables."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rtec.errors import MeasurementError
from rtec.metrology.instruments.spindle_drift import SpindleDriftSetup
from rtec.metrology.instruments.straightness import StraightnessSetup
from rtec.metrology.measurement import Measurement
from rtec.metrology.procedures.drift import Drift, spindle_drift
from rtec.metrology.procedures.straightness import Straightness, reversal

Floats = NDArray[np.float64]


def drift_of(measurement: Measurement, distance_mm: float | None = None) -> Drift:
    """Drift from a measurement of instrument spindle_drift; positive as the tool moves in the probe's direction.

    Args:
        measurement: with `spindle_rpm`; probes "radial1" and "radial2" give the tilt.
        distance_mm: between the radial probes, instead of that of the set-up.

    Raises:
        MeasurementError: another instrument, or no speeds.
    """
    name, setup = measurement.name, measurement.instrument.setup
    if not isinstance(setup, SpindleDriftSetup):
        raise MeasurementError(f"{name}: instrument is {measurement.instrument.name}; drift needs spindle_drift")
    if "spindle_rpm" not in measurement.channels:
        raise MeasurementError(f"{name}: column spindle_rpm is missing; without speeds there are no phases")
    probes = {n: p.sign * measurement.readings[f"reading_{n}_um"] for n, p in setup.probe.items()}
    sensors = {n: measurement.channels[n] for n in measurement.machine.sensor_names if n in measurement.channels}
    known = distance_mm if distance_mm is not None else setup.distance_mm
    return spindle_drift(name, measurement.time_s, measurement.channels["spindle_rpm"], probes, known, sensors)


def straightness_of(measurement: Measurement) -> tuple[str, Straightness]:
    """Straightness by reversal from a measurement of instrument straightness with reversed runs.

    The probe's sign is the same in all runs, so readings are s + a, and s - a with the artefact turned over.

    Returns:
        Axis name and result.

    Raises:
        MeasurementError: another instrument, no reversed runs, or runs that do not read the same places.
    """
    name, setup, axis = measurement.name, measurement.instrument.setup, measurement.instrument.axis
    if not isinstance(setup, StraightnessSetup) or axis is None:
        raise MeasurementError(
            f"{name}: instrument is {measurement.instrument.name}; this needs straightness of an axis"
        )
    if not setup.reversed_runs:
        raise MeasurementError(f"{name}: [setup] reversed_runs is missing; without reversal the artefact stays in")
    position = measurement.channels[measurement.machine.axis(axis).channel]
    places = np.unique(position)
    reading = setup.sign * measurement.readings["reading_um"]
    runs = {
        int(r): _run(name, int(r), places, position, reading, measurement.run == r) for r in np.unique(measurement.run)
    }
    turned = [x for r, x in runs.items() if r in setup.reversed_runs]
    plain = [x for r, x in runs.items() if r not in setup.reversed_runs]
    if len(turned) != len(plain) or not turned:
        raise MeasurementError(
            f"{name}: {len(plain)} runs before and {len(turned)} after reversal; each needs its partner"
        )
    try:
        found = reversal(places, -np.stack(plain), np.stack(turned))
    except MeasurementError as e:
        raise MeasurementError(f"{name}: {e}") from e
    return axis, replace(found, artefact_um=-found.artefact_um)


def _run(name: str, run: int, places: Floats, position: Floats, reading: Floats, rows: NDArray[np.bool_]) -> Floats:
    at = np.searchsorted(places, position[rows])
    if len(np.unique(at)) < len(at):
        twice = places[int(np.argmax(np.bincount(at)))]
        raise MeasurementError(f"{name}: run {run} reads {twice:g} mm twice; give the way back a run of its own")
    out = np.full(len(places), np.nan)
    out[at] = reading[rows]
    return out
