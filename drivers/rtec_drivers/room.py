"""Recognises bare numbers that may be room temperatures, before their scale is known."""

import struct
from typing import Final

LOW_DEGC: Final = 10.0
HIGH_DEGC: Final = 45.0
SCALES: Final = (1.0, 0.1, 0.01)


def in_room(number: float, degc: bool = False) -> bool:
    """Is it a room's temperature in °C or, unless `degc`, in tenths or hundredths of it?"""
    return any(LOW_DEGC <= number * scale <= HIGH_DEGC for scale in (SCALES[:1] if degc else SCALES))


def room_high_word(word: int) -> bool:
    """Is it the high word of a float of 32 bits that is a room's temperature?

    As an integer it would be above 160 °C in hundredths, so no plain temperature is mistaken for one.
    """
    (value,) = struct.unpack(">f", struct.pack(">HH", word, 0))
    return in_room(value, degc=True)
