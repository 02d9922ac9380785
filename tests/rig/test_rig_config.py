"""Configuration and maps: every fault at once, and all that ships is valid."""

import json
import pathlib
import re
from typing import get_args

import pydantic
import pytest
from harness import MODBUS_MAPS

from rig.config import ConfigError, load_config, parse_config
from rig.config.axis import Axis, Scale
from rig.config.config import EXAMPLES, RigConfig
from rig.config.maps import (
    MAP_FOLDER,
    DriveMap,
    RegisterMap,
    load_map,
)
from rig.config.schema import Section, parse
from rig.registers import decode, encode

EXAMPLE_TEXT = (EXAMPLES / "simulate.toml").read_text()
GENERIC = (MAP_FOLDER / "generic.toml").read_text()


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.toml")), ids=lambda p: p.stem)
def test_every_example_is_valid(path):
    assert load_config(path).device_fingerprint()


@pytest.mark.parametrize("name", MODBUS_MAPS)
def test_every_map_that_ships_keeps_the_schema(name):
    loaded = load_map(name)
    assert loaded.name == name
    assert loaded.stop and loaded.move
    frames = loaded.move.write
    written = {f.address + i for f in frames for i in range(f.count)}
    assert loaded.move.trigger.address in written
    names = {word.value for frame in frames for word in frame.words}
    assert {"position", "speed", "accel"} <= names


def test_there_is_an_example_for_every_map():
    assert set(MODBUS_MAPS) <= {path.stem for path in EXAMPLES.glob("*.toml")}


def test_every_fault_of_a_configuration_is_listed_at_once():
    text = EXAMPLE_TEXT.replace("unit = 2", "unit = 1")
    text = text.replace("reduction = 10\n", "reduction = -10\n", 1)
    text = text.replace('order = "ZXY"', 'order = "ZXZ"')
    text = text.replace("window_s = 0.2", "window_s = nan")
    text = text.replace("port = 2055", "prot = 2055")
    with pytest.raises(ConfigError) as caught:
        parse_config(text)
    faults = "\n".join(caught.value.faults)
    for part in (
        "axes.pitch.reduction",
        "unit must differ",
        "mechanism.order",
        "settle.window_s",
        "imu.port: missing",
        "imu.prot: unknown key",
    ):
        assert part in faults
    assert len(caught.value.faults) == 6


@pytest.mark.parametrize(
    ("old", "new", "part"),
    [
        ("max_deg = 20", "max_deg = -30", "under max_deg"),
        ('map = "leadshine_pr"', 'map = "unknown"', "no register map"),
        ("pulses_per_rev = 10000", "pulses_per_rev = 10", "coarser than"),
        ("speed_deg_s = 120", "speed_deg_s = 0", "speed_deg_s"),
        ("speed_deg_s = 120", "comm_timeout_s = 1\nspeed_deg_s = 120", "no register"),
        ("direction = -1", "direction = 0", "must be 1 or -1"),
        ("timeout_s = 5", "timeout_s = 0.1", "longer than window_s"),
        ('transport = "tcp"', 'transport = "udp"', "one of tcp"),
        ("column_count = 4", "column_count = 2", "too few"),
        ("unit = 3", 'unit = "three"', "whole number"),
        ("poll_s = 0.01", "approach_overshoot_deg = 19\nmax_step_deg = -1", "max_step"),
        ("speed_deg_s = 120", "speed_deg_s = 4e3\naccel_deg_s2 = 1", "does not fit"),
    ],
)
def test_a_wrong_value_is_named(old, new, part):
    text = EXAMPLE_TEXT.replace(old, new, 1)
    if "accel_deg_s2 = 1" in new:
        text = text.replace("accel_deg_s2 = 1200\n", "", 1)
        text = text.replace("reduction = 10\n", "reduction = 1e4\n", 1)
        text = text.replace("pulses_per_rev = 10000", "pulses_per_rev = 1000", 1)
    with pytest.raises(ConfigError, match=part):
        parse_config(text)


def test_a_session_range_outside_the_limits_is_refused():
    text = EXAMPLE_TEXT + "\n[session]\npitch_range_deg = [-25, 10]\nk = 60\n"
    with pytest.raises(ConfigError) as caught:
        parse_config(text)
    assert any("pitch_range_deg" in fault for fault in caught.value.faults)
    assert any("session.k" in fault for fault in caught.value.faults)


def test_an_overshoot_shrinks_the_default_ranges_and_binds_given_ones():
    text = EXAMPLE_TEXT.replace("[motion]", "[motion]\napproach_overshoot_deg = 2")
    assert parse_config(text).ranges[0] == (-18.0, 20.0)
    with pytest.raises(ConfigError, match="overshoot"):
        parse_config(text + "\n[session]\nyaw_range_deg = [-20, 20]\n")


@pytest.mark.parametrize(
    "text", ["[bus", "", "axes = 3", "bus = 1\nimu = 2\naxes = [1]"]
)
def test_nonsense_is_one_clear_error(text):
    with pytest.raises(ConfigError):
        parse_config(text)


def test_a_run_is_resumed_with_other_addresses_and_limits_and_nothing_else():
    config = parse_config(EXAMPLE_TEXT)
    began = {"config": config.described(), "device": config.device_fingerprint()}
    began = json.loads(json.dumps(began))
    limits = "[session]\nverify_limit_deg = 0.1\nreference_tolerance_deg = 0.1\n"
    for old, new in (
        ("port = 5020", "port = 5021"),
        ("timeout_s = 5\n", "timeout_s = 6\n"),
        ("poll_s = 0.01", "poll_s = 0.02\nstall_s = 0.6"),
        ("[settle]", limits + "[settle]"),
    ):
        assert old in EXAMPLE_TEXT
        judged = parse_config(EXAMPLE_TEXT.replace(old, new, 1))
        assert judged.changed_since(began) == [], new
    for old, new, named in (
        ("reduction = 10", "reduction = 11", "axes.pitch.reduction: was 10.0"),
        ('order = "ZXY"', 'order = "ZYX"', "mechanism.order: was ZXY, is ZYX"),
        ("samples = 25", "samples = 26", "settle.samples: was 25, is 26"),
        ("[settle]", "[session]\nk = 6\n[settle]", "session.k: was 4, is 6"),
        (
            'map = "leadshine_pr"',
            'map = "generic"',
            "axes.pitch.map: was leadshine",
        ),
    ):
        changed = parse_config(EXAMPLE_TEXT.replace(old, new, 1))
        assert any(text.startswith(named) for text in changed.changed_since(began))


def test_pulses_are_rounded_first_and_the_angle_follows_from_them():
    scale = Scale(pulses_per_rev=1000, reduction=7.5, direction=-1)
    pulses = scale.to_pulses(10.01)
    assert pulses == round(-1000 * 7.5 * 10.01 / 360)
    rounded = scale.to_deg(pulses)
    assert rounded == pytest.approx(360 * -pulses / (1000 * 7.5))
    assert scale.to_pulses(rounded) == pulses


@pytest.mark.parametrize("order", ["big", "little"])
@pytest.mark.parametrize("kind", ["u16", "i16", "u32", "i32"])
def test_values_survive_registers(kind, order):
    low = {"u16": 0, "u32": 0, "i16": -(2**15), "i32": -(2**31)}[kind]
    high = {"u16": 2**16, "u32": 2**32, "i16": 2**15, "i32": 2**31}[kind] - 1
    for value in (low, high, 0, 1, low + 1, high - 1, 12345):
        assert decode(encode(value, kind, order), kind, order) == value
    for value in (low - 1, high + 1):
        with pytest.raises(ValueError, match="does not fit"):
            encode(value, kind, order)


def test_word_order_of_a_pair_is_the_makers():
    assert encode(-70001, "i32", "big") == [0xFFFE, 0xEE8F]
    assert encode(-70001, "i32", "little") == [0xEE8F, 0xFFFE]
    assert encode(-1000, "i32", "big") == [0xFFFF, 0xFC18]  # Oriental Motor FAQ 0331


def test_every_fault_of_a_map_is_listed_at_once():
    text = 'colour = "red"\n' + GENERIC
    for old, new in {
        'word_order = "big"': 'word_order = "middle"',
        "address = 0x0012": "address = 70000",
        "position:i32": "positon:i32",
        "done = { set = [3]": "done = { set = [99]",
    }.items():
        assert old in text
        text = text.replace(old, new)
    with pytest.raises(ConfigError) as caught:
        parse(RegisterMap, text, "broken.toml")
    text = str(caught.value)
    for part in ("word_order", "position.address", "positon", "status.done", "colour"):
        assert part in text


def test_the_trigger_must_be_written_last():
    text = GENERIC.replace("trigger = { address = 0x0028", "trigger = { address = 0x20")
    with pytest.raises(ConfigError, match="last word of the last frame"):
        parse(RegisterMap, text, "broken.toml")


def test_a_map_beside_the_configuration_needs_no_code(tmp_path):
    text = GENERIC.replace("0x0012", "0x0112")
    (tmp_path / "mine.toml").write_text(text.replace('"generic"', '"mine"'))
    (tmp_path / "rig.toml").write_text(
        EXAMPLE_TEXT.replace('map = "leadshine_pr"', 'map = "mine.toml"')
    )
    config = load_config(tmp_path / "rig.toml")
    assert {axis.map.position.address for axis in config.axes} == {0x112}


def test_configuration_is_frozen():
    config = parse_config(EXAMPLE_TEXT)
    for table, key in ((config, "output"), (config.mechanism, "order")):
        with pytest.raises(pydantic.ValidationError, match="frozen"):
            setattr(table, key, "XYZ")


def test_an_unknown_key_names_the_nearest_known_one():
    text = EXAMPLE_TEXT.replace("window_s = 0.2", "windows_s = 0.2")
    with pytest.raises(ConfigError) as caught:
        parse_config(text.replace("pulses_per_rev = 10000", "pulse_per_rev = 1", 1))
    faults = "\n".join(caught.value.faults)
    assert "settle.windows_s: unknown key; did you mean window_s?" in faults
    assert ".pulse_per_rev: unknown key; did you mean pulses_per_rev?" in faults
    assert ".pulses_per_rev: missing; a whole number in [1, 100000000]" in faults


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("unit = 3", "unit = true", "axes.roll.unit: must be a whole number"),
        ("unit = 3", "unit = 3.0", "axes.roll.unit: must be a whole number"),
        ("reduction = 10", "reduction = inf", "axes.pitch.reduction: must be a number"),
        ("window_s = 0.2", 'window_s = "0.2"', "settle.window_s: must be a number in"),
        ("column_count = 4", "signs = [1, 0, 1]", r"imu.signs\[1\]: must be 1 or -1"),
        ("column_count = 4", "columns = [1, 2]", "imu.columns"),
        ("column_count = 4", 'separator = "1"', "imu.separator: must be one character"),
        ("[imu]", "[imu]\nmounting_deg = [0, 0, nan]", r"imu.mounting_deg\[2\]"),
        ('host = "127.0.0.1"\nport = 5020', "port = 5020", "bus.host: missing"),
        ('format = "hyperimu"', 'format = "lines"', "imu.order: missing"),
    ],
)
def test_nothing_is_converted_in_silence(old, new, says):
    with pytest.raises(ConfigError, match=says):
        parse_config(EXAMPLE_TEXT.replace(old, new, 1))


def test_every_key_is_described_once_and_the_guide_names_no_advanced_one():
    described: dict[str, bool] = {}

    def walk(model, prefix=""):
        for name, field in model.model_fields.items():
            inner = field.annotation
            inner = next((a for a in get_args(inner) if a is not type(None)), inner)
            section = isinstance(inner, type) and issubclass(inner, Section)
            if section and not issubclass(inner, DriveMap):
                walk(inner, f"{name}.")
                continue
            if name == "axes":
                walk(Axis, "axes.*.")
                continue
            assert field.description, name
            extra = field.json_schema_extra or {}
            described[prefix + name] = extra.get("advanced", False)

    walk(RigConfig)
    assert any(described.values())
    guide = (pathlib.Path(__file__).parents[2] / "docs" / "rig.md").read_text()
    table = guide.partition("The keys that you set:")[2].partition("###")[0]
    for name, advanced in described.items():
        assert not (
            advanced and re.search(rf"`[^`]*\b{name.split('.')[-1]}`", table)
        ), name
