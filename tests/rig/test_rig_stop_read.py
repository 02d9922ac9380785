"""What a stop reads of a broken file or map: as much as there is, nothing invented."""

import pytest

from rig import stop_config
from rig.config.config import EXAMPLES
from rig.config.maps import MAP_FOLDER

MAP_TEXT = (MAP_FOLDER / "leadshine_pr.toml").read_text()
STOP = "address = 0x6002, words = [0x0040]"


def map_of(old, new):
    """What is read of a map with a change, and its faults."""
    faults = []
    assert old in MAP_TEXT, old
    return stop_config.map_of(MAP_TEXT.replace(old, new), MAP_FOLDER, faults), faults


# Maps


@pytest.mark.parametrize(
    "stop",
    [
        'address = "0x6002", words = [0x0040]',
        'address = 0x6002, words = ["0x0040"]',
        "address = 0x6002, words = 0x0040",
        'address = [0x6002], words = "64"',
    ],
)
def test_a_stop_frame_is_read_or_refused(stop):
    drive_map, faults = map_of(STOP, stop)
    assert not faults
    frames = [(f.address, [w.value for w in f.words]) for f in drive_map.stop.write]
    assert frames == [(0x6002, [0x40])]


@pytest.mark.parametrize("address", ['"x6002"', '""', '"6 2"', "-1", "65536", "1.5"])
def test_no_other_register_is_written_for_an_address_that_is_none(address):
    drive_map, faults = map_of(STOP, f"address = {address}, words = [0x0040]")
    assert drive_map is None
    assert faults == ["the map leadshine_pr has no readable [stop]"]


@pytest.mark.parametrize("drive", ["Modbus", "modbuss", ""])
def test_a_kind_that_names_no_class_is_modbus(drive):
    drive_map, _ = map_of("schema = 1", f'drive = "{drive}"')
    assert drive_map.drive == "modbus"


@pytest.mark.parametrize("address", ["-1", "0x11003", '"x"'])
def test_a_status_that_cannot_be_read_is_told_in_words(address):
    drive_map, faults = map_of("address = 0x1003", f"address = {address}")
    assert drive_map.stop and drive_map.status is None
    text = "[status] or [position] of the map leadshine_pr cannot be read"
    assert faults == [text]
