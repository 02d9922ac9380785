"""RTU frames bear no number: a reply that comes late is taken for no other's.

The line is a pseudo-terminal, or a socket without Modbus TCP's numbers. The reply of
one question comes when the next has been asked; both ask for two registers. The
connection is kept all the while.
"""

import contextlib
import time

import pytest
from harness import changed, fast_config, read_words, simulator

from rig.drives.bus import Bus
from rig.drives.line import BusError
from rig.drives.modbus import ModbusDrive
from rig_workbench.simulator import parse_fault
from rig_workbench.simulator.drive import DriveException

PAIRS = {'map = "leadshine_pr"': 'map = "oriental_az"'}  # status and position: 2 and 2
PLACE = 123456
PLACE_AT, PLACE_WORDS = 0x00CC, [PLACE >> 16, PLACE & 0xFFFF]
TIMEOUT_S = 0.08


@pytest.fixture(params=["rtu", "rtu_tcp"])
def line(request):
    """A drive that stands at PLACE, and its bus."""
    if request.param == "rtu":
        pytest.importorskip("serial", reason="serial ports need pyserial")
    config = fast_config(PAIRS)
    with simulator(config, transport=request.param) as sim:
        settings = changed(sim.start().bus, timeout_s=TIMEOUT_S, read_retries=2)
        sim.drives[0].position = PLACE
        with Bus(settings, config.silence_s) as bus:
            yield sim, bus, ModbusDrive(bus, config.axes[0])


def position_after_a_late_status(line, late_s):
    """What is read of the position while the reply to the status is to come."""
    sim, bus, drive = line
    unit, status = drive.axis.unit, drive.axis.map.status
    delay = TIMEOUT_S + late_s
    sim.faults.add(parse_fault(f"delayed_reply,count=1,axis=pitch,seconds={delay}"))
    with contextlib.suppress(BusError):
        read_words(bus, unit, status.address, status.count, retries=0)
    with contextlib.suppress(BusError):  # no answer is an answer; a wrong one is not
        return read_words(bus, unit, PLACE_AT, 2, retries=0)
    return PLACE_WORDS


def test_a_late_status_is_not_taken_for_the_position(line):
    """H: the status came 30 ms late, and was the position."""
    drive = line[2]
    word = drive.status().word
    assert word != PLACE
    for late_s in (0.03, 0.05, 0.07, 0.09):
        assert position_after_a_late_status(line, late_s) == PLACE_WORDS
        found = drive.status()
        assert (found.word, found.position) == (word, PLACE)


def test_every_reply_of_a_slow_unit_is_its_own_or_none(line):
    """All replies are late, by more than a question's patience; then none is."""
    sim, bus, drive = line
    word = drive.status().word
    sim.faults.add(parse_fault(f"delayed_reply,axis=pitch,seconds={1.4 * TIMEOUT_S}"))
    end = time.monotonic() + 3.0
    while time.monotonic() < end:
        try:
            assert read_words(bus, drive.axis.unit, PLACE_AT, 2) == PLACE_WORDS
        except BusError:
            pass
        try:
            assert read_words(bus, drive.axis.unit, 0x007E, 2) == [0, word]
        except BusError:
            pass
    sim.repair()
    time.sleep(10 * TIMEOUT_S)
    for _ in range(5):
        found = drive.status()
        assert (found.word, found.position) == (word, PLACE)


def test_a_drive_that_refuses_a_pair_by_halves_is_told_apart_too(line):
    """Its refusal answers the question as well as its registers would."""
    sim, _, drive = line
    word, read = drive.status().word, sim.drives[0].read

    def strict(address, count):
        if count == 1:
            raise DriveException(2)
        return read(address, count)

    sim.drives[0].read = strict
    for late_s in (0.03, 0.05, 0.07):
        assert position_after_a_late_status(line, late_s) == PLACE_WORDS
    found = drive.status()
    assert (found.word, found.position) == (word, PLACE)


class Talking:
    """A serial port on which bytes still come in until it was emptied so often."""

    def __init__(self, port, emptied):
        self.port, self.emptied, self.sent_into = port, emptied, []

    def __getattr__(self, name):
        return getattr(self.port, name)

    @property
    def in_waiting(self):
        return 1 if self.emptied else self.port.in_waiting

    def reset_input_buffer(self):
        self.emptied = max(0, self.emptied - 1)

    def read(self, size=1):
        return b"" if self.emptied else self.port.read(size)

    def write(self, data):
        self.sent_into.append(self.emptied)
        return self.port.write(data)


@pytest.mark.slow
def test_nothing_is_sent_while_a_serial_line_is_not_quiet():
    """A frame sent into a late reply would meet it on the wire."""
    pytest.importorskip("serial", reason="serial ports need pyserial")
    config = fast_config(PAIRS)
    with simulator(config, transport="rtu") as sim:
        sim.drives[0].position = PLACE
        with Bus(changed(sim.start().bus, timeout_s=5.0, read_retries=1)) as bus:
            assert read_words(bus, 1, PLACE_AT, 2) == PLACE_WORDS
            port = bus._client.socket = Talking(bus._client.socket, 3)
            assert read_words(bus, 1, PLACE_AT, 2) == PLACE_WORDS
    first, *others = port.sent_into
    assert first == 3 and others and not any(others)


@pytest.mark.parametrize("transport", ["tcp", "rtu_tcp"])
def test_a_lost_reply_over_a_network_leaves_the_connection(transport):
    """A gateway that gives one would give no other for seconds."""
    config = fast_config(PAIRS)
    with simulator(config, transport=transport) as sim:
        sim.drives[0].position = PLACE
        sim.faults.add(parse_fault("lost_reply,count=1,axis=pitch"))
        settings = changed(sim.start().bus, timeout_s=TIMEOUT_S, read_retries=0)
        with Bus(settings) as bus:
            first = bus._client.socket
            with pytest.raises(BusError):
                read_words(bus, 1, PLACE_AT, 2)
            assert read_words(bus, 1, PLACE_AT, 2, retries=9) == PLACE_WORDS
            assert bus._client.socket is first and first.fileno() >= 0
