"""The phone's stream: published formats, and everything a Wi-Fi does to them."""

import contextlib
import http.client
import json
import socket
import threading
import time

import numpy as np
import pytest
from harness import changed, fast_config
from scipy.spatial.transform import Rotation

from rig.readings import phone as receiver
from rig.readings.geometry import angle_between_deg, euler_to_matrix, matrix_to_euler
from rig.readings.phone import Imu
from rig.readings.source import ReadingError
from rig.readings.stream import MAX_LINE, LineSplitter, StreamParser
from rig_workbench.simulator.faults import FaultInjector
from rig_workbench.simulator.phone import Phone

HYPER = changed(fast_config().imu, max_jump_deg=180.0, host="127.0.0.1")
PLAIN = changed(
    HYPER, format="lines", columns=(0, 1, 2), stamp_column=-1, column_count=3,
    order="ZXY", signs=(1, 1, 1),
)  # fmt: skip


def feed(settings, *lines, parser=None):
    parser = parser or StreamParser(settings)
    return parser.lines([line.encode() for line in lines], 100.0), parser


def test_hyperimu_line_as_published_is_androids_orientation():
    """Time stamp, then azimuth, pitch, roll of the Orientation sensor in degrees.

    Pitch turns about the phone's X and roll about its Y, so in the order Z, Y, X the
    roll comes before the pitch.
    """
    readings, _ = feed(HYPER, "1700000000000,350.5,-10.25,5.125")
    expected = euler_to_matrix([-350.5, -5.125, 10.25], "ZYX")
    np.testing.assert_allclose(readings[0].value, expected, atol=1e-12)
    pitched, _ = feed(HYPER, "1700000000000,0,-110.0,0")  # pitch may pass 90, roll not
    np.testing.assert_allclose(
        pitched[0].value, euler_to_matrix([110.0, 0, 0], "XYZ"), atol=1e-12
    )


def test_lines_arrive_in_any_pieces():
    stream = b"".join(b"%d,10.5,1.5,2.5\r\n" % stamp for stamp in range(1, 40))
    for size in (1, 2, 3, 7, 64, len(stream)):
        splitter, parser, count = LineSplitter(), StreamParser(HYPER), 0
        for start in range(0, len(stream), size):
            lines = splitter.feed(stream[start : start + size])
            count += len(parser.lines(lines, 100.0))
        assert count == 38  # the first line may be the end of an older one


def test_hash_ends_a_line_too():
    assert LineSplitter().feed(b"x#1,2,3#4,5,6#7") == [b"1,2,3", b"4,5,6"]


def test_a_stream_without_line_ends_keeps_no_memory():
    splitter = LineSplitter()
    for _ in range(2000):
        assert splitter.feed(b"1234567890" * 100) == []
        assert len(splitter._tail) <= MAX_LINE
    assert splitter.feed(b"\n1,2,3\n") == [b"1,2,3"]


@pytest.mark.parametrize(
    "line",
    [
        "1,nan,2,3", "1,inf,2,3", "1,1e999,2,3", "1,0x10,2,3", "1,1_0,2,3", "1,,2,3",
        "1,10,3,95", "1,361,2,3", "1,10.5,2", "x,1,2,3", "1,--1,2,3", "1,1.,2,3",
        "1,٣,2,3", "1,10 5,2,3", "abc", ",,,", "1;2;3;4",
    ],
)  # fmt: skip
def test_a_malformed_line_is_dropped_and_counted(line):
    readings, parser = feed(HYPER, line)
    assert readings == []
    assert sum(parser.counts.values()) == 1


def test_a_line_may_write_every_angle_in_0_to_360():
    readings, _ = feed(PLAIN, "350,355,359.5", "-10,-5,-0.5", "350,180,0", "0,361,0")
    assert len(readings) == 2
    assert angle_between_deg(readings[0].value, readings[1].value) < 1e-9


def test_a_decimal_comma_is_a_wrong_number_of_columns_not_another_angle():
    readings, parser = feed(HYPER, "17,10,5,1,5,2,5")
    assert readings == []
    assert parser.counts["decimal commas"] == 1


def test_changed_columns_are_dropped_for_good():
    _, parser = feed(HYPER, "1,10,2,3")
    more = [f"{n},10,2,3,4,5" for n in range(2, 60)]
    assert feed(HYPER, *more, parser=parser)[0] == []
    assert parser.counts["not of 4 columns"] == len(more)


def test_one_torn_line_is_no_change_of_columns():
    _, parser = feed(HYPER, "1,10,2,3", "2,10,2,33,10,2,3", "4,10,2,3", "5,10,2")
    readings, _ = feed(HYPER, "6,10,2,3", parser=parser)
    assert len(readings) == 1


def test_without_a_configured_width_the_first_good_line_sets_it():
    settings = changed(HYPER, column_count=0)
    readings, parser = feed(settings, "1,10,2,3,0.5", "2,10,2,3,0.5", "3,10,2,3")
    assert len(readings) == 2
    assert parser.counts["not of 5 columns"] == 1


def test_older_stamps_are_dropped_until_the_clock_was_plainly_set_back():
    _, parser = feed(HYPER, "5000,10,2,3")
    readings, _ = feed(HYPER, "4000,50,2,3", parser=parser)
    assert readings == []
    later = [f"{1000 + n},50,2,3" for n in range(60)]
    readings, _ = feed(HYPER, *later, parser=parser)
    assert readings


def test_a_single_wild_reading_is_dropped_and_a_real_turn_is_accepted():
    settings = changed(PLAIN, max_jump_deg=20.0)
    _, parser = feed(settings, "10,2,3")
    readings, _ = feed(settings, "70,2,3", parser=parser)
    assert readings == []
    readings, _ = feed(settings, "10.1,2,3", parser=parser)
    assert len(readings) == 1
    readings, _ = feed(settings, *["70,2,3"] * 6, parser=parser)
    assert len(readings) == 2


def test_a_reading_that_waited_in_a_buffer_is_as_old_as_it_is():
    parser = StreamParser(HYPER)
    parser.lines([b"1000,10,2,3"], 50.0)
    late = parser.lines([b"1100,10,2,3"], 53.0)
    assert late[0].time == pytest.approx(50.1, abs=0.01)


def test_radians_signs_and_quaternion_columns():
    settings = changed(PLAIN, unit="rad", signs=(1, -1, 1))
    readings, _ = feed(settings, "0.1,0.2,0.3")
    read = np.radians(matrix_to_euler(readings[0].value, "ZXY"))
    np.testing.assert_allclose(read, [0.1, -0.2, 0.3], atol=1e-9)
    settings = changed(PLAIN, quaternion_columns=(0, 1, 2, 3), column_count=4)
    readings, parser = feed(settings, "0,0,0.7071068,0.7071068", "0,0,0.5,0.5")
    assert len(readings) == 1
    assert parser.counts["a quaternion whose length is not one"] == 1
    np.testing.assert_allclose(
        readings[0].value, euler_to_matrix([90, 0, 0], "ZYX"), atol=1e-6
    )


@pytest.mark.parametrize("nested", [True, False])
def test_sensor_logger_message_as_published(nested):
    q = dict(zip(("qx", "qy", "qz", "qw"), (0.0, 0.0, 0.6, 0.8), strict=True))
    extra = {"roll": 0.1, "pitch": 0.2, "yaw": 0.3}
    entry = {"name": "orientation", "time": 1_700_000_000_000_000_000}
    entry |= {"values": q | extra} if nested else q | extra
    other = {"name": "accelerometer", "time": 1, "values": {"x": 1}}
    message = {"messageId": 1, "sessionId": "s", "deviceId": "d",
               "payload": [other, entry]}  # fmt: skip
    readings = StreamParser(HYPER).body(json.dumps(message).encode(), 5.0)
    assert len(readings) == 1
    turned = matrix_to_euler(readings[0].value, "ZYX")
    np.testing.assert_allclose(
        turned, [np.degrees(2 * np.arcsin(0.6)), 0, 0], atol=1e-9
    )


@pytest.mark.parametrize(
    "body",
    [b"", b"{}", b"[]", b"null", b'{"payload": 3}', b'{"payload": [1, null, []]}',
     b'{"payload": [{"name": "orientation"}]}', b"\xff\xfe", b"[" * 50_000,
     b'{"payload": [{"name": "orientation", "values": {"qx": "a", "qy": null}}]}',
     b'{"payload": [{"name": "orientation", "time": {}, "values": {"qx": 1e400, '
     b'"qy": NaN, "qz": 0, "qw": 1}}]}'],
)  # fmt: skip
def test_a_malformed_message_is_dropped(body):
    assert StreamParser(HYPER).body(body, 1.0) == []


def connect(imu):
    return socket.create_connection(("127.0.0.1", imu.port), timeout=2)


def wait_for(condition, seconds=5.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "did not happen"
        time.sleep(0.005)


def test_a_phone_that_comes_back_on_a_new_connection_is_heard():
    with Imu(changed(PLAIN, port=0, stale_s=0.3)) as imu:
        for angle in (10, 30):
            with connect(imu) as phone:
                phone.sendall(b"?\r\n" + f"{angle},2,3\r\n".encode() * 3)
                wait_for(
                    lambda a=angle: (
                        imu.since(0)
                        and abs(matrix_to_euler(imu.since(0)[-1].value, "ZXY")[0] - a)
                        < 1e-6
                    )
                )
        assert imu.connections == 2


def test_a_half_open_connection_is_given_up_for_the_next():
    with Imu(changed(PLAIN, port=0, stale_s=0.1)) as imu:
        with connect(imu) as first, connect(imu) as second:
            first.sendall(b"?\r\n9,8,7\r\n")
            wait_for(lambda: imu.connections == 1)

            def heard():  # what it sent while it waited is lost
                second.sendall(b"1,2,3\r\n")
                return angles_of(imu) == {9.0, 1.0}

            wait_for(heard)  # or it fails: the second is heard
            assert imu.connections == 2


def test_a_stale_stream_is_an_error_and_a_silent_one_names_the_port():
    with Imu(changed(PLAIN, port=0, stale_s=0.1)) as imu:
        with pytest.raises(ReadingError, match="no reading yet"):
            imu.latest()
        with connect(imu) as phone:
            phone.sendall(b"?\r\n1,2,3\r\n")
            wait_for(lambda: imu.since(0))
            time.sleep(0.15)
            with pytest.raises(ReadingError, match="old"):
                imu.latest()
            with pytest.raises(ReadingError, match=f":{imu.port}"):
                imu.wait_for_stream(0.05)


def test_stamps_of_another_unit_are_named_as_the_cause():
    settings = changed(
        PLAIN, port=0, stale_s=0.1, stamp_column=0, columns=(1, 2, 3), column_count=4
    )
    with Imu(settings) as imu, connect(imu) as phone:
        begun, said = time.monotonic(), ""
        while "time stamps are" not in said and time.monotonic() - begun < 3.0:
            stamp = time.monotonic() - begun  # seconds, where ms are agreed
            phone.sendall(f"{stamp:.3f},1,2,3\n".encode())
            time.sleep(0.01)
            try:
                imu.latest()
            except ReadingError as error:
                said = str(error)
        assert "its time stamps are wrong" in said


def test_a_taken_port_is_one_clear_error():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        settings = changed(PLAIN, port=taken.getsockname()[1])
        with pytest.raises(ReadingError, match="cannot open the port of the phone"):
            Imu(settings).open()


def test_client_mode_connects_and_connects_again():
    with socket.create_server(("127.0.0.1", 0)) as sender:
        settings = changed(PLAIN, transport="connect", port=sender.getsockname()[1])
        with Imu(settings) as imu:
            for _ in range(2):
                connection, _ = sender.accept()
                connection.sendall(b"?\n4,5,6\n")
                before = len(imu.since(0))
                wait_for(lambda b=before: len(imu.since(0)) > 0)
                connection.close()
            assert imu.since(0)


def test_http_push_is_received_and_an_oversized_one_refused():
    settings = changed(HYPER, format="sensorlogger", port=0)
    with Imu(settings) as imu:
        turned = euler_to_matrix([20.0, 5.0, -3.0], "ZYX")
        keys = ("qx", "qy", "qz", "qw")
        q = dict(
            zip(keys, Rotation.from_matrix(turned).as_quat().tolist(), strict=True)
        )
        payload = [{"name": "orientation", "time": 1, "values": q}]
        web = http.client.HTTPConnection("127.0.0.1", imu.port, timeout=2)
        web.request("POST", "/data", json.dumps({"payload": payload}))
        assert web.getresponse().status == 200
        assert angle_between_deg(imu.since(0)[-1].value, turned) < 1e-6
        web.close()
        web.putrequest("POST", "/data")
        web.putheader("Content-Length", str(1 << 40))
        web.endheaders()
        assert web.getresponse().status == 413
        web.close()


def streaming(imu, angle, source="127.0.0.1", seconds=30.0):
    """A sender of ``angle`` at 100 Hz from an address of its own, until refused."""
    ended = threading.Event()

    def send():
        made = socket.socket()
        made.bind((source, 0))
        made.settimeout(2)
        with made, contextlib.suppress(OSError):
            made.connect(("127.0.0.1", imu.port))
            made.sendall(b"?\r\n")
            end = time.monotonic() + seconds
            while time.monotonic() < end and not ended.is_set():
                made.sendall(f"{angle},0,0\r\n".encode())
                time.sleep(0.01)
        ended.set()

    threading.Thread(target=send, daemon=True).start()
    return ended


def angles_of(imu):
    return {round(float(matrix_to_euler(r.value, "ZXY")[0]), 3) for r in imu.since(0)}


@pytest.mark.parametrize("second", ["127.0.0.1", "127.0.0.2"])
def test_a_second_sender_is_refused_reported_and_never_mixed_in(second):
    told = []
    with Imu(
        changed(PLAIN, port=0, stale_s=0.2),
        report=lambda event, **fields: told.append((event, fields["address"])),
    ) as imu:
        first = streaming(imu, 10)
        wait_for(lambda: imu.sender)
        for _ in range(2):  # it comes again
            refused = streaming(imu, 40, second)
            assert refused.wait(5.0)
        time.sleep(0.1)
        assert angles_of(imu) == {10.0} and imu.sender == "127.0.0.1"
        assert told == [("sender_refused", second)]
        assert not first.is_set()
        first.set()  # the first goes: an address that was refused stays refused
        other = streaming(imu, 40, "127.0.0.2")
        assert other.wait(5.0)
        assert angles_of(imu) == {10.0}


def test_receiving_that_ended_is_said_at_once():
    def full(event, **fields):
        raise RuntimeError("the journal is full")

    with Imu(changed(PLAIN, port=0, allow=("127.0.0.2",)), full) as imu:
        with connect(imu), pytest.raises(ReadingError, match=r"stopped: .* is full"):
            imu.wait_for_stream(20.0)


def test_only_an_address_that_is_allowed_is_heard():
    settings, told = changed(PLAIN, port=0, allow=("127.0.0.2",)), []
    with Imu(settings, lambda event, **more: told.append(more)) as imu:
        assert streaming(imu, 40).wait(5.0)
        with pytest.raises(ReadingError, match=r"senders refused: 127\.0\.0\.1"):
            imu.wait_for_stream(0.05)
        ended = streaming(imu, 10, "127.0.0.2")
        wait_for(lambda: imu.sender)
        ended.set()
        assert angles_of(imu) == {10.0} and imu.sender == "127.0.0.2"
    assert [each["address"] for each in told] == ["127.0.0.1"]
    assert "127.0.0.2" in told[0]["reason"]


def test_whoever_connects_and_says_nothing_does_not_become_the_phone():
    with Imu(changed(PLAIN, port=0, stale_s=0.2)) as imu:
        idle = socket.create_connection(("127.0.0.1", imu.port), 2, ("127.0.0.2", 0))
        with idle:
            ended = streaming(imu, 10)
            wait_for(lambda: imu.sender == "127.0.0.1")
            ended.set()
            assert angles_of(imu) == {10.0} and imu.sender == "127.0.0.1"


def test_what_was_sent_while_another_was_heard_is_not_taken_for_new():
    """The phone's new connection waits until the half-open one is given up."""
    with Imu(changed(PLAIN, port=0, stale_s=0.2)) as imu, connect(imu) as old:
        old.sendall(b"?\r\n10,0,0\r\n")
        wait_for(lambda: imu.sender)
        with connect(imu) as new:
            new.sendall(b"?\r\n" + b"20,0,0\r\n" * 5)  # at once, then 30
            end = time.monotonic() + 5.0
            while 30.0 not in angles_of(imu):
                assert time.monotonic() < end
                new.sendall(b"30,0,0\r\n")
                time.sleep(0.01)
        assert angles_of(imu) == {10.0, 30.0}


def push(imu, angle, source="127.0.0.1", device="a"):
    """The status of one pushed message."""
    web = http.client.HTTPConnection(
        "127.0.0.1", imu.port, timeout=2, source_address=(source, 0)
    )
    q = Rotation.from_euler("ZXY", [angle, 0, 0], degrees=True).as_quat()
    values = dict(zip(("qx", "qy", "qz", "qw"), q.tolist(), strict=True))
    entry = {"name": "orientation", "time": time.time_ns(), "values": values}
    with contextlib.closing(web):
        web.request("POST", "/", json.dumps({"deviceId": device, "payload": [entry]}))
        return web.getresponse().status


@pytest.mark.parametrize("second", [("127.0.0.2", "a"), ("127.0.0.1", "b")])
def test_a_second_sender_of_pushed_messages_is_refused_too(second):
    told = []
    settings = changed(HYPER, format="sensorlogger", port=0)
    with Imu(settings, report=lambda e, **more: told.append(more["address"])) as imu:
        for _ in range(3):
            assert push(imu, 10) == 200
            assert push(imu, 15, *second) == 403
        assert angles_of(imu) == {10.0}
    assert told == [second[0]]


def test_strangers_are_refused_before_a_byte_is_read_and_cost_no_thread():
    """F: 400 of them were 241 threads and 376 MB, each body read before the check."""
    settings = changed(HYPER, format="sensorlogger", port=0, allow=("127.0.0.9",))
    body = b"x" * 65536
    head = b"POST / HTTP/1.1\r\nContent-Length: 1000000\r\n\r\n"
    with Imu(settings) as imu:
        taken, made = [], []
        imu.take_body = lambda body: taken.append(body) or (False, False)
        before = threading.active_count()
        for _ in range(400):
            stranger = socket.create_connection(("127.0.0.1", imu.port), 5)
            made.append(stranger)
            with contextlib.suppress(OSError):  # it is refused while it sends
                stranger.sendall(head)
                for _ in range(15):
                    stranger.sendall(body)
            assert threading.active_count() == before
        for stranger in made:
            stranger.settimeout(5)
            with contextlib.suppress(ConnectionError):
                assert stranger.recv(64)[:12] in (b"HTTP/1.1 403", b"")
            stranger.close()
        assert not taken


def test_connections_that_send_nothing_keep_no_phone_out(monkeypatch):
    """Without imu.allow anybody may be the phone, until one is."""
    monkeypatch.setattr(receiver, "PATIENCE_S", 600.0)
    settings = changed(HYPER, format="sensorlogger", port=0)
    with Imu(settings) as imu, contextlib.ExitStack() as stack:
        for _ in range(20):
            stack.enter_context(connect(imu))
        assert push(imu, 10) == 200


def test_connections_that_send_nothing_are_short(monkeypatch):
    monkeypatch.setattr(receiver, "PATIENCE_S", 0.1)
    with Imu(changed(PLAIN, port=0)) as imu, connect(imu) as idle:
        with contextlib.suppress(ConnectionError):
            assert idle.recv(64) == b""


# Apps, by what they were seen to send

SENSORLOG_HEADER = (
    "loggingTime(txt),accelerometerAccelerationX(G),motionTimestamp_sinceReboot(s),"
    "motionYaw(rad),motionAttitudeReferenceFrame(txt),motionQuaternionX(R),"
    "motionQuaternionY(R),motionQuaternionZ(R),motionQuaternionW(R),"
    "motionMagneticFieldX(µT),motionHeading(°)"
)


def sensorlog_line(quaternion, seconds):
    numbers = ",".join(f"{value:.6f}" for value in quaternion)
    return (
        f"2026-11-27 19:05:11.{int(1000 * seconds) % 1000:03d} +0100,-0.01,"
        f"{90211.5 + seconds:.3f},0.5,XArbitraryCorrectedZVertical,{numbers},"
        "-12.5,271.2"
    )


SENSORLOG = changed(HYPER, format="sensorlog", stamp_column=-1, column_count=0)
TURNED = Rotation.from_euler("ZYX", [30.0, -10.0, 5.0], degrees=True)


def test_sensorlogs_lines_are_read_by_the_names_of_its_header():
    """A date with a blank, text in other columns, and letters that ASCII lacks."""
    stream = "\n".join(
        [
            SENSORLOG_HEADER,
            *(sensorlog_line(TURNED.as_quat(), n / 50) for n in range(5)),
            "",
        ]
    ).encode()
    parser, splitter = StreamParser(SENSORLOG), LineSplitter()
    readings = []
    for n, line in enumerate(splitter.feed(stream)):
        readings += parser.lines([line], 100.0 + n / 50)
    assert len(readings) == 5 and parser.counts["accepted"] == 5
    assert angle_between_deg(readings[0].value, TURNED.as_matrix()) < 1e-3
    times = np.diff([reading.time for reading in readings])
    np.testing.assert_allclose(times, 0.02, atol=2e-3)
    assert "motionQuaternionX(R) (column 5)" in parser.taken_for


def test_a_line_of_names_that_was_moved_is_followed():
    """Columns change with the app's settings; a header comes before they do."""
    names = SENSORLOG_HEADER.split(",")
    values = sensorlog_line(TURNED.as_quat(), 0.0).split(",")
    order = np.random.default_rng(0).permutation(len(names))
    lines = [",".join(row[i] for i in order) for row in (names, values)]
    readings, _ = feed(SENSORLOG, *lines)
    assert angle_between_deg(readings[0].value, TURNED.as_matrix()) < 1e-3


def test_sensorlog_without_its_header_is_named():
    readings, parser = feed(SENSORLOG, sensorlog_line(TURNED.as_quat(), 0.0))
    assert not readings
    assert parser.counts["before the header, which the app sends at the start"] == 1


JSON = changed(HYPER, format="json", stamp_column=-1, column_count=0)
X, Y, Z, W = (float(value) for value in TURNED.as_quat())
SHAPES = {
    "SensorStreamer": {
        "accelerometer": {"timestamp": 1, "value": [0.1, 0.2, 9.8]},
        "rotationVector": {"timestamp": 52_000_000_000, "value": [X, Y, Z]},
    },
    "SensaGram": {
        "type": "android.sensor.game_rotation_vector", "timestamp": 52_000_000_000,
        "values": [X, Y, Z, W, -1.0],
    },
    "Sensor Logger": {
        "messageId": 1, "payload": [
            {"name": "accelerometer", "time": 3, "values": {"x": 1, "y": 2, "z": 3}},
            {"name": "orientation", "time": 52_000_000_000,
             "values": {"qx": X, "qy": Y, "qz": Z, "qw": W, "yaw": 1.0}},
        ],
    },
}  # fmt: skip


@pytest.mark.parametrize("app", SHAPES)
def test_json_lines_of_apps_are_attitudes(app):
    readings, parser = feed(JSON, json.dumps(SHAPES[app]))
    assert len(readings) == 1
    assert angle_between_deg(readings[0].value, TURNED.as_matrix()) < 1e-6
    assert parser.first and "quaternion" in parser.taken_for


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("{", "not JSON"),
        ('{"accelerometer": {"value": [1, 2, 3]}}', "without a rotation vector"),
        ('{"rotationVector": {"value": [1, 2, null]}}', "not a number"),
        ('{"rotationVector": {"value": [3, 2, 1, 0]}}', "length is not one"),
        ("[" * 5000, "not JSON"),
    ],
)
def test_json_that_is_no_orientation_is_dropped_by_name(text, reason):
    readings, parser = feed(JSON, text)
    assert not readings and any(reason in name for name in parser.counts)


def test_datagrams_are_heard_from_one_phone():
    settings = changed(JSON, transport="udp", port=0, max_jump_deg=180.0)
    line = json.dumps(SHAPES["SensorStreamer"]).encode()
    with Imu(settings) as imu, contextlib.ExitStack() as stack:
        first, other = (
            stack.enter_context(socket.socket(type=socket.SOCK_DGRAM)) for _ in "ab"
        )
        other.bind(("127.0.0.2", 0))
        first.sendto(line, ("127.0.0.1", imu.port))
        reading = imu.wait_for_stream(3.0)
        assert angle_between_deg(reading.value, TURNED.as_matrix()) < 1e-6
        other.sendto(line, ("127.0.0.1", imu.port))
        end = time.monotonic() + 3.0
        while not imu.refused and time.monotonic() < end:
            time.sleep(0.01)
        assert imu.sender == "127.0.0.1" and imu.refused == ["127.0.0.2"]


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
def test_the_unit_of_a_unix_stamp_is_told_by_the_first(unit):
    per_s = {"s": 1, "ms": 1e3, "us": 1e6, "ns": 1e9}[unit]
    parser, now, times = StreamParser(changed(HYPER, column_count=0)), time.time(), []
    for n in range(3):
        stamp = f"{(now + n / 10) * per_s:.{3 * (unit == 's')}f}"
        (reading,) = parser.lines([f"{stamp},10.5,1.5,2.5".encode()], 100.0 + n / 10)
        times.append(reading.time)
    np.testing.assert_allclose(times, [100, 100.1, 100.2], atol=2e-3)


def test_a_stamp_of_an_uptime_has_the_unit_that_is_configured():
    parser = StreamParser(changed(HYPER, stamp_unit="s"))
    readings = [
        reading
        for n in range(3)
        for reading in parser.lines([f"{500 + n},10.5,1.5,2.5".encode()], 100.0 + n)
    ]
    assert [reading.time for reading in readings] == [100.0, 101.0, 102.0]


@pytest.mark.parametrize(
    ("settings", "line"),
    [
        (PLAIN, "10,5,1,5,2,5"),
        (changed(PLAIN, column_count=0), "10,5,-1,5,2,25"),
        (HYPER, "1700000000000,350,5,-10,25,5,125"),
        (changed(PLAIN, separator=";"), "10,5;1,5;2,5"),
    ],
)
def test_decimal_commas_are_refused_by_name(settings, line):
    readings, parser = feed(settings, line)
    assert not readings and parser.counts["decimal commas"] == 1


@pytest.mark.parametrize(
    "changes",
    [
        {"format": "json", "transport": "udp"},
        {"format": "json", "transport": "connect"},
        {"format": "sensorlog"},
    ],
)
def test_the_simulated_phone_sends_what_apps_do(changes):
    settings = changed(
        fast_config().imu, host="127.0.0.1", port=0, stamp_column=-1, column_count=0,
        **changes,
    )  # fmt: skip
    phone = Phone(settings, TURNED.as_matrix, FaultInjector(), 100.0)
    try:
        if settings.transport == "connect":
            settings = changed(settings, port=phone.start(0))
        with Imu(settings) as imu:
            if settings.transport != "connect":
                phone.start(imu.port)
            reading = imu.wait_for_stream(5.0)
            assert angle_between_deg(reading.value, TURNED.as_matrix()) < 1e-4
            assert not imu.counts.get("garbage")
    finally:
        phone.close()
