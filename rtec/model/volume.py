"""Errors of a model over the travels of its machine: at evenly spaced places, and of a cylinder that it cuts."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np

from rtec.arrays import Floats
from rtec.errors import ModelError
from rtec.machine.links import tool_at_work
from rtec.model.at import state_at
from rtec.model.model import Model

RADIUS_MM, LENGTH_MM = 100.0, 200.0
AROUND, ALONG = 360, 21
PLACES = 5


@dataclass(frozen=True)
class TipErrors:
    """Errors at evenly spaced places of the travels.

    Attributes:
        place_mm: nominal places of the tool tip relative to the workpiece, (n, 3): where it is commanded to be.
        error_um: actual minus nominal place, (n, 3).
    """

    place_mm: Floats
    error_um: Floats

    @property
    def size_um(self) -> Floats:
        """Length of each error, (n,)."""
        return np.asarray(np.linalg.norm(self.error_um, axis=1))


def tip_errors(model: Model, state: Mapping[str, float], places: int = PLACES) -> TipErrors:
    """Errors at the tool tip over all travels, in one state.

    Args:
        model: model of the machine.
        state: directions, temperatures, spindle speed; names as for `Model.predict`. Positions are replaced.
        places: number of places of each axis.

    Raises:
        ModelError: a channel that the model needs is missing.
    """
    machine = model.machine
    grid = np.array(list(product(*(np.linspace(*a.travel_mm, places) for a in machine.axes))))
    at = {k: np.full(len(grid), v) for k, v in state.items()}
    at |= {a.name: grid[:, i] for i, a in enumerate(machine.axes)}
    return TipErrors(tool_at_work(machine, grid), model.predict(at))


def component_errors(model: Model, state: Mapping[str, float]) -> dict[str, float]:
    """Every component error in one state, µm or µrad, by name; those that no effect feeds are zero.

    Args:
        model: model of the machine.
        state: positions, directions, temperatures, spindle speed; names as for `Model.predict`.

    Raises:
        ModelError: a channel that the model needs is missing.
    """
    values = model.components(state_at(model, dict(state), {})[0])[0]
    return dict(zip(model.machine.components, values.tolist(), strict=True))


@dataclass(frozen=True)
class Cylinder:
    """Errors of a cylinder of 200 mm.

    Attributes:
        larger_um: mean diameter minus 200 mm.
        form_um: roundness of a milled cylinder; change of the diameter along the length of a turned one.
        turned: whether it is turned.
        length_mm: length of a turned cylinder; 0 for a milled one.
    """

    larger_um: float
    form_um: float
    turned: bool
    length_mm: float = 0.0


def cylinder(model: Model, state: Mapping[str, float]) -> Cylinder:
    """Errors of a cylinder of 200 mm that this machine cuts uncorrected.

    Turned, where the spindle carries the workpiece: the axis across the spindle is at a radius of 100 mm, and the tool
    moves negative along the other over at most 200 mm. Milled otherwise: once around a circle of 100 mm about the
    middle of the travels of X and Y (or the first two axes), counter-clockwise.

    Args:
        model: model of the machine.
        state: temperatures, spindle speed, positions of the other axes; names as for `Model.predict`.

    Raises:
        ModelError: the cylinder does not fit into the travels.
    """
    machine = model.machine
    return _turned(model, state) if any("spindle" in n for n in machine.work_chain) else _milled(model, state)


def _turned(model: Model, state: Mapping[str, float]) -> Cylinder:
    across = next((a for a in model.machine.axes if a.direction == "X"), None)
    along = next((a for a in model.machine.axes if a.direction == "Z"), None)
    if across is None or along is None or not across.travel_mm[0] <= RADIUS_MM <= across.travel_mm[1]:
        raise ModelError("a radius of 100 mm is outside the travel of this machine")
    low, high = along.travel_mm
    start = min(max(state.get(along.name, low) + 0.5 * LENGTH_MM, low + LENGTH_MM), high)
    places = np.linspace(start, max(start - LENGTH_MM, low), ALONG)
    n = np.ones(ALONG)
    at = {k: v * n for k, v in state.items() if k not in (across.name, along.name)}
    at |= {across.name: RADIUS_MM * n, along.name: places, f"dir_{along.name}": -n}
    diameter = 2.0 * model.predict(at)[:, "XYZ".index(across.direction)]
    return Cylinder(float(diameter.mean()), float(np.ptp(diameter)), True, float(np.ptp(places)))


def _milled(model: Model, state: Mapping[str, float]) -> Cylinder:
    if len(model.machine.axes) < 2:
        raise ModelError("a cylinder needs two axes")
    first, second = sorted(model.machine.axes, key=lambda a: a.direction)[:2]
    for axis in (first, second):
        if axis.travel_mm[1] - axis.travel_mm[0] < 2.0 * RADIUS_MM:
            raise ModelError(f"a cylinder of 200 mm is larger than the travel of {axis.name}")
    turn = np.linspace(0.0, 2.0 * np.pi, AROUND, endpoint=False)
    cos, sin = np.cos(turn), np.sin(turn)
    middle = [0.5 * (a.travel_mm[0] + a.travel_mm[1]) for a in (first, second)]
    at = {k: np.full(AROUND, v) for k, v in state.items() if k not in (first.name, second.name)}
    at |= {first.name: middle[0] + RADIUS_MM * cos, second.name: middle[1] + RADIUS_MM * sin}
    at |= {f"dir_{first.name}": np.where(sin > 0.0, -1.0, 1.0), f"dir_{second.name}": np.where(cos >= 0.0, 1.0, -1.0)}
    error = model.predict(at)
    outward = error[:, "XYZ".index(first.direction)] * cos + error[:, "XYZ".index(second.direction)] * sin
    # The position of the circle is no error of its form.
    fit = np.stack([np.ones(AROUND), cos, sin], axis=1)
    values = np.linalg.lstsq(fit, outward, rcond=None)[0]
    return Cylinder(2.0 * float(values[0]), float(np.ptp(outward - fit @ values)), False)
