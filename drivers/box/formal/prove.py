#!/usr/bin/env python3
"""Proves the gateware's properties (formal/*.vh), and that the proofs notice broken gateware.

Needs yosys with yosys-smtbmc, and z3 (Debian: apt-get install yosys z3). `prove.py` proves all; `prove.py NAME` one
module or mutant. Bounded proof of the first clocks, then induction: together for all time.
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

BOX = Path(__file__).parents[1]
PROOFS = {
    "inserter": {"SEPARATION": 3, "WIDTH": 5, "RATE_BITS": 2},
    "watchdog": {"CLK_HZ": 2_000_000, "US_PER_MS": 3},
}
BOUNDED, INDUCTION = 12, 8
MUTANTS = {
    "a count is inserted beside an edge ahead": ("inserter", "since_in >= CLEAR - 2 && !edge_in", "1'b1"),
    "a count is inserted beside an edge behind": ("inserter", "since_raw >= CLEAR - 1 &&", "1'b1 &&"),
    "the ledger forgets a count": (
        "inserter",
        "inserted <= inserted_next;",
        "inserted <= up ? inserted_next : inserted;",
    ),
    "an edge of the encoder is lost": (
        "inserter",
        "raw <= raw + (raw_up ? 1 :",
        "raw <= raw + (raw_up && !insert ? 1 :",
    ),
    "what was inserted meanwhile is not taken off": ("inserter", "near_off - step - step_before", "near_off - step"),
    "silence does not hold": ("inserter", "!hold && over[last]", "over[last]"),
    "a cycle is of three counts": ("inserter", "more ? 4'sd4", "more ? 4'sd3"),
    "a count against an edge that goes its way": ("inserter", "(alone || raw_down)", "(alone || raw_up)"),
    "the watchdog is late": ("watchdog", "silent_ms > hold_after_ms", "silent_ms > hold_after_ms + 2"),
    "the watchdog forgets": ("watchdog", "held <= 1;", "held <= tick_ms;"),
}


def solve(smt2: Path, steps: int, *more: str) -> bool:
    """Does yosys-smtbmc prove every assertion?"""
    command = ["yosys-smtbmc", "-s", "z3", "--unroll", "--noprogress", "-t", str(steps), *more, str(smt2)]
    output = subprocess.run(command, capture_output=True, text=True, check=False).stdout  # noqa: S603 (our own words)
    if "Status: PASSED" not in output and "Status: FAILED" not in output:
        sys.exit(f"yosys-smtbmc says neither: {output[-500:]}")
    return "Status: PASSED" in output


def holds(module: str, old: str = "", new: str = "", *, induction: bool = True) -> bool:
    """Prove one module, with a piece of it replaced if one is given."""
    text = (BOX / "gateware" / f"{module}.v").read_text(encoding="utf-8")
    if old and text.count(old) != 1:
        sys.exit(f"{module}.v: {old!r} is {text.count(old)} times in it; correct the mutant")
    with tempfile.TemporaryDirectory() as folder:
        source, smt2 = Path(folder) / f"{module}.v", Path(folder) / f"{module}.smt2"
        source.write_text(text.replace(old, new) if old else text, encoding="utf-8")
        sizes = " ".join(f"-set {name} {value}" for name, value in PROOFS[module].items())
        script = f"read_verilog -formal -DFORMAL {source}; chparam {sizes} {module}; prep -top {module} -flatten; "
        script += f"memory_map; opt_clean; write_smt2 -wires {smt2}"
        command = [shutil.which("yosys") or "yosys", "-q", "-p", script]
        subprocess.run(command, cwd=BOX, check=True, capture_output=True)  # noqa: S603 (our own words)
        return solve(smt2, BOUNDED) and (not induction or solve(smt2, INDUCTION, "-i"))


def main(names: list[str]) -> int:
    """Prove the named ones, or all; give the exit status."""
    bad = 0
    for name in names or [*PROOFS, *MUTANTS]:
        if name in PROOFS:
            good = holds(name)
            sys.stdout.write(f"{name}: {'proven' if good else 'NOT PROVEN'}\n")
        else:
            good = not holds(*MUTANTS[name])
            sys.stdout.write(f"mutant, {name}: {'found' if good else 'NOT FOUND'}\n")
        sys.stdout.flush()
        bad += not good
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
