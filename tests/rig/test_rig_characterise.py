"""The play of an axis, found in a closed loop over the real protocol."""

import json

import pytest
from harness import RATE_HZ, fast_config

from rig.commission import bench, characterise, steps
from rig.commission.operator import Operator
from rig.device.record import SIGN_CHECKED, DeviceRecord
from rig.simulator import Simulator, Truth


@pytest.fixture
def measured(tmp_path, monkeypatch):
    """Measure the play of an axis of a simulated device: exit code, record, text."""
    monkeypatch.setattr(bench, "SLOW_DEG_S", 400.0)

    def measure(axis, **truth):
        config = fast_config().model_copy(update={"output": str(tmp_path)})
        told = []
        with Simulator(config, Truth(**truth), rate_hz=RATE_HZ) as sim:
            served = sim.start()
            record = DeviceRecord(tmp_path / "device.json")
            place = steps.Place(
                served, record, Operator(yes=True, say=told.append),
                full_speed=True, on_imu_port=sim.start_phone,
            )  # fmt: skip
            steps.begin_simulated(place, SIGN_CHECKED)
            place.folder = tmp_path / "play"
            place.folder.mkdir()
            code = steps.measure_play(place, axis)
        lines = (place.folder / "journal.jsonl").read_text().splitlines()
        records = [json.loads(line) for line in lines]
        return code, records, "\n".join(told)

    return measure


@pytest.mark.slow
@pytest.mark.parametrize(("axis", "play"), [(0, 0.31), (2, 0.0)])
def test_the_play_lies_in_a_narrow_interval(measured, axis, play):
    code, records, told = measured(axis, noise_deg=0.005, backlash_deg=play)
    assert code == 0, told
    (found,) = [record for record in records if record["event"] == "backlash"]
    # An unlucky 95 % interval is off by some of its standard deviations of 0.005.
    assert found["low_deg"] - 0.01 <= play <= found["high_deg"] + 0.01
    assert found["high_deg"] - found["low_deg"] <= characterise.ENOUGH_DEG
    stands = [record for record in records if record["event"] == "stand"]
    assert len(stands) == found["measurements"] <= 4 + characterise.MOST
    assert "play" in told


@pytest.mark.slow
def test_more_play_than_is_looked_for_is_said(measured):
    code, records, told = measured(1, noise_deg=0.005, backlash_deg=1.45)
    assert code != 0
    assert "of play; at most 1.5 deg is looked for" in told
    assert not [record for record in records if record["event"] == "backlash"]


@pytest.mark.slow
def test_no_room_is_said_before_anything_moves(measured, monkeypatch):
    monkeypatch.setattr(characterise, "FAR_DEG", 170.0)
    code, records, told = measured(0, noise_deg=0.005)
    assert code != 0
    assert "from a limit" in told
    assert not [record for record in records if record["event"] == "command"]


pytestmark = pytest.mark.slow  # minutes together
