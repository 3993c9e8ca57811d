"""`make discovery`: effects hidden in simulated measurements, and how many of them the diagnosis finds.

python -m tests.discovery [--quick] [--seeds 1000:1150] [--only GROUP] [--method NAME] [--jobs 2] [--json FILE]
"""

import argparse
import json
import os
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from timeit import default_timer

from rtec.cli.common import bar
from rtec.cli.screen import Console
from tests.discovery import tables
from tests.discovery.figures import cut, figures, seconds
from tests.discovery.generator.cases import GROUPS, cases
from tests.discovery.score import Outcome
from tests.discovery.work import METHODS, run

SEEDS, QUICK = "1000:1150", "1000:1020"
"""A hundred and fifty sets of each noise with nothing hidden: a quarter of an hour on two cores."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run, print, and write where asked."""
    wish = _arguments().parse_args(argv)
    first, last = (int(part) for part in (wish.seeds or (QUICK if wish.quick else SEEDS)).split(":"))
    groups = wish.only or list(GROUPS)
    todo = list(cases(range(first, last), groups))
    start = default_timer()
    with bar(f"{len(todo)} sets") as tell:
        outcomes = run(todo, wish.method, wish.jobs, tell)
    minutes = (default_timer() - start) / 60.0
    if wish.json:
        wish.json.write_text(json.dumps(facts(outcomes, wish.method, (first, last)), indent=1), encoding="utf-8")
    console = Console(width=140)
    stopped = f"stopped after {len(outcomes)} of {len(todo)} sets, " if len(outcomes) < len(todo) else ""
    tables.show(console, outcomes, title=f"{wish.method}: {stopped}seeds {first} to {last - 1}, {minutes:.1f} min")
    return 130 if stopped else 0


def facts(outcomes: Sequence[Outcome], method: str, seeds: tuple[int, int]) -> dict[str, object]:
    """All figures and all outcomes as plain data."""
    own, oracle = cut(outcomes)
    return {
        "method": method,
        "seeds": list(seeds),
        "figures": [
            {"name": f.name, "hits": f.share.hits, "total": f.share.total, "interval": f.share.interval(), "met": f.met}
            for f in figures(outcomes)
        ],
        "held_out_cut": own,
        "held_out_cut_of_the_truth": oracle,
        "seconds_median_and_95": seconds(outcomes),
        "sets": [asdict(o) for o in outcomes],
    }


def _arguments() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tests.discovery", description="Benchmark of hidden effects.")
    parser.add_argument("--quick", action="store_true", help=f"seeds {QUICK} only")
    parser.add_argument("--seeds", help=f"FIRST:END, end not included; {SEEDS} if not given")
    parser.add_argument("--only", action="append", choices=GROUPS, help="this group; may be given again")
    parser.add_argument("--method", choices=sorted(METHODS), default="evidence", help="which method is put to it")
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1), help="processes")
    parser.add_argument("--json", type=Path, help="write all figures and outcomes to this file")
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
