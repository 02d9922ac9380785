"""Drives: three transports, retries, and other stacks."""

import asyncio
import contextlib
import itertools
import pathlib
import queue
import struct
import threading
import time

import pytest
from harness import (
    HASTY,
    MODBUS_MAPS,
    changed,
    fast_config,
    fast_text,
    free_port,
    read_words,
    simulator,
)
from hypothesis import given
from hypothesis import strategies as st
from recorder import Recorder, axis_with, rtu_over_tcp

from rig.config import ConfigError, parse_config
from rig.config.maps import load_map
from rig.config.settings import BusSettings
from rig.core.stop import stop_all
from rig.drives.bus import Bus, Rejected
from rig.drives.line import BusError
from rig.drives.modbus import ModbusDrive
from rig.drives.wire import crc16
from rig_workbench.simulator import parse_fault


@pytest.fixture
def recorder():
    made = []

    def make(answer):
        made.append(Recorder(answer))
        return made[-1]

    yield make
    for peer in made:
        peer.close()


def test_speed_and_ramp_arrive_in_the_makers_units():
    axis = axis_with("leadshine_pr", speed_deg_s=36.0, accel_deg_s2=360.0)
    # reduction 10: 36 deg/s is 1 rev/s = 60 rpm; 360 deg/s^2 is 10 rev/s^2, so
    # 1000 rpm takes 1000 / 600 s = 1667 ms.
    assert axis.motion_counts() == {"speed": 60, "accel": 1667, "decel": 1667}
    axis = changed(axis, map=load_map("applied_motion"))
    assert axis.motion_counts() == {"speed": 240, "accel": 60, "decel": 60}
    axis = changed(axis, map=load_map("oriental_az"))
    assert axis.motion_counts()["speed"] == 10000


def test_a_speed_is_never_rounded_up_to_the_registers_unit():
    """1 rpm of a motor without a gear is 6 deg/s: 1 deg/s became 6 deg/s."""
    axis = axis_with("leadshine_pr", reduction=1.0, speed_deg_s=11.9, accel_deg_s2=600)
    assert axis.motion_counts()["speed"] == 1
    assert axis.drive_motion[0] == pytest.approx(6.0)
    slow = changed(axis, speed_deg_s=1.0)
    with pytest.raises(ValueError, match=r"speed_deg_s: must be at least 6 deg/s"):
        slow.motion_counts()
    assert changed(axis, speed_deg_s=6.0).motion_counts()["speed"] == 1
    text = fast_text({"speed_deg_s = 400": "speed_deg_s = 0.5"})
    with pytest.raises(ConfigError, match=r"pitch.speed_deg_s: must be at least 0\.6"):
        parse_config(text)


def test_a_ramp_register_holds_a_time_that_is_rounded_up():
    axis = axis_with("leadshine_pr", reduction=1.0, speed_deg_s=60, accel_deg_s2=3e5)
    assert axis.motion_counts()["accel"] == 20  # ms per 1000 rpm, of 20 exactly
    assert changed(axis, accel_deg_s2=2.95e5).motion_counts()["accel"] == 21
    with pytest.raises(ValueError, match=r"accel_deg_s2: .*does not fit u16"):
        changed(axis, accel_deg_s2=1.0).motion_counts()
    coarse = axis_with("applied_motion", reduction=1.0, accel_deg_s2=59.0)
    with pytest.raises(ValueError, match="accel_deg_s2: must be at least 60 deg/s"):
        coarse.motion_counts()


@given(
    name=st.sampled_from(MODBUS_MAPS),
    speed=st.floats(1e-3, 5000),
    accel=st.floats(1e-3, 1e5),
    reduction=st.floats(0.01, 500),
    per_rev=st.integers(200, 100_000),
)
def test_no_drive_is_told_to_be_quicker_than_configured(
    name, speed, accel, reduction, per_rev
):
    axis = axis_with(
        name, speed_deg_s=speed, accel_deg_s2=accel, reduction=reduction,
        pulses_per_rev=per_rev,
    )  # fmt: skip
    try:
        counts = axis.motion_counts()
    except ValueError as error:
        assert str(error).startswith(("speed_deg_s: ", "accel_deg_s2: "))
        return
    units = axis.map.units  # what the makers' units come to, worked out again
    in_unit = reduction / 360 * (per_rev if units.speed == "pulse_per_s" else 1)
    told = counts["speed"] / units.speed_per_unit / in_unit
    least = 1 / units.speed_per_unit / in_unit
    assert speed - least < told <= speed * (1 + 1e-8)
    turns = counts["accel"] / units.accel_per_unit
    if units.accel == "s_per_rev_per_s":
        turns = 1 / turns
    in_unit = reduction / 360 * (per_rev if units.accel == "pulse_per_s2" else 1)
    assert turns / in_unit <= accel * (1 + 1e-8)
    assert axis.drive_motion == pytest.approx((told, turns / in_unit))


@pytest.mark.parametrize("transport", ["tcp", "rtu_tcp", "rtu"])
def test_three_drives_move_on_every_transport(transport):
    if transport == "rtu":
        pytest.importorskip("serial", reason="serial ports need pyserial")
    config = fast_config()
    with simulator(config, transport=transport) as sim:
        with Bus(sim.start().bus) as bus:
            drives = [ModbusDrive(bus, axis) for axis in config.axes]
            for drive, target in zip(drives, (1000, -2000, 555), strict=True):
                drive.go(target)
            end = time.monotonic() + 10
            while not all(drive.status().done for drive in drives):
                assert time.monotonic() < end
            assert [d.status().position for d in drives] == [1000, -2000, 555]
        assert sim.executions() == [[1000], [-2000], [555]]


def test_a_target_outside_the_limits_never_reaches_the_bus():
    config = fast_config()
    with simulator(config) as sim, Bus(sim.start().bus) as bus:
        drive = ModbusDrive(bus, config.axes[0])
        for pulses in (config.axes[0].max_pulses + 1, config.axes[0].min_pulses - 1):
            with pytest.raises(ValueError, match="are outside"):
                drive.go(pulses)
        assert sim.server.requests == 0


@pytest.mark.parametrize(
    "fault", ["lost_reply", "lost_request", "noise_bytes", "exception_reply"]
)
def test_reads_are_retried(fault):
    config = fast_config(HASTY)
    with simulator(config) as sim, Bus(sim.start().bus) as bus:
        drive = ModbusDrive(bus, config.axes[0])
        sim.faults.add(parse_fault(f"{fault},count=2"))
        assert drive.status().position == round(sim.drives[0].position)
        sim.faults.add(parse_fault(fault))
        with pytest.raises(BusError):
            drive.status()


@pytest.mark.parametrize("transport", ["tcp", "rtu_tcp"])
def test_a_move_whose_reply_is_lost_is_executed_once_and_reported(transport):
    config = fast_config(HASTY)
    with (
        simulator(config, transport=transport) as sim,
        Bus(sim.start().bus) as bus,
    ):
        sim.faults.add(parse_fault("lost_write_reply,count=1"))
        with pytest.raises(BusError):
            ModbusDrive(bus, config.axes[0]).go(1234)
        assert sim.executions()[0] == [1234]


def test_exception_replies_are_errors_with_their_name():
    config = fast_config()
    with simulator(config, travel_deg=(-5, 5)) as sim, Bus(sim.start().bus) as bus:
        with pytest.raises(Rejected, match="illegal value") as caught:
            ModbusDrive(bus, config.axes[0]).go(5000)
        assert caught.value.code == 3
        with pytest.raises(Rejected, match="illegal address"):
            read_words(bus, 1, 0x7777, 1)


def test_a_late_reply_is_never_taken_for_the_next_one(recorder):
    """A peer that always answers one request late."""
    pending = []

    def answer(frame):
        value = struct.unpack(">H", frame[2:4])[0]
        body = frame[:2] + b"\x02" + struct.pack(">H", value)
        pending.append(body + crc16(body))
        if len(pending) == 1:
            time.sleep(0.15)  # beyond the time-out
        return pending[-1]

    peer = recorder(answer)
    with Bus(rtu_over_tcp(peer.port)) as bus:
        for address in (11, 22, 33, 44):
            assert read_words(bus, 1, address, 1) == [address]


def test_replies_of_another_unit_function_or_length_are_refused(recorder):
    script = {
        1: lambda f: bytes([9, 3, 2, 0, 1]),
        2: lambda f: bytes([1, 4, 2, 0, 1]),
        3: lambda f: bytes([1, 3, 4, 0, 1, 0, 2]),
    }
    for build in script.values():

        def answer(frame, build=build):
            body = build(frame)
            return body + crc16(body)

        peer = recorder(answer)
        with Bus(rtu_over_tcp(peer.port, retries=0)) as bus:
            with pytest.raises(BusError):
                read_words(bus, 1, 0, 1)


def test_silence_between_frames_is_kept(recorder):
    times = []

    def answer(frame):
        times.append(time.monotonic())
        body = frame[:2] + b"\x02\x00\x01"
        return body + crc16(body)

    peer = recorder(answer)
    with Bus(rtu_over_tcp(peer.port), silence_s=0.03) as bus:
        for _ in range(4):
            read_words(bus, 1, 0, 1)
    gaps = [b - a for a, b in itertools.pairwise(times)]
    assert min(gaps) >= 0.03


def test_a_closed_port_is_one_clear_error():
    with pytest.raises(BusError, match="cannot open"):
        Bus(rtu_over_tcp(free_port())).open()
    with pytest.raises(BusError, match="no such port"):
        Bus(BusSettings(transport="rtu", device="/dev/does-not-exist")).open()


def test_a_serial_port_in_use_says_so():
    pytest.importorskip("serial", reason="serial ports need pyserial")
    with simulator(fast_config(), transport="rtu") as sim:
        settings = sim.start().bus
        with Bus(settings), pytest.raises(BusError, match="in use by another"):
            Bus(settings).open()


def test_identify_only_reads():
    config = fast_config()
    frames = []
    with (
        simulator(config) as sim,
        Bus(sim.start().bus, emit=lambda event, **fields: frames.append(event)) as bus,
    ):
        for axis in config.axes:
            drive = ModbusDrive(bus, axis)
            drive.status(), drive.alarm()
            assert drive.ids()["pulses_per_rev"] == 10000
        assert frames == []


def test_stop_reaches_the_others_when_one_unit_is_dead():
    # A move of seconds, for a stop that comes late on a busy computer.
    config = fast_config({**HASTY, "speed_deg_s = 400": "speed_deg_s = 4"})
    with simulator(config) as sim, Bus(sim.start().bus) as bus:
        drives = [ModbusDrive(bus, axis) for axis in config.axes]
        for drive in drives:
            drive.go(5000 if drive.axis.name != "yaw" else -5000)
        sim.faults.add(parse_fault("dead_drive,axis=yaw"))
        pitch, yaw, roll = stop_all(drives)
        assert pitch.acknowledged and pitch.standing
        assert roll.acknowledged and roll.standing
        assert not yaw.acknowledged and not yaw.standing and yaw.detail
        assert not sim.drives[0].moving and sim.drives[0].position != 5000


@contextlib.contextmanager
def pymodbus_server():
    """pymodbus' own server with 200 registers in a thread; gives its port.

    Closing the loop under a connection that pymodbus still holds ends in errors that
    are printed when the tests are over, so it is closed once nothing is left on it.
    """
    from pymodbus.server import ModbusTcpServer
    from pymodbus.simulator import DataType, SimData, SimDevice

    started: queue.Queue = queue.Queue()
    left: list[object] = []

    async def run():
        registers = SimData(0, count=200, values=0, datatype=DataType.REGISTERS)
        address = ("127.0.0.1", 0)
        server = ModbusTcpServer([SimDevice(1, simdata=[registers])], address=address)
        await server.serve_forever(background=True)
        stop = asyncio.Event()
        port = server.transport.sockets[0].getsockname()[1]
        started.put((asyncio.get_running_loop(), stop, port))
        await stop.wait()
        while server.active_connections:  # until the client's end has arrived
            await asyncio.sleep(0.01)
        await server.shutdown()
        await asyncio.sleep(0.01)
        left.extend(asyncio.all_tasks() - {asyncio.current_task()})

    thread = threading.Thread(target=asyncio.run, args=(run(),))
    thread.start()
    loop, stop, port = started.get(timeout=30)
    try:
        yield port
    finally:
        loop.call_soon_threadsafe(stop.set)
        thread.join(30)
        assert not thread.is_alive() and not left, left


def test_against_pymodbus_own_server_on_tcp():
    """A second stack at the other end: registers stored there read back the same."""
    with pymodbus_server() as port:
        settings = BusSettings(
            transport="tcp", host="127.0.0.1", port=port, timeout_s=1.0
        )
        axis = changed(axis_with("generic"), unit=1)
        with Bus(settings) as bus:
            bus.write(1, 10, 16, [0xFFFE, 0xEE8F, 3])
            assert read_words(bus, 1, 10, 3) == [0xFFFE, 0xEE8F, 3]
            bus.write(1, 20, 6, [77])
            assert read_words(bus, 1, 20, 1) == [77]
            ModbusDrive(bus, axis).go(-321)
            assert read_words(bus, 1, 0x20, 2) == [0xFFFF, 0x10000 - 321]
            assert read_words(bus, 1, 0x28, 1) == [1]


def test_only_one_file_opens_a_drive_port():
    import rig

    for path in pathlib.Path(rig.__file__).parent.rglob("*.py"):
        assert "pymodbus.client" not in path.read_text(), path.name
        if path.parent.name != "simulator":  # whose frames are pymodbus's
            assert "pymodbus" not in path.read_text(), path.name
