"""device.json: states that stand on each other, and what takes them away."""

import json

import pytest
from harness import fast_config

from rig.config import parse_config
from rig.config.config import differences
from rig.faults import Refused
from rig.journal.device import (
    HOMED,
    IDENTIFIED,
    SIGN_CHECKED,
    STATES,
    STOP_PROVED,
    ZEROED,
    DeviceRecord,
)

CONFIG = fast_config()


@pytest.fixture
def record(tmp_path):
    """Of a device that has reached every state."""
    made = DeviceRecord.load(tmp_path / "device.json")
    for name in STATES:
        made.reach(name, CONFIG, word=name)
    return made


def test_a_record_without_a_file_is_empty_and_says_what_to_do(tmp_path):
    record = DeviceRecord.load(tmp_path / "device.json")
    text = record.missing(CONFIG)
    assert "not IDENTIFIED" in text and "it never was" in text
    assert text.index("scan") < text.index("home") < text.index("axes")
    assert record.left() == ({}, []) and not (tmp_path / "device.json").exists()


def test_states_are_kept_on_the_disk(record):
    again = DeviceRecord.load(record.path)
    assert again.missing(CONFIG, ZEROED) is None
    assert again.state(HOMED) == {"word": "HOMED"}
    assert json.loads(record.path.read_text())["schema"] == 1


def test_a_state_needs_those_before_it(tmp_path):
    record = DeviceRecord.load(tmp_path / "device.json")
    record.reach(IDENTIFIED, CONFIG)
    with pytest.raises(Refused, match="not HOMED"):
        record.reach(SIGN_CHECKED, CONFIG)


@pytest.mark.parametrize("lost", STATES)
def test_what_is_void_takes_all_after_it_along_and_says_why(record, lost):
    record.void(lost, "alarm of yaw")
    again = DeviceRecord.load(record.path)
    stand = [name for name in STATES if again.state(name) is not None]
    assert stand == list(STATES[: STATES.index(lost)])
    text = again.missing(CONFIG, ZEROED)
    assert f"not {lost}: alarm of yaw" in text


def test_other_evidence_makes_what_was_built_on_it_void(record):
    record.reach(HOMED, CONFIG, word="HOMED")
    assert record.missing(CONFIG, ZEROED) is None
    record.reach(HOMED, CONFIG, word="somewhere else")
    assert "HOMED was passed again" in record.missing(CONFIG)
    record.reach(SIGN_CHECKED, CONFIG)
    record.reach(STOP_PROVED, CONFIG)
    assert record.missing(CONFIG) is None


@pytest.mark.parametrize(
    ("old", "new", "key", "state"),
    [
        ("pulses_per_rev = 10000", "pulses_per_rev = 4000",
         "axes.pitch.pulses_per_rev: was 10000, is 4000", SIGN_CHECKED),
        ("direction = -1", "direction = 1",
         "axes.yaw.direction: was -1, is 1", SIGN_CHECKED),
        ('order = "ZXY"', 'order = "ZYX"',
         "mechanism.order: was ZXY, is ZYX", SIGN_CHECKED),
        ("column_count = 4", "column_count = 4\nmounting_deg = [0, 0, 90]",
         "imu.mounting_deg: was [0.0, 0.0, 0.0], is [0.0, 0.0, 90.0]", SIGN_CHECKED),
        ("unit = 3", "unit = 4", "axes.roll.unit: was 3, is 4", IDENTIFIED),
        ('"leadshine_pr"', '"oriental_az"', "axes.pitch.map: was leadshine_pr (",
         IDENTIFIED),
    ],
)  # fmt: skip
def test_an_edited_key_is_named_with_both_values(record, old, new, key, state):
    text = record.missing(fast_config({old: new}))
    assert f"not {state}: edited since" in text and key in text


def test_keys_that_say_nothing_of_a_place_change_nothing(record):
    other = fast_config({"std_deg = 0.1": "std_deg = 0.2", "port = 5020": "port = 1"})
    assert record.missing(other, ZEROED) is None
    assert differences(CONFIG.device_fingerprint(), other.device_fingerprint()) == []


def test_a_fingerprint_is_the_same_once_it_was_json():
    found = CONFIG.device_fingerprint()
    assert json.loads(json.dumps(found)) == found
    assert differences({}, {"a": 1}) == ["a: was not known, is 1"]


def test_where_the_drives_were_left(record):
    record.left_at({"pitch": 10, "yaw": None, "roll": -3})
    assert DeviceRecord.load(record.path).left()[0] == {
        "pitch": 10,
        "yaw": None,
        "roll": -3,
    }
    record.left_at(dict.fromkeys(("pitch", "yaw", "roll")))
    assert set(DeviceRecord.load(record.path).left()[0].values()) == {None}


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"schema": 2}', "\x00"])
def test_a_damaged_record_is_refused_with_its_path(tmp_path, text):
    path = tmp_path / "device.json"
    path.write_text(text)
    with pytest.raises(Refused, match=r"device\.json: not a device record"):
        DeviceRecord.load(path)


def test_the_record_lies_beside_the_configuration(tmp_path):
    text = 'device = "here/it.json"\n' + CONFIG.text
    assert parse_config(text, tmp_path).device_path == tmp_path / "here/it.json"
    assert parse_config(CONFIG.text, tmp_path).device_path == tmp_path / "device.json"
