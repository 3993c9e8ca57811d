"""How many simulated machines judge a rate: enough in the suite that a fault shows, all of them in `make proof`."""

import os

WHOLE = "RTEC_WHOLE_PROOF" in os.environ


def of(whole: int, some: int) -> int:
    """The whole number in `make proof`, else some of them; the bound on the rate is the same."""
    return whole if WHOLE else some
