"""Causes the faults of the catalogue, at their instants, at the far sides of one process."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from rtec.loop.clock import Clock
from rtec_drivers.box.gateware import GatewareBox
from rtec_drivers.box.simulator import BoxSimulator
from rtec_drivers.hil.bus_devices import SlaveLine, SlcanSimulator
from rtec_drivers.hil.plant import MachinePlant
from rtec_drivers.pty_peer import PtyPeer

GARBAGE = bytes((0x55, 0x00, 0xFF, 0x13, 0x0D, 0x80, 0x2A))
JUMP_MM = 10.0
LATE_BOX_NS, LATE_NS = 3_000_000, 700_000_000
Box = BoxSimulator | GatewareBox
Switch = Callable[[bool], None]
"""Switches a fault on, or off."""


@dataclass(frozen=True)
class FaultSwitch:
    """Begin or end of a fault."""

    at_ns: int
    name: str
    begins: bool


class Injector:
    """Switches faults on and off at their instants, in a thread of its own.

    Args:
        switches: switches by fault.
        clock: clock of the instants.
    """

    def __init__(self, switches: dict[str, Switch], clock: Clock) -> None:
        self._switches, self._clock = switches, clock
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self, start_ns: int, faults: Sequence[tuple[str, float, float]]) -> None:
        """Begin; faults are name, begin and end, s after `start_ns`. Faults of other processes are ignored."""
        events = [
            FaultSwitch(start_ns + round(at_s * 1e9), name, begins)
            for name, begin_s, end_s in faults
            if name in self._switches
            for at_s, begins in ((begin_s, True), (end_s, False))
        ]
        events.sort(key=lambda e: (e.at_ns, e.begins))
        self._thread = threading.Thread(target=self._run, args=(events,), name="rtec-hil-faults", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Switch no more faults."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()

    def _run(self, events: list[FaultSwitch]) -> None:
        for event in events:
            if self._stop.wait(max(0.0, (event.at_ns - self._clock.now_ns()) * 1e-9)):
                return
            self._switches[event.name](event.begins)


def box_switches(peer: PtyPeer, box: Box, plant: MachinePlant, counts_per_mm: float) -> dict[str, Switch]:
    """The faults of an encoder box."""

    def reset(on: bool) -> None:
        if on:
            box.reset()

    return {
        "box-unplugged": _cable([peer]),
        "box-silent": _locked(peer, lambda on: setattr(peer.faults, "silent", on)),
        "box-garbage": _locked(peer, lambda on: setattr(peer.faults, "babble", GARBAGE if on else b"")),
        "box-crc": _locked(peer, lambda on: setattr(peer.faults, "flip_rate", 0.01 if on else 0.0)),
        "box-half-frames": _locked(peer, lambda on: setattr(peer.faults, "cut_every", 10 if on else 0)),
        "box-late": _locked(peer, lambda on: setattr(peer.faults, "late_ns", LATE_BOX_NS if on else 0)),
        "box-frozen": _locked(peer, lambda on: setattr(box, "frozen", on)),
        "box-reset": _locked(peer, reset),
        "box-count-jump": _locked(
            peer, lambda on: setattr(plant, "jump_counts", round(JUMP_MM * counts_per_mm) if on else 0)
        ),
        "box-encoder-fault": _locked(peer, lambda on: setattr(box, "encoder_fault", on)),
    }


def modbus_switches(peers: Sequence[PtyPeer], lines: Sequence[SlaveLine]) -> dict[str, Switch]:
    """The faults of Modbus lines; a fault of a slave is one of the first slave of each line."""
    firsts = [line.slaves[0] for line in lines]

    def wires(name: str, bad: object, good: object) -> Switch:
        return _each(peers, lambda peer, on: setattr(peer.faults, name, bad if on else good))

    def slaves(change: Callable[[int, bool], None]) -> Switch:
        def switch(on: bool) -> None:
            for k, peer in enumerate(peers):
                with peer.lock:
                    change(k, on)

        return switch

    return {
        "modbus-unplugged": _cable(peers),
        "modbus-garbage": wires("babble", GARBAGE, b""),
        "modbus-crc": wires("flip_rate", 0.01, 0.0),
        "modbus-half-frames": wires("cut_every", 3, 0),
        "modbus-silent": slaves(lambda k, on: setattr(firsts[k], "silent", on)),
        "modbus-late": slaves(lambda k, on: setattr(firsts[k], "late_ns", LATE_NS if on else 0)),
        "modbus-wrong-node": slaves(
            lambda k, on: setattr(firsts[k], "answers_as", firsts[k].number % 247 + 1 if on else firsts[k].number)
        ),
        "modbus-frozen": slaves(lambda k, on: setattr(firsts[k], "frozen", on)),
        "modbus-open": slaves(lambda k, on: setattr(firsts[k], "open", on)),
    }


def can_switches(peers: Sequence[PtyPeer], adapters: Sequence[SlcanSimulator]) -> dict[str, Switch]:
    """The faults of CAN adapters and of the sensors behind them."""

    def wires(name: str, bad: object, good: object) -> Switch:
        return _each(peers, lambda peer, on: setattr(peer.faults, name, bad if on else good))

    def bus(name: str, bad: object, good: object) -> Switch:
        def switch(on: bool) -> None:
            for peer, adapter in zip(peers, adapters, strict=True):
                with peer.lock:
                    setattr(adapter, name, bad if on else good)

        return switch

    def sensors(change: Callable[[SlcanSimulator, bool], None]) -> Switch:
        def switch(on: bool) -> None:
            for peer, adapter in zip(peers, adapters, strict=True):
                with peer.lock:
                    change(adapter, on)

        return switch

    return {
        "can-unplugged": _cable(peers),
        "can-garbage": wires("babble", GARBAGE, b""),
        "can-half-frames": wires("cut_every", 3, 0),
        "can-late": wires("late_ns", LATE_NS, 0),
        "can-silent": bus("silent", True, False),
        "can-bus-off": bus("bus_off", True, False),
        "can-wrong-node": bus("wrong_node", True, False),
        "can-lost-frames": bus("lose_every", 100, 0),
        "can-frozen": sensors(_freeze),
        "can-open": sensors(_open),
    }


def _freeze(adapter: SlcanSimulator, on: bool) -> None:
    for number in (n for frame in adapter.frames for n in frame.numbers.values()):
        number.frozen = number.raw() if on else None


def _open(adapter: SlcanSimulator, on: bool) -> None:
    first = next(n for frame in adapter.frames for n in frame.numbers.values() if n.open_code is not None)
    first.open = on


def _cable(peers: Sequence[PtyPeer]) -> Switch:
    def switch(on: bool) -> None:
        for peer in peers:
            if on:
                peer.pull()
            else:
                peer.plug()

    return switch


def _locked(peer: PtyPeer, change: Switch) -> Switch:
    def switch(on: bool) -> None:
        with peer.lock:
            change(on)

    return switch


def _each(peers: Sequence[PtyPeer], change: Callable[[PtyPeer, bool], None]) -> Switch:
    def switch(on: bool) -> None:
        for peer in peers:
            with peer.lock:
                change(peer, on)

    return switch
