"""Shares with their 95 % intervals (Clopper and Pearson: exact, never too narrow)."""

from dataclasses import dataclass

LEVEL = 0.95


@dataclass(frozen=True)
class Share:
    """`hits` of `total`."""

    hits: int
    total: int

    @property
    def value(self) -> float:
        """As a number between 0 and 1; NaN of nothing."""
        return self.hits / self.total if self.total else float("nan")

    def interval(self) -> tuple[float, float]:
        """Lowest and highest true share that go with this."""
        from scipy.special import betaincinv

        if not self.total:
            return 0.0, 1.0
        tail, k, n = 0.5 * (1.0 - LEVEL), self.hits, self.total
        low = float(betaincinv(k, n - k + 1, tail)) if k else 0.0
        high = float(betaincinv(k + 1, n - k, 1.0 - tail)) if k < n else 1.0
        return low, high

    def __str__(self) -> str:
        if not self.total:
            return "-"
        low, high = self.interval()
        return f"{100 * self.value:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"


def share(flags: "list[bool]") -> Share:
    """How many are true."""
    return Share(sum(flags), len(flags))
