"""The faults that the bench can cause, by name; `injector` causes them."""

from dataclasses import dataclass
from typing import Literal

Bus = Literal["box", "modbus", "can"]
BUS_OF_DRIVER: dict[str, Bus] = {"serial_box": "box", "modbus": "modbus", "can": "can"}


@dataclass(frozen=True)
class BusFault:
    """One fault.

    Attributes:
        bus: bus that has the fault.
        what: description.
        needs_order: must the operator order to resume after it?
    """

    bus: Bus
    what: str
    needs_order: bool = False


FAULTS: dict[str, BusFault] = {
    "box-unplugged": BusFault("box", "the box's cable is pulled, whatever is on the line, and put back: another port"),
    "box-silent": BusFault("box", "the box does not answer"),
    "box-garbage": BusFault("box", "garbage before every answer and between them"),
    "box-crc": BusFault("box", "one answer in a hundred arrives with a wrong bit"),
    "box-half-frames": BusFault("box", "one answer in ten ends in its middle"),
    "box-late": BusFault("box", "every answer comes 3 ms late, so it belongs to an older question"),
    "box-frozen": BusFault("box", "the box answers, always with the same instant and counts"),
    "box-reset": BusFault("box", "the box restarts: its ledger is zero; ordered to resume at the end", True),
    "box-count-jump": BusFault("box", "the counters jump by 10 mm; at the end they are right, ordered to resume", True),
    "box-encoder-fault": BusFault("box", "a line of an encoder is broken; ordered to resume at the end", True),
    "modbus-unplugged": BusFault("modbus", "the line's cable is pulled and put back: another port"),
    "modbus-silent": BusFault("modbus", "the first slave does not answer; the others do"),
    "modbus-garbage": BusFault("modbus", "garbage before every answer and between them"),
    "modbus-crc": BusFault("modbus", "one answer in a hundred arrives with a wrong bit"),
    "modbus-half-frames": BusFault("modbus", "every third answer ends in its middle"),
    "modbus-late": BusFault("modbus", "the first slave answers 700 ms late, so to an older request"),
    "modbus-wrong-node": BusFault("modbus", "another slave answers in the place of the first"),
    "modbus-frozen": BusFault("modbus", "the first slave's values stay as they are"),
    "modbus-open": BusFault("modbus", "a thermocouple of the first slave is open"),
    "can-unplugged": BusFault("can", "the adapter is pulled out and put back: another port"),
    "can-silent": BusFault("can", "the sensors say nothing"),
    "can-garbage": BusFault("can", "garbage before every frame and between them"),
    "can-lost-frames": BusFault("can", "one frame in a hundred has a wrong CRC, so the adapter drops it"),
    "can-half-frames": BusFault("can", "every third frame ends in its middle, between adapter and computer"),
    "can-late": BusFault("can", "every frame comes 700 ms late"),
    "can-wrong-node": BusFault("can", "the sensors send as another node"),
    "can-frozen": BusFault("can", "the values stay as they are"),
    "can-open": BusFault("can", "a thermocouple is open"),
    "can-bus-off": BusFault("can", "the adapter has left the bus: no frames either way"),
}
