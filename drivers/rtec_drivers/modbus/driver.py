"""Temperatures over Modbus RTU and TCP, from modules with a shipped register map or one written in the run file.

A scan for slaves and their registers uses functions 3 and 4 only, which read.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Self

from pydantic import Field, model_validator

from rtec.arrays import Floats, Ints
from rtec.errors import ConfigError, DriverUnavailable
from rtec.loop.clock import Clock
from rtec.loop.ports import Scanner
from rtec.machine import Machine
from rtec.tomlfile import Strict, nearest, validated
from rtec.wording import counted
from rtec_drivers.byte_line import ByteLine, way_of
from rtec_drivers.modbus.frame import (
    HOLDING,
    INPUT,
    Exchange,
    ModbusAnswer,
    ModbusLineOptions,
    ModbusRequest,
    frames_of_slaves,
)
from rtec_drivers.modbus.map import Register, blocks_of, load_profile
from rtec_drivers.modbus.poll import Poller, Slave
from rtec_drivers.reopen import NS, Backoff, Worker
from rtec_drivers.temperatures import TemperatureReadings, in_room, room_high_word

NUMBERS: Final = range(1, 248)
TIMEOUT_NS: Final = NS // 10
"""Wait for the first answer; modules answer within 50 ms, and a later one is recognised when its answer comes."""
PATIENT_NS: Final = 3 * NS // 10
TRIES: Final = 2
"""A request may be lost; and libmodbus takes the one after a request to an absent slave for that slave's answer."""
REGISTERS: Final = 128
BLOCK: Final = 32
UNKNOWN_FUNCTION: Final = 1
FAILED, NO_WAY, NO_ANSWER = 4, 10, 11
"""Errors by which a gateway reports that a slave does not exist; pymodbus' server sends FAILED."""
SLAVE_NS: Final = 5 * NS
"""Longest time for its registers of one kind."""
NAMES: Final = {INPUT: "input", HOLDING: "holding"}


class ModbusScanner:
    """Scans a Modbus line.

    Args:
        options: the line.
        clock: clock of the deadlines.
        numbers: numbers of the slaves to ask; None: all possible ones.

    Attributes:
        duration: duration of the search, in words.
        slaves: numbers of the slaves that answered.
    """

    def __init__(self, options: ModbusLineOptions, clock: Clock, numbers: Sequence[int] | None = None) -> None:
        self.slaves: list[int] = []
        numbers = NUMBERS if numbers is None else numbers
        ask_s, look_s = len(numbers) * TRIES * TIMEOUT_NS / NS, len(NAMES) * SLAVE_NS // NS
        self.duration = f"up to {ask_s:.0f} s, and up to {look_s} s more for each slave that answers"
        self._options, self._clock, self._numbers = options, clock, numbers
        self._connect: Callable[[], ByteLine]
        self._connect, _ = way_of(options.serial, options.tcp, clock)
        self._line: ByteLine | None = None
        self._looked_at = 0
        self._exchange: Exchange = options.exchange(clock, clock.sleep_until_ns)
        self._blocks: list[ModbusRequest] = []
        self._words: dict[tuple[int, int, int], int] = {}
        self._places: dict[str, tuple[int, Register]] = {}

    def __enter__(self) -> Self:
        """Open the line.

        Raises:
            DriverUnavailable: it cannot be opened.
        """
        self._line = self._connect()
        return self

    def __exit__(self, *error: object) -> None:
        """Close the line."""
        if self._line is not None:
            self._line.close()
            self._line = None

    def search(self) -> Iterator[tuple[float, str]]:
        """Ask every number; read the registers of a slave as soon as it answers."""
        numbers = self._numbers
        if self._whatever_the_number():
            numbers = numbers[:1]
            yield 0.0, f"the same device answers to every number: it is taken as slave {numbers[0]}"
        for k, number in enumerate(numbers):
            if self._is_there(number) and number not in self.slaves:
                self.slaves.append(number)
            for slave in self.slaves[self._looked_at :]:  # one with a lower number may have answered late
                yield from ((k / len(numbers), "") for _ in self._look_at(slave))
                self._looked_at += 1
                yield (k + 1) / len(numbers), self._about(slave)
            yield (k + 1) / len(numbers), ""

    def read(self) -> dict[str, float]:
        """Numbers of all existing registers; those that do not answer now keep their last one."""
        for request in self._blocks:
            if (answer := self._ask(request, PATIENT_NS)) is None:
                self._let_pass()
            self._take(request, answer)
        return {place: self._number(*where) for place, where in self._places.items()}

    def proposed(self, names: Sequence[str]) -> dict[str, str]:
        """In order, the registers that may hold a room's temperature."""
        could_be = [p for p, (n, r) in self._places.items() if in_room(self._number(n, r), r.type == "float32")]
        return dict(zip(names, could_be, strict=False)) if len(could_be) >= len(names) else {}

    def table(self, places: Mapping[str, str], unit: float) -> dict[str, Any]:
        """`slave`, with the registers."""
        slaves: dict[str, dict[str, Any]] = {}
        for name, place in places.items():
            number, register = self._places[place]
            table = slaves.setdefault(f"slave_{number}", {"id": number, "register": {}})
            keys = register.model_dump(include={"address", "function", "type"}) | {"scale": unit}
            table["register"][name] = keys | ({"word_order": "low"} if register.word_order == "low" else {})
        return {"slave": slaves}

    def _whatever_the_number(self) -> bool:
        """Does a device on TCP ignore the slave's number? Many do: the connection leads to only one."""
        tcp, last = self._options.tcp, self._numbers[-3:]
        return tcp is not None and not tcp.rtu and len(last) == 3 and all(self._is_there(n) for n in last)

    def _is_there(self, number: int) -> bool:
        if number in self.slaves:
            return True
        for _ in range(TRIES):
            answer = self._ask(ModbusRequest(number, INPUT, 0, 1), TIMEOUT_NS)
            if answer is not None and answer.error == FAILED:
                answer = self._ask(ModbusRequest(number, HOLDING, 0, 1), TIMEOUT_NS)
            if answer is not None:
                return answer.error not in (FAILED, NO_WAY, NO_ANSWER)
        return number in self.slaves

    def _look_at(self, number: int) -> Iterator[None]:
        """Read the slave's registers; one step a request."""
        for function in NAMES:
            todo = [ModbusRequest(number, function, first, BLOCK) for first in range(0, REGISTERS, BLOCK)]
            end_ns = self._clock.now_ns() + SLAVE_NS
            while todo and self._clock.now_ns() < end_ns:
                request = todo.pop(0)
                answer = self._ask(request, PATIENT_NS)
                if answer is None:  # a busy line loses a request at times
                    self._let_pass()
                    answer = self._ask(request, 3 * PATIENT_NS)
                if answer is None or answer.error == UNKNOWN_FUNCTION:
                    break
                if not answer.error:
                    self._blocks.append(request)
                    self._take(request, answer)
                elif request.count > 1:
                    half = request.count // 2
                    halves = (request.address, half), (request.address + half, request.count - half)
                    todo[:0] = [ModbusRequest(number, function, first, count) for first, count in halves]
                yield
            self._name(number, function)

    def _name(self, slave: int, function: int) -> None:
        """Name the place of each number: pairs of registers that may be a room's temperature as a float; integers."""
        there = {a: word for (s, f, a), word in sorted(self._words.items()) if (s, f) == (slave, function)}
        floats = dict(float_pairs(there))
        within = {a + 1 for a in floats}
        for address in (a for a in there if a not in within):
            order = floats.get(address)
            keys = {"type": "float32", "word_order": order} if order else {"type": "int16"}
            register = Register.model_validate({"address": address, "function": NAMES[function], **keys})
            kind = {"high": "float", "low": "float, low word first"}.get(order or "", "")
            words = f"registers {address} and {address + 1} ({kind})" if order else f"register {address}"
            self._places[f"slave {slave}, {NAMES[function]} {words}"] = (slave, register)

    def _number(self, slave: int, register: Register) -> float:
        function = next(code for code, name in NAMES.items() if name == register.function)
        return register.number(self._words[slave, function, register.address + k] for k in range(register.words))

    def _take(self, request: ModbusRequest, answer: ModbusAnswer | None) -> None:
        for k, word in enumerate(answer.registers if answer is not None else ()):
            self._words[request.slave, request.function, request.address + k] = word

    def _ask(self, request: ModbusRequest, timeout_ns: int) -> ModbusAnswer | None:
        if self._line is None:
            return None
        answer, data = self._exchange.ask(self._line, request, self._clock.now_ns() + timeout_ns)
        if not self._exchange.numbered:
            late = {slave for slave, _ in frames_of_slaves(data)} & set(self._numbers)
            self.slaves += sorted(late - {*self.slaves, request.slave})
        return answer

    def _let_pass(self) -> None:
        """Drop what comes until the line is quiet: RTU answers have no number, a late one would pass for another."""
        while self._line is not None and not self._exchange.numbered:
            if not self._line.receive(self._clock.now_ns() + PATIENT_NS):
                return

    def _about(self, number: int) -> str:
        kinds = [(NAMES[f], sum((s, g) == (number, f) for s, g, _ in self._words)) for f in NAMES]
        what = " and ".join(f"{counted(count, f'{name} register')}" for name, count in kinds if count)
        return f"slave {number} answers: {what or f'no registers below {REGISTERS}'}"


def float_pairs(words: Mapping[int, int]) -> Iterator[tuple[int, str]]:
    """First address and word order of registers that may be a room's temperature as a float.

    The high word alone shows that. The data do not show its low word; numbers of two registers are taken to begin at
    even addresses.
    """
    for address, word in words.items():
        first = address - address % 2
        if first in words and first + 1 in words and room_high_word(word):
            yield first, "high" if address == first else "low"


class SlaveOptions(Strict):
    """One slave on the line.

    Attributes:
        id: number of the slave.
        profile: name of a shipped register map.
        channels: channel of the profile by sensor.
        register: registers by sensor, for a module without a profile, or in addition to it.
        period_s: period of asking it.
        timeout_s: longest wait for its answer.
        late_s: time after an unanswered request within which the answer may still come.
        max_gap: unused registers that may be read, too, so that one request fetches more.
    """

    id: Annotated[int, Field(ge=1, le=247)]
    profile: str | None = None
    channels: dict[str, str] = Field(default_factory=dict)
    register_: dict[str, Register] = Field(default_factory=dict, alias="register")
    period_s: Annotated[float, Field(ge=0.01, le=3600)] = 1.0
    timeout_s: Annotated[float, Field(ge=0.005, le=10)] = 0.3
    late_s: Annotated[float, Field(ge=0.0, le=10)] = 1.0
    max_gap: Annotated[int, Field(ge=0, le=120)] = 0

    @model_validator(mode="after")
    def _reads_something(self) -> Self:
        if bool(self.profile) != bool(self.channels):
            raise ValueError("profile and channels go together")
        if not self.channels and not self.register_:
            raise ValueError("nothing is read: give profile and channels, or register")
        if self.channels.keys() & self.register_.keys():
            raise ValueError("the same sensor is in channels and in register")
        return self


class ModbusOptions(ModbusLineOptions):
    """Options of a Modbus line.

    Attributes:
        slave: the slaves by a name of your choice.
    """

    slave: Annotated[dict[str, SlaveOptions], Field(min_length=1)]


class ModbusDriver:
    """Temperatures from Modbus modules on a serial line or over TCP, several on one line.

    Polls in a thread of its own and gives the newest valid values. A lost line is reopened, with growing waits; silent
    slaves are reported, and slow no other. Nothing that the loop calls waits for the line.

    Args:
        options: options of the run file.
        machine: machine with the sensors of the arrays.
        clock: clock of instants and deadlines.
        base: not used.

    Attributes:
        poller: poller of the open line, with its figures.

    Raises:
        ConfigError: sensors, profiles or channels that do not exist; all of them.
        DriverUnavailable: voltages need a package that is not installed.
    """

    options_model = ModbusOptions
    EXAMPLE = """\
[device.thermocouples]
driver = "modbus"
serial = { port = "/dev/serial/by-id/usb-FTDI_USB-RS485_Cable_FT0ABCDE-if00-port0", baud = 19200, parity = "even" }
# or: tcp = { host = "192.168.1.50" }

# A module with a shipped register map: which of the machine's sensors is on which terminal.
[device.thermocouples.slave.bed]
id = 1
profile = "isma-sfar-s-6ti"
channels = { T_bed = "1", T_column = "2" }

# A module of your own: addresses as they go over the line, from 0.
[device.thermocouples.slave.spindle]
id = 2
period_s = 0.5
timeout_s = 0.1

[device.thermocouples.slave.spindle.register.T_spindle]
address = 0
function = "input"
type = "int16"
scale = 0.1
open_codes = [32767, -32768]
"""

    @classmethod
    def scanner(cls, table: Mapping[str, Any], clock: Clock) -> Scanner:
        """A scanner that lists the slaves that answer, and their registers."""
        way = {key: table[key] for key in ("serial", "tcp") if key in table}
        return ModbusScanner(validated(ModbusLineOptions, way, "modbus"), clock)

    def __init__(self, options: ModbusOptions, machine: Machine, clock: Clock, base: Path = Path()) -> None:
        del base
        self._options, self._clock = options, clock
        maps = _register_maps(options)
        self._readings = TemperatureReadings(machine.sensor_names, {n: r for m in maps.values() for n, r in m.items()})
        self._maps = maps
        self._connect, self._retry = way_of(options.serial, options.tcp, clock)
        self._worker: Worker[ByteLine] | None = None
        self._slaves: list[Slave] = []
        self.poller: Poller | None = None

    def __enter__(self) -> Self:
        """Open the line and start polling.

        Raises:
            DriverUnavailable: it cannot be opened, and the options have `at_start = "required"`.
        """
        line = None
        try:
            line = self._connect()
        except DriverUnavailable as e:
            if self._retry.at_start == "required":
                raise
            self._tell(str(e))
        self._slaves = [self._slave(name, table) for name, table in self._options.slave.items()]
        self._worker = Worker("rtec-modbus", self._clock, self._connect, self._serve, self._tell, self._backoff())
        self._worker.start(line)
        return self

    def __exit__(self, *error: object) -> None:
        """Stop polling and close the line."""
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.stop()

    def read_temperatures(self, degc: Floats, time_ns: Ints) -> None:
        """Fill in the newest valid values, °C, and the instants of their requests, ns; then raise the faults.

        Raises:
            DriverFault: some sensors have no valid new value; all others are filled in.
            DriverUnavailable: not entered.
        """
        if self._worker is None:
            raise DriverUnavailable("modbus: not entered, so nothing is read")
        self._readings.fill(degc, time_ns)
        self._readings.tell()

    @property
    def attempts(self) -> int:
        """Number of attempts to open the line in the background."""
        return self._worker.attempts if self._worker is not None else 0

    def faults(self) -> list[str]:
        """Present faults, one line a sensor."""
        return self._readings.faults()

    def _backoff(self) -> Backoff:
        return Backoff(self._retry.first_retry_s, self._retry.longest_retry_s)

    def _serve(self, line: ByteLine) -> None:
        worker = self._worker
        if worker is not None:
            self.poller = Poller(
                self._slaves, self._readings, self._clock, self._options.exchange(self._clock, worker.wait_until_ns)
            )
            self.poller.serve(line, worker)

    def _slave(self, name: str, table: SlaveOptions) -> Slave:
        tcp = self._options.tcp
        numbered = tcp is not None and not tcp.rtu  # then the number distinguishes a late answer from a new one
        late_s = 0.0 if numbered else max(table.late_s, table.timeout_s)
        return Slave(
            name,
            table.id,
            blocks_of(table.id, self._maps[name], table.max_gap),
            round(table.period_s * NS),
            round(table.timeout_s * NS),
            round(late_s * NS),
            self._backoff(),
        )

    def _tell(self, why: str) -> None:
        if why:
            self._readings.silent([n for m in self._maps.values() for n in m], why)


def _register_maps(options: ModbusOptions) -> dict[str, Mapping[str, Register]]:
    out: dict[str, Mapping[str, Register]] = {}
    faults: list[str] = []
    slave_of: dict[str, str] = {}
    for name, table in options.slave.items():
        out[name] = {**_from_profile(name, table, faults), **table.register_}
        for sensor in out[name]:
            if sensor in slave_of:
                faults.append(f"sensor {sensor!r} is in slave {slave_of[sensor]!r} and in slave {name!r}")
            slave_of[sensor] = name
    numbers = [t.id for t in options.slave.values()]
    faults += [f"two slaves have id {n}" for n in sorted(set(numbers)) if numbers.count(n) > 1]
    if faults:
        raise ConfigError("\n".join(faults))
    return out


def _from_profile(name: str, table: SlaveOptions, faults: list[str]) -> dict[str, Register]:
    if table.profile is None:
        return {}
    try:
        profile = load_profile(table.profile)
    except ConfigError as e:
        faults.append(f"slave {name!r}: {e}")
        return {}
    faults += [
        f"slave {name!r}: profile {table.profile} has no channel {c!r}{nearest(c, profile.channel)}"
        for c in table.channels.values()
        if c not in profile.channel
    ]
    return {s: profile.channel[c] for s, c in table.channels.items() if c in profile.channel}
