"""What a careful colleague would refuse: signs, origins, gearing, unknown devices.

Sessions over the real protocol against a simulated device that is not what the
configuration or the record says.
"""

import json
import re

import numpy as np
import pytest
from harness import (
    RATE_HZ,
    changed,
    commissioned,
    fast_config,
    fast_text,
    in_the_middle,
    make_run,
    session,
    simulator,
)
from scipy.spatial.transform import Rotation

import jaxcal
from rig.__main__ import main
from rig.command_run import run_safely
from rig.config import example_text, parse_config
from rig.core.record_check import ZeroRecord, check_zero, moved
from rig.faults import MotionFault, Refused
from rig.identification.conclusion import check_matrix
from rig.journal.device import (
    HOMED,
    IDENTIFIED,
    SIGN_CHECKED,
    STOP_PROVED,
    ZEROED,
    DeviceRecord,
)
from rig.journal.run_folder import read_journal
from rig.procedures.calibrate import collect
from rig.procedures.verify import load_calibration, unchecked, verify
from rig.readings.geometry import euler_to_matrix, frame_at, geometry_of
from rig.readings.phone import Imu
from rig_workbench.simulator import Truth
from rig_workbench.simulator.faults import FaultInjector
from rig_workbench.simulator.phone import Phone

LOST = 1.4  # degrees, as was seen


def device(config, **truth):
    """A noise-free one that is not as configured."""
    return simulator(config, truth=Truth(noise_deg=0.0, **truth))


def run_verify(config, calibration, folder, sim, record=None, here=False):
    """One verification of two postures; its exit code and what it said."""
    folder.mkdir()
    said = []
    saved, zero = load_calibration(calibration, config)
    run = make_run(
        config, folder, "verify", said.append,
        record=record or commissioned(config, folder),
    )  # fmt: skip
    run.zero_at, run.kept_zero = None if here else zero.pulses, zero
    run.listeners.append(sim.answer)
    return run_safely(run, lambda r: verify(r, saved, 2)), said


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """A calibration by drives that go to pulse 0, and its folder."""
    folder = tmp_path_factory.mktemp("trust") / "run"
    config = fast_config()
    with simulator(config, noise_deg=0.005) as sim:
        assert session(sim.start(), folder, sim) == 0
    return folder


# A reversed or exchanged axis


@pytest.mark.parametrize("axis", range(3))
def test_a_reversed_axis_ends_the_session_and_is_named(axis, tmp_path):
    name, config = ("pitch", "yaw", "roll")[axis], fast_config()
    turned = tuple(number == axis for number in range(3))
    said = []
    with device(config, reversed=turned) as sim:
        assert session(sim.start(), tmp_path, sim, said) == 3
    assert any(line.startswith("fault:") and name in line for line in said), said[-3:]
    assert not list(tmp_path.glob("calibration*.json"))


def test_exchanged_axes_end_the_session(tmp_path):
    config, said = fast_config(), []
    with device(config, swapped=(1, 0, 2)) as sim:
        assert session(sim.start(), tmp_path, sim, said) == 3
    assert not list(tmp_path.glob("calibration*.json"))


def test_a_fit_that_is_reversed_or_exchanged_is_refused_by_its_axis():
    good = np.array(Truth().matrix)
    assert check_matrix(fast_config(), good) == []
    reversed_roll = good * [1, 1, -1]
    with pytest.raises(MotionFault, match=r"roll turns -0\.87 deg .*axes\.roll\.direc"):
        check_matrix(fast_config(), reversed_roll)
    with pytest.raises(MotionFault, match=r"pitch follows the command of yaw"):
        check_matrix(fast_config(), good[[1, 0, 2]])
    (warning,) = check_matrix(fast_config(), good * [[0.5], [1], [1]])
    assert "pitch turns 0.21 deg" in warning


def test_a_refused_fit_saves_nothing_and_voids_the_sign_check(tmp_path, monkeypatch):
    """Where the moves themselves showed nothing."""
    from rig.core import measure as measuring

    monkeypatch.setattr(measuring, "_check_agreement", lambda *_: None)
    config, said = fast_config(), []
    with device(config, reversed=(False, False, True)) as sim:
        assert session(sim.start(), tmp_path, sim, said) == 3
    assert any("no calibration is saved: roll turns -0.87" in line for line in said)
    assert not list(tmp_path.glob("calibration*.json"))
    record = DeviceRecord.load(tmp_path / "device.json")
    assert "no calibration is saved" in record.missing(config, SIGN_CHECKED)


# A lost origin


@pytest.mark.parametrize("axis", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_a_lost_origin_is_seen_in_the_tilt_of_the_zero_posture(
    axis, calibrated, tmp_path
):
    """By a record that knows nothing of where the drives were left."""
    lost = [0.0, 0.0, 0.0]
    lost[axis] = LOST
    with simulator(fast_config(), noise_deg=0.005) as sim:
        config = sim.start()
        assert run_verify(config, calibrated, tmp_path / "before", sim)[0] == 0
        sim.power_cycle(tuple(lost))
        code, said = run_verify(config, calibrated, tmp_path / "after", sim)
    assert code == 3
    name = ("pitch", "yaw", "roll")[axis]
    assert re.search(rf"{name} [+-]\d\.\d\d\b.* deg from its place before", said[-2])
    assert "not measurable: yaw, about the vertical" in said[-2]
    records = read_journal(tmp_path / "after/journal.jsonl")
    assert not [r for r in records if r["event"] in ("zero", "posture")]


@pytest.mark.parametrize(("heading", "code"), [("relative", 0), ("absolute", 3)])
def test_yaw_is_seen_where_the_heading_can_be_trusted(
    heading, code, calibrated, tmp_path
):
    config = fast_config()
    config = changed(config, imu=changed(config.imu, heading=heading))
    with simulator(config, noise_deg=0.005) as sim:
        served = sim.start()
        sim.power_cycle((0.0, LOST, 0.0))
        found, said = run_verify(served, calibrated, tmp_path / "run", sim)
    # Not seen, the error over the limit is what is left to tell it.
    assert found == code or (heading, found) == ("relative", 1), said


def test_drives_that_are_not_where_they_were_left_have_lost_their_place(
    calibrated, tmp_path
):
    """Also where gravity shows nothing: yaw turns about the vertical."""
    with simulator(fast_config(), noise_deg=0.005) as sim:
        config = sim.start()
        record = commissioned(config, tmp_path)
        code, _ = run_verify(config, calibrated, tmp_path / "a", sim, record)
        assert code == 0 and len(record.left()[0]) == 3
        sim.power_cycle((0.0, LOST, 0.0))
        moves = sim.executions()
        code, said = run_verify(config, calibrated, tmp_path / "b", sim, record)
        assert code == 2 and sim.executions() == moves
    assert "yaw: it is at" in said[-1] and "1.40 deg from" in said[-1]
    again = DeviceRecord.load(record.path)
    assert again.state(HOMED) is None and again.state(IDENTIFIED) is not None
    assert "`jaxcal-rig setup home`" in again.missing(config)


def test_with_zero_confirmed_the_pulses_tell_a_lost_origin(calibrated, tmp_path):
    """The operator has put the device into its zero posture by hand."""
    with simulator(fast_config(), noise_deg=0.005) as sim:
        config = sim.start()
        sim.power_cycle((0.0, LOST, 0.0))
        code, said = run_verify(config, calibrated, tmp_path / "run", sim, here=True)
    assert code == 3 and "yaw +1.40 deg" in said[-2]


def test_an_absolute_encoder_keeps_its_place(calibrated, tmp_path):
    config = fast_config()
    axes = tuple(
        changed(axis, map=changed(axis.map, absolute_encoder=True))
        for axis in config.axes
    )
    config = changed(config, axes=axes)
    with simulator(config, noise_deg=0.005) as sim:
        served = sim.start()
        record = commissioned(served, tmp_path)
        record.left_at(dict.fromkeys(config.axis_names, 0))  # moved by hand since
        code, said = run_verify(served, calibrated, tmp_path / "run", sim, record)
    assert code == 0, said


def test_a_homed_bit_that_is_gone_voids_the_place(calibrated, tmp_path):
    with simulator(fast_config(), noise_deg=0.005) as sim:
        config = sim.start()
        record = commissioned(config, tmp_path)
        for drive in sim.drives:
            drive.homed = True
        assert run_verify(config, calibrated, tmp_path / "a", sim, record)[0] == 0
        sim.power_cycle()  # every count comes back as it was
        code, said = run_verify(config, calibrated, tmp_path / "b", sim, record)
    assert code == 2 and "pitch, yaw, roll: the homed bit is cleared" in said[-1]


def test_resume_says_which_axis_has_lost_its_origin(tmp_path):
    config = fast_config()
    with simulator(config) as sim:
        served, done = sim.start(), []

        def alarm(run, phase):
            if not done and phase == "moving" and in_the_middle(run, phase):
                done.append(True)
                sim.drives[0].raise_alarm(0x30)

        folder = tmp_path / "run"
        assert session(served, folder, sim, listeners=[alarm]) == 3
        record = DeviceRecord.load(folder / "device.json")
        assert "pitch went into alarm" in record.missing(config)
        sim.power_cycle((0.0, 0.0, LOST))
        said = []
        assert session(served, folder, sim, said) == 3
    assert re.search(r"roll [+-]\d\.\d\d", said[-2]) and "lost their origin" in said[-2]


def test_gravity_resolves_the_axes_it_can(rng):
    """Against rotations written apart: a small turn of one joint about its own axis."""
    config = fast_config()
    mounting = euler_to_matrix(config.imu.mounting_deg, "ZYX")
    for heading in (0.0, 170.0, -90.0):
        base = Rotation.from_euler("z", heading, degrees=True).as_matrix()
        zero = base @ mounting
        other = Rotation.from_euler("z", 33.0, degrees=True).as_matrix()
        for axis, letter in ((0, "X"), (2, "Y")):
            vector = np.radians(LOST) * np.eye(3)["XYZ".index(letter)]
            now = base @ Rotation.from_rotvec(vector).as_matrix() @ mounting
            angle, joints = moved(config, zero, other @ now)  # another north
            assert angle == pytest.approx(LOST)
            np.testing.assert_allclose(joints, LOST * np.eye(3)[axis], atol=1e-6)
        assert geometry_of(config).unseen(zero) == ["yaw"]
    lying = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    assert geometry_of(config).unseen(lying) == ["roll"]
    tilted = Rotation.from_euler("x", 45, degrees=True).as_matrix()
    assert geometry_of(config).unseen(tilted) == []
    for _ in range(50):  # noise of a phone is no fault
        noise = Rotation.from_rotvec(rng.normal(0, 0.1, 3), degrees=True).as_matrix()
        check_zero(config, tilted, tilted @ noise, "it")


def test_the_pulses_of_the_zero_count_too():
    config = fast_config()
    kept = ZeroRecord("it", (0, 0, 0), np.eye(3))
    assert "zero posture is 0.000 deg" in kept.check(config, (3, 0, 0), np.eye(3))
    far = config.to_pulses((0.0, LOST, 0.0))
    with pytest.raises(MotionFault, match=r"yaw \+1\.40 deg"):
        kept.check(config, far, np.eye(3))


def test_a_zero_by_the_drives_is_compared_with_the_last_one(tmp_path):
    config = parse_config(fast_text(session='\n[session]\nzero = "drive"\n'))
    with simulator(config) as sim:
        served = sim.start()
        record = commissioned(served, tmp_path)
        said = []
        for name in ("a", "b"):
            (tmp_path / name).mkdir()
            run = make_run(
                served, tmp_path / name, "collect", said.append, record=record
            )
            run.listeners.append(sim.answer)
            assert run_safely(run, lambda r: collect(r, 1)) == 0
            record._left = {}
            sim.power_cycle((0.0, 0.0, LOST))
    assert sum("WARNING: the zero posture is not that of" in t for t in said) == 1
    assert record.state(ZEROED)["pulses"] == [0, 0, 0]


def test_a_zero_at_other_pulses_than_the_last_one_is_told(tmp_path):
    config = fast_config()
    with simulator(config) as sim:
        served = sim.start()
        record = commissioned(served, tmp_path)
        said = []
        for name, here in (("a", (0.0, 0.0, 0.0)), ("b", (2.0, 0.0, 0.0))):
            (tmp_path / name).mkdir()
            run = make_run(
                served, tmp_path / name, "collect", said.append, record=record
            )
            run.listeners.append(sim.answer)
            run.zero_at = served.to_pulses(here)  # as if an operator had put it there
            assert run_safely(run, lambda r: collect(r, 1)) == 0
    told = [text for text in said if text.startswith("WARNING")]
    assert len(told) == 1 and "pitch +2.00 deg from" in told[0]


# Gearing


def test_goto_with_another_gearing_is_refused_before_a_port_opens(
    calibrated, tmp_path, capsys
):
    path = tmp_path / "rig.toml"
    text = fast_text({"port = 5020": "port = 1", "port = 2055": "port = 1"})
    path.write_text(text.replace("pulses_per_rev = 10000", "pulses_per_rev = 4000"))
    commissioned(parse_config(path.read_text()), tmp_path)
    for command in (["verify"], ["goto", "--to", "1", "1", "1"]):
        code = main([*command, str(calibrated), "--config", str(path), "--arm",
                     "--zero", "--out", str(tmp_path / "runs")])  # fmt: skip
        assert code == 2
        error = capsys.readouterr().err
        for name in ("pitch", "yaw", "roll"):
            assert f"axes.{name}.pulses_per_rev: was 10000, is 4000" in error
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("direction = -1", "direction = 1", "axes.yaw.direction: was -1, is 1"),
        ('"leadshine_pr"', '"generic"', "axes.pitch.map: was leadshine_pr ("),
        ('order = "ZXY"', 'order = "YXZ"', "mechanism.order: was ZXY, is YXZ"),
        ("column_count = 4", "column_count = 4\nmounting_deg = [90, 0, 0]",
         "imu.mounting_deg: was [0.0, 0.0, 0.0], is [90.0, 0.0, 0.0]"),
    ],
)  # fmt: skip
def test_a_calibration_is_of_one_device(calibrated, old, new, key):
    with pytest.raises(Refused, match="another device") as caught:
        load_calibration(calibrated, fast_config({old: new}))
    assert key in str(caught.value)
    same = fast_config({"std_deg = 0.1": "std_deg = 0.2", "port = 5020": "port = 1"})
    assert load_calibration(calibrated, same)[1].attitude.shape == (3, 3)


@pytest.mark.parametrize("key", ["device", "zero_pulses", "zero_attitude"])
def test_a_calibration_that_does_not_say_its_device_is_refused(
    key, calibrated, tmp_path
):
    text = json.dumps(json.loads((calibrated / "calibration.json").read_text()))
    saved = jaxcal.Calibration.load(calibrated / "calibration.json")
    notes = dict(saved.provenance["notes"])
    del notes[key]
    old = text.replace(json.dumps(saved.provenance["notes"]), json.dumps(notes))
    assert old != text
    (tmp_path / "calibration.json").write_text(old)
    with pytest.raises(Refused, match="the device and zero posture are not recorded"):
        load_calibration(tmp_path, fast_config())


def test_the_drives_own_gearing_counts(tmp_path):
    config, said = fast_config(), []
    with device(config, drive_pulses_per_rev=(10000, 10000, 9000)) as sim:
        assert session(sim.start(), tmp_path, sim, said) == 2
        assert not any(sim.executions())
    assert "the drive of roll (unit 3) is set to 9000 pulses per turn" in said[-1]
    assert "axes.roll.pulses_per_rev is 10000" in said[-1]


def test_a_drive_without_a_word_on_its_gearing_is_not_asked_for_it(tmp_path):
    config = fast_config()
    bare = tuple(
        changed(axis, map=changed(axis.map, pulses_per_rev=None))
        for axis in config.axes
    )
    with device(changed(config, axes=bare)) as sim:
        served = changed(sim.start(), axes=config.axes)
        record = commissioned(served, tmp_path)
        run = make_run(served, tmp_path, "collect", [].append, record=record)
        run.listeners.append(sim.answer)
        assert run_safely(run, lambda r: collect(r, 1)) == 0


# States


@pytest.mark.parametrize("lost", [IDENTIFIED, HOMED, SIGN_CHECKED, STOP_PROVED])
def test_sessions_need_the_states_and_say_which_command_reaches_them(
    lost, calibrated, tmp_path, capsys
):
    path = tmp_path / "rig.toml"
    path.write_text(fast_text({"port = 5020": "port = 1", "port = 2055": "port = 1"}))
    config = parse_config(path.read_text())
    commissioned(config, tmp_path).void(lost, "the cable was cut")
    sessions = (
        ["calibrate"], ["collect"], ["verify", str(calibrated)],
        ["goto", str(calibrated), "--to", "1", "1", "1"],
    )  # fmt: skip
    for command in sessions:
        code = main([*command, "--config", str(path), "--arm", "--zero",
                     "--out", str(tmp_path / "runs")])  # fmt: skip
        assert code == 2
        error = capsys.readouterr().err
        assert f"not {lost}: the cable was cut" in error
        assert "`jaxcal-rig setup axes`" in error and "cannot open" not in error
    assert not (tmp_path / "runs").exists()


def test_another_drive_is_another_device(tmp_path):
    config, said = fast_config(), []
    with simulator(config) as sim:
        served = sim.start()
        record = commissioned(served, tmp_path)
        identity = {name: {"pulses_per_rev": 10000} for name in ("pitch", "yaw")}
        record.reach(IDENTIFIED, served, identity=identity)
        assert session(served, tmp_path, sim) == 0
        identity["yaw"] = {"peak_current_tenth_A": 45}
        record = commissioned(served, tmp_path)
        record.reach(IDENTIFIED, served, identity=identity)
        (tmp_path / "b").mkdir()
        run = make_run(served, tmp_path / "b", "collect", said.append, record=record)
        record.reach(HOMED, served)
        record.reach(SIGN_CHECKED, served)
        record.reach(STOP_PROVED, served)
        assert run_safely(run, lambda r: collect(r, 1)) == 2
    assert "yaw: another drive (peak_current_tenth_A: was 45" in said[-1]
    assert DeviceRecord.load(record.path).state(IDENTIFIED) is None


def test_after_a_lost_place_the_way_on_begins_with_home(tmp_path):
    config = fast_config()
    record = commissioned(config, tmp_path)
    run = make_run(config, tmp_path, "collect", [].append, record=record)
    assert run.to_go_on == f"jaxcal-rig resume {tmp_path}"
    record.void(HOMED, "yaw went into alarm")
    assert "`jaxcal-rig setup home`, then `jaxcal-rig setup axes`" in run.to_go_on
    assert run.to_go_on.endswith(f"Then jaxcal-rig resume {tmp_path}")
    run.journal.close()


def test_while_armed_the_place_of_the_drives_is_not_known(tmp_path):
    """A killed session must not leave positions of before."""
    config, seen = fast_config(), []
    with simulator(config) as sim:
        served = sim.start()

        def look(run, phase):
            if phase == "moving":
                seen.append(DeviceRecord.load(tmp_path / "device.json").left()[0])

        assert session(served, tmp_path, sim, listeners=[look]) == 0
        positions = [round(drive.position) for drive in sim.drives]
    assert seen and all(set(each.values()) == {None} for each in seen)
    left = DeviceRecord.load(tmp_path / "device.json").left()[0]
    assert list(left.values()) == positions


def test_a_session_reaches_zeroed(calibrated):
    record = DeviceRecord.load(calibrated / "device.json")
    zero = read_journal(calibrated / "journal.jsonl")
    zero = next(r for r in zero if r["event"] == "zero")
    assert record.state(ZEROED)["pulses"] == zero["pulses"]
    np.testing.assert_allclose(record.state(ZEROED)["attitude"], zero["attitude"])
    notes = jaxcal.Calibration.load(calibrated / "calibration.json").provenance["notes"]
    np.testing.assert_allclose(notes["zero_attitude"], zero["attitude"])


def test_a_pushing_phone_comes_to_the_next_session_of_the_process(tmp_path):
    """The axis check and the session after it each open the phone's port."""
    text = example_text("oriental_az")
    settings = parse_config(text).imu
    assert settings.format == "sensorlogger"
    settings = changed(settings, host="127.0.0.1", port=0)
    phone = Phone(settings, lambda: np.eye(3), FaultInjector([]), RATE_HZ, 0)
    try:
        for _ in range(2):
            with Imu(settings) as imu:
                phone.start(imu.port)
                imu.wait_for_stream(20.0)
    finally:
        phone.close()


def test_a_simulated_calibration_moves_no_real_joint(calibrated, tmp_path, capsys):
    """G: it has the real device's fingerprint where --config names its file."""
    file = tmp_path / "calibration.json"
    content = json.loads((calibrated / "calibration.json").read_text())
    assert content["provenance"]["notes"]["simulated"] is False
    content["provenance"]["notes"]["simulated"] = True
    file.write_text(json.dumps(content))
    with pytest.raises(Refused, match="made with a simulated device"):
        load_calibration(file, fast_config())
    assert load_calibration(file, fast_config(), simulated=True)[1].pulses
    path = tmp_path / "rig.toml"
    path.write_text(fast_text({"port = 5020": "port = 1"}))  # opening would say so
    for given in (["goto", str(file), "--to", "0", "0", "0"], ["verify", str(file)]):
        given = [*given, "--config", str(path), "--arm", "--zero"]
        assert main(given) == 2
        error = capsys.readouterr().err
        assert "simulated" in error and "cannot open" not in error


def test_the_run_of_a_real_device_is_not_resumed_as_a_simulated_one(
    calibrated, tmp_path, capsys
):
    """G: --simulate was left aside, and the real device moved."""
    path = tmp_path / "rig.toml"
    path.write_text(fast_text({"port = 5020": "port = 1"}))
    given = ["resume", str(calibrated), "--simulate", "--arm", "--config", str(path)]
    assert main(given) == 2
    error = capsys.readouterr().err
    assert "was made with a real device" in error and "cannot open" not in error


@pytest.mark.parametrize("bit", [False, True])
def test_a_position_not_read_after_a_session_voids_home(bit, tmp_path):
    """D: after a killed session a pushed joint was not noticed."""
    with simulator(fast_config()) as sim:
        served = sim.start()
        record = commissioned(served, tmp_path, sim)
        for drive in sim.drives:
            drive.homed = bit
        record.left_at(
            dict.fromkeys(served.axis_names), served.axis_names if bit else ()
        )  # as when armed
        run = make_run(served, tmp_path, "collect", [].append, record=record)
        run.listeners.append(sim.answer)
        code = run_safely(run, lambda r: collect(r, 1))
    assert code == (0 if bit else 2)
    assert (record.state(HOMED) is None) is not bit
    if not bit:
        assert "pitch, yaw, roll: the last session ended without" in record.missing(
            served
        )
        assert sim.executions() == [[], [], []]


def test_goto_names_what_neither_drive_nor_phone_can_tell():
    plain = fast_config({'map = "leadshine_pr"': 'map = "generic"'})
    frame = frame_at(plain, np.eye(3))
    assert unchecked(plain, frame) == ["yaw"]
    assert unchecked(fast_config(), frame_at(fast_config(), np.eye(3))) == []
