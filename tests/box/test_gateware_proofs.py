"""The gateware's formal proofs. Oracle: yosys-smtbmc with z3, and mutants that must not be provable.

The whole of it is `make box`; here are both modules and one mutant of each promise that a machine would feel first.
"""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

PROVE = Path(__file__).parents[2] / "drivers" / "box" / "formal" / "prove.py"
LACKS = [tool for tool in ("yosys", "yosys-smtbmc", "z3") if shutil.which(tool) is None]

pytestmark = pytest.mark.skipif(bool(LACKS), reason=f"needs {', '.join(LACKS)} (Debian: apt-get install yosys z3)")


@pytest.mark.parametrize(
    "name",
    [
        "inserter",
        "watchdog",
        "the ledger forgets a count",
        "silence does not hold",
        "a count is inserted beside an edge ahead",
        "the watchdog forgets",
    ],
)
def test_proof(name: str) -> None:
    """A module is proven; a mutant is found."""
    done = subprocess.run([sys.executable, str(PROVE), name], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
