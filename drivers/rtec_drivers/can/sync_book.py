"""Which SYNC a position answers: CANopen answers carry no number, so answers are counted.

An encoder answers every SYNC once, and in order. While no answer is owed, the next SYNC may go out, and what comes is
its answer. Where an answer does not come, it is lost or late:

- Only one SYNC is out: an answer that comes now is exact, however late. The wait for it is four timeouts; where the
  last answers were prompt, it is eight times the slowest of them (5 ms at least), if that is shorter.
- Then the next SYNC goes out, and readings are in doubt: they are counted, not used. SYNCs become rarer until answers
  come. All owed answers came: they were late, and the count is exact again.
- Every axis answers, but fewer answers came than are owed: the first of them is as late as the oldest unanswered SYNC
  at most. When nothing more came for three times that delay (or the slowest answer's, if that is longer), and no SYNC
  went out meanwhile, the others are lost.

A start is in doubt, too: an answer to the SYNC of an earlier run may be on its way.
"""

NEVER_NS = -(2**62)
IN_STEP = 16
"""Rounds without a late answer, after which a missing one is most likely lost."""
PROMPT = 8
"""Multiple of the slowest answer at which a prompt encoder's answer is missing."""
PROMPT_NS = 5_000_000
"""And the least such time, which this computer may take itself."""
SLOW_IN_A_ROW = 3
"""Rounds that come too late for the timeout, after which it is no hiccup."""
PATIENCE = 4
"""Multiple of the timeout, or of the slowest answer, at which the answer of any other encoder is missing."""
QUIET = 3
"""Multiple of the largest delay that an answer may have had, after which no other one is on its way."""
FORGET = 64
"""Rounds in which a slow answer is forgotten, about."""
LATEST_NS = 500_000_000
"""Largest delay of an answer that is reckoned with, unless the timeout is more than half of it."""
START_NS = 50_000_000
"""Largest time before a start at which an earlier run may have sent its last SYNC."""


class SyncBook:
    """Counts SYNCs and answers; says when the next SYNC may go out, and whether a reading is whole.

    `takes` and `whole` are called by the thread that receives, all others by the loop. Each counter has one writer.

    Args:
        axes: number of axes.

    Attributes:
        answered_ns: instant of the SYNC that a whole reading answers, ns.
    """

    def __init__(self, axes: int) -> None:
        self.answered_ns, self._latency_ns = NEVER_NS, 0
        self._axes = range(axes)
        self._asked, self._sync_ns, self._oldest_ns = 0, NEVER_NS, NEVER_NS
        self._answered, self._lost, self._heard_ns = [0] * axes, [0] * axes, [NEVER_NS] * axes
        self._unasked = self._unasked_seen = 0
        self._excused, self._excused_ns = axes, NEVER_NS
        self._in_step = self._slow_in_a_row = self._slowest_ns = self._gap_ns = 0
        self._doubt = self._quiet = True

    def takes(self, axis: int, now_ns: int) -> bool:
        """Count an answer; False where none was owed."""
        self.answered_ns = self._sync_ns  # before the count: the loop may send the next SYNC right after it
        self._heard_ns[axis] = now_ns
        if self._owed(axis) <= 0:
            self._unasked += 1
            return False
        self._answered[axis] += 1
        return True

    def whole(self, now_ns: int) -> bool:
        """Has every axis answered the newest SYNC, without doubt?"""
        if self._any_owed():
            return False
        self._latency_ns = now_ns - self.answered_ns
        return not self._doubt

    def due(self, now_ns: int, timeout_ns: int) -> bool:
        """May the next SYNC go out?"""
        if self._unasked != self._unasked_seen:
            self._look_at_unasked(now_ns, timeout_ns)
        if self._doubt:
            return self._due_in_doubt(now_ns, timeout_ns)
        if not self._any_owed():
            self._in_step += 1
            self._slowest_ns -= self._slowest_ns // FORGET
            self._note_latency(timeout_ns)
            return True
        patience_ns = self._patience_ns(timeout_ns)
        if now_ns - self._sync_ns < patience_ns:
            return False
        self._doubt, self._oldest_ns, self._gap_ns = True, self._sync_ns, patience_ns
        return True

    def sent(self, now_ns: int) -> None:
        """Note a SYNC, before it goes out."""
        self._sync_ns = now_ns
        self._asked += 1

    def not_sent(self) -> None:
        """The SYNC that was noted last did not go out."""
        self._asked -= 1

    def owes(self, axis: int) -> bool:
        """Does this axis owe an answer?"""
        return self._owed(axis) > 0

    def late_ns(self, now_ns: int, timeout_ns: int) -> int:
        """Delay of the answers, ns, where the last ones came too late for this timeout; 0 where they do not.

        A reading is used until the one after it has come, so answers must come within half the timeout.
        """
        heard = now_ns - min(self._heard_ns) < 2 * _latest_ns(timeout_ns)
        return self._latency_ns if heard and self._slow_in_a_row >= SLOW_IN_A_ROW else 0

    def _owed(self, axis: int) -> int:
        return self._asked - self._answered[axis] - self._lost[axis]

    def _any_owed(self) -> bool:
        for k in self._axes:  # noqa: SIM110 - a generator would be made in every cycle
            if self._asked - self._answered[k] - self._lost[k] > 0:
                return True
        return False

    def _patience_ns(self, timeout_ns: int) -> int:
        """Time after a SYNC at which an answer is missing."""
        longest_ns = min(PATIENCE * max(timeout_ns, self._slowest_ns), _latest_ns(timeout_ns) // 2)
        if self._in_step < IN_STEP:
            return longest_ns
        return min(max(PROMPT * self._slowest_ns, PROMPT_NS), longest_ns)

    def _look_at_unasked(self, now_ns: int, timeout_ns: int) -> None:
        """A position came that nobody owes: it may be an answer that was taken for lost."""
        self._unasked_seen = self._unasked
        if self._excused and now_ns - self._excused_ns < 2 * _latest_ns(timeout_ns):
            self._excused -= 1
            self._doubt = self._quiet = True

    def _due_in_doubt(self, now_ns: int, timeout_ns: int) -> bool:
        if self._asked == 0:
            self._oldest_ns = now_ns - min(2 * timeout_ns, START_NS)
            self._gap_ns = self._patience_ns(timeout_ns)
            return True
        if not self._quiet and not self._any_owed():
            self._doubt, self._in_step = False, 0
            self._note_latency(timeout_ns)
            return True
        if min(self._heard_ns) >= self._sync_ns:
            last_ns = max(self._heard_ns)
            late_ns = max(last_ns - self._oldest_ns, self._slowest_ns)
            if now_ns - last_ns < QUIET * min(late_ns, _latest_ns(timeout_ns)):
                return False
            self._write_off(now_ns, timeout_ns)
            self._doubt = self._quiet = False
            return False  # what came since is seen before the next SYNC
        if now_ns - self._sync_ns < self._gap_ns:
            return False
        self._gap_ns = min(2 * self._gap_ns, _latest_ns(timeout_ns) // 2)
        return True

    def _note_latency(self, timeout_ns: int) -> None:
        self._slowest_ns = max(self._slowest_ns, self._latency_ns)
        self._slow_in_a_row = self._slow_in_a_row + 1 if 2 * self._latency_ns > timeout_ns else 0

    def _write_off(self, now_ns: int, timeout_ns: int) -> None:
        """What is still owed was lost."""
        if not self._any_owed():
            self._note_latency(timeout_ns)
        self._excused_ns = now_ns
        for k in self._axes:
            owed = self._owed(k)
            if owed > 0:
                self._lost[k] += owed
                self._excused += owed


def _latest_ns(timeout_ns: int) -> int:
    return max(LATEST_NS, 2 * timeout_ns)
