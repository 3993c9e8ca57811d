"""The true errors of every link at a position, at the temperatures of one second, and the true place of the tool tip.

Symbols: `r` encoder reading, `m` motor (screw) position, `p` the same after the play, `s` slide position; all mm along
the axis, positive as programmed. `g` is the positioning error of screw or scale, µm.

    encoder on the screw:  r = m + eccentricity(m),  s = p + g(m)
    linear scale:          r = s - g(s),             s = p      (the screw's own error is inside the loop)

The chain gets the whole error along the axis as `s - r`, which is `EXX` of the axis [ISO 230-1].

The tool tip is the exact product of homogeneous transforms along both sides of the machine. The code is independent of
`rtec.machine` on purpose: the simulated truth must not use the code that it tests.

    tool side:  T = Trans(offset + q·(d + ε0 × d)) · E(ε, δ)           work side:  Trans(offset - …) · E(-ε, -δ)
    fixed link: T = Trans(offset) · E(ε, δ), its own displacement in machine coordinates, on either side
    tip = position of T_WORK^-1 T_TOOL                                  e = tip - nominal tip   [G 2.9, 2.22-2.26]

E is [G 2.6]; lengths mm, angles rad; many poses at once along the first axis of every array.
"""

import math

import numpy as np

from rtec.arrays import Floats
from rtec.machine import Axis, Machine
from rtec.sim.truth import AxisTruth, Growth, Truth, UnseenDrift

DIRECTIONS = {"X": (1.0, 0.0, 0.0), "Y": (0.0, 1.0, 0.0), "Z": (0.0, 0.0, 1.0)}


class ExactChain:
    """The two sides of one machine.

    Attributes:
        links: all link names, tool side first: the order of every array of link errors.
        directions: (axes, 3) unit vectors.
    """

    def __init__(self, machine: Machine) -> None:
        self.links = (*machine.tool_chain, *machine.work_chain)
        self.directions = np.array([DIRECTIONS[a.direction] for a in machine.axes]).reshape(-1, 3)
        self._n_tool = len(machine.tool_chain)
        names = machine.axis_names
        self._axis = [names.index(name) if name in names else -1 for name in self.links]
        self._offset = np.array(
            [
                machine.axes[a].offset_mm if a >= 0 else machine.links[name].offset_mm
                for name, a in zip(self.links, self._axis, strict=True)
            ]
        )

    def nominal_mm(self, q_mm: Floats) -> Floats:
        """Tool tip relative to the workpiece, (n, 3), without any error; q_mm is (n, axes)."""
        fixed = self._offset[: self._n_tool].sum(axis=0) - self._offset[self._n_tool :].sum(axis=0)
        return np.asarray(fixed + q_mm @ self.directions)

    def tip_mm(self, q_mm: Floats, delta_mm: Floats, epsilon_rad: Floats, squareness_rad: Floats) -> Floats:
        """Tool tip relative to the workpiece, (n, 3).

        Args:
            q_mm: positions that the scales show, (n, axes).
            delta_mm: displacement of every link, (n, links, 3).
            epsilon_rad: rotation of every link, (n, links, 3).
            squareness_rad: tilt of each axis' line of travel, (axes, 3).
        """
        travel = q_mm[:, :, None] * (self.directions + _cross(squareness_rad, self.directions))
        sides = []
        for links, side in ((range(self._n_tool), 1.0), (range(self._n_tool, len(self.links)), -1.0)):
            product = np.broadcast_to(np.eye(4), (len(q_mm), 4, 4))
            for k in links:
                a = self._axis[k]
                if a >= 0:
                    place = self._offset[k] + side * (travel[:, a] + delta_mm[:, k])
                    product = product @ _link(place, side * epsilon_rad[:, k])
                else:
                    product = product @ _link(self._offset[k] + delta_mm[:, k], epsilon_rad[:, k])
            sides.append(product)
        tool, work = sides
        return np.asarray(np.linalg.solve(work, tool[:, :, 3:])[:, :3, 0])


def _cross(a: Floats, b: Floats) -> Floats:
    """`a × b` along the last axis; numpy's function takes ten times as long on a few vectors."""
    return np.asarray(a[:, [1, 2, 0]] * b[:, [2, 0, 1]] - a[:, [2, 0, 1]] * b[:, [1, 2, 0]])


def _link(place_mm: Floats, epsilon_rad: Floats) -> Floats:
    """`Trans(place) · E(ε, 0)`, (n, 4, 4); a displacement δ is part of `place`, as `Trans(δ) · E(ε, 0) = E(ε, δ)`."""
    out = np.zeros((len(place_mm), 4, 4))
    a, b, c = epsilon_rad.T
    out[:, 0, 0] = out[:, 1, 1] = out[:, 2, 2] = out[:, 3, 3] = 1.0
    out[:, 0, 1], out[:, 1, 0] = -c, c
    out[:, 0, 2], out[:, 2, 0] = b, -b
    out[:, 1, 2], out[:, 2, 1] = -a, a
    out[:, :3, 3] = place_mm
    return out


LETTERS = "XYZABC"


class AxisGeometry:
    """One axis' errors as a function of position; the caller sets the temperatures once a second."""

    def __init__(self, axis: Axis, truth: AxisTruth, body_index: dict[str, int], reference_degc: float) -> None:
        self.on_scale = truth.encoder == "scale"
        self.half_play_mm = truth.backlash_um * 0.5e-3
        self._along = "XYZ".index(axis.direction)
        self._screw, self._reference_degc = truth.screw, reference_degc
        self._omega = 2 * math.pi / axis.pitch_mm if axis.pitch_mm else 0.0
        self._waves, self._bumps, self._slopes = _pack(truth)
        self._segments = np.array([body_index[name] for name in truth.screw.bodies], dtype=np.int64)
        self._edges = np.linspace(*axis.travel_mm, len(self._segments) + 1)
        self._expansion = np.zeros(len(self._edges))
        self._slope_low = self._slope_high = 0.0

    def set_temperatures(self, body_degc: Floats) -> None:
        """Integrate the screw's expansion from its fixed point, with the temperature of each of its sections."""
        if not len(self._segments):
            return
        rise = body_degc[self._segments] - self._reference_degc
        strain = self._screw.um_per_m_degc * 1e-3 * rise * (1.0 + self._screw.bend_per_degc * rise)
        self._slope_low, self._slope_high = float(strain[0]), float(strain[-1])
        self._expansion = np.concatenate([[0.0], np.cumsum(strain * np.diff(self._edges))])
        self._expansion = self._expansion - self._expand(np.array([self._screw.fixed_at_mm]))

    def position_error_um(self, q_mm: Floats) -> Floats:
        """`g`: travel of the slide beyond the nominal one of screw or scale, µm, (n,)."""
        return self._smooth_um(q_mm) + self._cyclic_um(q_mm)

    def encoder_error_um(self, base_mm: Floats) -> Floats:
        """Encoder reading minus the position of the motor (on the screw) or the slide (scale), µm, (n,)."""
        if self.on_scale:
            return -self.position_error_um(base_mm)
        screw = self._screw
        return screw.encoder_um * np.sin(self._omega * base_mm + screw.encoder_phase_rad)

    def encoder_table_um(self, nodes_mm: Floats) -> Floats:
        """The encoder error without its sines, µm, for the controller's table."""
        return -self._smooth_um(nodes_mm) if self.on_scale else np.zeros(len(nodes_mm))

    def encoder_sines(self) -> tuple[float, float, float, float]:
        """Amplitude, µm, and phase of the encoder's error once and twice per pitch."""
        s = self._screw
        if self.on_scale:
            return -s.cyclic_um, s.cyclic_phase_rad, -s.cyclic2_um, s.cyclic2_phase_rad
        return s.encoder_um, s.encoder_phase_rad, 0.0, 0.0

    def slide_mm(self, motor_mm: Floats, after_play_mm: Floats) -> Floats:
        """`s`, (n,)."""
        if self.on_scale:
            return after_play_mm
        return after_play_mm + 1e-3 * self.position_error_um(motor_mm)

    def motor_at(self, reading_mm: Floats) -> Floats:
        """The position at which the encoder reads `reading_mm`: of the motor, or of the slide with a scale."""
        base = reading_mm
        for _ in range(3):  # the error's slope is below 1e-3, so each pass gains three digits
            base = reading_mm - 1e-3 * self.encoder_error_um(base)
        return base

    def motions(self, q_mm: Floats) -> Floats:
        """The six motions, µm and µrad, (n, 6); the one along the axis is zero, see `slide_mm`."""
        out = self._shapes(q_mm)
        out[:, self._along] = 0.0
        return out

    def _smooth_um(self, q_mm: Floats) -> Floats:
        return self._shapes(q_mm)[:, self._along] + self._expand(q_mm)

    def _cyclic_um(self, q_mm: Floats) -> Floats:
        s, turn = self._screw, self._omega * q_mm
        once = s.cyclic_um * np.sin(turn + s.cyclic_phase_rad)
        return once + s.cyclic2_um * np.sin(2 * turn + s.cyclic2_phase_rad)

    def _expand(self, q_mm: Floats) -> Floats:
        low, high = self._edges[0], self._edges[-1]
        inside = np.interp(q_mm, self._edges, self._expansion)
        below, above = np.minimum(q_mm - low, 0.0), np.maximum(q_mm - high, 0.0)
        return np.asarray(inside + self._slope_low * below + self._slope_high * above)

    def _shapes(self, q_mm: Floats) -> Floats:
        q = q_mm[:, None]
        number, phase, waves = self._waves
        centre, width, bumps = self._bumps
        return np.asarray(
            np.sin(number * q + phase) @ waves + np.exp(-(((q - centre) / width) ** 2)) @ bumps + q * self._slopes
        )


class Geometry:
    """All links of one machine: true tip from positions, temperatures and time."""

    def __init__(self, machine: Machine, truth: Truth, bodies: tuple[str, ...], seed: int) -> None:
        index = {name: i for i, name in enumerate((*bodies, "air"))}
        self.chain = ExactChain(machine)
        self.axes = [AxisGeometry(a, truth.axis[a.name], index, truth.reference_degc) for a in machine.axes]
        self._reference_degc = truth.reference_degc
        self._axis_link = [self.chain.links.index(name) for name in machine.axis_names]
        self._growth = [
            (self._slot(machine, g), index[g.body], index[g.minus] if g.minus else -1, g.per_degc, g.per_degc2)
            for g in (*truth.growth_um, *truth.growth_urad)
        ]
        self._drift = [
            (self._slot(machine, d), d.amplitude, 2 * math.pi / (d.period_h * 3600.0)) for d in truth.drift_um
        ]
        self._phase = np.random.default_rng([seed, 4]).uniform(0.0, 2 * math.pi, len(self._drift))
        self._square0 = np.zeros((len(machine.axes), 3))
        for a, name in enumerate(machine.axis_names):
            for k, tilt in truth.axis[name].squareness_urad.items():
                self._square0[a, "ABC".index(k)] = tilt
        self._square = self._square0
        self._link = np.zeros((len(self.chain.links), 6))
        self._along = np.array(["XYZ".index(a.direction) for a in machine.axes])

    def set_temperatures(self, body_degc: Floats, time_s: float) -> None:
        """Set the temperatures (bodies, then air) and the time of this second."""
        for axis in self.axes:
            axis.set_temperatures(body_degc)
        self._link = np.zeros_like(self._link)
        self._square = self._square0.copy()
        for (row, column, square), body, minus, per_degc, per_degc2 in self._growth:
            rise = body_degc[body] - (body_degc[minus] if minus >= 0 else self._reference_degc)
            (self._square if square else self._link)[row, column] += rise * (per_degc + per_degc2 * rise)
        for ((row, column, _), amplitude, omega), phase in zip(self._drift, self._phase, strict=True):
            self._link[row, column] += amplitude * (math.sin(omega * time_s + phase) - math.sin(phase))

    def slides_mm(self, motor_mm: Floats, after_play_mm: Floats) -> Floats:
        """Positions of the slides, mm, (n, axes)."""
        columns = [axis.slide_mm(motor_mm[:, a], after_play_mm[:, a]) for a, axis in enumerate(self.axes)]
        return np.stack(columns, axis=1)

    def at_readings(self, reading_mm: Floats, direction: Floats) -> Floats:
        """Positions of the slides, (n, axes), at encoder readings after motion in `direction` (±1; 0: mid-play)."""
        columns = []
        for a, axis in enumerate(self.axes):
            base = axis.motor_at(reading_mm[:, a])
            play = 0.0 if axis.on_scale else direction[:, a] * axis.half_play_mm
            columns.append(axis.slide_mm(base, base - play))
        return np.stack(columns, axis=1)

    def tip_mm(self, reading_mm: Floats, slide_mm: Floats) -> Floats:
        """True tool tip relative to the workpiece, (n, 3)."""
        errors = np.broadcast_to(self._link, (len(reading_mm), *self._link.shape)).copy()
        for a, axis in enumerate(self.axes):
            row = self._axis_link[a]
            errors[:, row] += axis.motions(reading_mm[:, a])
            errors[:, row, self._along[a]] += 1e3 * (slide_mm[:, a] - reading_mm[:, a])
        return self.chain.tip_mm(reading_mm, errors[:, :, :3] * 1e-3, errors[:, :, 3:] * 1e-6, self._square * 1e-6)

    def _slot(self, machine: Machine, item: Growth | UnseenDrift) -> tuple[int, int, bool]:
        if item.motion.endswith("0"):
            return machine.axis_names.index(item.link), "ABC".index(item.motion[0]), True
        return self.chain.links.index(item.link), LETTERS.index(item.motion), False


def _pack(truth: AxisTruth) -> tuple[tuple[Floats, Floats, Floats], tuple[Floats, Floats, Floats], Floats]:
    """All six motions as arrays: (wave number, phase, (waves, 6)), (centre, width, (bumps, 6)), slopes (6,)."""
    shapes = {**truth.motion_um, **truth.motion_urad}
    slots = [(LETTERS.index(key[1]), shape) for key, shape in shapes.items()]
    waves = [(k, *wave) for k, shape in slots for wave in shape.waves]
    bumps = [(k, *bump) for k, shape in slots for bump in shape.bumps]
    wave_size, bump_size, slopes = np.zeros((len(waves), 6)), np.zeros((len(bumps), 6)), np.zeros(6)
    for i, (k, amplitude, _, _) in enumerate(waves):
        wave_size[i, k] = amplitude
    for i, (k, height, _, _) in enumerate(bumps):
        bump_size[i, k] = height
    for k, shape in slots:
        slopes[k] = shape.slope_per_m * 1e-3
    number = np.array([2 * math.pi / length for _, _, length, _ in waves])
    phase = np.array([phase for _, _, _, phase in waves])
    centre, width = np.array([c for _, _, c, _ in bumps]), np.array([w for _, _, _, w in bumps])
    return (number, phase, wave_size), (centre, width, bump_size), slopes
