"""Numbers and counts as people read them: plain decimals, the same digits for the same kind, no -0.00, no 2e+01.

Every text for people takes its numbers from here; files and JSON keep all digits.
"""

import math
from collections.abc import Sequence

NONE = "–"
POSITIONS_NOT_KNOWN = "the positions of the axes are not known"
"""In the reason of the loop, by which others know it."""
TO_RESUME = "`rtec ctl resume`"
"""In every reason of the loop or of a device that waits for this order, by which others know it."""
ERROR_UNITS = {"um": "µm", "urad": "µrad", "noise": "× noise"}
"""Units of errors as people read them; errors of several instruments together are multiples of their noise."""
LEAST_SHARE = 0.0005
"""A share nearer to none or all than this is shown as neither."""


def number(value: float, digits: int = 2, *, sign: bool = False) -> str:
    """A number with `digits` decimals, for a column or for errors in µm and µrad; a dash for none.

    Args:
        value: number to show.
        digits: decimals.
        sign: show a plus?
    """
    if not math.isfinite(value):
        return NONE
    rounded = round(value, digits) + 0.0  # no negative zero
    return f"{rounded:+.{digits}f}" if sign else f"{rounded:.{digits}f}"


def significant(value: float, digits: int = 3, *, sign: bool = False) -> str:
    """A number with `digits` significant digits and no exponent: 20, 0.0124; a dash for none."""
    if not math.isfinite(value):
        return NONE
    if value == 0.0:
        return "0"
    decimals = digits - 1 - math.floor(math.log10(abs(float(f"{value:.{digits - 1}e}"))))
    return number(round(value, decimals), max(decimals, 0), sign=sign)


def with_error(value: float, error: float | None) -> tuple[str, str]:
    """A fitted value and its standard error: the error with two significant digits, the value with the same decimals.

    Where the error is unknown or zero, the value has four significant digits and the error is a dash.
    """
    if error is None or not math.isfinite(error) or error <= 0.0:
        return significant(value, 4), NONE
    text = significant(error, 2)
    return number(value, len(text.partition(".")[2])), text


def two_numbers(one: float, two: float) -> tuple[str, str]:
    """Two errors beside each other as in `sizes`, or with as many decimals (at most eight) as show a difference."""
    pairs = ((number(one, digits), number(two, digits)) for digits in range(decimals(one, two), 9))
    return next((pair for pair in pairs if pair[0] != pair[1]), (number(one), number(two)))


def decimals(*values: float) -> int:
    """Decimals with which each of some errors in µm or µrad has two digits: two for machine tools, at most six."""
    least = min((abs(v) for v in values if math.isfinite(v) and abs(v) >= 1e-6), default=1.0)
    return min(max(2, 1 - math.floor(math.log10(float(f"{least:.1e}")))), 6)


def sizes(*values: float) -> tuple[str, ...]:
    """Errors in µm or µrad beside each other, all with the decimals that give each of them two digits."""
    return tuple(number(v, decimals(*values)) for v in values)


def percent(share: float) -> str:
    """A share as a percentage: "97 %", "5.2 %"; never 0 % or 100 % for a share between them."""
    if not math.isfinite(share):
        return NONE
    if 0.0 < share < LEAST_SHARE:
        return "< 0.1 %"
    if 1.0 - LEAST_SHARE < share < 1.0:
        return "> 99.9 %"
    value = 100.0 * share
    whole = abs(value) >= 9.95 and not 99.5 <= value < 100.0
    return f"{number(value, 0 if whole or value == 0.0 else 1)} %"


def probability(p: float) -> str:
    """A probability as a percentage; never 0 % or 100 %."""
    return percent(min(max(p, 1e-9), 1.0 - 1e-9))


def odds(p: float) -> str:
    """The odds of a probability: "13 to 1", "1 to 4"; beyond a thousand "more than 1000 to 1"."""
    for_it = min(max(p, 1e-9), 1.0 - 1e-9)
    ratio = for_it / (1.0 - for_it)
    size = max(ratio, 1.0 / ratio)
    text = "more than 1000" if size > 1000.0 else number(size, 1 if size < 9.95 else 0).removesuffix(".0")
    return f"{text} to 1" if ratio >= 1.0 else f"1 to {text}"


def duration(seconds: float) -> str:
    """A duration: "90 s", "45 min", "2.5 h"."""
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 7200.0 else f"{seconds / 3600.0:.1f} h"


def listed(names: Sequence[object]) -> str:
    """Names in a row: "a", "a and b", "a, b and c"."""
    *first, last = map(str, names)
    return f"{', '.join(first)} and {last}" if first else last


def counted(n: int, what: str, several: str = "") -> str:
    """A number of things: "1 log", "3 logs", "2 entries".

    Args:
        n: number.
        what: singular.
        several: plural, where that is not with an s.
    """
    return f"{n} {what if n == 1 else several or what + 's'}"
