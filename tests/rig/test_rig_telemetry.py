"""Telemetry: what it says, that it is bounded, and that it never harms a session."""

import json
import threading
import time
import types

import numpy as np
import pytest
from harness import fast_config, session, simulator

from rig.drives.drive import Status
from rig.journal.run_folder import read_journal
from rig.outputs import telemetry
from rig.readings.geometry import Reading, euler_to_matrix, frame_at


class Phone:
    """Readings that turn at 10 deg/s about pitch (X), 100 a second, until now."""

    def since(self, start):
        now = time.monotonic()
        times = now - np.arange(50)[::-1] / 100.0
        return [
            Reading(t, euler_to_matrix([0.0, 10.0 * (t - now), 0.0], "ZXY"))
            for t in times
            if t >= start
        ]


class Silent:
    def since(self, start):
        return []


class Polled:
    def __init__(self, axis, position):
        self.axis = axis
        self.last = None
        if position is not None:
            self.last = Status(position, True, True, False, False, 0)


def made(folder, imu, frame=None, positions=(None, None, None)):
    """A device as the telemetry sees it."""
    config = fast_config()
    drives = [Polled(a, p) for a, p in zip(config.axes, positions, strict=True)]
    run = types.SimpleNamespace(folder=folder)
    return types.SimpleNamespace(
        run=run, config=config, imu=imu, drives=drives, frame=frame
    )


def test_a_sample_says_what_phone_and_drives_said_last(tmp_path):
    config = fast_config()
    frame = frame_at(config, np.eye(3))
    device = made(tmp_path, Phone(), frame, (2777, None, -2778))
    sample = telemetry.sample(device)
    ten = config.axes[0].to_deg(2777)
    assert sample["drives"] == [
        pytest.approx(ten, abs=1e-4),
        None,
        pytest.approx(-10.0008),
    ]
    assert sample["deg"] == pytest.approx([0.0, 0.0, 0.0], abs=0.1)
    assert sample["rate"] == pytest.approx(100.0, rel=0.02)
    readings = len(Phone().since(time.monotonic() - 0.2))
    expected = np.std(0.1 * np.arange(readings), ddof=1)
    assert sample["std"][0] == pytest.approx(expected, rel=0.1)
    assert 0.0 <= sample["age"] < 0.1


def test_before_the_zero_and_without_a_phone_it_says_what_it_can(tmp_path):
    found = telemetry.sample(made(tmp_path, Phone()))
    assert found.keys() == {"time", "drives", "age", "rate"}
    assert telemetry.sample(made(tmp_path, Silent())).keys() == {"time", "drives"}


def test_the_file_is_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(telemetry, "MAX_BYTES", 300)
    monkeypatch.setattr(telemetry, "PERIOD_S", 0.0005)
    older = tmp_path / telemetry.OLDER
    end = time.monotonic() + 20.0
    replaced = set()
    with telemetry.telemetry(made(tmp_path, Silent())):
        while len(replaced) < 3 and time.monotonic() < end:
            if older.exists():
                replaced.add(older.stat().st_ino)
            time.sleep(0.005)
    assert len(replaced) >= 3
    sizes = {path.name: path.stat().st_size for path in tmp_path.iterdir()}
    assert set(sizes) <= {telemetry.TELEMETRY, telemetry.OLDER}
    assert max(sizes.values()) < 400
    for line in older.read_text().splitlines():
        json.loads(line)


@pytest.mark.parametrize("failing", ["full", "broken"])
def test_its_failure_never_reaches_the_session(tmp_path, monkeypatch, failing):
    """A disk that takes nothing, and a sample that raises."""
    config, folder = fast_config(), tmp_path / "run"
    if failing == "full":
        (folder / telemetry.TELEMETRY).mkdir(parents=True)  # cannot be opened
    else:
        monkeypatch.setattr(telemetry, "sample", lambda device: 1 / 0)
    complaints = []
    monkeypatch.setattr(threading, "excepthook", complaints.append)
    with simulator(config) as sim:
        assert session(sim.start(), folder, sim) == 0
    assert not complaints
    assert read_journal(folder / "journal.jsonl")[-1]["event"] == "end"


def test_a_disk_that_hangs_does_not_keep_the_session_from_its_end(
    tmp_path, monkeypatch
):
    hung = threading.Event()

    def hang(device):
        hung.wait(60.0)
        return {}

    monkeypatch.setattr(telemetry, "sample", hang)
    config, folder = fast_config(), tmp_path / "run"
    with simulator(config) as sim:
        assert session(sim.start(), folder, sim) == 0
    assert not hung.is_set()  # it hangs still
    hung.set()


def test_a_session_leaves_telemetry_of_its_moves(tmp_path):
    config, folder = fast_config(), tmp_path / "run"
    with simulator(config) as sim:
        assert session(sim.start(), folder, sim) == 0
    lines = (folder / telemetry.TELEMETRY).read_text().splitlines()
    samples = [json.loads(line) for line in lines]
    seen = np.array([s["deg"] for s in samples if "deg" in s])
    times = np.array([s["time"] for s in samples])
    assert np.diff(times).mean() >= telemetry.PERIOD_S
    assert np.ptp(seen, axis=0).min() > 3.0  # every axis was seen to turn
    assert not [t for t in threading.enumerate() if t.name == "telemetry"]
