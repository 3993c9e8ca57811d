"""Detects readings that no longer change."""


class StuckWatch:
    """Detects a reading that is constant, to the last digit, for too long.

    Args:
        after_s: longest time without a change; None: no limit.
    """

    def __init__(self, after_s: float | None) -> None:
        self._after_s = after_s
        self._since: dict[str, tuple[float, int]] = {}

    def look(self, name: str, value: float, now_ns: int) -> str:
        """Record a reading; give its fault, or ""."""
        if self._after_s is None:
            return ""
        known, since_ns = self._since.get(name, (None, now_ns))
        if known != value:
            self._since[name] = (value, now_ns)
            return ""
        still_s = (now_ns - since_ns) * 1e-9
        return f"{name}: has read {value:g} for {still_s:.0f} s: stuck" if still_s > self._after_s else ""
