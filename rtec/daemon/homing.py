"""An order to home, from its text to the loop: the axes must stand while it is given.

The order is refused at once where its text, the run file or an axis that is missing is at fault (`Homing.check`). The
supervisor then looks at the axes for a tenth of a second, and hands the order to the loop (`rtec.daemon.reload`).
"""

from collections.abc import Callable
from typing import Final

import numpy as np

from rtec.loop.orders import OrderRefused
from rtec.loop.records import Samples
from rtec.loop.run_file import Setup
from rtec.loop.state import Saved
from rtec.loop.zero import Home, home_of, read_positions

LOOK_NS: Final = 100_000_000
"""The axes must stand for this long, ns."""
STANDS_MM: Final = 0.01
"""Largest motion, mm, of an axis that stands: servos hunt by some counts."""
PATIENCE_NS: Final = 1_000_000_000
"""The look waits this long for a reading, ns. One that failed is no reason to refuse."""


class Homing:
    """One order to home at a time.

    Args:
        setup: the run's setup; machine and `[run] zero` never change while it runs.
        newest: gives the newest state of the loop.

    Attributes:
        busy: is an order unfinished?
    """

    def __init__(self, setup: Setup, newest: Callable[[], Saved | None]) -> None:
        self.busy = False
        self._setup, self._newest = setup, newest
        self._positions_mm: dict[str, float] = {}
        self._first: Samples | None = None

    def check(self, text: str) -> None:
        """Check an order.

        Raises:
            OrderRefused: it cannot be carried out; the message says what to do.
        """
        setup = self._setup
        if setup.file.run.zero != "ordered":
            raise OrderRefused(
                f'home: [run] zero of {setup.path.name} is "counts": count 0 is position 0. For an incremental encoder '
                'write zero = "ordered" and start again'
            )
        given, saved = read_positions(text, setup.machine), self._newest()
        missing = [name for name in setup.machine.axis_names if name not in given]
        if missing and not (saved is not None and saved.homed):
            raise OrderRefused(f"home: no position is known yet, so name all axes; missing: {', '.join(missing)}")

    def begin(self, text: str) -> None:
        """Begin to look whether the axes stand."""
        self._positions_mm = read_positions(text, self._setup.machine)
        self.busy, self._first = True, None

    def look(self, samples: Samples) -> Home | str | None:
        """Look at rows, at least one: the order for the loop, the reason against it, or None where it looks on."""
        if not self.busy:
            return None
        if self._first is None:
            self._first = samples.rows(0, 1).copy()
        axes = self._setup.machine.axes
        mm = np.abs(samples.counts - self._first.counts).max(axis=0) / [abs(a.counts_per_mm) for a in axes]
        move = [a.name for a, moved in zip(axes, mm, strict=True) if a.name in self._positions_mm and moved > STANDS_MM]
        if move:
            self.busy = False
            return f"{', '.join(move)} moved by up to {mm.max():.3g} mm while it was looked at; stop the axes first"
        begin_ns, saved = self._first.time_ns[0], self._newest()
        if samples.time_ns[-1] - begin_ns < LOOK_NS:
            return None
        if saved is None or samples.counts_time_ns[-1] - begin_ns < LOOK_NS // 2:
            if samples.time_ns[-1] - begin_ns < PATIENCE_NS:
                return None
            self.busy = False
            return "the counts of the axes cannot be read; `rtec status` says why"
        self.busy = False
        return home_of(self._positions_mm, self._setup.machine, samples.counts[-1], saved.supply)

    def text(self, was: Samples | None) -> str:
        """The result in words; `was` is the newest row before it."""
        saved, out = self._newest(), []
        for k, axis in enumerate(self._setup.machine.axes):
            if axis.name in self._positions_mm:
                known = was is not None and saved is not None and saved.homed
                before = f" (was {was.counts[0, k] / axis.counts_per_mm:.4f})" if known and was is not None else ""
                out.append(f"{axis.name} {self._positions_mm[axis.name]:.4f} mm{before}")
        return f"homed: {', '.join(out)}"
