"""The score of the benchmark of hidden effects."""

from collections.abc import Sequence

from rtec.bench.score import ScoreRow
from rtec.report.page import Page, Section, Table
from rtec.wording import percent


def bench_page(rows: Sequence[ScoreRow], sets: int) -> Page:
    """Every row with its goal.

    Args:
        rows: rows of the score.
        sets: number of data sets.
    """
    met = sum(r.met for r in rows)
    lines = [
        (r.what, f"{r.hits} of {r.total}", f"{'at most' if r.at_most else 'at least'} {percent(r.goal)}",
         "met" if r.met else "missed")
        for r in rows
    ]  # fmt: skip
    table = Table(("what", "sets", "goal", ""), lines, words=(0, 3))
    lead = f"{met} of {len(rows)} goals are met, over {sets} data sets."
    return Page("Benchmark of hidden effects", lead, [], [Section("Score", [], table)])
