"""A state walked through window by window, so that a million readings never need their whole design in memory."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtec.effects import State
from rtec.effects.derived import FAR_MM, lag_update
from rtec.effects.state import Value
from rtec.jit import njit

Floats = NDArray[np.float64]


@njit
def _lag_on(value: Floats, time_s: Floats, tau_s: float, memory: Floats) -> Floats:
    """First-order lag that goes on from `memory`: lagged, input, instant, begun; moved to the window's end."""
    out = np.empty(len(value))
    for i in range(len(value)):
        if memory[3] == 0.0:
            memory[0] = value[i]
            memory[3] = 1.0
        else:
            memory[0] = lag_update(memory[0], memory[1], value[i], time_s[i] - memory[2], tau_s)
        memory[1] = value[i]
        memory[2] = time_s[i]
        out[i] = memory[0]
    return out


class Walk:
    """The channels of one state, seen through a window that moves on; what effects may ask of a state.

    Lags are those of the whole state to the last bit: each goes on from where the window before it ended.
    """

    def __init__(self, state: State) -> None:
        self._state = state
        self._memory: dict[tuple[int, int], Floats] = {}
        self._seen: dict[tuple[str, bool], Floats] = {}
        self._window = slice(0, 0)
        self._slot, self._call = 0, 0

    def move(self, start: int, stop: int) -> None:
        """Look at instants start … stop - 1; windows follow each other without gaps."""
        self._window = slice(start, stop)
        self._seen.clear()

    def begin(self, slot: int) -> "Walk":
        """Say whose basis functions are asked for next: lags are remembered by slot and order of asking."""
        self._slot, self._call = slot, 0
        return self

    def value(self, name: str) -> Floats:
        """Give a channel in the window."""
        return self._cached(name, False)

    def rise(self, sensor: str) -> Floats:
        """Temperature above the reference in the window, K."""
        return self._cached(sensor, True)

    def lagged(self, value: Value, tau_s: Value) -> Floats:
        """First-order lag of a value in the window."""
        time_s = self._state.time_s[self._window]
        whole: Any = np.broadcast_to(np.asarray(value, dtype=np.float64), time_s.shape)
        memory = self._memory.setdefault((self._slot, self._call), np.zeros(4))
        self._call += 1
        return _lag_on(np.ascontiguousarray(whole), np.ascontiguousarray(time_s), float(tau_s), memory)

    def _channel(self, name: str) -> Floats:
        """Give a whole channel; an axis that was not recorded stands at zero, as in `State.positions_mm`.

        Of an axis that was recorded at one place only, velocity and acceleration are zero, too.
        """
        state = self._state
        if name in state.channels:
            return state.value(name)
        for axis in state.machine.axes:
            recorded = state.channels.get(axis.channel)
            if name not in axis.moving_channels or (recorded is not None and np.ptp(recorded) > 0.0):
                continue
            if recorded is None or name in (axis.velocity_channel, axis.acceleration_channel):
                return np.full(len(state), FAR_MM if name == axis.since_reversal_channel else 0.0)
        return state.value(name)

    def _cached(self, name: str, rise: bool) -> Floats:
        key = (name, rise)
        if key not in self._seen:
            value = self._channel(name)[self._window]
            self._seen[key] = value - self._state.reference_degc if rise else value
        return self._seen[key]
