"""The Modbus driver against parts that nobody here wrote: a server on libmodbus (C), and pymodbus' own server."""

import asyncio
import os
import select
import shutil
import socket
import subprocess
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymodbus.server import ModbusSerialServer, ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from rtec.errors import DriverUnavailable
from tests.support.modbus_peer import CLOCK, MS, Seen, driver, until

SOURCE = Path(__file__).parents[1] / "support" / "modbus_slave.c"
FLOAT = {"address": 100, "type": "float32"}


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The slave in C, compiled."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler (Debian: gcc libc6-dev)")
    out = tmp_path_factory.mktemp("libmodbus") / "modbus_slave"
    built = subprocess.run(
        [compiler, "-Wall", "-Werror", "-o", str(out), str(SOURCE), "-lmodbus"],
        capture_output=True,
        text=True,
        check=False,
    )
    if "modbus/modbus.h" in built.stderr and "No such file" in built.stderr:
        pytest.skip("libmodbus is not installed (Debian: libmodbus-dev)")
    assert built.returncode == 0, built.stderr
    return out


@contextmanager
def running(*command: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """The slave, and the first line that it prints."""
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            yield process, process.stdout.readline().strip()
        finally:
            process.kill()


def tables(slave: int = 1) -> dict[str, Any]:
    registers = {
        "T_bed": {"address": 5, "scale": 0.1},
        "T_air": {"address": 7, "scale": 0.1, "function": "input"},
        "T_column": FLOAT,
        "T_spindle": {"address": 10, "range_degc": [-1, 70000], "type": "uint16"},
    }
    return {"m": {"id": slave, "period_s": 0.05, "timeout_s": 0.2, "late_s": 0.2, "register": registers}}


def tcp(port: int) -> dict[str, Any]:
    return {"host": "127.0.0.1", "port": port, "first_retry_s": 0.02, "longest_retry_s": 0.1}


def check(seen: Seen) -> None:
    """Oracle: what the C program says it holds."""
    assert until(lambda: seen["T_bed"] == 20.5 and abs(seen["T_air"] - 20.7) < 1e-9)
    assert abs(seen["T_column"] - 36.6) < 1e-5
    counted = seen["T_spindle"]
    assert until(lambda: seen["T_spindle"] > counted)


def test_libmodbus_over_tcp_and_back_after_its_death(program: Path) -> None:
    """Oracle: the values; the second server is another process on the same port."""
    with running(str(program), "tcp", "15020") as (process, line):
        port = int(line.split()[1])
        with driver(tcp=tcp(port), slave=tables(255 - 8)) as device:
            seen = Seen(device)
            check(seen)
            assert device.faults() == []
            process.kill()
            process.wait()
            assert until(lambda: any("no connection" in f or "closed" in f or "lost" in f for f in device.faults()))
            assert seen["T_bed"] == 20.5
            with running(str(program), "tcp", str(port)) as (_, again):
                assert again == f"PORT {port}"
                stamp = int(seen.time_ns[0])
                assert until(lambda: seen["T_bed"] == 20.5 and int(seen.time_ns[0]) > stamp and device.faults() == [])


def test_libmodbus_refuses_what_it_does_not_have(program: Path) -> None:
    """Oracle: its registers end at 127; the other slave's reads go on."""
    with running(str(program), "tcp", "15120") as (_, line):
        table = tables() | {"far": {"id": 2, "period_s": 0.05, "register": {}}}
        table["far"]["register"] = {"T_column": {"address": 500}}
        del table["m"]["register"]["T_column"]
        with driver(tcp=tcp(int(line.split()[1])), slave=table) as device:
            seen = Seen(device)
            assert until(lambda: any("error 2: it has no such register" in f for f in device.faults()))
            assert until(lambda: seen["T_bed"] == 20.5)
            assert [f for f in device.faults() if "T_column" not in f] == []


@contextmanager
def pty_pair() -> Iterator[tuple[str, str]]:
    """Two ptys joined by a thread: what goes into one comes out of the other."""
    masters, ports, keep = [], [], []
    for _ in range(2):
        master, slave = os.openpty()
        tty.setraw(slave)
        masters.append(master)
        keep.append(slave)
        ports.append(os.ttyname(slave))
    wake, waker = os.pipe()

    def carry() -> None:
        while True:
            ready, _, _ = select.select([*masters, wake], [], [])
            if wake in ready:
                return
            for fd in ready:
                os.write(masters[1 - masters.index(fd)], os.read(fd, 4096))

    thread = threading.Thread(target=carry, daemon=True)
    thread.start()
    try:
        yield ports[0], ports[1]
    finally:
        os.write(waker, b"x")
        thread.join()
        for fd in (*masters, *keep, wake, waker):
            os.close(fd)


def test_libmodbus_over_a_serial_line(program: Path) -> None:
    """Oracle: the values; a slave with another number is silent and told.

    libmodbus drops the request that follows one to an absent slave (it takes it for that slave's answer), so each
    attempt on the absent one costs a reading of the present one, and the attempts must become rare.
    """
    with pty_pair() as (ours, theirs), running(str(program), "rtu", theirs, "17") as (_, line):
        assert line == "READY"
        table = tables(17)
        table["m"]["register"] = {n: r for n, r in table["m"]["register"].items() if n != "T_air"}
        table["absent"] = {"id": 18, "period_s": 0.5, "timeout_s": 0.1, "register": {"T_air": {"address": 0}}}
        port = {"port": ours, "baud": 19200}
        with driver(serial=port, slave=table) as device:
            seen = Seen(device)
            assert until(lambda: seen["T_bed"] == 20.5 and abs(seen["T_column"] - 36.6) < 1e-5)
            assert until(lambda: any("slave 18 (absent): no answer" in f for f in device.faults()))
            stamp = int(seen.time_ns[0])
            assert until(lambda: seen["T_bed"] == 20.5 and int(seen.time_ns[0]) > stamp + 200 * MS)


class OtherServer:
    """pymodbus' own server with its simulated devices, in a thread: on a serial port, or else over TCP."""

    def __init__(self, devices: list[SimDevice], serial_port: str = "") -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = int(free.getsockname()[1])
        self._devices, self._serial_port = devices, serial_port
        self._loop, self._ready = asyncio.new_event_loop(), threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        assert self._ready.wait(5.0)

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        self._loop.run_until_complete(self._serve())
        self._loop.close()

    async def _serve(self) -> None:
        self._server: ModbusTcpServer | ModbusSerialServer = (
            ModbusSerialServer(self._devices, port=self._serial_port, baudrate=19200, ignore_missing_devices=True)
            if self._serial_port
            else ModbusTcpServer(self._devices, address=("127.0.0.1", self.port))
        )
        await self._server.listen()
        self._ready.set()
        await self._server.serving

    async def _stop(self) -> None:
        await self._server.shutdown()  # type: ignore[no-untyped-call]

    def close(self) -> None:
        asyncio.run_coroutine_threadsafe(self._stop(), self._loop).result(5.0)
        self._thread.join(5.0)


@contextmanager
def other_server(devices: list[SimDevice], serial_port: str) -> Iterator[OtherServer]:
    """It, closed at the end."""
    server = OtherServer(devices, serial_port)
    try:
        yield server
    finally:
        server.close()


@pytest.mark.parametrize("serial", [False, True], ids=["tcp", "rtu"])
def test_pymodbus_simulator_with_several_slaves_and_number_types(serial: bool) -> None:
    """Oracle: pymodbus packs the numbers into its registers."""
    first = SimDevice(
        id=1,
        simdata=[
            SimData(0, values=[215, 65136], datatype=DataType.REGISTERS),
            SimData(10, values=-1234, datatype=DataType.INT32),
            SimData(20, values=36.625, datatype=DataType.FLOAT32),
        ],
    )
    second = SimDevice(id=2, simdata=[SimData(0, values=41.25, datatype=DataType.FLOAT64)])
    registers = {
        "T_bed": {"address": 1, "scale": 0.1, "range_degc": [-50, 100]},
        "T_spindle": {"address": 10, "type": "int32", "scale": 0.01},
        "T_column": {"address": 20, "type": "float32"},
    }
    slaves = {
        "one": {"id": 1, "period_s": 0.05, "register": registers},
        "two": {"id": 2, "period_s": 0.05, "register": {"T_air": {"address": 0, "type": "float64"}}},
    }
    with (
        pty_pair() as (ours, theirs),
        other_server([first, second], theirs if serial else "") as server,
    ):
        line = {"serial": {"port": ours, "baud": 19200}} if serial else {"tcp": tcp(server.port)}
        with driver(**line, slave=slaves) as device:
            seen = Seen(device)
            assert until(lambda: not any(np.isnan(seen[s]) for s in ("T_bed", "T_spindle", "T_column", "T_air")))
            assert abs(seen["T_bed"] + 40.0) < 1e-9
            assert abs(seen["T_spindle"] + 12.34) < 1e-9
            assert (seen["T_column"], seen["T_air"]) == (36.625, 41.25)


def test_a_late_tcp_answer_is_told_from_a_new_one_by_its_number() -> None:
    """Oracle: the server numbers the requests; every answer comes after the deadline until it hurries."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        delay_ms, asked_ns = [150.0], [0]
        stop = threading.Event()

        def serve() -> None:
            connection, _ = listener.accept()
            with connection:
                pending: list[tuple[int, bytes]] = []
                while not stop.is_set():
                    if select.select([connection], [], [], 0.005)[0]:
                        request = connection.recv(12)
                        if len(request) < 12:
                            return
                        asked_ns.append(CLOCK.now_ns())
                        value = (len(asked_ns) - 1).to_bytes(2, "big")
                        answer = request[:4] + b"\x00\x05" + request[6:8] + b"\x02" + value
                        pending.append((CLOCK.now_ns() + round(delay_ms[0] * MS), answer))
                    for item in [p for p in pending if p[0] <= CLOCK.now_ns()]:
                        pending.remove(item)
                        connection.sendall(item[1])

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        slave = {"id": 1, "period_s": 0.02, "timeout_s": 0.1, "register": {"T_bed": {"address": 0}}}
        slow = tcp(listener.getsockname()[1])
        try:
            with driver(tcp=slow, slave={"a": slave}) as d:
                seen = Seen(d)
                assert until(lambda: len(asked_ns) >= 3)
                assert np.isnan(seen["T_bed"])
                assert until(lambda: any("answers only earlier requests" in f for f in d.faults()))
                delay_ms[0] = 0.0
                assert until(lambda: seen["T_bed"] > 0)
                ways_ns = []
                for _ in range(21):
                    k, stamp_ns = round(seen["T_bed"]), int(seen.time_ns[0])
                    ways_ns.append(asked_ns[k] - stamp_ns)
                    CLOCK.sleep_until_ns(CLOCK.now_ns() + 10 * MS)
                assert min(ways_ns) >= 0  # no answer is older than its stamp
                assert sorted(ways_ns)[10] < 30 * MS  # nor younger by a request
        finally:
            stop.set()
            thread.join()


@pytest.mark.parametrize(
    ("answer", "why"),
    [
        (lambda q: b"\x00\x05" + b"\x09" + q[7:8] + b"\x02\x00\xc8", "unit 9 answered instead; a wrong id"),
        (lambda q: b"\x00\x03" + q[6:8] + b"\x00", "it answers with 2 bytes, 4 are right: another register map?"),
        (lambda q: b"\x00\x05" + q[6:7] + b"\x04\x02\x00\xc8", "it answers with function code 4, but 3 was asked"),
        (lambda q: b"\x00\x03" + q[6:7] + b"\x83\x06", "holding register 0: error 6: it is busy"),
        (lambda q: b"\x00\x03" + q[6:7] + b"\x83\x0a", "the gateway is there, but has no way to this unit; look at id"),
        (lambda q: b"\x00\x03" + q[6:7] + b"\x83\x0b", "the gateway is there, but the unit behind it does not answer"),
    ],
    ids=["unit", "length", "function", "busy", "no way", "no answer"],
)
def test_an_answer_over_tcp_that_is_not_the_one_is_told(answer: Callable[[bytes], bytes], why: str) -> None:
    """Oracle: MODBUS Messaging on TCP/IP 1.0b, 3.1.3: transaction, protocol, length, unit, function, data.

    Whatever the answer, it shows that the connection is good: after several of them it is still the first one.
    """
    requests = []
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            connection, _ = listener.accept()
            with connection, suppress(OSError):
                while len(request := connection.recv(12)) == 12:
                    requests.append(request)
                    connection.sendall(request[:4] + answer(request))

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        slave = {"id": 1, "period_s": 0.02, "timeout_s": 0.1, "register": {"T_bed": {"address": 0}}}
        with driver(tcp=tcp(listener.getsockname()[1]), slave={"a": slave}) as d:
            assert until(lambda: any(why in f for f in d.faults())), d.faults()
            assert until(lambda: len(requests) >= 6)
            assert d.attempts == 1
            assert not any("opening" in f for f in d.faults())
        thread.join()


def test_silence_on_an_open_connection_points_at_the_unit_id() -> None:
    """Oracle: a server that accepts, reads, and says nothing."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        why = "no answer, within 100 ms; the connection is open: look at id = 7"
        slave = {"id": 7, "period_s": 0.02, "timeout_s": 0.1, "register": {"T_bed": {"address": 0}}}
        with driver(tcp=tcp(listener.getsockname()[1]), slave={"a": slave}) as d:
            assert until(lambda: any(why in f for f in d.faults())), d.faults()


def test_what_is_no_modbus_is_told() -> None:
    """Oracle: an HTTP server's first words."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            connection, _ = listener.accept()
            with connection:
                connection.recv(12)
                connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")
                connection.recv(1)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        with driver(tcp=tcp(listener.getsockname()[1]), slave=tables()) as device:
            assert until(lambda: any("no Modbus TCP" in f for f in device.faults()))
        thread.join()
    with pytest.raises(DriverUnavailable, match="no connection"):
        driver(tcp=tcp(1), slave=tables()).__enter__()
