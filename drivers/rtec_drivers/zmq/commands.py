"""Commands to another process: what it has, what it answers, and whether it may be commanded at all."""

from collections.abc import Mapping, Sequence

from rtec.errors import DriverFault, DriverTimeout
from rtec_drivers.zmq import message

HOLDS = "the correction holds until it is ordered to resume"


class CommandAccount:
    """This side's account of the commands.

    Attributes:
        has: output that the other process says it has, axis by axis; None before it said.
        must_resume: why it waits for an order; "" where it does not.

    Args:
        axes: names in order.
        step: the first command may differ from `has` by at most this.
        timeout_s: so long may a command stay without an answer.
    """

    def __init__(self, axes: Sequence[str], step: int, timeout_s: float) -> None:
        self._axes, self._step, self._timeout_ns = tuple(axes), step, round(timeout_s * 1e9)
        self.has: tuple[int, ...] | None = None
        self._seq = 0
        self.order_resume()

    def order_resume(self) -> None:
        """Whoever publishes now may be commanded."""
        self.must_resume, self._boot, self._first = "", "", True
        self._refused, self._waiting_ns, self._answered = "", -1, self._seq

    def stop(self, why: str) -> None:
        """Command nothing more until the order comes."""
        if not self.must_resume:
            self.must_resume = f"{why}; {HOLDS}"

    def told(self, boot: str, output: Mapping[str, int]) -> None:
        """Take in what a state says of the other process."""
        if not self._boot:
            self._boot = boot
        elif boot != self._boot:
            self.stop("the other process restarted")
        if set(output) == set(self._axes):
            self.has = tuple(output[a] for a in self._axes)

    def answered(self, answer: message.Answer) -> None:
        """Take in an answer; one of another start is of no interest."""
        if answer.boot != self._boot or answer.seq <= self._answered:
            return
        self._answered, self._waiting_ns, self._refused = answer.seq, -1, answer.refused

    def next_command(self, output: Sequence[int]) -> bytes:
        """Give the text of the next command.

        Raises:
            DriverFault: an order is waited for, or the first command is a jump.
            DriverTimeout: the other process has not said yet what it has.
        """
        if self.must_resume:
            raise DriverFault(self.must_resume)
        if self.has is None or not self._boot:
            raise DriverTimeout("the other process has not said what it has applied")
        furthest = max(abs(a - b) for a, b in zip(output, self.has, strict=True))
        if self._first and furthest > self._step:
            raise DriverFault(
                f"the first command {list(output)} is {furthest} off what the other process has, {list(self.has)}: "
                "refused; the loop must take over its output first"
            )
        self._first = False
        self._seq += 1
        return message.command(self._boot, self._seq, dict(zip(self._axes, output, strict=True)))

    def sent(self, now_ns: int) -> None:
        """Note a command that was sent.

        Raises:
            DriverFault: the last one was refused.
            DriverTimeout: none was answered for too long.
        """
        if self._refused:
            raise DriverFault(f"the other process refuses commands: {self._refused}")
        if self._waiting_ns < 0:
            self._waiting_ns = now_ns
        elif now_ns - self._waiting_ns > self._timeout_ns:
            raise DriverTimeout(f"no command was answered for {(now_ns - self._waiting_ns) * 1e-9:.2f} s")
