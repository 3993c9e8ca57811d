"""The Modbus driver keeps the laws that every driver keeps. Oracle: the contract in `rtec/loop/ports.py`."""

from collections.abc import Iterator

import pytest

from rtec_drivers.modbus.driver import ModbusDriver
from tests.support.conformance import DriverLaws, Rig
from tests.support.modbus_peer import FakeSlave, line, serial, slave_table


class TestModbus(DriverLaws):
    @pytest.fixture
    def rig(self) -> Iterator[Rig]:
        with line({1: FakeSlave(value=lambda k: 200 + k % 9)}) as fake:
            yield Rig(
                ModbusDriver,
                {"serial": serial(fake.port), "slave": {"bed": slave_table(1, "T_headstock")}},
                misspelt="slav",
                nearest="slave",
                sensors=["T_headstock"],
                missing={"serial": serial("/dev/rtec-no-such-port")},
            )
