"""What a free choice asserts of lasers, plates and ball bars together, on machines drawn at random.

python -m tests.characterise.free_proof [--machines 100] [--first 5000] [--only whole|warm] [--to FILE]

    whole   machines of `ball_bar_truth`: tool-side, table-side and bridge, in each plane, 0 to 4 causes of geometry and
            servo, lengths of bars and heights of balls unknown; a laser and a plate read at rest
    warm    the machines of `joint_proof`, of which all sensors rise together

An effect of the model that is not in the truth is false, unless a warning (`confounded`, `undecided`) names it. A cause
is missed if no effect of the model is its, no warning names it, and it moves readings of a measurement by more than the
noise. The verdict is wrong if the residual is more than a quarter above the noise and no warning says so.
"""

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rtec.characterise import Characterisation, characterise
from rtec.errors import ModelError
from rtec.metrology.measurement import Measurement
from tests.characterise.joint_proof import SHAPES
from tests.characterise.joint_proof import drawn as warm_machine
from tests.support.ball_bar_truth import SIDES, THREE, Bar, TrueMachine
from tests.support.joint_truth import TRAVEL_MM, measured

KINDS = ("whole", "warm")
FIRST = 5000
SIZES = {
    # cause: from, to
    "scale_a": (3.0, 30.0), "scale_b": (3.0, 30.0), "lean": (5.0, 50.0), "play_a": (1.0, 6.0), "play_b": (1.0, 6.0),
    "bend_a": (0.05, 0.4), "bend_b": (0.05, 0.4), "arch_a": (0.1, 1.0), "roll": (20.0, 200.0), "lead_ms": (0.05, 0.5),
    "side_a": (0.5, 3.0),
}  # fmt: skip
ONE_WAY = ("play_a", "play_b")
ABOVE = 1.25
SHAPED, PIECES = ("scale", "polynomial_position"), "piecewise_position"
"""Pieces may take the place of shapes along an axis; their numbers are heights, so they are not compared."""
Term = tuple[str, str, str]
"""Effect, component, name of the number."""


@dataclass(frozen=True)
class Judged:
    """How the fit of one machine did.

    Attributes:
        kind, seed: the machine.
        z: how many standard errors each asserted number of a true cause is off.
        false, missed: asserted and not there; there and not asserted.
        open: effects that a warning leaves open.
        verdict: whether the residual is the noise, or said not to be.
    """

    kind: str
    seed: int
    z: tuple[tuple[str, float], ...]
    false: tuple[str, ...]
    missed: tuple[str, ...]
    open: tuple[str, ...]
    verdict: bool


def machine_of(seed: int) -> tuple[TrueMachine, tuple[Bar, ...], float, str]:
    """A whole machine, its bars, the noise, and whether the bars' length is known."""
    rng = np.random.default_rng([seed, 23])
    size = {"ex": float(rng.uniform(-10, 10)), "ey": float(rng.uniform(-10, 10))}
    for name in rng.choice(list(SIZES), int(rng.integers(0, 5)), replace=False):
        low, high = SIZES[name]
        sign = 1.0 if name in ONE_WAY or rng.random() < 0.5 else -1.0
        size[str(name)] = sign * float(np.exp(rng.uniform(np.log(low), np.log(high))))
    if rng.random() < 0.5:
        size["lag_ms"] = 1e3 / float(rng.uniform(25.0, 90.0))
    zero = "setup" if rng.random() < 0.3 else "none"
    feed = float(rng.choice([1000.0, 3000.0]))
    bars = [*THREE, Bar(0.0, 150.0, "cw", 4000.0 - feed)] if rng.random() < 0.5 else [*THREE]
    bars = [
        replace(b, feed=feed if i < 3 else b.feed, height_um=50.0 * float(rng.standard_normal()) if b.h else 0.0,
                longer_um=30.0 * float(rng.standard_normal()) if zero == "setup" else 0.0)
        for i, b in enumerate(bars)
    ]  # fmt: skip
    kind, plane = str(rng.choice(list(SIDES))), str(rng.choice(["XY", "YZ", "XZ"]))
    return TrueMachine(kind, plane, size), tuple(bars), float(np.exp(rng.uniform(np.log(0.1), np.log(0.5)))), zero


def terms_of(m: TrueMachine) -> dict[str, dict[Term, float]]:
    """For each cause, the numbers of the program's effects that it is, any of them, with their true values."""
    a, b, n = m.letters
    about = {"X": "A", "Y": "B", "Z": "C"}
    bow = 0.5e-3 * TRAVEL_MM**2 / 1.5
    own, turns = (a, 1.0) if m.carrier == 0 else (b, -1.0)

    def bent(component: str, per_km: float) -> dict[Term, float]:
        return {("polynomial_position", component, "c2"): bow * per_km}

    tau = [1e-3 * (m["lag_ms"] - s * m["lead_ms"]) for s in (0.5, -0.5)]
    whole = {
        "scale_a": {("scale", f"E{a}{a}", "k"): m["scale_a"]},
        "scale_b": {("scale", f"E{b}{b}", "k"): m["scale_b"]},
        "lean": {
            ("squareness", f"E{about[n]}0{a}", "alpha"): m.hand * m["lean"],
            ("squareness", f"E{about[n]}0{b}", "alpha"): -m.hand * m["lean"],
        },
        "play_a": {("backlash", f"E{a}{a}", "B"): -m["play_a"]},
        "play_b": {("backlash", f"E{b}{b}", "B"): -m["play_b"]},
        "bend_a": bent(f"E{b}{a}", -m["bend_a"]),
        "bend_b": bent(f"E{a}{b}", -m["bend_b"]),
        "arch_a": bent(f"E{n}{a}", m["arch_a"]),
        "roll": {("polynomial_position", f"E{about[own]}{own}", "c1"): turns * 1e-3 * m["roll"] * TRAVEL_MM},
        "lead_ms": {("servo_lag", f"E{a}{a}", "tau"): m["lead_ms"], ("servo_lag", f"E{b}{b}", "tau"): -m["lead_ms"]},
        "side_a": {("backlash", f"E{b}{a}", "B"): m["side_a"]},
        "lag_a": {("inertia", f"E{a}{a}", "k"): 0.5e6 * tau[0] ** 2},
        "lag_b": {("inertia", f"E{b}{b}", "k"): 0.5e6 * tau[1] ** 2},
    }
    there = {*m.size, *(("lag_a", "lag_b") if m["lag_ms"] else ())}
    return {cause: terms for cause, terms in whole.items() if cause in there}


def _moved_um(m: TrueMachine, cause: str, bars: Sequence[Bar]) -> float:
    """How far a cause moves readings of a measurement at most (root mean square), what its set-up takes up removed."""
    exact = [replace(b, height_um=0.0, longer_um=0.0) for b in bars]
    keep = "lag_ms" if cause.startswith("lag") else cause
    here, nothing = (measured(replace(m, size=size), exact, 0.0, 0) for size in ({keep: m[keep]}, {}))
    largest = 0.0
    for one, other in zip(here, nothing, strict=True):
        axes = [one.channels[one.machine.axis(d).channel] for d in m.plane]
        flat = np.stack([np.ones(len(one)), *axes], axis=1)
        for row in one.matrix() - other.matrix():
            shape = flat[:, :1] if one.instrument.name == "laser_linear" else flat
            left = row - shape @ np.linalg.lstsq(shape, row, rcond=None)[0]
            largest = max(largest, float(np.sqrt(np.mean(left**2))))
    return largest


def judge(kind: str, seed: int) -> Judged:
    """Draw, measure, fit with a free choice, compare with the truth."""
    if kind == "whole":
        m, bars, noise, zero = machine_of(seed)
        causes = terms_of(m)
        above = [c for c in causes if _moved_um(m, c, bars) > noise]
        return _judged(kind, seed, _free(measured(m, bars, noise, seed, zero=zero)), causes, above)
    truth, recorded = warm_machine(seed)
    causes = {n: {(n.split(":")[0], SHAPES[n][0], SHAPES[n][1]): size} for n, size in truth.size.items()}
    above = [n for n, size in truth.size.items() if abs(size) > 0.3 * SHAPES[n][2]]
    return _judged(kind, seed, _free(recorded), causes, above)


def _free(recorded: Sequence[Measurement]) -> Characterisation | None:
    """The fit; None where it says that nothing but noise is there."""
    try:
        return characterise(recorded)
    except ModelError as e:
        if "the readings are noise" not in str(e):
            raise
        return None


def _judged(
    kind: str,
    seed: int,
    found: Characterisation | None,
    causes: Mapping[str, Mapping[Term, float]],
    above: Sequence[str],
) -> Judged:
    if found is None:
        return Judged(kind, seed, (), (), tuple(above), (), True)
    said = " ".join(w.text for w in found.warnings if w.code in ("confounded", "undecided", "which_part"))
    true = {term: value for terms in causes.values() for term, value in terms.items()}
    shaped = {component for effect, component, _ in true if effect in SHAPED}
    z, false, left_open, there = [], [], [], set()
    for c in found.coefficients:
        term = (c.effect.split("(")[0], c.component, c.name)
        if c.se is None:
            continue
        if term[0] == PIECES and c.component in shaped:
            there |= {t for t in true if t[0] in SHAPED and t[1] == c.component}
            continue
        there.add(term)
        short = c.effect.split(",")[0].rstrip(")")
        if short in said:
            left_open.append(c.effect)
        elif term in true:
            z.append((f"{term[0]}({term[1]})", (c.value - true[term]) / c.se))
        else:
            false.append(f"{c.effect} {c.name} {c.value:.3g} ± {c.se:.2g}")
    missed = [c for c in above if not any(t in there or f"{t[0]}({t[1]}" in said for t in causes[c])]
    residual = found.held_out_rms > ABOVE * found.judged.noise_floor
    told = any(w.code in ("left_over", "uneven", "confounded", "undecided") for w in found.warnings)
    return Judged(kind, seed, tuple(z), tuple(false), tuple(missed), tuple(left_open), not residual or told)


def kept(path: Path | None) -> dict[tuple[str, int], Judged]:
    """Machines that a file has; a line that was cut off is none."""
    out = {}
    for line in path.read_text("utf-8").splitlines() if path and path.exists() else ():
        with suppress(json.JSONDecodeError):
            j = json.loads(line)
            j["z"] = tuple((name, far) for name, far in j["z"])
            lists: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in j.items()}
            out[j["kind"], j["seed"]] = Judged(**lists)
    return out


def summary(judged: Sequence[Judged]) -> list[str]:
    """Figures of machines of one kind, one a line."""
    z = np.array([far for j in judged for _, far in j.z])
    return [
        f"{judged[0].kind}: {len(judged)} machines, {len(z)} asserted numbers of true causes",
        f"  within 3 standard errors: {100.0 * np.mean(np.abs(z) < 3.0):.1f} %, rms {np.sqrt(np.mean(z**2)):.2f}",
        f"  machines with a false cause: {sum(bool(j.false) for j in judged)}",
        f"  machines with a missed cause: {sum(bool(j.missed) for j in judged)}",
        f"  machines with an effect left open: {sum(bool(j.open) for j in judged)}",
        f"  verdict wrong: {sum(not j.verdict for j in judged)}",
    ]


def main(argv: Sequence[str] | None = None) -> None:
    """Judge many, print, and keep where asked."""
    parser = argparse.ArgumentParser(prog="python -m tests.characterise.free_proof")
    parser.add_argument("--machines", type=int, default=100, help="of each kind")
    parser.add_argument("--first", type=int, default=FIRST, help="first seed")
    parser.add_argument("--only", choices=KINDS, action="append", help="this kind; may be given again")
    parser.add_argument("--to", type=Path, help="keep each machine as a line of this file, and go on from it")
    wish = parser.parse_args(argv)
    todo = [(k, s) for s in range(wish.first, wish.first + wish.machines) for k in wish.only or KINDS]
    done = kept(wish.to)
    with suppress(KeyboardInterrupt), wish.to.open("a", encoding="utf-8") if wish.to else nullcontext() as to:
        for kind, seed in todo:
            if (kind, seed) in done:
                continue
            done[kind, seed] = judge(kind, seed)
            if to:
                to.write("\n" + json.dumps(asdict(done[kind, seed])))
                to.flush()
    for kind in wish.only or KINDS:
        mine = [done[t] for t in todo if t in done and t[0] == kind]
        if mine:
            sys.stdout.write("\n".join(summary(mine)) + "\n")


if __name__ == "__main__":
    main()
