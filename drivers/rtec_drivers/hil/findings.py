"""Effects of the faults, and the requirements that hold whatever the faults."""

import math
from collections.abc import Sequence

import numpy as np

from rtec.hil import LEAST_COMPARED_S, WITHIN, Check, FaultFound, FaultOrder, OffAndOn
from rtec.playback.replay import replay_log
from rtec_drivers.hil.bus_run import BusRun, Logbook, held_spans
from rtec_drivers.hil.faults import FAULTS, FaultWatch
from rtec_drivers.hil.plant import TipTrack, errors_um, inside

AT_END_S = 0.05
"""A hold that ends this near to the run's end, s, counts as a hold for good."""
HICCUP_S = 0.1
RECOVER_S = 8.0
"""The run goes on for this time, s, after the last fault."""
ROUNDING = 1e-6
CALM_S = 1.0
"""After a recovery the correction is still on its way for this time, s."""
BOX_BACK_S = 6.0
"""Time, s, after its fault within which the box may still be recovering: the longest back-off and a handshake."""
ROWS_BACK, ROWS_ON = 20, 2
"""Cycles within which a command reaches the machine; both sides have the same clock."""
CALM_ROWS = 200
"""Cycles after a hold until commands pass through again."""
LINGERS_S = 20.0
"""Time, s, after a fault's end for which it may still cause a hold: back-off, late answers, a full reopening."""
SHORT_S = 0.5
"""A shorter hold, s, is a hiccup of this PC: the counts were stale for some cycles, and the guard held."""
Spans = Sequence[tuple[float, float]]


def faults_found(
    faults: Sequence[FaultOrder],
    logbook: Logbook,
    track: TipTrack,
    watch: FaultWatch,
    on_s: float,
    names: Sequence[str],
) -> list[FaultFound]:
    """Effect of each fault until the next one after its end; overlapping faults share their holds.

    Faults that a run did not reach, because it was stopped, are not among them.
    """
    seconds, error = logbook.seconds(watch.start_ns), np.linalg.norm(errors_um(track, names), axis=1)
    period_s, spans = on_s / max(1, len(seconds)), held_spans(logbook, watch.start_ns)
    out = []
    for k, order in enumerate(faults):
        if order.at_s >= on_s:
            continue
        until_s = min([f.at_s for f in faults if f.at_s > order.end_s] + [on_s])
        mine = inside(seconds, [(order.at_s, until_s)])
        recovered_s = _recovered_s(spans, order, until_s, on_s)
        meanwhile = inside(track.time_s, [(order.at_s, order.end_s + (recovered_s if recovered_s > 0.0 else 0.0))])
        during = inside(seconds, [(order.at_s, order.end_s)])
        reports = watch.reports[k]
        out.append(
            FaultFound(
                order=order,
                what=FAULTS[order.name].what,
                told=dict(reports.texts),
                noticed_s=reports.noticed_s,
                held_s=float(np.count_nonzero(mine & logbook.held)) * period_s,
                recovered_s=recovered_s,
                largest_um=float(error[meanwhile].max()) if meanwhile.any() else math.nan,
                oldest_s={n: float(age[during].max()) for n, age in logbook.age_s.items()} if during.any() else {},
            )
        )
    return out


def _recovered_s(spans: Spans, order: FaultOrder, until_s: float, on_s: float) -> float:
    """From the fault's end until the end of the last hold; 0 without a hold after its end, NaN where it never ends.

    A hold for some cycles that begins after the fault's end is a hiccup of this PC. A hold that lasts into the next
    fault, at `until_s`, is followed to its end: its cause is then unknown. Only a hold until
    the run's end counts as never.
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
    """Time without faults: after settling, without faults and their effects."""
    out, low = [], settle_s
    for fault in sorted(found, key=lambda f: f.order.at_s):
        if fault.order.at_s > low:
            out.append((low, fault.order.at_s))
        recovered_s = on_s if math.isnan(fault.recovered_s) else fault.recovered_s
        low = max(low, fault.order.end_s + recovered_s + CALM_S)
    return [*out, (low, on_s)] if low < on_s else out


def unheld_spans(quiet: Spans, held: Spans) -> list[tuple[float, float]]:
    """Parts of the quiet time in which the correction followed the model: without holds and a moment after each.

    A hold without a fault has its cause in the PC, which delayed a far side or a worker; another check counts these.
    """
    out = list(quiet)
    for begin, end in held:
        pieces = [(low, min(high, begin)) for low, high in out] + [(max(low, end + CALM_S), high) for low, high in out]
        out = sorted((low, high) for low, high in set(pieces) if low < high)
    return out


def held_check(which: str, run: BusRun, faults: Sequence[FaultOrder], judged: bool) -> Check:
    """Was every hold caused by a fault?"""
    spans = [s for s in held_spans(run.logbook, run.start_ns) if s[1] - s[0] > SHORT_S]
    alone = [s for s in spans if not any(f.at_s - SHORT_S <= s[0] <= f.end_s + LINGERS_S for f in faults)]
    text = f"held {len(spans)} times, {len(alone)} of them without a fault"
    return Check(f"{which}: held only for faults", not alone, text, judged)


def checks_of(which: str, run: BusRun, found: Sequence[FaultFound], judged: bool = True) -> list[Check]:
    """Requirements of one run.

    Args:
        which: name of the run, in a word.
        run: result of the run.
        found: effects of the faults.
        judged: this PC runs nothing else, so requirements on its clock count, too.
    """
    summary, logbook = run.report.summary, run.logbook
    own, logged = list(summary["output"].values()), list(logbook.output.values())
    machine = list(run.far_counts["machine"]["inserted"])
    replayed = replay_log(run.setup, run.log, check=True)
    seen = [f for f in found if not run.report.interrupted or f.order.end_s + RECOVER_S <= run.duration_s]
    lost = [f.order.name for f in seen if math.isnan(f.recovered_s)]
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
    if seen:
        text = f"not after {', '.join(lost)}" if lost else f"after all {len(seen)} faults"
        checks.append(Check(f"{which}: correction follows again", not lost, text, judged))
    return checks


def given_astray(run: BusRun) -> tuple[int, int]:
    """Instants at which the machine had counts of none of the last commands, and the number of checked instants.

    While the box has a fault, or cannot be reached and the correction is held, and for a while afterwards, it keeps its
    ledger: those instants are not checked.
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


def compared_spans(quiet: Spans, off_s: float) -> list[tuple[float, float]]:
    """Parts of the corrected run's quiet time that the uncorrected run, of `off_s`, has, too.

    Both runs begin the same program at the same temperatures. Only at the same time since the start are they at the
    same place of it, and the machine as warm.
    """
    return [(low, min(high, off_s)) for low, high in quiet if low < off_s]


def improvement_check(buses: OffAndOn, simulated: OffAndOn, spans: Spans, judged: bool = True) -> Check:
    """Is the correction as good behind real buses as without any, over the compared times?"""
    name = f"improvement within {100.0 * WITHIN:.0f} % of the all-simulated run"
    compared_s = sum(high - low for low, high in spans)
    if compared_s < LEAST_COMPARED_S:
        return Check(
            name,
            passed=False,
            found=f"only {compared_s:.1f} s are in both runs, settled and without faults; {LEAST_COMPARED_S:g} s are "
            "needed: give longer --off and --on, or place the faults otherwise",
            judged=False,
            why_not="too little can be compared",
        )
    ratio = buses.factor / simulated.factor
    return Check(
        name,
        abs(ratio - 1.0) <= WITHIN,
        f"factor {buses.factor:.2f} behind real buses, {simulated.factor:.2f} all simulated: ratio {ratio:.3f}",
        judged,
    )
