"""One session with an encoder box over an open line: from the handshake until the line is lost."""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from rtec.errors import DriverFault, DriverTimeout
from rtec.loop.clock import Clock
from rtec_drivers.box import protocol
from rtec_drivers.box.protocol import BoxState, Frame, FrameReader, Info

HELLO_PERIOD_S = 0.1
READS_PER_WAIT = 64
"""Limits the reads, so that a box that floods the line takes no longer than a silent one, whatever the clock does."""
PATIENCE_S = 0.05
"""After a silence of this time, s, the box is asked without waiting for its answer, and less often."""
ASK_PERIOD_S = 0.02
REMEMBERED_QUESTIONS = 256


class BoxLine(Protocol):
    """A session's line: the serial port is one."""

    device: str

    def write(self, data: bytes) -> None:
        """Send all or nothing."""
        ...

    def read(self) -> bytes:
        """The bytes that have arrived."""
        ...

    def wait(self, timeout_s: float) -> bool:
        """Wait for bytes."""
        ...

    def close(self) -> None:
        """Close it."""
        ...


@dataclass(frozen=True, slots=True)
class BoxAnswer:
    """A state of the box; it was latched between question and answer, ns of the clock."""

    state: BoxState
    asked_ns: int
    answered_ns: int


class BoxSession:
    """Questions and answers, matched by sequence number.

    Attributes:
        info: the box's description.
        sequence: sequence number of the last frame sent.
        silent_s: age, s, of the oldest unanswered question when the box was last asked.
    """

    def __init__(self, line: BoxLine, clock: Clock) -> None:
        self.line, self._clock = line, clock
        self.info = Info(0, 0, 0, 0, 0, 0)
        self.sequence, self.silent_s = 0, 0.0
        self._looked_ns = clock.now_ns()
        self._waiting_ns: int | None = None  # since the first question after the last answer
        self._reader = FrameReader()
        self._open_questions: deque[tuple[int, int]] = deque(maxlen=REMEMBERED_QUESTIONS)

    def talk(self, timeout_s: float) -> BoxAnswer:
        """Ask for the state as `exchange` does; after a silence less often, and without waiting.

        Raises:
            DriverTimeout: no answer.
            DriverUnavailable: the line is gone.
        """
        now_ns = self._clock.now_ns()
        self.silent_s = 0.0 if self._waiting_ns is None else (now_ns - self._waiting_ns) * 1e-9
        late = self._look_in(now_ns) if self.silent_s > PATIENCE_S else None
        answer = self.exchange(timeout_s, late)
        self.silent_s = 0.0
        return answer

    @property
    def silence(self) -> str:
        """Message that the silence is too long to be waited for; "" where it is not."""
        return f"the encoder box is silent for {self.silent_s:.2f} s" if self.silent_s > PATIENCE_S else ""

    def greet(self, timeout_s: float) -> Info:
        """Greet until the box answers.

        Raises:
            DriverTimeout: no answer within that time.
            DriverFault: it has another version.
        """
        tries = max(1, round(timeout_s / HELLO_PERIOD_S))
        for _ in range(tries):
            sequence = self.send(protocol.HELLO)
            for frame in self._frames_for(HELLO_PERIOD_S):
                if frame.version != protocol.VERSION:
                    raise DriverFault(
                        f"{self.line.device}: the box speaks version {frame.version} of the link, "
                        f"rtec version {protocol.VERSION}"
                    )
                info = protocol.info_of(frame.payload) if frame.kind == protocol.INFO else None
                if info is not None and frame.sequence == sequence:
                    self.info, self._waiting_ns = info, None
                    return info
        raise DriverTimeout(f"{self.line.device}: no encoder box answers within {timeout_s:g} s")

    def check(self, box_serial: int | None, travel_counts: Mapping[str, float]) -> None:
        """Check that the box can be used.

        Args:
            box_serial: its number; None: any.
            travel_counts: largest distance from zero that each axis can have, counts; a start takes counters as signed.

        Raises:
            DriverFault: another number, another number of axes, or counters of an unknown or too small width.
        """
        info, place = self.info, self.line.device
        if box_serial is not None and info.box_serial != box_serial:
            raise DriverFault(f"{place}: box number {info.box_serial} answers, not {box_serial}")
        if info.axes != len(travel_counts):
            raise DriverFault(f"{place}: the box has {info.axes} axes, the machine {len(travel_counts)}")
        if info.counter_bits not in (16, 24, 32):
            raise DriverFault(f"{place}: the box has counters of {info.counter_bits} bits; 16, 24 or 32 are known")
        most = 2 ** (info.counter_bits - 1)
        if narrow := [axis for axis, counts in travel_counts.items() if counts >= most]:
            raise DriverFault(
                f"{place}: counters of {info.counter_bits} bits go round within the travel of {', '.join(narrow)}; "
                "after a start nobody would know where the axis is: take a box with wider counters"
            )

    def exchange(self, timeout_s: float, newest: BoxAnswer | None = None) -> BoxAnswer:
        """Ask for the state and wait; give the newest answer, which may belong to an older question.

        Args:
            timeout_s: longest wait.
            newest: an answer that is there already.

        Raises:
            DriverTimeout: none came in time.
            DriverUnavailable: the line is gone.
        """
        deadline_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        question = self.ask(protocol.READ)
        for _ in range(READS_PER_WAIT):
            newest = self.collect() or newest
            if newest is not None and self._answers(question):
                return newest
            left_ns = deadline_ns - self._clock.now_ns()
            if left_ns <= 0 or not self.line.wait(left_ns * 1e-9):
                break
        newest = self.collect() or newest
        if newest is None:
            raise DriverTimeout(f"{self.line.device}: the encoder box does not answer within {timeout_s * 1e3:g} ms")
        return newest

    def ask(self, kind: int, payload: bytes = b"") -> int:
        """Send a question that a STATE answers; remember its instant."""
        now_ns = self._clock.now_ns()
        sequence = self.send(kind, payload)
        self._open_questions.append((sequence, now_ns))
        if self._waiting_ns is None:
            self._waiting_ns = now_ns
        return sequence

    def collect(self) -> BoxAnswer | None:
        """Read what has arrived; give the answer to the newest of the open questions, if there is one."""
        received = self.line.read()
        if not received:
            return None
        newest = None
        for frame in self._reader.feed(received):
            asked_ns = self._asked_at(frame)
            state = protocol.state_of(frame.payload) if asked_ns is not None else None
            if asked_ns is not None and state is not None and len(state.counts) == self.info.axes:
                newest = BoxAnswer(state, asked_ns, self._clock.now_ns())
                self._waiting_ns = self._open_questions[0][1] if self._open_questions else None
        return newest

    def send(self, kind: int, payload: bytes = b"") -> int:
        """Send one frame; give its sequence number."""
        sequence = (self.sequence + 1) & 0xFFFF
        self.line.write(protocol.encode(Frame(kind, sequence, payload)))
        self.sequence = sequence
        return sequence

    def _look_in(self, now_ns: int) -> BoxAnswer:
        answer = self.collect()
        if answer is not None:
            return answer
        if now_ns - self._looked_ns >= ASK_PERIOD_S * 1e9:
            self._looked_ns = now_ns
            self.ask(protocol.READ)
        raise DriverTimeout(f"{self.line.device}: {self.silence}")

    def _answers(self, question: int) -> bool:
        """Has that question been answered?"""
        return all(sequence != question for sequence, _ in self._open_questions)

    def _asked_at(self, frame: Frame) -> int | None:
        """Instant of this answer's question; closes it and the older ones."""
        if frame.kind != protocol.STATE or frame.version != protocol.VERSION:
            return None
        if all(sequence != frame.sequence for sequence, _ in self._open_questions):
            return None
        while True:
            sequence, asked_ns = self._open_questions.popleft()
            if sequence == frame.sequence:
                return asked_ns

    def _frames_for(self, wait_s: float) -> list[Frame]:
        """Everything that arrives within that time, or up to the first good frame."""
        deadline_ns = self._clock.now_ns() + round(wait_s * 1e9)
        for _ in range(READS_PER_WAIT):
            left_ns = deadline_ns - self._clock.now_ns()
            if left_ns <= 0 or not self.line.wait(left_ns * 1e-9):
                break
            frames = self._reader.feed(self.line.read())
            if frames:
                return frames
        return []
