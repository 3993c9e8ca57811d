"""How many simulated machines judge a claim: enough in the suite that a fault shows, all of them in `make proof`."""

import os
from collections.abc import Sequence
from typing import TypeVar

import pytest

T = TypeVar("T")

WHOLE = "RTEC_WHOLE_PROOF" in os.environ


long = pytest.mark.skipif(not WHOLE, reason="takes long; `make proof` runs it")
"""Of what shorter tests of the suite cover in part."""


def of(whole: int, some: int) -> int:
    """The whole number in `make proof`, else some of them; the bound on the rate is the same."""
    return whole if WHOLE else some


def few(cases: Sequence[T], some: int) -> Sequence[T]:
    """All cases in `make proof`, else the first of them."""
    return cases if WHOLE else cases[:some]
