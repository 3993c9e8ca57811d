"""What the faults did, and what must be so whatever they did."""

import math
from collections.abc import Sequence

import numpy as np

from rtec.hil import WITHIN, Check, FaultFound, FaultOrder, OffAndOn
from rtec.playback.replay import replay_log
from rtec_drivers.hil.bus_run import BusRun
from rtec_drivers.hil.catalogue import FAULTS
from rtec_drivers.hil.logbook import Logbook, held_spans
from rtec_drivers.hil.track import TipTrack, errors_um, inside
from rtec_drivers.hil.watch import FaultWatch

AT_END_S = 0.05
"""Held so near to the end is held for good, as far as this run can tell."""
HICCUP_S = 0.1
LEAST_QUIET_S = 5.0
"""Less time without faults says nothing about accuracy."""
ROUNDING = 1e-6
CALM_S = 1.0
"""After a recovery the correction is on its way for a moment."""
BOX_BACK_S = 6.0
"""So long after its fault the box may still be on its way back: the longest back-off and a handshake."""
ROWS_BACK, ROWS_ON = 20, 2
"""A command reaches the machine within so many cycles; the clocks of both sides are one."""
CALM_ROWS = 200
"""So many cycles behind a hold commands go through again."""
LINGERS_S = 20.0
"""So long after a fault's end the correction may still be held for it: back-off, late answers, a full reopening."""
SHORT_S = 0.5
"""A hold shorter than this is a hiccup of this PC: the counts were stale for some cycles, and the guard saw it."""
Spans = Sequence[tuple[float, float]]


def faults_found(
    faults: Sequence[FaultOrder],
    logbook: Logbook,
    track: TipTrack,
    watch: FaultWatch,
    on_s: float,
    names: Sequence[str],
) -> list[FaultFound]:
    """What each of them did until the next one behind its end; those that overlap share what was held."""
    seconds, error = logbook.seconds(watch.start_ns), np.abs(errors_um(track, names))
    period_s, spans = on_s / max(1, len(seconds)), held_spans(logbook, watch.start_ns)
    out = []
    for k, order in enumerate(faults):
        until_s = min([f.at_s for f in faults if f.at_s > order.end_s] + [on_s])
        mine = inside(seconds, [(order.at_s, until_s)])
        recovered_s = _recovered_s(spans, order, until_s, on_s)
        meanwhile = inside(track.time_s, [(order.at_s, order.end_s + (recovered_s if recovered_s > 0.0 else 0.0))])
        during = inside(seconds, [(order.at_s, order.end_s)])
        told = watch.told[k]
        out.append(
            FaultFound(
                order=order,
                what=FAULTS[order.name].what,
                told=dict(told.texts),
                noticed_s=told.noticed_s,
                held_s=float(np.count_nonzero(mine & logbook.held)) * period_s,
                recovered_s=recovered_s,
                largest_um=float(error[meanwhile].max()) if meanwhile.any() else math.nan,
                oldest_s={n: float(age[during].max()) for n, age in logbook.age_s.items()} if during.any() else {},
            )
        )
    return out


def _recovered_s(spans: Spans, order: FaultOrder, until_s: float, on_s: float) -> float:
    """From the fault's end until the last instant held; 0 where none is behind its end, NaN where it never ends.

    A hold for some cycles that begins behind the fault's end is a hiccup of this PC. A hold that lasts into the next
    fault, at `until_s`, is followed to its end: whose it was by then nobody can tell, and only the run's end is never.
    """
    behind = [
        high
        for low, high in spans
        if high > order.end_s and low < until_s and (low <= order.end_s or min(high, until_s) - low > HICCUP_S)
    ]
    if not behind:
        return 0.0
    return math.nan if max(behind) > on_s - AT_END_S else max(behind) - order.end_s


def quiet_spans(found: Sequence[FaultFound], settle_s: float, on_s: float) -> list[tuple[float, float]]:
    """The time in which nothing was wrong: after settling, without faults and what followed them."""
    out, low = [], settle_s
    for fault in sorted(found, key=lambda f: f.order.at_s):
        if fault.order.at_s > low:
            out.append((low, fault.order.at_s))
        recovered_s = on_s if math.isnan(fault.recovered_s) else fault.recovered_s
        low = max(low, fault.order.end_s + recovered_s + CALM_S)
    return [*out, (low, on_s)] if low < on_s else out


def unheld_spans(quiet: Spans, held: Spans) -> list[tuple[float, float]]:
    """The parts of quiet time in which the correction followed the model: without holds, and without a moment behind.

    A hold without a fault is the PC's, which kept a far side or a worker waiting; how often says a check of its own.
    """
    out = list(quiet)
    for begin, end in held:
        pieces = [(low, min(high, begin)) for low, high in out] + [(max(low, end + CALM_S), high) for low, high in out]
        out = sorted((low, high) for low, high in set(pieces) if low < high)
    return out


def held_check(which: str, run: BusRun, faults: Sequence[FaultOrder], judged: bool) -> Check:
    """Was the correction held for faults only?"""
    spans = [s for s in held_spans(run.logbook, run.start_ns) if s[1] - s[0] > SHORT_S]
    alone = [s for s in spans if not any(f.at_s - SHORT_S <= s[0] <= f.end_s + LINGERS_S for f in faults)]
    text = f"held {len(spans)} times, {len(alone)} of them without a fault"
    return Check(f"{which}: held only for faults", not alone, text, judged)


def checks_of(which: str, run: BusRun, found: Sequence[FaultFound], judged: bool = True) -> list[Check]:
    """What must be so of one run.

    Args:
        which: of the runs, in a word.
        run: as it was found afterwards.
        found: what the faults did.
        judged: this PC is the bench's alone, so what depends on its clock counts, too.
    """
    summary, logbook = run.report.summary, run.logbook
    own, logged = list(summary["output"].values()), list(logbook.output.values())
    machine = list(run.found["machine"]["inserted"])
    replayed = replay_log(run.setup, run.log, check=True)
    lost = [f.order.name for f in found if math.isnan(f.recovered_s)]
    astray, looked = given_astray(run)
    checks = [
        Check(
            f"{which}: ledger exact",
            own == machine == logged,
            f"at the end the loop had commanded {own}, its log says {logged}, the machine was given {machine}",
        ),
        Check(
            f"{which}: the machine was given what was commanded",
            astray == 0,
            f"in {astray} of {looked} instants in which the box could be reached it was not",
            judged,
        ),
        Check(
            f"{which}: no jump",
            logbook.fastest <= 1.0 + ROUNDING,
            f"fastest change of the correction {100.0 * logbook.fastest:.0f} % of its slew limit",
        ),
        Check(
            f"{which}: log complete and replayed bit by bit",
            run.report.overruns == 0 and replayed.different == 0 and replayed.rows == summary["cycles"],
            f"{replayed.rows} of {summary['cycles']} cycles in the log, {replayed.different} replayed otherwise",
        ),
    ]
    if found:
        text = f"not after {', '.join(lost)}" if lost else f"after all {len(found)} faults"
        checks.append(Check(f"{which}: correction follows again", not lost, text, judged))
    return checks


def given_astray(run: BusRun) -> tuple[int, int]:
    """Instants at which the machine had counts that none of the last commands was, and how many were looked at.

    While the box has a fault, or cannot be reached and the correction is held, and for a while afterwards, it keeps
    what it has: those instants are left out.
    """
    track, logbook = run.track, run.logbook
    faults = [(f.at_s, f.end_s + BOX_BACK_S) for f in run.watch.faults if FAULTS[f.name].bus == "box"]
    seconds = logbook.seconds(run.start_ns)
    row = np.searchsorted(seconds, track.time_s)
    looked = (row >= CALM_ROWS) & (row < len(seconds) - ROWS_ON) & ~inside(track.time_s, faults)
    held = np.concatenate([[0], np.cumsum(logbook.held)])
    looked[looked] = held[row[looked] + ROWS_ON] == held[row[looked] - CALM_ROWS]
    row, inserted = row[looked], track.inserted[looked]
    good = np.zeros(len(row), np.bool_)
    for back in range(-ROWS_ON, ROWS_BACK):
        good |= (logbook.commanded[row - back] == inserted).all(axis=1)
    return int(np.count_nonzero(~good)), len(row)


def improvement_check(buses: OffAndOn, simulated: OffAndOn, quiet: Spans, judged: bool = True) -> Check:
    """Is the correction as good behind real buses as without any?"""
    name = f"improvement within {100.0 * WITHIN:.0f} % of the all-simulated run"
    quiet_s = sum(high - low for low, high in quiet)
    if quiet_s < LEAST_QUIET_S:
        return Check(name, True, f"not judged: only {quiet_s:.1f} s of the run were without faults")
    ratio = buses.factor / simulated.factor
    return Check(
        name,
        abs(ratio - 1.0) <= WITHIN,
        f"factor {buses.factor:.2f} behind real buses, {simulated.factor:.2f} all simulated: ratio {ratio:.3f}",
        judged,
    )
