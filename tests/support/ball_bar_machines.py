"""Machines drawn at random for ball bars, their readings worked out without rtec, and how the diagnosis does on them.

Kinds of machine:
    bb        [BB]'s parameters only, three tests at one feed; half of them with straight guides
    wander    the same with a noise that wanders along the circle
    mixed     each cause beyond [BB]'s with one chance in two; a fourth test at three times the feed
    all       every cause beyond [BB]'s; those four tests
    sine      the same, and the spikes are half-waves in time, which no shape of the catalogue is
    whole     whole machines by exact transforms: tool-side, table-side and mixed, in each plane, with 0 to 4 causes,
              real play and servo loops; the height of the ball, and at times the length of the bar, unknown
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rtec.metrology.ball_bar.diagnosis import BallBarDiagnosis, diagnose
from rtec.metrology.ball_bar.fit import FittedValue
from rtec.metrology.measurement import Measurement
from tests.support.ball_bar_dynamic import DEG, PITCH_MM, THREE, TWO_FEEDS, random_static, run_tests
from tests.support.ball_bar_truth import SIDES, Bar, TrueMachine, reading_um, recordings
from tests.support.ball_bar_truth import THREE as BARS
from tests.support.ball_bar_truth import truth_of as truth_by_name

Floats = NDArray[np.float64]
Numbers = dict[str, float]
KINDS = ("bb", "wander", "mixed", "all", "sine", "whole")
PER_RHO = {"yaw_x": "rho_yaw_x", "yaw_y": "rho_yaw_y", "pitch_x": "rho_pitch_x", "pitch_y": "rho_pitch_y"}
SPIKE_WIDTH = 2.446386
"""Of `u exp(1 - u)` at half its height, by bisection."""
RANGES = {
    # cause: from, to (either sign where True); each between what is seldom noticed and what is repaired
    "delay": (0.05, 1.0, True), "gain": (100.0, 600.0, False), "spike": (2.0, 12.0, False), "way": (0.05, 0.5, False),
    "ms": (150.0, 700.0, False), "play": (0.5, 3.0, True), "cyclic": (0.5, 2.0, False), "gamma": (1.5, 4.0, False),
    "change_over": (0.05, 0.3, False), "slope": (2.0, 15.0, True),
}  # fmt: skip


@dataclass(frozen=True)
class Machine:
    """What was made true."""

    static: Numbers
    dynamic: Numbers
    noise_um: float


@dataclass(frozen=True)
class Judged:
    """How the diagnosis of one machine did.

    Attributes:
        kind, seed, noise_um: the machine.
        within: parameters within three standard errors, of `count`.
        inside: those whose 95 % interval holds the truth.
        off: the parameters that are not within three standard errors, with how many they are off.
        explained, explained_bb: share of the variance above noise, by everything and by [BB]'s parameters alone.
        false_names: causes beyond [BB]'s that are named and are not there.
        missed: those that are there and are not named.
        z: how many standard errors each parameter is off.
        missed_above: those of the missed that are above the size from which they would be found.
        headline: what it names is the largest cause, or nothing is named.
    """

    kind: str
    seed: int
    noise_um: float
    count: int
    within: int
    inside: int
    off: tuple[tuple[str, float], ...]
    explained: float
    explained_bb: float
    false_names: tuple[str, ...]
    missed: tuple[str, ...]
    z: tuple[float, ...] = ()
    missed_above: tuple[str, ...] = ()
    headline: bool = True


def drawn(kind: str, seed: int) -> Machine:
    """A machine of a kind."""
    rng = np.random.default_rng([KINDS.index(kind), seed])
    noise = float(np.exp(rng.uniform(np.log(0.1), np.log(1.0))))
    static = random_static(rng, bent=kind not in ("bb", "wander") or seed % 2 == 0)
    dynamic: Numbers = {}
    for name in ("delay", "change_over", *(f"{n}_{a}" for n in ("gain", "spike", "play", "cyclic", "gamma", "slope")
                                           for a in "xy")):  # fmt: skip
        size = _within(rng, name.removesuffix("_x").removesuffix("_y"))
        there = rng.random() < {"bb": 0.0, "wander": 0.0, "mixed": 0.5}.get(kind, 1.0)
        if there:
            dynamic[name] = size
            if name.startswith("spike"):
                dynamic[f"{name}_ms" if kind == "sine" else f"{name}_way"] = _within(
                    rng, "ms" if kind == "sine" else "way"
                )
    return Machine(static, dynamic, noise)


def _within(rng: np.random.Generator, what: str) -> float:
    low, high, either = RANGES[what]
    size = float(np.exp(rng.uniform(np.log(low), np.log(high))))
    return -size if either and rng.random() < 0.5 else size


def measured(kind: str, seed: int) -> tuple[Machine, list[Measurement], list[Floats], list[Floats]]:
    """A machine, its recordings, their readings without noise, and those of a ball that is on the centre."""
    m = drawn(kind, seed)
    tests = THREE if kind in ("bb", "wander") else TWO_FEEDS
    more = m.noise_um if kind == "wander" else 0.0
    out, clean = run_tests(tests, m.static, m.dynamic, m.noise_um, seed, wander_um=more)
    centred = run_tests(tests, {**m.static, "ex": 0.0, "ey": 0.0}, m.dynamic)[1]
    return m, out, clean, centred


def judge(kind: str, seed: int) -> Judged:
    """Draw, measure, diagnose with and without what goes beyond [BB], compare with the truth."""
    if kind == "whole":
        return judge_whole(seed)
    machine, recordings, clean, centred = measured(kind, seed)
    found, bb = diagnose(recordings), diagnose(recordings, dynamic=False, phase="angle")
    truth, count, within, inside, off = truth_of(machine), 0, 0, 0, []
    z = []
    for v in found.fitted.values:
        if np.isfinite(v.value) and _alone(v) and _by_feed(v.name) in truth:
            far = v.value - truth[_by_feed(v.name)]
            far = (far + 180.0) % 360.0 - 180.0 if v.unit == "deg" else far
            count += 1
            z.append(far / v.se)
            within += abs(far) <= 3.0 * v.se
            inside += abs(far) <= v.high - v.value
            if abs(far) > 3.0 * v.se:
                off.append((v.name, far / v.se))
    named = {_by_feed(p.candidate.name) for p in found.found.beyond.picks}
    there = there_are(machine)
    missed = tuple(sorted(there - named))
    return Judged(
        kind, seed, machine.noise_um, count, within, inside, tuple(off), explained(found, clean, centred),
        explained(bb, clean, centred), tuple(sorted(named - there)), missed, tuple(z),
        _above(missed, found, truth | {n: machine.dynamic[n] for n in missed if n.startswith("spike")}),
    )  # fmt: skip


def _above(missed: Sequence[str], found: BallBarDiagnosis, truth: Mapping[str, float]) -> tuple[str, ...]:
    """Those of the missed that are larger than the size from which they would have been found by themselves."""
    limits: Numbers = {}
    for n in found.found.not_found:
        name = _by_feed(n.candidate.name)
        limits[name] = min(n.limit, limits.get(name, np.inf)) if not n.with_ else np.inf
    sizes = {n: truth[n] if n in truth else truth[f"{n}_amplitude"] for n in missed if n in limits}
    return tuple(n for n, size in sizes.items() if abs(size) > limits[n])


SIZES = {
    # cause of a whole machine: from, to, either sign
    "scale_a": (3.0, 30.0), "scale_b": (3.0, 30.0), "lean": (5.0, 50.0), "play_a": (1.0, 6.0), "play_b": (1.0, 6.0),
    "bend_a": (0.05, 0.4), "bend_b": (0.05, 0.4), "arch_a": (0.1, 1.0), "roll": (20.0, 200.0), "lead_ms": (0.05, 0.5),
    "side_a": (0.5, 3.0), "wave_a": (0.5, 2.0), "stick_a": (2.0, 10.0),
}  # fmt: skip
ONE_WAY = ("play_a", "play_b", "wave_a", "stick_a")


def whole_machine(seed: int) -> tuple[TrueMachine, tuple[Bar, ...], float, str]:
    """A whole machine, its tests, noise, and whether the length of the bar is known."""
    rng = np.random.default_rng([KINDS.index("whole"), seed])
    size = {"ex": float(rng.uniform(-10, 10)), "ey": float(rng.uniform(-10, 10)), "stick_mm": 0.2}
    for name in rng.choice(list(SIZES), int(rng.integers(0, 5)), replace=False):
        low, high = SIZES[name]
        sign = 1.0 if name in ONE_WAY or rng.random() < 0.5 else -1.0
        size[str(name)] = sign * float(np.exp(rng.uniform(np.log(low), np.log(high))))
    given = [*BARS, Bar(0.0, 150.0, "cw", 3000.0)] if rng.random() < 0.5 else [*BARS]
    if rng.random() < 0.5:
        size["lag_ms"] = 1e3 / float(rng.uniform(25.0, 90.0))
    zero = "setup" if rng.random() < 0.2 else "none"
    bars = tuple(
        replace(b, height_um=50.0 * float(rng.standard_normal()) if b.h else 0.0,
                longer_um=30.0 * float(rng.standard_normal()) if zero == "setup" else 0.0)
        for b in given
    )  # fmt: skip
    kind, plane = str(rng.choice(list(SIDES))), str(rng.choice(["XY", "YZ", "XZ"]))
    return TrueMachine(kind, plane, size), bars, float(np.exp(rng.uniform(np.log(0.1), np.log(0.5)))), zero


def judge_whole(seed: int) -> Judged:
    """Draw a whole machine, measure, diagnose, compare with the truth."""
    m, bars, noise, zero = whole_machine(seed)
    found = diagnose(recordings(m, bars, noise, seed, 1.0, zero=zero))
    truth = whole_truth(m, bars)
    sure = [v for v in found.fitted.values if np.isfinite(v.value) and _alone(v) and _by_feed(v.name) in truth]
    z = [(v.value - truth[_by_feed(v.name)]) / v.se for v in sure]
    inside = sum(v.low <= truth[_by_feed(v.name)] <= v.high for v in sure)
    a, b, _ = (letter.lower() for letter in m.letters)
    there = {f"gain_{a}", f"gain_{b}"} if m["lag_ms"] else set()
    there |= {"delay"} if m["lead_ms"] else set()
    names = {"side_a": f"play_{a}_{b}", "wave_a": f"cyclic_{a}", "stick_a": f"spike_{a}"}
    there |= {name for cause, name in names.items() if m[cause]}
    either = {v.name: {v.name, *v.with_} for v in found.fitted.values}
    named = {_by_feed(p.candidate.name) for p in found.found.beyond.picks}
    wrong = {n for n in named if not either.get(n, {n}) & there}
    looked_for = {_by_feed(n.candidate.name) for n in found.found.not_found if not n.with_}
    missed = tuple(n for n in sorted(there - named) if n in looked_for)
    above = _above(missed, found, truth | {f"spike_{a}": m["stick_a"]})
    return Judged(
        "whole", seed, noise, len(z), sum(abs(x) <= 3.0 for x in z), inside,
        tuple((v.name, x) for v, x in zip(sure, z, strict=True) if abs(x) > 3.0), found.explained, found.explained_bb,
        tuple(sorted(wrong)), missed, tuple(z), above, _headline(m, bars, found),
    )  # fmt: skip


def whole_truth(m: TrueMachine, bars: Sequence[Bar]) -> Numbers:
    """The truth by the program's names; a delay is told from the phase only where there are two feeds."""
    out = {k: v for k, v in truth_by_name(m, bars).items() if np.isfinite(v)}
    a, b, _ = (letter.lower() for letter in m.letters)
    out |= {"delay": m["lead_ms"], f"spike_{a}_plus": m["stick_a"], f"spike_{a}_minus": m["stick_a"]}
    return out | {f"play_{x}_{y}": out.get(f"play_{x}_{y}", 0.0) for x, y in ((a, b), (b, a))}


def _headline(m: TrueMachine, bars: Sequence[Bar], found: BallBarDiagnosis) -> bool:
    """Is the named cause as large as any other, each made by itself, up to a fifth and the noise?"""
    if found.named is None:
        return True
    a, b, _ = m.letters
    groups = {
        "scale_a": f"scale {a}", "scale_b": f"scale {b}", "lean": "squareness", "play_a": f"clearance {a}",
        "play_b": f"clearance {b}", "bend_a": f"bend {a} in plane", "bend_b": f"bend {b} in plane",
        "arch_a": f"bend {a} out of plane", "roll": "twist", "lead_ms": "servo", "side_a": f"lateral play {a}",
        "wave_a": f"cyclic error {a}", "stick_a": f"reversal spike {a}", "lag_ms": "servo gain",
    }  # fmt: skip
    by_itself = {}
    for cause in groups:
        if m[cause]:
            alone = replace(m, size={cause: m[cause], "stick_mm": m["stick_mm"]})
            by_itself[cause] = max(_g_of(alone, bar) for bar in bars)
    by_itself.pop("lag_ms", None)
    if found.circles[0].setup.zero != "none":
        # The length of the bar takes what both scales have in common.
        half = 0.5 * (m["scale_a"] - m["scale_b"])
        apart = replace(m, size={"scale_a": half, "scale_b": -half})
        by_itself = {c: g for c, g in by_itself.items() if c not in ("scale_a", "scale_b")}
        by_itself["scale_a"] = max(_g_of(apart, bar) for bar in bars)
    if m["lag_ms"] and found.circles[0].setup.zero == "none":
        # Both loops together keep the circle round, and a bar of unknown length does not show them.
        by_itself["lag_ms"] = max(0.5 * m["lag_ms"] ** 2 * (c.feed / 60.0 / c.r) ** 2 * c.r * 1e-3 for c in bars)
    mine = [g for cause, g in by_itself.items() if groups[cause].lower() in found.named.group.lower()]
    # A servo's part is a scale, and its phase a squareness, where one feed does not tell them apart.
    if len({b.feed for b in bars}) == 1 and any(k in found.named.group for k in ("scale", "squareness")):
        mine += [by_itself[c] for c in ("lag_ms", "lead_ms") if c in by_itself]
    return bool(mine) and max(mine) >= 0.8 * max(by_itself.values()) - 0.2


def _g_of(m: TrueMachine, bar: Bar) -> float:
    angle = np.deg2rad(np.arange(1.0, 360.0, 2.0)) * (1.0 if bar.sense == "ccw" else -1.0)
    reading = reading_um(m, replace(bar, height_um=0.0, longer_um=0.0), angle)
    waves = np.stack([np.ones(len(angle)), np.cos(angle), np.sin(angle)], axis=1)
    return float(np.ptp(reading - waves @ np.linalg.lstsq(waves, reading, rcond=None)[0]))


def explained(d: BallBarDiagnosis, clean: list[Floats], centred: list[Floats]) -> float:
    """Share of the variance of the readings without noise and without centre offset, each about its test's mean."""
    rest = sum(float(np.var(c - d.fitted.fitted_um(i))) for i, c in enumerate(clean))
    return 1.0 - rest / sum(float(np.var(c)) for c in centred)


def there_are(machine: Machine) -> set[str]:
    """Names of the program for the causes beyond [BB]'s that are there."""
    names = {"play_x": "play_x_y", "play_y": "play_y_x", "gamma_x": "indexing_x", "gamma_y": "indexing_y",
             "slope_x": "clearance_slope_x", "slope_y": "clearance_slope_y"}  # fmt: skip
    return {names.get(n, n) for n in machine.dynamic if not n.endswith(("_way", "_ms"))}


def truth_of(machine: Machine) -> Numbers:
    """The truth by the program's names and in its units; without those of a spike that is a half-wave in time."""
    s, d = machine.static, machine.dynamic
    out = {f"centre_{a}": s[f"e{a}"] for a in "xy"} | {f"clearance_{a}": s[f"d{a}"] for a in "xy"}
    out |= {f"scale_{a}": 1e6 * (s[f"S{a}"] - 1.0) for a in "xy"}
    out |= {f"perpendicularity_{a}": 1e6 * s[f"phi{a}"] for a in "xy"}
    out |= {"squareness": 1e6 * s["thetax"], "phase": 1e6 * s["psi"], "twist": 1e6 * s.get("kappa", 0.0)}
    out |= {name: 1e3 / s[rho] if rho in s else 0.0 for name, rho in PER_RHO.items()}
    out |= {n: d.get(n, 0.0) for n in ("delay", "gain_x", "gain_y", "change_over")}
    out |= {"play_x_y": d.get("play_x", 0.0), "play_y_x": d.get("play_y", 0.0), "play_x_z": 0.0, "play_y_z": 0.0}
    for a in "xy":
        out |= _of_axis(a, d)
    return out


def _of_axis(a: str, d: Mapping[str, float]) -> Numbers:
    # [BB 21] taken to its Fourier series: -tan²(γ/2) sin 2θ, and the next term is a thousandth of it.
    joint = np.tan(0.5 * d.get(f"gamma_{a}", 0.0) * DEG) ** 2 * PITCH_MM / (2.0 * np.pi) * 1e3
    out = {
        f"clearance_slope_{a}": d.get(f"slope_{a}", 0.0), f"clearance_bow_{a}": 0.0,
        f"cyclic_{a}_amplitude": d.get(f"cyclic_{a}", 0.0), f"indexing_{a}_amplitude": float(joint),
    }  # fmt: skip
    if f"cyclic_{a}" in d:
        out[f"cyclic_{a}_phase"] = 0.7 / DEG
    if f"gamma_{a}" in d:
        out[f"indexing_{a}_phase"] = 180.0
    if f"spike_{a}_ms" not in d:
        out |= {f"spike_{a}_{end}": d.get(f"spike_{a}", 0.0) for end in ("plus", "minus")}
    if f"spike_{a}_way" in d:
        out[f"spike_{a}_width"] = SPIKE_WIDTH * d[f"spike_{a}_way"]
    return out


def _alone(v: FittedValue) -> bool:
    """Whether a parameter is asserted; these machines have no curved positioning error, which a bend may be instead."""
    return all(name.startswith("curve_") for name in v.with_)


def _by_feed(name: str) -> str:
    """A spike's name without its feed."""
    return name.replace("_f1000", "").replace("_f916.513", "").replace("_f3000", "")
