"""The faults that the bench can make happen, by name; what each does stands in `injector`."""

from dataclasses import dataclass
from typing import Literal

Bus = Literal["box", "modbus", "can"]
BUS_OF_DRIVER: dict[str, Bus] = {"serial_box": "box", "modbus": "modbus", "can": "can"}


@dataclass(frozen=True)
class Fault:
    """One fault.

    Attributes:
        bus: whose.
        what: it, in words.
        needs_order: when it is over the operator must order to resume.
    """

    bus: Bus
    what: str
    needs_order: bool = False


FAULTS: dict[str, Fault] = {
    "box-unplugged": Fault("box", "the box's cable is pulled, whatever is on the line, and put back: another port"),
    "box-silent": Fault("box", "the box does not answer"),
    "box-garbage": Fault("box", "garbage before every answer and between them"),
    "box-crc": Fault("box", "one answer in a hundred arrives with a wrong bit"),
    "box-half-frames": Fault("box", "one answer in ten ends in its middle"),
    "box-late": Fault("box", "every answer comes 3 ms late, so it belongs to an older question"),
    "box-frozen": Fault("box", "the box answers, always with the same instant and counts"),
    "box-reset": Fault("box", "the box restarts: its ledger is zero; ordered to resume at the end", True),
    "box-count-jump": Fault("box", "the counters jump by 10 mm; at the end they are right, ordered to resume", True),
    "box-encoder-fault": Fault("box", "a line of an encoder is broken; ordered to resume at the end", True),
    "modbus-unplugged": Fault("modbus", "the line's cable is pulled and put back: another port"),
    "modbus-silent": Fault("modbus", "the first slave does not answer; the others do"),
    "modbus-garbage": Fault("modbus", "garbage before every answer and between them"),
    "modbus-crc": Fault("modbus", "one answer in a hundred arrives with a wrong bit"),
    "modbus-half-frames": Fault("modbus", "every third answer ends in its middle"),
    "modbus-late": Fault("modbus", "the first slave answers 700 ms late, so to an older request"),
    "modbus-wrong-node": Fault("modbus", "another slave answers in the place of the first"),
    "modbus-frozen": Fault("modbus", "the first slave's values stay as they are"),
    "modbus-open": Fault("modbus", "a thermocouple of the first slave is open"),
    "can-unplugged": Fault("can", "the adapter is pulled out and put back: another port"),
    "can-silent": Fault("can", "the sensors say nothing"),
    "can-garbage": Fault("can", "garbage before every frame and between them"),
    "can-lost-frames": Fault("can", "one frame in a hundred has a wrong CRC, so the adapter drops it"),
    "can-half-frames": Fault("can", "every third frame ends in its middle, between adapter and computer"),
    "can-late": Fault("can", "every frame comes 700 ms late"),
    "can-wrong-node": Fault("can", "the sensors send as another node"),
    "can-frozen": Fault("can", "the values stay as they are"),
    "can-open": Fault("can", "a thermocouple is open"),
    "can-bus-off": Fault("can", "the adapter has left the bus: no frames either way"),
}
