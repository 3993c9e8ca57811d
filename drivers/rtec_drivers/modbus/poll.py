"""Polls the slaves on one line in turn, so that a silent slave costs the others almost nothing.

- Every slave has its own period, its own deadline and its own back-off. A slave that did not answer is asked again only
  when no healthy slave is due meanwhile, or when it has waited for `STARVED_NS`.
- RTU answers have no number. After a missed deadline the slave is not asked for its late time, within which the old
  answer may still come; an answer in that time is dropped. The first answer afterwards is only a sign of life and is
  dropped, too; the line must stay free of further answers for twice the late time before the slave's answers are
  accepted again. An old answer that comes even later makes the late time longer.
- A slave that has answered each of its last requests owes no answer. If its number is in bytes that come when another
  slave was asked, a third device uses its number: the fault is reported for the other slave, and its own values stay
  as fresh as before.
- A block that the slave refuses (an exception) is asked again after a back-off of its own; all others are read as
  before. A refusal is an answer: the line is good, and is not reopened. Only a gateway's report that the slave does not
  answer counts as the slave's silence.
- A damaged answer (checksum) is requested again in the next period; three in a row count as silence.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

from rtec.errors import DriverTimeout
from rtec.loop.clock import Clock
from rtec_drivers.byte_line import ByteLine
from rtec_drivers.modbus.frame import ERRORS, LONGEST_NOISE, Exchange, frames_of_slaves
from rtec_drivers.modbus.map import Block
from rtec_drivers.reopen import NS, Backoff, Worker
from rtec_drivers.temperatures import TemperatureReadings

STARVED_NS = 5 * NS
LONGEST_LATE_NS = 10 * NS
NEVER_NS = 3600 * NS
GATEWAY_ERRORS = (10, 11)
"""A gateway answers, but not the slave behind it."""
LISTEN_NS = NS // 20
FRAME_PAUSE_NS = NS // 50
"""Upper limit of a pause within a frame, even behind a USB adapter."""
CORRUPT_IN_A_ROW = 3
SILENT_IN_A_ROW = 3
IN_STEP = 3
"""Requests answered in a row, after which any other bytes are no late answer to an earlier one."""


@dataclass
class Asking:
    """When to ask for a block.

    Attributes:
        block: the read.
        backoff: waits after a refusal.
        not_before_ns: the slave refused it; it is not asked before.
    """

    block: Block
    backoff: Backoff
    not_before_ns: int = 0


@dataclass
class Slave:
    """One slave: its reads, their times, and its past answers.

    Attributes:
        name, number: name in the run file; number on the line.
        blocks: the reads that fetch all its numbers.
        period_ns, timeout_ns: period of asking; longest wait for an answer.
        late_ns: time after a request within which an answer may still come.
        backoff: waits after silence.
        unanswered_ns: instant of its last request that may still be unanswered; 0: none.
        pause_ns: longest pause between two such consecutive requests.
        in_row: number of requests answered in time, one after the other.
        unheard: number of requests in a row to which nothing came that proves a good line.
    """

    name: str
    number: int
    blocks: Sequence[Block]
    period_ns: int
    timeout_ns: int
    late_ns: int
    backoff: Backoff
    due_ns: int = 0
    silent: int = 0
    corrupt: int = 0
    unanswered_ns: int = 0
    pause_ns: int = 0
    probation: bool = False
    in_row: int = 0
    unheard: int = 0
    names: tuple[str, ...] = field(init=False)
    asking: tuple[Asking, ...] = field(init=False)

    def __post_init__(self) -> None:
        self.names = tuple(name for block in self.blocks for name in block.names)
        self.asking = tuple(Asking(block, self.backoff.another()) for block in self.blocks)

    @property
    def failing(self) -> bool:
        """Was the last request not answered?"""
        return self.silent > 0

    @property
    def in_step(self) -> bool:
        """Were all recent requests answered?"""
        return self.in_row >= IN_STEP

    def answered(self, now_ns: int) -> None:
        """Schedule the next request in the same rhythm; after a pause, start a new rhythm."""
        self.in_row += 1
        self.silent = self.corrupt = self.unanswered_ns = self.pause_ns = 0
        self.probation = False
        self.backoff.reset()
        self.due_ns += self.period_ns
        if self.due_ns <= now_ns:
            self.due_ns = now_ns + self.period_ns

    def was_silent(self, asked_ns: int, now_ns: int) -> None:
        """Do not ask it during its back-off, nor while its answer may still come."""
        self.silent, self.in_row, self.probation = self.silent + 1, 0, True
        self._unanswered(asked_ns)
        self.due_ns = max(now_ns + self.backoff.next_ns(), asked_ns + self.late_ns)

    def line_opened(self, now_ns: int) -> None:
        """Ask it at once, unless an old answer may still come."""
        self.due_ns = max(now_ns, self.unanswered_ns + self.late_ns) if self.unanswered_ns else now_ns
        self.silent = self.in_row = self.unheard = 0

    def lives(self, asked_ns: int, now_ns: int) -> None:
        """It answers again, but perhaps an older request: wait whether more is on its way."""
        self._unanswered(asked_ns)
        self.silent, self.probation = 1, False
        self.due_ns = now_ns + self.late_ns + max(self.late_ns, self.pause_ns)

    def spoke_unasked(self, now_ns: int) -> None:
        """An old answer has come: learn its delay, and wait for silence again."""
        late_ns = now_ns - self.unanswered_ns
        self.in_row = 0
        if self.unanswered_ns and late_ns < LONGEST_LATE_NS:
            self.late_ns = min(max(self.late_ns, 2 * late_ns), LONGEST_LATE_NS)
        if not self.probation:
            self.silent, self.probation = max(self.silent, 1), True
            self.due_ns = now_ns + self.late_ns

    def _unanswered(self, asked_ns: int) -> None:
        """Record a request; the one before it no longer counts as unanswered if it is too old."""
        pause_ns = asked_ns - self.unanswered_ns
        owed = self.unanswered_ns and pause_ns < LONGEST_LATE_NS
        self.pause_ns = max(self.pause_ns, pause_ns) if owed else 0
        self.unanswered_ns = asked_ns


class Poller:
    """Serves one open line until the worker stops or the line breaks."""

    def __init__(
        self, slaves: Sequence[Slave], readings: TemperatureReadings, clock: Clock, exchange: Exchange
    ) -> None:
        self._slaves, self._readings, self._clock, self._exchange = slaves, readings, clock, exchange
        self.requests = self.late = 0
        self._why = ""

    def serve(self, line: ByteLine, worker: Worker[ByteLine]) -> None:
        """Poll the due slaves, for ever.

        Raises:
            DriverUnavailable: the line is gone.
            DriverTimeout: no slave has answered for a while; reopening the line may help.
        """
        now_ns = self._clock.now_ns()
        for slave in self._slaves:
            slave.line_opened(now_ns)
        while not worker.stopping:
            chosen, wake_ns = self.choose(self._clock.now_ns())
            if chosen is None:
                self._idle(line, worker, wake_ns)
                continue
            self._drop_old(line)
            self._ask(line, chosen)
            if not chosen.failing:
                worker.backoff.reset()
            if all(s.unheard >= SILENT_IN_A_ROW for s in self._slaves):
                raise DriverTimeout(f"{self._why}; no other slave answers either; opening the line again")

    def choose(self, now_ns: int) -> tuple[Slave | None, int]:
        """The slave to ask now, or None and the end of the wait, ns: healthy ones first, failing ones in the gaps."""
        healthy = [s for s in self._slaves if not s.failing]
        failing = sorted((s for s in self._slaves if s.failing), key=lambda s: s.due_ns)
        next_ns = min((s.due_ns for s in healthy), default=now_ns + NEVER_NS)
        if next_ns <= now_ns:
            return min(healthy, key=lambda s: s.due_ns), now_ns
        for waiting in failing:
            starved = now_ns - waiting.due_ns > STARVED_NS
            if waiting.due_ns <= now_ns and (starved or next_ns >= now_ns + waiting.timeout_ns):
                return waiting, now_ns
        later = (s.due_ns if s.due_ns > now_ns else s.due_ns + STARVED_NS + 1 for s in failing)
        return None, min(next_ns, *later) if failing else next_ns

    def _ask(self, line: ByteLine, slave: Slave) -> None:
        requests = self.requests
        for asking in slave.asking:
            if asking.not_before_ns <= self._clock.now_ns() and not self._reads(line, slave, asking):
                return
        if self.requests > requests:
            slave.answered(self._clock.now_ns())
        else:
            slave.due_ns = min(asking.not_before_ns for asking in slave.asking)

    def _reads(self, line: ByteLine, slave: Slave, asking: Asking) -> bool:
        """Ask for a block; False where the slave's other blocks must wait."""
        block, asked_ns = asking.block, self._clock.now_ns()
        self.requests += 1
        answer, data = self._exchange.ask(line, block.request, asked_ns + slave.timeout_ns)
        self._look_for_late(data, slave)
        if answer is None:
            self._no_answer(slave, block, data, asked_ns)
            return False
        slave.unheard = 0
        if answer.error in GATEWAY_ERRORS:
            self._behind_gateway(slave, answer.error, asked_ns)
            return False
        if slave.probation and not self._exchange.numbered:
            slave.lives(asked_ns, self._clock.now_ns())
            return False
        if answer.error:
            self._refused(slave, asking, answer.error)
            return True
        asking.backoff.reset()
        for name, raw, why in block.raw(answer.registers):
            if why:
                self._readings.silent([name], f"slave {slave.number} ({slave.name}): {block.request.place}: {why}")
            else:
                self._readings.take(name, raw, asked_ns)
        return True

    def _no_answer(self, slave: Slave, block: Block, data: bytes, asked_ns: int) -> None:
        now_ns = self._clock.now_ns()
        why = self._exchange.why_not(data, block.request)
        slave.unheard = 0 if self._exchange.proves_line(data) else slave.unheard + 1
        if data[:1] == bytes([slave.number]) and slave.corrupt + 1 < CORRUPT_IN_A_ROW:
            slave.corrupt += 1
            slave.due_ns = now_ns + slave.period_ns
            return
        slave.was_silent(asked_ns, now_ns)
        within_ms = slave.timeout_ns // 1_000_000
        self._why = f"slave {slave.number} ({slave.name}): {why}, within {within_ms} ms"
        if not data:
            self._why += f"; {self._exchange.if_silent(slave.number)}"
        self._readings.silent(slave.names, self._why)

    def _behind_gateway(self, slave: Slave, error: int, asked_ns: int) -> None:
        slave.was_silent(asked_ns, self._clock.now_ns())
        slave.unanswered_ns = 0
        self._readings.silent(slave.names, f"slave {slave.number} ({slave.name}): error {error}: {ERRORS[error]}")

    def _refused(self, slave: Slave, asking: Asking, error: int) -> None:
        asking.not_before_ns = self._clock.now_ns() + asking.backoff.next_ns()
        why = f"error {error}: {ERRORS.get(error, 'it refuses')}"
        place = asking.block.request.place
        self._readings.silent(asking.block.names, f"slave {slave.number} ({slave.name}): {place}: {why}")

    def _idle(self, line: ByteLine, worker: Worker[ByteLine], wake_ns: int) -> None:
        """Wait for the next turn; while an old answer may come, listen, to learn its delay."""
        if self._exchange.numbered or not any(s.failing for s in self._slaves):
            worker.wait_until_ns(wake_ns)
            return
        data = line.receive(min(wake_ns, self._clock.now_ns() + LISTEN_NS))
        while data and len(data) < LONGEST_NOISE:
            more = line.receive(self._clock.now_ns() + FRAME_PAUSE_NS)
            if not more:
                break
            data += more
        self._look_for_late(data, None)

    def _drop_old(self, line: ByteLine) -> None:
        """Drop bytes that came unasked, and record the slave; numbered answers are sorted out later."""
        if self._exchange.numbered:
            return
        data = b""
        while len(data) < LONGEST_NOISE and (more := line.receive(0)):
            data += more
        self._look_for_late(data, None)

    def _look_for_late(self, data: bytes, expected: Slave | None) -> None:
        if self._exchange.numbered or not data:
            return
        numbers = {number for number, _ in frames_of_slaves(data)}
        for slave in self._slaves:
            if slave is not expected and slave.number in numbers and not (expected and slave.in_step):
                self.late += 1
                slave.spoke_unasked(self._clock.now_ns())
                why = f"slave {slave.number} ({slave.name}): answers later than its timeout_s"
                self._readings.silent(slave.names, why)
