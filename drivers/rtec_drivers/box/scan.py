"""Scans for an RTEC encoder box at a serial port: its number of inputs, and their counts. Commands nothing."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any, Final, Self

from rtec.errors import DriverTimeout
from rtec.loop.clock import Clock
from rtec_drivers.box.protocol import Info
from rtec_drivers.box.session import HELLO_PERIOD_S, BoxSession
from rtec_drivers.serial_line import PortFinder, PortOptions, SerialLine

OPEN_S: Final = 3.0
"""Longest wait, s: some boxes restart when their port is opened."""
ANSWER_S: Final = 0.1
PLACE: Final = "input {}"


class BoxScanner:
    """Asks a box for its description and its counts.

    Args:
        options: the port.
        clock: clock of the deadlines.

    Attributes:
        duration: duration of the search, in words.
        info: the box's description; None before its answer.
    """

    def __init__(self, options: PortOptions, clock: Clock) -> None:
        self.duration = f"up to {OPEN_S:g} s"
        self.info: Info | None = None
        self._options, self._clock = options, clock
        self._session: BoxSession | None = None
        self._counts: tuple[int, ...] = ()

    def __enter__(self) -> Self:
        """Open the port.

        Raises:
            DriverUnavailable: it cannot be opened.
        """
        self._session = BoxSession(SerialLine(self._options, PortFinder(self._options).find()), self._clock)
        return self

    def __exit__(self, *error: object) -> None:
        """Close the port."""
        if self._session is not None:
            self._session.line.close()
            self._session = None

    def search(self) -> Iterator[tuple[float, str]]:
        """Greet until the box answers."""
        tries = round(OPEN_S / HELLO_PERIOD_S)
        for k in range(tries):
            yield k / tries, ""
            with suppress(DriverTimeout):
                self.info = info = self._session.greet(HELLO_PERIOD_S) if self._session is not None else None
                if info is not None:
                    yield (
                        1.0,
                        (
                            f"RTEC encoder box number {info.box_serial}: {info.axes} inputs, counters of "
                            f"{info.counter_bits} bits, inserts up to {info.counts_per_s} counts/s"
                        ),
                    )
                    return
        yield 1.0, "no RTEC encoder box answers here"

    def read(self) -> dict[str, float]:
        """Counts by input."""
        if self._session is not None and self.info is not None:
            with suppress(DriverTimeout):
                self._counts = self._session.exchange(ANSWER_S).state.counts
        return {PLACE.format(k + 1): float(count) for k, count in enumerate(self._counts)}

    def proposed(self, names: Sequence[str]) -> dict[str, str]:
        """In order, if the box has as many inputs as the machine has axes."""
        if self.info is None or self.info.axes != len(names):
            return {}
        return {name: PLACE.format(k + 1) for k, name in enumerate(names)}

    def table(self, places: Mapping[str, str], unit: float) -> dict[str, Any]:
        """`axes`, in the order of the inputs, and the number of the box."""
        del unit
        number = {} if self.info is None else {"box_serial": self.info.box_serial}
        return {"axes": sorted(places, key=lambda name: int(places[name].split()[1])), **number}
