"""Against the least a stranger would build: a bare Modbus TCP slave, a bare phone.

The slave is a socket and a dictionary: functions 3, 6 and 16, one connection at a time,
an exception for every register it lacks, and a move that is over at once. The phone
has no noise, few readings a second, and angles as its app writes them.
"""

import contextlib
import json
import re
import socket
import struct
import threading
import time

import numpy as np
import pytest
from harness import commissioned, free_port, no_figures
from scipy.spatial.transform import Rotation

from rig.__main__ import main
from rig.config import load_config
from rig.readings.geometry import angle_between_deg, euler_to_matrix

MATRIX = np.array([[0.95, 0.03, -0.02], [0.01, 1.04, 0.02], [-0.015, 0.01, 0.9]])
PULSES_PER_DEG = 1000
CONFIG = """
[bus]
transport = "tcp"
host = "127.0.0.1"
port = {bus}
{axes}
[imu]
host = "127.0.0.1"
port = {imu}
{phone}
[session]
verify_postures = 2
{session}
"""
AXIS = """
[[axes]]
name = "{name}"
unit = {unit}
map = "generic"
pulses_per_rev = 36000
reduction = 10
min_deg = -20
max_deg = 20
speed_deg_s = 20
accel_deg_s2 = 100
"""
LINES = """
format = "lines"
order = "ZXY"
columns = [0, 1, 2]
"""
HYPERIMU = """
format = "hyperimu"
"""
SENSOR_LOGGER = """
format = "sensorlogger"
stale_s = 1.5
"""
QUICK = """
[settle]
window_s = 0.1
min_samples = 5
samples = 10
"""


class Slave:
    """Three units of the ``generic`` map (rig/maps/generic.toml, read by a person)."""

    def __init__(self):
        self.socket = socket.create_server(("127.0.0.1", 0))
        self.port = self.socket.getsockname()[1]
        mapped = [0x10, 0x12, 0x13, 0x14, *range(0x20, 0x29), 0x29, 0x2A, 0x2B]
        self.registers = {u: dict.fromkeys(mapped, 0) for u in (1, 2, 3)}
        for registers in self.registers.values():
            registers[0x10] = 0b1001  # enabled, done
        self.functions, self.moves, self.stops = set(), [], []
        self.ways = {}  # of units that move: from, to, when, pulses a second
        threading.Thread(target=self._serve, daemon=True).start()

    def advance(self, unit):
        """Where it is by now, on a straight way at the speed that it was told."""
        if unit not in self.ways:
            return
        begin, end, begun, speed = self.ways[unit]
        gone = min(speed * (time.monotonic() - begun), abs(end - begin))
        at = begin + round(gone if end > begin else -gone)
        registers = self.registers[unit]
        registers[0x12], registers[0x13] = struct.unpack(">HH", struct.pack(">i", at))
        registers[0x10] = 0b1001 if at == end else 0b0101
        if at == end:
            del self.ways[unit]

    def long(self, unit, address):
        high, low = (self.registers[unit][address + i] for i in (0, 1))
        return struct.unpack(">i", struct.pack(">HH", high, low))[0]

    def position(self, unit):
        self.advance(unit)
        words = struct.pack(">HH", *(self.registers[unit][a] for a in (0x12, 0x13)))
        return struct.unpack(">i", words)[0] / PULSES_PER_DEG

    def _serve(self):
        while True:
            try:
                connection, _ = self.socket.accept()
            except OSError:
                return
            with contextlib.suppress(OSError, EOFError), connection:
                while True:
                    head = self._take(connection, 7)
                    transaction, _, length, unit = struct.unpack(">HHHB", head)
                    pdu = self._answer(unit, self._take(connection, length - 1))
                    size = len(pdu) + 1
                    connection.sendall(
                        struct.pack(">HHHB", transaction, 0, size, unit) + pdu
                    )

    def _take(self, connection, count):
        data = b""
        while len(data) < count:
            more = connection.recv(count - len(data))
            if not more:
                raise EOFError
            data += more
        return data

    def _answer(self, unit, pdu):
        function, address = struct.unpack(">BH", pdu[:3])
        self.functions.add(function)
        registers = self.registers[unit]
        self.advance(unit)
        if function == 3:
            (count,) = struct.unpack(">H", pdu[3:5])
            wanted = range(address, address + count)
            if not all(a in registers for a in wanted):
                return bytes([0x83, 2])
            words = [registers[a] for a in wanted]
            return struct.pack(f">BB{count}H", 3, 2 * count, *words)
        if function == 6:
            words = struct.unpack(">H", pdu[3:5])
        elif function == 16:
            words = struct.unpack(f">{(len(pdu) - 6) // 2}H", pdu[6:])
        else:
            return bytes([0x80 | function, 1])
        for offset, word in enumerate(words):
            registers[address + offset] = word
        if address == 0x28 and words[-1] == 1:
            way = self.long(unit, 0x12), self.long(unit, 0x20), time.monotonic()
            self.ways[unit] = *way, self.long(unit, 0x22)
            self.moves.append((unit, way[1] / PULSES_PER_DEG))
        if address == 0x28 and words[-1] == 2:
            self.ways.pop(unit, None)
            registers[0x10] = 0b1001
            self.stops.append(unit)
        return pdu[:5]


def attitude(slave):
    """A plant without bias, so that its zero reads exactly zero."""
    pitch, yaw, roll = MATRIX @ [slave.position(unit) for unit in (1, 2, 3)]
    return euler_to_matrix([yaw, pitch, roll], "ZXY"), (pitch, yaw, roll)


def line_phone(slave, port, closing, rate, wrap=False):
    """``yaw,pitch,roll`` and a line feed; ``wrap``: every angle in 0..360."""
    with contextlib.suppress(OSError):
        phone = connected(port, closing)
        while not closing.is_set():
            pitch, yaw, roll = attitude(slave)[1]
            angles = [yaw, pitch, roll]
            if wrap:
                angles = [angle % 360.0 for angle in angles]
            phone.sendall((",".join(f"{a:.4f}" for a in angles) + "\n").encode())
            time.sleep(1 / rate)


def wrapping_phone(slave, port, closing, rate):
    line_phone(slave, port, closing, rate, wrap=True)


def hyper_phone(slave, port, closing, rate):
    """HyperIMU: stamp, azimuth, pitch, roll of Android's legacy orientation, CR LF."""
    with contextlib.suppress(OSError):
        phone = connected(port, closing)
        while not closing.is_set():
            r = attitude(slave)[0]
            azimuth = np.degrees(np.arctan2(-r[1, 0], r[0, 0])) % 360.0
            pitch = np.degrees(np.arctan2(-r[2, 1], r[2, 2]))
            roll = np.degrees(np.arcsin(r[2, 0]))
            stamp = int(time.time() * 1000)
            phone.sendall(f"{stamp},{azimuth},{pitch},{roll}\r\n".encode())
            time.sleep(1 / rate)


def logger_phone(slave, port, closing, rate):
    """Sensor Logger: half a second of readings in every message."""
    import urllib.request

    while not closing.is_set():
        payload = []
        for _ in range(max(1, round(rate / 2))):
            q = Rotation.from_matrix(attitude(slave)[0]).as_quat()
            values = dict(zip(("qx", "qy", "qz", "qw"), q.tolist(), strict=True))
            payload.append(
                {"name": "orientation", "time": time.time_ns(), "values": values}
            )
            time.sleep(1 / rate)
        message = {"messageId": 1, "sessionId": "s", "deviceId": "d"}
        request = urllib.request.Request(
            f"http://127.0.0.1:{port}/data",
            json.dumps(message | {"payload": payload}).encode(),
            {"Content-Type": "application/json"},
        )
        with contextlib.suppress(OSError):
            urllib.request.urlopen(request, timeout=2).close()


def connected(port, closing):
    while not closing.is_set():
        try:
            return socket.create_connection(("127.0.0.1", port), timeout=2)
        except OSError:
            time.sleep(0.05)
    raise OSError


def configured(folder, slave, imu, phone):
    """rig.toml of a device of which all is known that a session needs."""
    axes = "".join(
        AXIS.format(name=name, unit=unit)
        for unit, name in enumerate(("pitch", "yaw", "roll"), 1)
    )
    path, session = folder / "rig.toml", 'method = "exact"'
    path.write_text(
        CONFIG.format(bus=slave.port, imu=imu, axes=axes, phone=phone, session=session)
    )
    commissioned(load_config(path), folder)
    return path


@pytest.mark.slow
@pytest.mark.parametrize(
    ("phone", "settings", "rate"),
    [
        pytest.param(line_phone, LINES + QUICK, 200, id="lines"),
        pytest.param(hyper_phone, HYPERIMU + QUICK, 200, id="hyperimu"),
        pytest.param(wrapping_phone, LINES, 50, id="wraps", marks=pytest.mark.slow),
        pytest.param(line_phone, LINES, 10, id="10 Hz", marks=pytest.mark.slow),
        pytest.param(
            logger_phone, SENSOR_LOGGER, 50, id="sensorlogger", marks=pytest.mark.slow
        ),
    ],
)
def test_a_whole_calibration_with_a_strangers_slave_and_phone(
    phone, settings, rate, tmp_path, capsys
):
    slave, imu, closing = Slave(), free_port(), threading.Event()
    path = configured(tmp_path, slave, imu, settings)
    thread = threading.Thread(
        target=phone, args=(slave, imu, closing, rate), daemon=True
    )
    thread.start()
    try:
        with no_figures():
            code = main(["calibrate", "--config", str(path), "--arm", "--zero",
                     "--out", str(tmp_path / "runs")])  # fmt: skip
    finally:
        closing.set()
        thread.join(5)
        slave.socket.close()
    said = capsys.readouterr().out
    assert code == 0, said
    (folder,) = (tmp_path / "runs").iterdir()
    saved = json.loads((folder / "summary.json").read_text())
    np.testing.assert_allclose(saved["A"], MATRIX, atol=2e-4)
    np.testing.assert_allclose(saved["b"], 0.0, atol=2e-3)
    assert slave.functions <= {3, 6, 16}
    assert set(slave.stops) == {1, 2, 3}
    assert angle_between_deg(attitude(slave)[0], np.eye(3)) < 20


class Worn:
    """Joints behind a slave's drives: they lag by play, and yield late from rest."""

    def __init__(self, slave, play, breakaway):
        self.slave, self.play, self.breakaway = slave, play, breakaway
        self.seen = 0
        self.loose, self.joint = dict.fromkeys((1, 2, 3), 0.0), [0.0, 0.0, 0.0]

    def position(self, unit):
        """Every move so far, one after the other: each is over at once."""
        while self.seen < len(self.slave.moves):
            moved, at = self.slave.moves[self.seen]
            self.seen += 1
            half = self.play / 2
            self.loose[moved] = min(max(self.loose[moved], at - half), at + half)
            if abs(self.loose[moved] - self.joint[moved - 1]) > self.breakaway:
                self.joint[moved - 1] = self.loose[moved]
        return self.joint[unit - 1]


@pytest.mark.slow
def test_a_strangers_worn_axis_is_characterised(tmp_path, capsys):
    """No noise but that of the phone's four digits; nothing of our simulator."""
    slave, imu, closing = Slave(), free_port(), threading.Event()
    path = configured(tmp_path, slave, imu, LINES + QUICK)
    worn = Worn(slave, 0.284, 0.057)
    arguments = (worn, imu, closing, 200)
    thread = threading.Thread(target=line_phone, args=arguments, daemon=True)
    thread.start()
    try:
        code = main(["characterise", "yaw", "--yes", "--config", str(path)])
    finally:
        closing.set()
        thread.join(5)
        slave.socket.close()
    said = capsys.readouterr().out
    assert code == 0, said
    number = r"(-?[0-9.]+)"
    for name, truth in (("play", 0.284), ("dead zone", 0.0), ("breakaway up", 0.057),
                        ("breakaway down", 0.057)):  # fmt: skip
        low, high = map(
            float,
            re.search(f"yaw: {name} .* interval {number}\\.\\.{number}", said).groups(),
        )
        assert low - 0.005 <= truth <= high + 0.005, (name, said)
        assert high - low <= 0.02
    assert slave.functions <= {3, 6, 16}
    assert set(slave.stops) == {1, 2, 3}
