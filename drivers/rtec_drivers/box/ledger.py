"""State of an encoder box's commands: its ledger, whether it accepts commands, and whether it may be commanded."""

from collections.abc import Sequence

from rtec.errors import DriverFault, DriverTimeout
from rtec_drivers.box import protocol
from rtec_drivers.box.protocol import BoxState

LARGEST = 2**31 - 1
PATIENT_TRIES = 10
"""Orders to resume that may be lost on the way before that is reported."""
HOLDS = "the correction holds until it is ordered to resume"


class BoxLedger:
    """The driver's side of the box's ledger.

    A box that restarted (another boot number, or its bit NOT_RESUMED) is not commanded until `order_resume`.

    Attributes:
        counts: the box's newest ledger; None before the first report.
        boot: boot number of the commanded box.
        must_resume: why it waits for an order; "" where it does not.
        pending: must the order to resume go out with the next command?

    Args:
        step_counts: the first command may differ from the box's ledger by at most this.
        timeout_s: longest time without an accepted command.
    """

    def __init__(self, step_counts: int, timeout_s: float) -> None:
        self._step, self._timeout_ns = step_counts, round(timeout_s * 1e9)
        self.counts: tuple[int, ...] | None = None
        self.order_resume()

    def order_resume(self) -> None:
        """Accept the present box, and command it from its ledger."""
        self.must_resume, self.boot, self.counts = "", -1, None
        self.pending, self._tries, self._first = True, 0, True
        self._last_taken, self._waiting_ns = -1, -1

    def reconnected(self) -> None:
        """Restart the time without an accepted command, since the line is back."""
        self._waiting_ns, self._tries = -1, 0

    def stop(self, why: str) -> None:
        """Command nothing until the order comes."""
        if not self.must_resume:
            self.must_resume = f"{why}; {HOLDS}"

    def reported(self, state: BoxState) -> None:
        """Process the box's report.

        Raises:
            DriverFault: it does not accept the order to resume.
        """
        self.counts = state.ledger
        if state.last_command != self._last_taken:
            self._last_taken, self._waiting_ns = state.last_command, -1
        if self.boot not in (-1, state.boot):
            self.stop(f"the encoder box restarted (start {state.boot}, before {self.boot}): its ledger is zero again")
        elif self.pending:
            self._take_up(state)
        elif state.status & protocol.NOT_RESUMED:
            self.stop("the encoder box stopped inserting by itself")
        elif state.status & protocol.ENCODER_FAULT:
            self.stop("the encoder box saw a fault of an encoder's signal: the position is not known")

    def check_command(self, targets: Sequence[int]) -> None:
        """Check that this may be commanded.

        Raises:
            DriverFault: it waits for an order, the numbers are too large, or the first command is a jump.
            DriverTimeout: the box has not reported its ledger yet.
        """
        if self.must_resume:
            raise DriverFault(self.must_resume)
        if self.counts is None:
            raise DriverTimeout("the encoder box has not told its ledger yet")
        if any(abs(t) > LARGEST for t in targets):
            raise DriverFault(f"inserted counts {list(targets)} do not fit into 32 bits")
        if self._first:
            self._check_first(targets, self.counts)

    def commanded(self, now_ns: int) -> None:
        """Record a command that was sent, with the order to resume where that was pending.

        Raises:
            DriverTimeout: the box has accepted none for too long.
        """
        self._tries += self.pending
        if self._waiting_ns < 0:
            self._waiting_ns = now_ns
        self.check_taken(now_ns)

    def check_taken(self, now_ns: int) -> None:
        """Check that the box accepts commands; called in every cycle, whether a command was sent or not.

        Raises:
            DriverTimeout: it has accepted none for too long.
        """
        if 0 <= self._waiting_ns < now_ns - self._timeout_ns:
            raise DriverTimeout(f"the encoder box has taken no command for {(now_ns - self._waiting_ns) * 1e-9:.2f} s")

    def _take_up(self, state: BoxState) -> None:
        self.boot = state.boot
        if state.status & protocol.ENCODER_FAULT:
            raise DriverFault("the encoder box sees, or saw, a fault of an encoder's signal")
        self.pending = bool(state.status & protocol.NOT_RESUMED)
        if self.pending and self._tries > PATIENT_TRIES:
            raise DriverFault("the encoder box does not take the order to resume")

    def _check_first(self, targets: Sequence[int], has: Sequence[int]) -> None:
        furthest = max(abs(t - h) for t, h in zip(targets, has, strict=True))
        if furthest > self._step:
            raise DriverFault(
                f"the first command {list(targets)} is {furthest} counts off what the encoder box has, {list(has)}: "
                "refused; the loop must take over the box's ledger first"
            )
        self._first = False
