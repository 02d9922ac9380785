"""Numbers of a sensor: lines over sockets and serial ports, registers."""

import contextlib
import os
import socket
import struct
import time
import tty

import numpy as np
import pytest
from harness import measured_text

from rig.config import ConfigError, parse_config
from rig.readings import make_source
from rig.readings.source import ReadingError
from rig_workbench.simulator.faults import FaultInjector
from rig_workbench.simulator.server import ModbusServer

AXES = {"x": "translation", "y": "translation"}
LINES = b"torn,9,9\r\n 7,1.5,-2e1\r\n7,nan,1\r\n7,1.5\n\n7,1.0,-20.0\r\n7,1,2"


def config(transport, *more):
    lines = "".join(f"{line}\n" for line in more)
    text = measured_text(AXES, transport).replace("scale =", f"{lines}scale =", 1)
    return parse_config(text)


def read(source, value):
    """Wait for a reading of the value."""
    end = time.monotonic() + 3
    while True:
        with contextlib.suppress(ReadingError):
            if np.allclose(source.latest().value, value):
                return
        assert time.monotonic() < end, (source.counts, source._ring)
        time.sleep(0.005)


@pytest.mark.parametrize("transport", ["tcp", "listen", "udp", "serial"])
def test_whole_lines_are_readings_and_others_are_counted(transport):
    more = ["columns = [1, 2]", "factors = [1.0, 0.1]"]
    with contextlib.ExitStack() as stack:
        if transport == "tcp":
            server = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
            more.append(f"port = {server.getsockname()[1]}")
        elif transport == "serial":
            master, slave = os.openpty()
            for fd in (master, slave):
                tty.setraw(fd)
                stack.callback(os.close, fd)
            more.append(f'device = "{os.ttyname(slave)}"')
        else:
            more.append("port = 0")
        source = stack.enter_context(make_source(config(transport, *more)))
        if transport == "serial":
            time.sleep(0.1)
            os.write(master, LINES)
        elif transport == "tcp":
            stack.enter_context(server.accept()[0]).sendall(LINES)
        elif transport == "listen":
            at = ("127.0.0.1", source.port)
            stack.enter_context(socket.create_connection(at)).sendall(LINES)
        else:
            sender = stack.enter_context(socket.socket(type=socket.SOCK_DGRAM))
            whole = LINES[LINES.index(b" 7") : LINES.rindex(b"7,1,2")]
            sender.sendto(whole, ("127.0.0.1", source.port))
        read(source, [1.0, -2.0])
        counts = source.counts
        assert counts["not numbers"] == 1 and counts["too short"] == 1
        assert counts["accepted"] == 2


def test_registers_of_a_modbus_device_are_readings():
    class Encoder:
        map = None

        def read(self, address, count):
            words = struct.unpack(">4H", struct.pack(">ii", -70001, 12345))
            return list(words[address : address + count])

    server = ModbusServer({3: Encoder()}, FaultInjector(), 0, 0.0)
    port = server.serve_tcp()
    try:
        given = config(
            "modbus", f"port = {port}", "factors = [0.001, 0.01]",
            "registers = [{unit = 3, address = 0}, {unit = 3, address = 2}]",
        )  # fmt: skip
        with make_source(given) as source:
            read(source, [-70.001, 123.45])
            assert source.counts["accepted"] >= 1
    finally:
        server.close()


def test_one_sender_is_heard_and_a_silent_one_is_stale():
    with make_source(config("udp", "port = 0", "most_jump = 5.0")) as source:
        with pytest.raises(ReadingError, match="has sent no reading yet"):
            source.latest()
        at = ("127.0.0.1", source.port)
        with (
            socket.socket(type=socket.SOCK_DGRAM) as first,
            socket.socket(type=socket.SOCK_DGRAM) as other,
        ):
            other.bind(("127.0.0.2", 0))
            first.sendto(b"1,2", at)
            read(source, [1, 2])
            other.sendto(b"1,3", at)
            first.sendto(b"90,2", at)
            first.sendto(b"2,2", at)
            read(source, [2, 2])
        assert source.refused == ["127.0.0.2"]
        assert source.counts["an impossible jump"] == 1
        source.stale_s = 0.01
        time.sleep(0.02)
        with pytest.raises(ReadingError, match=r"the sensor's last reading is .* old"):
            source.latest()


@pytest.mark.parametrize(
    "old, new, told",
    [
        ("names = ['x', 'y']", "names = ['x', 'x']", "readings.names: must differ"),
        ('"tcp"\nscale', '"serial"\nscale', "readings.device: missing"),
        ('"tcp"\nscale', '"modbus"\nscale', "readings.registers: must be 2"),
        ("[readings]", '[imu]\nformat = "hyperimu"\nport = 1\n[readings]', "either"),
    ],
)
def test_wrong_readings_are_refused(old, new, told):
    with pytest.raises(ConfigError, match=told):
        parse_config(measured_text(AXES).replace(old, new, 1))


def test_a_sensor_that_waits_for_a_request_is_asked_for_each_line():
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        given = config("tcp", f"port = {port}", r'request = "?\\r"')
        with make_source(given) as source:
            connection, _ = server.accept()
            with connection:
                for value in (1.0, 2.0):
                    while b"?\r" not in connection.recv(64):
                        pass
                    connection.sendall(b"%g,3\r\n" % value)
                    read(source, [value, 3.0])
        assert source.counts == {"accepted": 2}
