"""Physical ranges of the numbers that files may hold: one type a quantity, with its unit.

A number outside its range is a mistake: another unit, a lost decimal point, a counter that overflowed. The bounds are
far beyond any machine tool, but small enough that a result of two of them fits into a float, or into 64 bits of
nanoseconds or counts. A model with narrower bounds (`Field(ge=1, le=4000)`) has them in its own code.
"""

import math
from typing import Annotated, Any, Final

from pydantic import AfterValidator, BeforeValidator, Field

DAY_S: Final = 86400.0
SMALLEST: Final = 1e-9
"""Least absolute value of a number that may be zero: a smaller one divides like zero without being zero."""


def _zero_or_more(value: float) -> float:
    if value and abs(value) < SMALLEST:
        raise ValueError(f"must be 0, or at least {SMALLEST:g}")
    return value


def _not_zero(value: float) -> float:
    if abs(value) < SMALLEST:
        raise ValueError(f"must not be 0: its size is at least {SMALLEST:g}")
    return value


def _but_nan(codes: Any) -> Any:
    listed = isinstance(codes, list | tuple)
    return tuple(c for c in codes if not (isinstance(c, float) and math.isnan(c))) if listed else codes


ZeroOrMore: Final = AfterValidator(_zero_or_more)

Millimetres = Annotated[float, Field(ge=-1e5, le=1e5)]
MillimetresPositive = Annotated[float, Field(ge=1e-6, le=1e5)]
MillimetresNotNegative = Annotated[float, Field(ge=0, le=1e5), ZeroOrMore]
Vector = tuple[Millimetres, Millimetres, Millimetres]
Micrometres = Annotated[float, Field(ge=-1e6, le=1e6)]
MicrometresPositive = Annotated[float, Field(ge=1e-6, le=1e6)]
MicrometresNotNegative = Annotated[float, Field(ge=0, le=1e6), ZeroOrMore]
Microradians = Annotated[float, Field(ge=-1e6, le=1e6)]
Radians = Annotated[float, Field(ge=-1e4, le=1e4)]
Degrees = Annotated[float, Field(ge=-3600, le=3600)]

DegreesCelsius = Annotated[float, Field(ge=-273.15, le=1e6)]
DegreesDifference = Annotated[float, Field(ge=-5000, le=5000)]
DegreesSpread = Annotated[float, Field(ge=0, le=5000), ZeroOrMore]

SecondsPositive = Annotated[float, Field(ge=1e-6, le=1e7)]
SecondsNotNegative = Annotated[float, Field(ge=0, le=1e7), ZeroOrMore]
HoursPositive = Annotated[float, Field(ge=1e-3, le=1e5)]

MillimetresPerSecond = Annotated[float, Field(ge=1e-6, le=1e5)]
MillimetresPerMinute = Annotated[float, Field(ge=1e-3, le=1e6)]
MillimetresPerSecond2 = Annotated[float, Field(ge=1e-3, le=1e7)]
RevolutionsPerMinute = Annotated[float, Field(ge=-1e6, le=1e6)]
MicrometresPerSecond = Annotated[float, Field(ge=1e-3, le=1e8)]
MicrometresPerSecond2 = Annotated[float, Field(ge=1e-3, le=1e10)]
CountsPerMillimetre = Annotated[float, Field(ge=1e-3, le=1e8)]
CountsPerSecond = Annotated[float, Field(ge=1e-3, le=1e9)]
Counts = Annotated[int, Field(ge=0, le=10**9)]

Share = Annotated[float, Field(ge=0, le=1), ZeroOrMore]
WattsPerKelvin = Annotated[float, Field(ge=0, le=1e6), ZeroOrMore]
Kilograms = Annotated[float, Field(ge=0, le=1e6)]
Newtons = Annotated[float, Field(ge=-1e9, le=1e9)]
LARGEST = 1e12
"""Largest number of a model file, and of a standard error in it."""
Coefficient = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
"""A number whose unit depends on its place: a coefficient of a model, an offset of a column."""
CoefficientNotNegative = Annotated[float, Field(ge=0, le=LARGEST)]
Factor = Annotated[float, Field(ge=-1e12, le=1e12), AfterValidator(_not_zero)]
"""A factor of readings."""
Code = Annotated[float, Field(ge=-(2.0**64), le=2.0**64)]
"""A reading that a device sends in place of a value: it may be any integer of 64 bits."""
BUT_NAN: Final = BeforeValidator(_but_nan)
"""Of a list of codes: NaN is not kept, as it is missing by itself."""
Whole = Annotated[int, Field(ge=-(2**63), le=2**63 - 1)]
Seed = Annotated[int, Field(ge=0, le=2**63 - 1)]
