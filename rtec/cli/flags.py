"""How the guard's flags are shown to people."""

from collections.abc import Mapping


def flag_lines(flags_seen: Mapping[str, float]) -> list[str]:
    """One line a flag with its share of the cycles; LIMITED is left out, since every correction begins with it."""
    return [
        f"{name.lower().replace('_', ' ')}: {100.0 * share:.3g} % of cycles"
        for name, share in flags_seen.items()
        if name != "LIMITED"
    ]
