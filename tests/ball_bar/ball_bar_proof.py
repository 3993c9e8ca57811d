"""How well ball bars are diagnosed, on many machines drawn at random.

python -m tests.ball_bar.ball_bar_proof [--machines 500] [--first 1000] [--only KIND] [--jobs 1] [--to FILE]

`--to` keeps every machine as one line of JSON as soon as it is judged: after Ctrl-C the same command goes on there.
"""

import argparse
import json
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext, suppress
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from rtec.cli.common import bar
from rtec.cli.screen import Console
from rtec.parallel import one_blas_thread
from tests.support.ball_bar_machines import KINDS, Judged, judge

FIRST = 1000
"""Seeds from here on; those of the tests are below."""
SHARE_OF = {"mixed": 1.0, "bb": 1.0, "wander": 0.5, "all": 0.4, "sine": 0.4, "whole": 0.6}


def one(todo: tuple[str, int]) -> Judged:
    """Judge one machine."""
    with one_blas_thread():
        return judge(*todo)


def run(todo: Sequence[tuple[str, int]], jobs: int) -> Iterator[Judged]:
    """Judge many, in their order."""
    if jobs <= 1:
        yield from map(one, todo)
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        yield from pool.map(one, todo, chunksize=4)


def summary(judged: Sequence[Judged]) -> dict[str, float]:
    """Figures of machines of one kind."""
    count = sum(j.count for j in judged)
    by_all, by_bb = (np.array([getattr(j, n) for j in judged]) for n in ("explained", "explained_bb"))
    return {
        "machines": len(judged),
        "parameters": count,
        "within_three_se": sum(j.within for j in judged) / count,
        "in_95_interval": sum(j.inside for j in judged) / count,
        "explained_median": float(np.median(by_all)),
        "explained_least": float(by_all.min()),
        "explained_above_90": float((by_all >= 0.9).mean()),
        "bb_alone_median": float(np.median(by_bb)),
        "bb_alone_mean": float(by_bb.mean()),
        "falsely_named": sum(bool(j.false_names) for j in judged) / len(judged),
        "missed_each": sum(len(j.missed) for j in judged) / len(judged),
        "missed_above_limit": sum(len(j.missed_above) for j in judged) / len(judged),
        "rms_z": float(np.sqrt(np.mean([x * x for j in judged for x in j.z] or [np.nan]))),
        "headline_right": sum(j.headline for j in judged) / len(judged),
    }


def kept(path: Path | None) -> dict[tuple[str, int], Judged]:
    """Machines that a file has; a line that was cut off is none."""
    out = {}
    for line in path.read_text("utf-8").splitlines() if path and path.exists() else ():
        with suppress(json.JSONDecodeError):
            j = Judged(**{name: _as_tuple(value) for name, value in json.loads(line).items()})
            out[j.kind, j.seed] = j
    return out


def _as_tuple(value: Any) -> Any:
    return tuple(_as_tuple(v) for v in value) if isinstance(value, list) else value


def main(argv: Sequence[str] | None = None) -> int:
    """Run, print, and keep where asked."""
    wish = _arguments().parse_args(argv)
    kinds = wish.only or list(SHARE_OF)
    todo = [(k, wish.first + i) for k in kinds for i in range(round(wish.machines * SHARE_OF[k]))]
    done = kept(wish.to)
    file = wish.to.open("a", encoding="utf-8") if wish.to else nullcontext()
    with suppress(KeyboardInterrupt), bar(f"{len(todo)} machines") as tell, file as to:
        for j in run([t for t in todo if t not in done], wish.jobs):
            done[j.kind, j.seed] = j
            if to:
                # A line begins with its end of line: after one that was cut off, too.
                to.write("\n" + json.dumps(asdict(j)))
                to.flush()
            tell(sum(t in done for t in todo), len(todo))
    judged = [done[t] for t in todo if t in done]
    kinds = [k for k in kinds if any(j.kind == k for j in judged)]
    if not kinds:
        return 1
    found = {k: summary([j for j in judged if j.kind == k]) for k in kinds}
    table = Table("figure", *kinds)
    for name in next(iter(found.values())):
        table.add_row(name, *(f"{found[k][name]:.4g}" for k in kinds))
    Console(width=120).print(table)
    return 0


def _arguments() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m tests.ball_bar.ball_bar_proof", description="Proof of the ball bar."
    )
    parser.add_argument("--machines", type=int, default=500, help="of the kinds bb and mixed; of the others fewer")
    parser.add_argument("--first", type=int, default=FIRST, help="first seed")
    parser.add_argument("--only", action="append", choices=KINDS, help="this kind; may be given again")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--to", type=Path, help="keep each machine as a line of this file, and go on from it")
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
