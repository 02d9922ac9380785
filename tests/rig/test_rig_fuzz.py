"""Random and mutated bytes: no crash, no growth, nothing accepted that is not valid.

The judges are written apart from what they judge: a line is right when scipy turns its
numbers, read by another grammar, into the same rotation; a Modbus value is right when
its bytes stand in the reply behind the header (and before the CRC) they must have.
"""

import json
import random
import re
import resource
import types

import numpy as np
import pytest
from harness import changed, fast_config, read_words
from scipy.spatial.transform import Rotation

import rig.drives.bus as bus_module
import rig.drives.wire as wire_module
from rig.config.settings import BusSettings
from rig.drives.bus import Bus
from rig.drives.line import BusError
from rig.drives.wire import Wire, crc16
from rig.readings.stream import MAX_LINE, LineSplitter, StreamParser

IMU = changed(fast_config().imu, max_jump_deg=180.0)
FIELD = re.compile(r"[ \t]*[+-]?[0-9]+([.][0-9]+)?([eE][+-]?[0-9]+)?[ \t]*")
SIZES = [
    pytest.param(20_000, id="quick"),
    pytest.param(500_000, id="full", marks=pytest.mark.slow),
]


def mutate(rng: random.Random, data: bytes) -> bytes:
    """One to three of: flip, drop, insert, repeat, cut, swap, or all new."""
    for _ in range(rng.randint(1, 3)):
        kind, at = rng.randrange(7), rng.randrange(len(data) + 1)
        if kind == 0 and data:
            at = min(at, len(data) - 1)
            data = (
                data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :]
            )
        elif kind == 1:
            data = data[:at] + data[at + 1 :]
        elif kind == 2:
            data = data[:at] + rng.randbytes(rng.randint(1, 4)) + data[at:]
        elif kind == 3:
            data = data[:at] + data[max(0, at - 5) : at] + data[at:]
        elif kind == 4:
            data = data[:at]
        elif kind == 5:
            data = data[at:] + data[:at]
        elif rng.random() < 0.1:
            data = rng.randbytes(rng.randint(0, 64))
    return data


def judged(line: bytes):
    """Angles about Z, Y, X of a HyperIMU line, or None where it means nothing."""
    try:
        fields = line.decode("ascii").strip(" \t\0").split(",")
    except UnicodeDecodeError:
        return None
    if len(fields) == 5 and not fields[4].strip(" \t"):
        fields.pop()
    if len(fields) != 4 or not all(FIELD.fullmatch(field) for field in fields):
        return None
    _, azimuth, pitch, roll = map(float, fields)
    if abs(azimuth) > 361 or abs(pitch) > 361 or abs(roll) > 90.1:
        return None
    return [-azimuth, -roll, -pitch]


def require_rotations(matrices, angles):
    """Of a thousand lines at once: by itself each costs scipy more than the parser."""
    right = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()
    np.testing.assert_allclose(matrices, right, atol=1e-9, err_msg=str(angles))


@pytest.mark.parametrize("count", SIZES)
def test_mutated_imu_lines(count):
    rng = random.Random(count)
    parser, splitter = StreamParser(IMU), LineSplitter()
    accepted, matrices, angles = 0, [], []
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    splitter.feed(b"\n")
    for number in range(count):
        azimuth, pitch, roll = (rng.uniform(-80, 80) for _ in range(3))
        line = b"%d,%.4f,%.4f,%.4f" % (number * 10, azimuth % 360, pitch, roll)
        if rng.random() < 0.8:
            line = mutate(rng, line)
        lines = []
        data = line + rng.choice([b"\n", b"\r\n", b"#"])
        while data:
            size = rng.randint(1, 40)
            lines += splitter.feed(data[:size])
            data = data[size:]
        assert len(splitter._tail) <= MAX_LINE
        for piece in lines:
            for reading in parser.lines([piece], number * 0.01):
                matrices.append(reading.value)
                angles.append(judged(piece))
                assert angles[-1] is not None, piece
                accepted += 1
        if len(angles) >= 1000 or (angles and number == count - 1):
            require_rotations(matrices, angles)
            matrices, angles = [], []
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert accepted > count * 0.1
    assert after - before < 100_000  # kilobytes
    assert sum(parser.counts.values()) > 0


@pytest.mark.parametrize("count", [pytest.param(300, id="quick"),
    pytest.param(20_000, id="full", marks=pytest.mark.slow)])  # fmt: skip
def test_random_imu_streams_keep_no_memory(count):
    rng = random.Random(1)
    parser, splitter = StreamParser(IMU), LineSplitter()
    for number in range(count):
        data = rng.randbytes(rng.randint(0, 4096))
        if rng.random() < 0.3:
            data = bytes(rng.choice(b"0123456789.,-+eE\r\n#") for _ in range(400))
        for reading in parser.lines(splitter.feed(data), number * 0.1):
            assert np.isfinite(reading.value).all()
        assert len(splitter._tail) <= MAX_LINE
    assert len(parser.counts) < 20


def quaternion_in(data):
    """The first dictionary with a quaternion, however deep."""
    if isinstance(data, dict) and "qx" in data:
        return data
    inner = data.values() if isinstance(data, dict) else data
    within = [quaternion_in(each) for each in inner if isinstance(each, dict | list)]
    return next((each for each in within if each), None)


@pytest.mark.parametrize("count", [pytest.param(5_000, id="quick"),
    pytest.param(100_000, id="full", marks=pytest.mark.slow)])  # fmt: skip
def test_mutated_sensor_logger_messages(count):
    rng = random.Random(2)
    parser = StreamParser(IMU)
    for number in range(count):
        q = np.array([rng.gauss(0, 1) for _ in range(4)])
        q /= np.linalg.norm(q)
        values = dict(zip(("qx", "qy", "qz", "qw"), q.tolist(), strict=True))
        entry = {"name": "orientation", "time": number * 10_000_000, "values": values}
        body = mutate(rng, json.dumps({"messageId": 1, "payload": [entry]}).encode())
        for reading in parser.body(body, number * 0.01):
            given = quaternion_in(json.loads(body)["payload"])
            numbers = [float(given[key]) for key in ("qx", "qy", "qz", "qw")]
            right = Rotation.from_quat(numbers).as_matrix()
            np.testing.assert_allclose(reading.value, right, atol=1e-9)


class Clock(types.SimpleNamespace):
    """A clock of the test: waiting advances it and takes no time."""

    now = 100.0

    def monotonic(self):
        return self.now

    time = monotonic

    def time_ns(self):
        return round(1e9 * self.now)

    def sleep(self, seconds):
        self.now += seconds


class Replies(Wire):
    """A wire without a line: one prepared reply, then silence.

    Questions of an RTU line that owes a reply, which come before, are answered soundly.
    """

    def __init__(self, settings, clock):
        super().__init__(settings)
        self.clock = clock
        self.reply = self.sent = self.asked = b""

    def open(self):
        self.socket = self

    def sendall(self, request):
        self.sent = request

    def pending(self):
        return b""

    def close(self):
        self._came = b""

    def _read(self, seconds):
        if self.asked not in self.sent:
            unit, function, count = self.sent[0], self.sent[1], self.sent[5]
            self.sent = self.asked
            body = bytes([unit, function, 2 * count]) + bytes(2 * count)
            return body + crc16(body)
        data, self.reply = self.reply, b""
        if not data:
            self.clock.sleep(seconds)
        return data


@pytest.mark.parametrize("count", SIZES)
@pytest.mark.parametrize("framer", ["rtu", "socket"])
def test_mutated_modbus_replies(framer, count, monkeypatch):
    rng, clock = random.Random(count), Clock()
    for module in (bus_module, wire_module):
        monkeypatch.setattr(module, "time", clock)
    transport = "tcp" if framer == "socket" else "rtu_tcp"
    settings = BusSettings(
        transport=transport, host="x", port=1, timeout_s=0.01, read_retries=0
    )
    bus = Bus(settings)
    replies = bus._client = Replies(settings, clock)
    bus._timeout_s = 0.0
    reads = writes = 0
    for _ in range(count // 2):
        words = [rng.randrange(65536) for _ in range(rng.randint(1, 3))]
        unit, address = rng.randint(1, 20), rng.randrange(60000)
        writing = rng.random() < 0.3
        data = b"".join(word.to_bytes(2, "big") for word in words)
        if writing:
            body = bytes([unit, 16]) + address.to_bytes(2, "big")
            body += len(words).to_bytes(2, "big")
        else:
            body = bytes([unit, 3, len(data)]) + data
        if framer == "rtu":
            raw = body + crc16(body)
        else:
            tid = replies._number + 1 & 0xFFFF
            raw = tid.to_bytes(2, "big") + bytes([0, 0, 0, len(body)]) + body
        if rng.random() < 0.9:
            raw = mutate(rng, raw)
        replies.reply = raw
        replies.asked = bytes([unit, 16 if writing else 3]) + address.to_bytes(2, "big")
        replies.asked += len(words).to_bytes(2, "big")
        try:
            if writing:
                bus.write(unit, address, 16, words)
                expected = body
                writes += 1
            else:
                got = read_words(bus, unit, address, len(words))
                expected = bytes([unit, 3, len(data)])
                expected += b"".join(word.to_bytes(2, "big") for word in got)
                reads += 1
        except BusError:
            continue
        if framer == "rtu":
            expected += crc16(expected)
        assert expected in raw, (raw.hex(), expected.hex())
    assert reads > count * 0.02 and writes > count * 0.005
