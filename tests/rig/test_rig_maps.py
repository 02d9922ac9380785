"""Register maps against what their makers publish, typed in by hand.

The frames are copied from manuals, vendors' examples and recorded sessions, with the
check bytes printed there; where none are printed they come from the table below, which
shares nothing with the one that is tested.
"""

import pytest
from recorder import Recorder, axis_with, rtu_over_tcp

from rig.drives.bus import Bus
from rig.drives.modbus import ModbusDrive
from rig.drives.wire import crc16


def mirrored(value, bits):
    return int(f"{value:0{bits}b}"[::-1], 2)


def _entry(byte):
    """CRC-16 with the polynomial x^16 + x^15 + x^2 + 1 (0x8005), highest bit first."""
    value = byte << 8
    for _ in range(8):
        value = value << 1 ^ (0x18005 if value & 0x8000 else 0)
    return value


TABLE = [_entry(byte) for byte in range(256)]


def check_bytes(data):
    """The CRC of an RTU frame, over mirrored bytes, low byte first."""
    value = 0xFFFF
    for byte in data:
        value = (value << 8 & 0xFFFF) ^ TABLE[value >> 8 ^ mirrored(byte, 8)]
    return mirrored(value, 16).to_bytes(2, "little")


def frame(text, crc=""):
    """A frame typed in as hex; ``crc``: its check bytes where they are printed."""
    data = bytes.fromhex(text)
    check = check_bytes(data)
    assert not crc or check == bytes.fromhex(crc), f"{text}: misread, or a wrong table"
    return data + check


@pytest.fixture
def spoken():
    """Bytes that a drive of a map is sent when something is done with it."""
    made = []

    def say(map_name, unit, act, answer=None, **changes):
        peer = Recorder(answer or echo)
        made.append(peer)
        with Bus(rtu_over_tcp(peer.port, retries=0, timeout_s=1.0)) as bus:
            result = act(ModbusDrive(bus, axis_with(map_name, unit=unit, **changes)))
        return peer.received, result

    yield say
    for peer in made:
        peer.close()


def echo(sent):
    """How a drive acknowledges a write."""
    return sent if sent[1] == 6 else sent[:6] + check_bytes(sent[:6])


def test_the_check_bytes_are_those_of_the_standard():
    """Of the Modbus specification's worked example, and of the two implementations."""
    assert check_bytes(bytes.fromhex("0207")) == bytes.fromhex("4112")
    for text in ("010300000001", "0506007C0067", "FF" * 40):
        data = bytes.fromhex(text)
        assert crc16(data) == check_bytes(data)


# Leadshine PR family


def test_leadshine_move_is_the_frame_of_the_manual(spoken):
    """CS2RS manual, page 43: absolute to 10000, ramps 10000, run at once."""
    printed = frame(
        "07 10 62 00 00 08 10 00 01 00 00 27 10 00 00 27 10 27 10 00 00 00 10", "8D 50"
    )
    sent, _ = spoken(
        "leadshine_pr", 7,
        lambda d: d.write(d.axis.map.move, position=10000, speed=0, accel=10000,
                          decel=10000),
    )  # fmt: skip
    assert sent == printed


def test_leadshine_registers_are_those_of_a_recorded_session(spoken):
    """Recorded with the check bytes: 200000 pulses at 600 rpm, ramps 50 ms/1000 rpm."""
    recorded = [
        frame("01 06 62 00 00 01", "57 B2"),  # absolute
        frame("01 06 62 01 00 03", "87 B3"),  # position, high word
        frame("01 06 62 02 0D 40", "32 D2"),  # position, low word
        frame("01 06 62 03 02 58", "66 E8"),
        frame("01 06 62 04 00 32", "56 66"),
        frame("01 06 62 05 00 32", "07 A6"),
    ]
    # reduction 10: 600 rpm are 360 deg/s; 1000 rpm in 50 ms are 12000 deg/s^2
    sent, _ = spoken(
        "leadshine_pr", 1, lambda d: d.go(200000), speed_deg_s=360.0,
        accel_deg_s2=12000.0, max_deg=2e4,
    )  # fmt: skip
    assert sent[:7] == bytes.fromhex("01 10 62 00 00 08 10")
    assert sent[7:19] == b"".join(single[4:6] for single in recorded)
    # 0x6206: no pause; 0x6207 is mapped to 0x6002, where 0x0010 runs path 0:
    assert sent[19:23] == b"\0\0" + frame("01 06 60 02 00 10", "37 C6")[4:6]


def test_leadshine_stop_and_homing(spoken):
    stop, _ = spoken("leadshine_pr", 1, ModbusDrive.stop)
    assert stop == frame("01 06 60 02 00 40", "37 FA")
    home, _ = spoken("leadshine_pr", 1, lambda d: d.write(d.axis.map.home))
    assert home == frame("01 06 60 02 00 20")


@pytest.mark.parametrize(
    ("word", "flags"),
    [  # words seen on drives: standing, moving, standing and homed, in alarm
        ("00 32", {"enabled", "done"}),
        ("00 06", {"enabled", "moving"}),
        ("00 72", {"enabled", "done", "homed"}),
        ("00 01", {"fault"}),
    ],
)
def test_leadshine_status_and_position(word, flags, spoken):
    replies = {
        frame("01 03 10 03 00 01"): frame(f"01 03 02 {word}"),
        frame("01 03 60 2C 00 02"): frame("01 03 04 FF FE EE 8F"),
    }
    sent, status = spoken("leadshine_pr", 1, ModbusDrive.status, replies.__getitem__)
    assert sent == b"".join(replies)
    assert status.position == -70001
    homed = axis_with("leadshine_pr").map.homed.holds(status.word)
    found = {n for n in ("enabled", "done", "moving", "fault") if getattr(status, n)}
    assert found | ({"homed"} if homed else set()) == flags


# Oriental Motor AZ


def test_oriental_move_is_the_direct_data_operation_of_the_manual(spoken):
    """HM-60262, direct data operation: 8500 steps at 2000 Hz, rates 1.5 kHz/s, 100 %.

    Printed with operation type 2, incremental; here it is 1, absolute.
    """
    printed = frame(
        "01 10 00 58 00 10 20 00 00 00 00 00 00 00 02 00 00 21 34 00 00 07 D0"
        "00 00 05 DC 00 00 05 DC 00 00 03 E8 00 00 00 01",
        "1C 08",
    )
    absolute = printed[:13] + b"\x00\x01" + printed[15:-2]
    sent, _ = spoken(
        "oriental_az", 1, lambda d: d.go(8500), pulses_per_rev=1000, reduction=1.0,
        speed_deg_s=720.0, accel_deg_s2=540.0, max_deg=2e4,
    )  # fmt: skip
    assert sent == absolute + check_bytes(absolute)


def test_oriental_pairs_have_the_high_word_first(spoken):
    """The maker's FAQ 0331: -1000 to 1802h and 1803h is FFFFh, FC18h."""
    sent, _ = spoken(
        "oriental_az", 1, lambda d: d.line.write(1, 0x1802, 16, [0xFFFF, 0xFC18])
    )
    assert sent == frame("01 10 18 02 00 02 04 FF FF FC 18")
    sent, _ = spoken("oriental_az", 1, lambda d: d.go(-1000))
    assert sent[15:19] == bytes.fromhex("FF FF FC 18")


def test_oriental_stop_is_given_and_taken_back(spoken):
    sent, _ = spoken("oriental_az", 3, ModbusDrive.stop)
    assert sent == frame("03 06 00 7D 00 20") + frame("03 06 00 7D 00 00")


def test_oriental_status_position_and_alarm(spoken):
    """READY (bit 5) and IN-POS (bit 14) of 007Fh; feedback at 00CCh; alarm at 0080h."""
    replies = {
        frame("01 03 00 7E 00 02"): frame("01 03 04 00 00 40 20"),
        frame("01 03 00 CC 00 02"): frame("01 03 04 00 00 21 34"),
        frame("01 03 00 80 00 02"): frame("01 03 04 00 00 00 85"),
    }
    sent, found = spoken(
        "oriental_az", 1, lambda d: (d.status(), d.alarm()), replies.__getitem__
    )
    assert sent == b"".join(replies)
    status, alarm = found
    assert status.done and not status.moving and not status.fault
    assert status.position == 8500
    assert alarm == "alarm 0x85 (RS-485 communication timeout)"


# Applied Motion


def test_applied_motion_move_is_what_a_running_machine_sends(spoken):
    """Recorded: 228580 steps at 7 rev/s, ramps 600 rev/s^2; then opcode FP."""
    recorded = frame(
        "05 10 00 1B 00 05 0A 0E 10 0E 10 06 90 00 03 7C E4", "74 AA"
    ) + frame("05 06 00 7C 00 67", "08 7C")
    # reduction 10: 7 rev/s are 252 deg/s, 600 rev/s^2 are 21600 deg/s^2
    replies = {  # it is asked first whether its home is at 2**30 or at 0
        frame("05 03 00 01 00 01"): frame("05 03 02 00 09"),
        frame("05 03 00 06 00 02"): frame("05 03 04 00 00 00 00"),
    }
    sent, _ = spoken(
        "applied_motion", 5, lambda d: d.go(228580),
        lambda sent: replies.get(sent) or echo(sent), speed_deg_s=252.0,
        accel_deg_s2=21600.0, max_deg=2e4,
    )  # fmt: skip
    assert sent == b"".join(replies) + recorded


def test_applied_motion_counts_from_where_home_was_set(spoken):
    """Home at 2**30: the target and the position are counted from there."""
    replies = {
        frame("05 03 00 01 00 01"): frame("05 03 02 00 09"),
        frame("05 03 00 06 00 02"): frame("05 03 04 40 00 00 05"),
    }

    def move(drive):
        drive.go(1000)
        return drive.last.position, drive.origin

    sent, found = spoken(
        "applied_motion", 5, move, lambda sent: replies.get(sent) or echo(sent)
    )
    assert found == (5, 2**30)
    assert (2**30 + 1000).to_bytes(4, "big") in sent
    assert (1000).to_bytes(4, "big") not in sent
    home, _ = spoken(
        "applied_motion", 5, lambda d: d.write(d.axis.map.set_zero, home=2**30)
    )
    assert home == frame("05 10 00 7C 00 06 0C 00 A5 40 00 00 00 00 00 00 00 00 00")


def test_applied_motion_opcodes(spoken):
    """Opcodes of the host command reference: SK E1, ME 9F, AR BA; all to 40125."""
    stop, _ = spoken("applied_motion", 32, ModbusDrive.stop)
    assert stop == frame("20 06 00 7C 00 E1")
    enable, _ = spoken("applied_motion", 32, lambda d: d.write(d.axis.map.enable))
    assert enable == frame("20 06 00 7C 00 9F")
    reset, _ = spoken("applied_motion", 32, lambda d: d.write(d.axis.map.alarm_reset))
    assert reset == frame("20 06 00 7C 00 BA")


def test_applied_motion_status_and_position(spoken):
    """SC at 40002: enabled (bit 0) and in position (bit 3); IP at 40007."""
    replies = {
        frame("20 03 00 01 00 01"): frame("20 03 02 00 09"),
        frame("20 03 00 06 00 02"): frame("20 03 04 00 03 7C E4"),
    }
    sent, status = spoken("applied_motion", 32, ModbusDrive.status, replies.__getitem__)
    assert sent == b"".join(replies)
    assert status.enabled and status.done and not status.moving and not status.fault
    assert status.position == 228580


@pytest.mark.parametrize(
    ("map_name", "position"),
    [("leadshine_pr", 0x6201), ("oriental_az", 0x005C), ("applied_motion", 0x001E)],
)
def test_the_target_is_read_back_where_the_move_wrote_it(map_name, position):
    axis = axis_with(map_name)
    assert axis.map.target.address == position
    assert axis.map.move.place_of("position") == (position, axis.map.target.type)
