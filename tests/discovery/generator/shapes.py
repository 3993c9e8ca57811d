"""True shapes of the hidden effects of the catalogue: each as its physics might be, none as the program has it.

Transitions are soft, powers are off, lags are two, periodic errors are not quite sinusoidal, bodies are not their
sensors. Every function gives the component error in any unit, (n,).
"""

import numpy as np
from numpy.typing import NDArray

from tests.discovery.generator.world import World

Floats = NDArray[np.float64]
Rng = np.random.Generator


def _sign(rng: Rng) -> float:
    return float(rng.choice([-1.0, 1.0]))


def scale(w: World, rng: Rng) -> Floats:
    """A pitch that is off, and a little more so at one end."""
    return w.u * (1.0 + rng.uniform(-0.06, 0.06) * w.u)


def curve(w: World, rng: Rng) -> Floats:
    """A smooth bow with a swing."""
    bow = _sign(rng) * np.cos(1.4 * w.u + rng.uniform(-0.5, 0.5))
    return bow + rng.uniform(0.3, 0.6) * np.sin(2.6 * w.u)


def bumpy(w: World, rng: Rng) -> Floats:
    """A screw in segments: random heights joined by smooth steps."""
    at = np.linspace(-1.0, 1.0, 8)
    heights = rng.standard_normal(8)
    heights[1::2] = -np.sign(heights[:-1:2]) * np.abs(heights[1::2])
    place = np.clip(np.searchsorted(at, w.u) - 1, 0, 6)
    part = (w.u - at[place]) / (at[1] - at[0])
    smooth = 0.7 * part + 0.3 * part**2 * (3.0 - 2.0 * part)
    return np.asarray(heights[place] + (heights[place + 1] - heights[place]) * smooth)


def revolution(w: World, rng: Rng) -> Floats:
    """Once a turn, a little flattened."""
    angle = 2.0 * np.pi * w.q / (w.pitch_mm * (1.0 + rng.uniform(-2e-4, 2e-4))) + rng.uniform(0.0, 6.28)
    return np.tanh(0.8 * np.sin(angle))


def half_revolution(w: World, rng: Rng) -> Floats:
    """Twice a turn, as a universal joint gives it: the exact angle, not its sine."""
    angle = 2.0 * np.pi * w.q / w.pitch_mm + rng.uniform(0.0, 6.28)
    bent = np.cos(np.radians(rng.uniform(8.0, 15.0)))
    return np.asarray(np.arctan2(np.sin(angle) * bent, np.cos(angle)) - np.arctan2(np.sin(angle), np.cos(angle)))


def fine(w: World, rng: Rng) -> Floats:
    """Within each signal period of the encoder, 0.02 mm."""
    angle = 2.0 * np.pi * w.q / 0.02 + rng.uniform(0.0, 6.28)
    return np.sin(angle) + 0.1 * np.cos(3.0 * angle)


def tooth(w: World, rng: Rng) -> Floats:
    """At every magnetic pole, some 15 to 32 mm apart."""
    angle = 2.0 * np.pi * w.q / float(rng.choice([15.0, 20.0, 24.0, 32.0])) + rng.uniform(0.0, 6.28)
    return np.tanh(0.9 * np.sin(angle)) + 0.1 * np.sin(2.0 * angle)


def bow(w: World, rng: Rng) -> Floats:
    """A guide that hangs through, not evenly."""
    return np.cosh(1.2 * w.u) + rng.uniform(0.1, 0.4) * np.sinh(2.0 * w.u)


def constant(w: World, rng: Rng) -> Floats:
    """An angle that hardly changes."""
    return 1.0 + 0.02 * w.scaled("Y") * _sign(rng)


def tilt(w: World, rng: Rng) -> Floats:
    """An angle that changes along the line, more towards one end, with a wave."""
    return _sign(rng) * np.cosh(1.3 * w.u + rng.uniform(-0.4, 0.4)) + rng.uniform(0.3, 0.6) * np.sin(2.6 * w.u)


def bent_guide(w: World, rng: Rng) -> Floats:
    """A guide of nearly constant curvature."""
    return np.sinh(rng.uniform(0.3, 0.6) * w.u)


def twisted(w: World, rng: Rng) -> Floats:
    """A guide of nearly constant twist, along X."""
    return np.tan(rng.uniform(0.3, 0.5) * w.scaled("X"))


def lost(w: World, rng: Rng) -> Floats:
    """Backlash that is taken up within a tenth of a millimetre."""
    return w.d * np.tanh((w.since_mm + 0.02) / rng.uniform(0.03, 0.1))


def worn_zone(w: World, rng: Rng) -> Floats:
    """Backlash that is larger in a worn zone."""
    return w.d * np.exp(-0.5 * ((w.u - rng.uniform(-0.4, 0.4)) / rng.uniform(0.4, 0.6)) ** 2)


def backlash_grows(w: World, rng: Rng) -> Floats:
    """Backlash that grows with use, a little slower later."""
    return w.d * (w.hours / 9.0) ** rng.uniform(0.85, 0.95)


def backlash_loaded(w: World, rng: Rng) -> Floats:
    """Backlash that grows with the work piece."""
    return w.d * w.load ** rng.uniform(0.85, 1.15)


def backlash_warm(w: World, rng: Rng) -> Floats:
    """Backlash that grows as the nut warms."""
    rise = w.rise("T_screw")
    return w.d * (rise + rng.uniform(0.0, 0.01) * rise**2)


def rocking(w: World, rng: Rng) -> Floats:
    """A slide that rocks as it turns round."""
    return w.d * np.tanh((w.since_mm + 0.02) / rng.uniform(0.03, 0.1))


def lagging(w: World, rng: Rng) -> Floats:
    """The slide lags behind with its speed."""
    return w.d * w.feed_m_min * (1.0 - rng.uniform(0.0, 0.02) * w.feed_m_min)


def presliding(w: World, rng: Rng) -> Floats:
    """What is lost at a reversal comes back over some millimetres."""
    return w.d * np.exp(-((w.since_mm / rng.uniform(2.0, 8.0)) ** rng.uniform(0.85, 1.15)))


def spike(w: World, rng: Rng) -> Floats:
    """Stick, then slip."""
    x = w.since_mm / rng.uniform(1.0, 4.0)
    return w.d * x ** rng.uniform(0.85, 1.15) * np.exp(-x)


def friction(w: World, rng: Rng) -> Floats:
    """Friction that falls with speed."""
    return w.d / (1.0 + (w.feed_m_min / rng.uniform(0.5, 1.2)) ** 1.5)


def floats_up(w: World, rng: Rng) -> Floats:
    """A slide that lifts on its oil."""
    return np.log1p(w.feed_m_min / rng.uniform(0.5, 2.0))


def heavy(w: World, rng: Rng) -> Floats:
    """A slide that bends what pushes it."""
    return w.acceleration_m_s2 * (1.0 + rng.uniform(0.0, 0.04) * np.abs(w.acceleration_m_s2))


def screw_grows(w: World, rng: Rng) -> Floats:
    """A screw that is fixed near one end and is a little warmer at the other."""
    return (w.q * 1e-3) * (1.0 + rng.uniform(0.0, 0.06) * w.u) * w.rise("T_screw")


def mount_grows(w: World, rng: Rng) -> Floats:
    """A mounting that grows, slightly more when warmer."""
    rise = w.rise("T_front")
    return rise * (1.0 + rng.uniform(0.0, 0.02) * rise)


def screw_bulges(w: World, rng: Rng) -> Floats:
    """A screw that is hot where it is used."""
    return w.rise("T_screw") * (1.0 - np.cos(rng.uniform(1.0, 1.5) * w.u))


def spindle_grows(w: World, rng: Rng) -> Floats:
    """A spindle that grows with its own heat, through two lags."""
    tau = rng.uniform(18.0, 50.0)
    return w.heat(rng.uniform(1.1, 1.8), tau, 0.12 * tau)


def spindle_shifts(w: World, rng: Rng) -> Floats:
    """Bearings that shift with speed, at once."""
    return w.krpm ** rng.uniform(1.85, 2.15)


def spindle_tilts(w: World, rng: Rng) -> Floats:
    """A head that leans with the spindle's temperature."""
    rise = w.rise("T_spindle")
    return rise * (1.0 + rng.uniform(-0.01, 0.01) * rise)


def column_leans(w: World, rng: Rng) -> Floats:
    """A column that is warmer in front."""
    return w.rise("T_front") - rng.uniform(0.95, 1.05) * w.rise("T_back")


def bed_bends(w: World, rng: Rng) -> Floats:
    """A bed that is warmer than the air."""
    return (w.rise("T_bed") - w.rise("T_air")) * (1.0 - np.cos(rng.uniform(0.8, 1.2) * w.u))


def shop(w: World, rng: Rng) -> Floats:
    """A structure that follows the shop's air slowly, through two lags."""
    tau = rng.uniform(30.0, 75.0)
    return w.rise_lagged("T_air", tau, 0.12 * tau)


def coolant(w: World, rng: Rng) -> Floats:
    """A work piece that has the coolant's temperature."""
    rise = w.rise("T_coolant")
    return rise * (1.0 + rng.uniform(-0.02, 0.02) * rise)


def ram(w: World, rng: Rng) -> Floats:
    """A ram that sags as it comes out."""
    out = w.q / 400.0
    return out ** rng.uniform(1.9, 2.4)


def crossed(w: World, rng: Rng) -> Floats:
    """An angle that grows along the line, and not evenly with another axis."""
    v = w.scaled(w.other(1))
    return w.u * (np.exp(rng.uniform(0.7, 1.0) * v) - 1.0)


def bends_under(w: World, rng: Rng) -> Floats:
    """A table that bends under its work piece."""
    return w.load ** rng.uniform(0.9, 1.1) * (1.0 + rng.uniform(-0.4, 0.4) * w.u - rng.uniform(0.5, 1.0) * w.u**2)


def slipped(w: World, rng: Rng) -> Floats:
    """Counts that are lost within some seconds."""
    at = rng.uniform(2.0, 7.5)
    return 1.0 / (1.0 + np.exp(-np.clip((w.hours - at) * 3600.0 / 20.0, -60.0, 60.0)))
