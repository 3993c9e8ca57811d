"""How far another computer's clock is off, from messages that carry their instant of sending."""

WINDOW_NS = 30_000_000_000


class ClockOffset:
    """Our clock minus theirs: the least of `received - sent`, over the last thirty to sixty seconds.

    The quickest message was on the way for the shortest time, so that time, which nobody can know, is all that the
    offset is too large by: a reading looks younger by it than it is. Messages that were held up do not.
    The window lets two clocks run apart: at 50 millionths, by 3 ms in a minute.
    """

    def __init__(self) -> None:
        self._now: int | None = None
        self._before: int | None = None
        self._start_ns = 0

    def reset(self) -> None:
        """Forget: theirs started anew."""
        self._now = self._before = None

    def add(self, sent_ns: int, received_ns: int) -> None:
        """Take in one message: sent by their clock, received by ours."""
        if self._now is None or received_ns - self._start_ns > WINDOW_NS:
            self._before, self._now, self._start_ns = self._now, None, received_ns
        offset = received_ns - sent_ns
        self._now = offset if self._now is None else min(self._now, offset)

    def ours(self, their_ns: int) -> int:
        """Give an instant of their clock by ours.

        Raises:
            ValueError: no message yet.
        """
        known = [offset for offset in (self._now, self._before) if offset is not None]
        if not known:
            raise ValueError("no message yet")
        return their_ns + min(known)
