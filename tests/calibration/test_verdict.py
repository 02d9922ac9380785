"""A calibration says whether its model explains the readings, and names what is wrong.

The arms are real: of dinova_1's first socket seven contacts lie 11 mm from the other
thirteen, whatever arm predicts them.
"""

from __future__ import annotations

import dataclasses
import re
import types
import warnings

import contacts
import numpy as np
import pytest

import jaxcal
from jaxcal.arms.findings import left_open, parts_of
from jaxcal.arms.plausible import mistaken_columns
from jaxcal.commands import main
from jaxcal.models import Chains, Gravity, Prior, Several, Socket

from ..models.arms import ur5, ur5_data

PLACE = contacts.load("panda_1")["front"]


def _fit(name, joints, sockets, offset=0.0):
    commands = np.column_stack([joints, sockets])
    offsets = np.full((len(sockets), 3), offset)
    return jaxcal.identify(commands, offsets, model=contacts.arm(name))


def test_good_contacts_get_a_good_verdict():
    found = _fit("panda_1", *PLACE)
    verdict = found.verdict
    assert verdict.good and verdict.held_out < 0.05 * verdict.nominal
    low, high = verdict.errors[0].interval
    assert low < verdict.held_out < high
    assert not [why for why in verdict.reasons if "moved" in why]
    assert "Cross-validated error" in found.summary()


@pytest.mark.slow
@pytest.mark.parametrize("by_default", [False, True])
def test_held_out_errors_are_those_of_fits_without_each_contact(by_default):
    rows = np.arange(0, 62, 2)
    joints, sockets = PLACE[0][rows], PLACE[1][rows]
    commands = np.column_stack([joints, sockets])
    arm = contacts.arm("panda_1")
    stated = dataclasses.replace(arm.default_prior(), by_data=False)
    options = {"model": arm, "loss": "gaussian", "noise_std": 2e-4, "prior": stated}
    if by_default:  # with sizes by the readings, and what may be there besides
        del options["prior"]
    zeros = np.zeros((len(rows), 3))
    whole = jaxcal.identify(commands, zeros, **options)
    errors = []
    for i in range(len(rows)):
        rest = np.delete(np.arange(len(rows)), i)
        fit = jaxcal.identify(commands[rest], zeros[rest], **options)
        errors.append(np.linalg.norm(fit.predict(commands[i])))
    assert whole.verdict.held_out == pytest.approx(np.mean(errors), rel=0.1)


def test_a_socket_that_was_moved_is_named():
    with pytest.warns(UserWarning, match="does not explain these readings"):
        verdict = _fit("dinova_1", *contacts.load("dinova_1")["front"]).verdict
    assert not verdict.explains
    text = str(verdict)
    assert "The noise of this model does not explain" in text
    assert "times the usual scatter of this sensor" in text
    moved = [why for why in verdict.reasons if "moved" in why]
    assert len(moved) == 1
    said = re.fullmatch(
        r"socket 0 seems to have moved by (\S+) m between measurements 6 and 7",
        moved[0],
    )
    assert float(said[1]) == pytest.approx(0.011, rel=0.05)


def test_rows_in_the_wrong_file_and_loose_contacts_are_named():
    joints, sockets = PLACE[0].copy(), PLACE[1].copy()
    sockets[[3, 40]] = 1.0 - sockets[[3, 40]]
    joints[20, 2] += 1.0
    verdict = _fit("panda_1", joints, sockets).verdict
    assert "measurement 3 fits socket 0 instead" in verdict.reasons
    assert "measurement 40 fits socket 1 instead" in verdict.reasons
    assert any(re.match(r"Rows? .*\b20\b.* outlier", why) for why in verdict.reasons)


def test_of_twelve_contacts_a_loose_one_cannot_be_scatter():
    """The eleven others give little to tell it by: it is 5.6 deviations off."""
    joints, sockets = contacts.load("kuka_14")["left_back"]
    rows = [0, 1, 5, 10, 20, 29, 41, 42, 45, 49, 52, 61]
    joints = joints[rows].copy()
    assert _fit("kuka_14", joints, sockets[rows]).verdict.good
    joints[5, 1] += 1.0
    with pytest.warns(UserWarning, match=r"Row 5 is an outlier \(5"):
        assert not _fit("kuka_14", joints, sockets[rows]).verdict.good


def test_one_loose_contact_is_named_and_no_file_is_written(tmp_path, capsys):
    joints = PLACE[0].copy()
    joints[20, 3] += 0.3
    with pytest.warns(UserWarning, match="some readings contradict the others"):
        verdict = _fit("panda_1", joints, PLACE[1]).verdict
    assert verdict.explains and verdict.helps and not verdict.clean
    assert any(re.match(r"Rows? .*\b20\b.* outlier", why) for why in verdict.reasons)
    names = [f"panda_joint{i + 1}" for i in range(7)]
    table = tmp_path / "contacts.csv"
    header = ",".join([*names, "socket"])
    np.savetxt(
        table,
        np.column_stack([joints, PLACE[1]]),
        "%.12g",
        ",",
        header=header,
        comments="",
    )
    urdf = contacts.common.HERE / "contacts" / "panda.urdf"
    out = tmp_path / "out.urdf"
    flags = ["identify", str(table), "--model", str(urdf), "--tip", "ball_link"]
    flags += ["--sensor", "socket", "--distance", "0,1,0.05,0.0001", "--out", str(out)]
    assert main(flags) == 2
    said = capsys.readouterr().err
    assert re.search(r"Rows? .*\b20\b.* outlier", said) and not out.exists()
    # To write over a file is one thing, to accept a bad fit another.
    out.write_text("a good file", encoding="utf-8")
    assert main([*flags, "--unproven"]) == 2
    assert "pass --overwrite to replace it" in capsys.readouterr().err
    assert main([*flags, "--overwrite"]) == 2
    assert "--unproven writes it" in capsys.readouterr().err
    assert out.read_text(encoding="utf-8") == "a good file"
    assert main([*flags, "--overwrite", "--unproven"]) in (0, None)
    assert out.read_text(encoding="utf-8").startswith("<?xml")


def test_exchanged_sockets_are_named_where_their_places_were_given():
    arm = contacts.arm("panda_1")
    places = arm.located(np.column_stack(PLACE)).sensor.places
    sensor = dataclasses.replace(arm.sensor, places=places)
    for sockets, count in ((PLACE[1], 0), (1.0 - PLACE[1], 2)):
        commands = np.column_stack([PLACE[0], sockets])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            found = jaxcal.identify(
                commands, np.zeros((62, 3)), model=arm.measured_with(sensor)
            )
        said = [why for why in found.verdict.reasons if "are their rows" in why]
        assert len(said) == count and found.verdict.clean == (count == 0)


def test_contacts_that_no_such_arm_made_are_refused():
    joints, sockets = PLACE
    other = contacts.load("panda_1")["right"]
    mixed = [
        np.concatenate([each[sockets == 0], more[other[1] == 1]])
        for each, more in zip(PLACE, other, strict=True)
    ]
    with pytest.raises(ValueError, match=r"sockets 0 and 1 must be 0\.05 apart, but"):
        _fit("panda_1", *mixed)
    twice = joints[sockets == 0]
    labels = np.repeat([0.0, 1.0], len(twice))
    with pytest.raises(ValueError, match="rows 30 and 0 are one posture"):
        _fit("panda_1", np.vstack([twice, twice]), labels)
    with pytest.raises(
        ValueError, match="have no contacts of socket 1, whose distance"
    ):
        _fit("panda_1", joints, 0.0 * sockets)
    with pytest.raises(
        ValueError, match="have no contacts of socket 1, whose distance"
    ):
        _fit("panda_1", joints, 0.0 * sockets, offset=1e-4)
    few = [
        np.concatenate([each, more[:5]])
        for each, more in zip(PLACE, other, strict=True)
    ]
    with pytest.raises(ValueError, match=r"62, 63, 64, 65, 66\) are .* another place"):
        _fit("panda_1", *few)
    turned = joints.copy()
    turned[:, 4] *= -1.0
    with pytest.raises(ValueError, match="panda_joint5 seems reversed"):
        _fit("panda_1", turned, sockets)
    beyond = joints.copy()
    beyond[7, 2] = contacts.arm("panda_1").limits[2, 1] + 2.5
    with pytest.raises(ValueError, match=r"row 7: panda_joint3 = .* is outside"):
        _fit("panda_1", beyond, sockets)


def test_many_contacts_of_the_other_socket_are_named():
    """So many that they inflate the scatter and none is an outlier."""
    joints, sockets = PLACE
    wrong = np.flatnonzero(sockets == 0)[::3]
    mixed = sockets.copy()
    mixed[wrong] = 1.0
    reasons = _fit("panda_1", joints, mixed).verdict.reasons
    named = {int(why.split()[1]) for why in reasons if why.endswith("socket 0 instead")}
    assert named == set(wrong.tolist())


def test_sockets_as_one_are_told():
    """Without a known distance only an arm shrunk to nothing fits them exactly."""
    joints = PLACE[0][::4]
    arm = contacts.arm("panda_1").measured_with(Socket())
    with pytest.warns(UserWarning, match="or of several sockets numbered as one"):
        found = jaxcal.identify(joints, np.zeros((len(joints), 3)), model=arm)
    assert not found.verdict.good


@pytest.mark.slow
def test_another_zero_and_noise_in_another_unit_are_named():
    rng = np.random.default_rng(0)
    arm, joints = ur5(), rng.uniform(-120.0, 120.0, (40, 6))
    readings = arm.predict(joints + 20.0 * np.eye(6)[1])
    readings *= rng.normal(1.0, 1e-5, readings.shape)  # as of a sensor
    with pytest.warns(UserWarning, match=r"theta2 is 20 degrees from the arm's"):
        found = jaxcal.identify(joints, readings, model=arm)
    assert not found.verdict.good
    for std, good in ((2e-4, True), (0.15, False)):
        options = {"model": contacts.arm("panda_1"), "noise_std": std}
        with warnings.catch_warnings(record=True):
            warnings.simplefilter("always")
            found = jaxcal.identify(
                np.column_stack(PLACE), np.zeros((len(PLACE[0]), 3)), **options
            )
        told = "times too large: residuals are" in str(found.verdict)
        assert (found.verdict.good, told) == (good, not good)


def test_what_is_known_anywhere_is_said():
    few, all_ = (
        _fit("panda_1", PLACE[0][rows], PLACE[1][rows]).verdict
        for rows in (np.arange(0, 62, 5), np.arange(62))
    )
    assert few.anywhere > all_.anywhere > few.held_out
    assert f"over the workspace: {few.anywhere:.3g}" in str(few)


def test_a_contact_that_is_written_twice_counts_once():
    rows = np.arange(0, 62, 5)
    once, twice = (
        _fit("panda_1", PLACE[0][each], PLACE[1][each])
        for each in (rows, np.append(rows, rows[0]))
    )
    np.testing.assert_array_equal(once.parameters, twice.parameters)
    assert twice.verdict.reasons[-1] == "measurement 13 repeats 0, counted once"


@pytest.mark.parametrize(("name", "off"), [("panda_1", -0.01), ("kuka_14", 0.01)])
def test_another_tip_within_the_prior_is_named(name, off):
    arm, place = contacts.arm(name), contacts.load(name)["front"]
    tool = arm.tool.copy()
    tool[0, 3] += off
    arm = dataclasses.replace(arm, tool=tool)
    commands = np.column_stack(place)
    found = jaxcal.identify(commands, np.zeros((62, 3)), model=arm)
    said = [why for why in found.verdict.reasons if "is it another tip?" in why]
    far = float(re.match(r"the tip is (\S+) m from its place", said[0])[1])
    assert len(said) == 1 and far == pytest.approx(0.01, rel=0.05)
    clean = _fit(name, *place).verdict
    assert not [why for why in clean.reasons if "another tip" in why]
    # Contacts show where the tip is: the file was wrong, and the calibration is right.
    assert clean.good and found.verdict.good and "contradict" not in str(found.verdict)
    tool = found.arm.tool[:3, 3] - _fit(name, *place).arm.tool[:3, 3]
    assert np.linalg.norm(tool) < 2e-4


def _with_gravity(name, arm, joints, sockets, still=False, in_pair=False):
    """Verdict of contacts beside what an IMU feels of the arm as all of them have it.

    In pair with an arm that has its own tracker.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        truth = _fit(name, *contacts.load(name)["front"]).arm
    rng, sensor = np.random.default_rng(0), arm.sensor
    low, high = 0.8 * arm.limits.T
    poses = rng.uniform(low, high, (30, len(low)))
    poses[:, -1] *= not still
    felt = truth.measured_with(Gravity()).predict(poses) + rng.normal(0, 0.01, (30, 3))
    model = arm.measured_with(Several((sensor, Gravity())))
    contact = np.column_stack([joints, sockets]), np.zeros((len(joints), 3))
    commands, measured = model.together(contact, (poses, felt))
    if in_pair:
        beside = ur5(joint_names=tuple("abcdef"))
        turned = rng.uniform(-120, 120, (20, 6))
        points = beside.predict(turned) + rng.normal(0, 0.05, (20, 3))
        model = Chains.of({"left": model, "right": beside})
        tables = {"left": (commands, measured), "right": (turned, points)}
        commands, measured = model.together(tables)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        verdict = jaxcal.identify(commands, measured, model=model).verdict
    return verdict.of_chains["left"] if in_pair else verdict


@pytest.mark.slow
def test_what_is_wrong_of_contacts_is_told_beside_other_sensors():
    arm, (joints, sockets) = contacts.arm("panda_1"), PLACE
    apart = arm.measured_with(Socket(2, distances=[(0, 1, 0.048, 1e-4)]))
    places = arm.located(np.column_stack(PLACE)).sensor.places
    placed = arm.measured_with(Socket(2, places, distances=arm.sensor.distances))
    other = sockets.copy()
    other[[3, 40]] = 1.0 - other[[3, 40]]
    for wrong, said in (
        (
            (apart, joints, sockets),
            "the distance of sockets 0 and 1 was given as 0.048 m, but",
        ),
        (
            (placed, joints, 1.0 - sockets),
            "socket 0 was found at the stated place of socket 1",
        ),
        ((arm, joints, other), "measurement 3 fits socket 0 instead"),
    ):
        verdict = _with_gravity("panda_1", *wrong)
        assert not verdict.good and said in str(verdict)
    twice = np.append(joints, joints[:1], axis=0), np.append(sockets, sockets[0])
    verdict = _with_gravity("panda_1", arm, *twice)
    assert verdict.good and "measurement 62 repeats 0" in str(verdict)
    assert 1e-4 < verdict.anywhere < 1e-3  # of the tip, in the arm's unit


@pytest.mark.slow
def test_what_is_wrong_of_contacts_is_told_of_a_chain_with_other_sensors():
    arm, (joints, sockets) = contacts.arm("panda_1"), PLACE
    apart = arm.measured_with(Socket(2, distances=[(0, 1, 0.048, 1e-4)]))
    verdict = _with_gravity("panda_1", apart, joints, sockets, in_pair=True)
    assert "the distance of sockets 0 and 1 was given as 0.048 m, but" in str(verdict)
    still = joints * (np.arange(7) != 6)
    verdict = _with_gravity("panda_1", arm, still, sockets, still=True, in_pair=True)
    assert "panda_joint7 is 0 in all 92" in str(verdict) and not verdict.good
    moved = contacts.arm("dinova_1"), *contacts.load("dinova_1")["front"]
    said = str(_with_gravity("dinova_1", *moved, in_pair=True))
    assert re.search(
        r"socket 0 seems to have moved by 0\.01\d+ m between .* 6 and 7", said
    )
    with pytest.raises(ValueError, match="are they radians"):
        _with_gravity("panda_1", arm, np.radians(joints), sockets)


def test_contacts_beside_gravity_leave_the_size_open():
    """Of an arm as it is, which its tip elsewhere may not be."""
    arm = _fit("panda_1", *PLACE).arm.measured_with(Socket(2))
    rows = np.arange(0, 62, 10)
    verdict = _with_gravity("panda_1", arm, PLACE[0][rows], PLACE[1][rows])
    assert not verdict.good and "so the arm's size is unknown" in str(verdict)


@pytest.mark.parametrize("apart", [0.03, 0.048, 0.06])
def test_a_distance_that_contacts_contradict_is_named(apart):
    arm = contacts.arm("panda_1").measured_with(
        Socket(2, distances=[(0, 1, apart, 1e-4)])
    )
    with pytest.warns(UserWarning, match="measure that distance again"):
        found = jaxcal.identify(np.column_stack(PLACE), np.zeros((62, 3)), model=arm)
    said = " ".join(found.verdict.reasons)
    free = float(re.search(r"lengths give (\S+) \+-", said)[1])
    assert not found.verdict.good and abs(free - 0.05) < 0.2 * abs(apart - 0.05) + 5e-4


def test_a_distance_is_freed_under_the_prior_that_was_stated():
    arm = contacts.arm("panda_1").measured_with(
        Socket(2, distances=[(0, 1, 0.047, 1e-4)])
    )
    usual = arm.default_prior()
    prior = Prior(np.asarray(usual.std) * 0.2, fixed=(*usual.fixed, "theta2"))
    commands, zeros = np.column_stack(PLACE), np.zeros((62, 3))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        said = str(jaxcal.identify(commands, zeros, model=arm, prior=prior).verdict)
        free = arm.measured_with(Socket(2))
        places = jaxcal.identify(commands, zeros, model=free, prior=prior).parameters
    apart = np.linalg.norm(places[-3:] - places[-6:-3])
    told = float(re.search(r"lengths give (\S+) \+-", said)[1])
    assert told == pytest.approx(apart, abs=1e-5)


def test_a_distance_between_sockets_that_are_not_touched_is_no_size():
    """As of one of two chains, where the other touches them."""
    arm = ur5(sensor=Socket(3, distances=[(1, 2, 50.0, 0.1)]))
    joints = np.zeros((4, 6))
    left_out = np.array([1.0, 1.0, 1.0, 0.0])
    for which, weights, doubtful in (
        ((0, 0, 1, 1), np.ones(4), True),
        ((0, 1, 2, 2), np.ones(4), False),
        ((0, 0, 1, 2), left_out, True),
    ):
        fit = types.SimpleNamespace(
            model=arm, commands=np.column_stack([joints, which])
        )
        parts = parts_of(fit, np.flatnonzero(weights))
        said = left_open(parts, " mm", anywhere=10.0, nominal=1.0)
        assert (said is not None) == doubtful


def test_a_column_that_never_changes_is_named():
    joints = PLACE[0].copy()
    joints[:, 6] = 0.0
    with pytest.warns(UserWarning, match="panda_joint7 is 0 in all 62 measurements"):
        assert not _fit("panda_1", joints, PLACE[1]).verdict.good
    joints = PLACE[0].copy()
    joints[:, 2] = 0.0
    with pytest.raises(ValueError, match="panda_joint3 never changes"):
        _fit("panda_1", joints, PLACE[1])
    joints = PLACE[0].copy()
    joints[:, 3] = 0.0  # beyond its limits
    with pytest.raises(ValueError, match=r"panda_joint4 .* the same in all 62 rows"):
        _fit("panda_1", joints, PLACE[1])


def test_degrees_that_were_converted_again_are_named():
    with pytest.raises(ValueError, match=r"Leave out np\.degrees, --radians"):
        _fit("panda_1", np.degrees(PLACE[0]), PLACE[1])


def test_loud_readings_are_judged_by_the_nominal_arm_or_what_was_asked():
    """A servo arm whose joints have .3 degrees of play."""
    arm, rng = ur5(), np.random.default_rng(0)
    std = np.asarray(arm.default_prior().std)
    truth = arm.nominal + 3.0 * std * rng.normal(size=len(std))
    joints = rng.uniform(-120.0, 120.0, (60, 6))
    measured = arm.predict(joints + rng.uniform(-0.15, 0.15, (60, 6)), truth)
    found = jaxcal.identify(joints, measured, model=arm)
    assert not found.verdict.explains and found.verdict.good
    assert "noise, or an effect that no parameter describes" in str(found.verdict)
    for accuracy, good in ((10.0, True), (0.5, False)):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            asked = jaxcal.identify(joints, measured, model=arm, accuracy=accuracy)
        assert asked.verdict.good == good
        again = jaxcal.Calibration.from_dict(asked.to_dict())
        assert again.verdict.good == good
    with pytest.raises(ValueError, match="accuracy must be positive"):
        jaxcal.identify(joints, measured, model=arm, accuracy=0.0)


def test_a_wrong_tip_is_named():
    """Positions of a point 0.7 m from where the tool is said to be."""
    arm = ur5()
    joints = np.random.default_rng(0).uniform(-120.0, 120.0, (60, 6))
    truth = arm.nominal.copy()
    truth[arm.names.index("tool z")] += 700.0
    noise = 0.1 * np.random.default_rng(1).normal(size=(60, 3))
    found = jaxcal.identify(joints, arm.predict(joints, truth) + noise, model=arm)
    assert any(why.startswith("tool z is ") for why in found.verdict.reasons)


def test_too_few_contacts_to_judge_are_said():
    rows = [0, 40, 1]
    with pytest.warns(
        UserWarning, match=r"no intervals and no verdict, .* 3 measurements"
    ):
        found = _fit("panda_1", PLACE[0][rows], PLACE[1][rows])
    assert not found.verdict.good and found.summary().count("no intervals") == 1
    usual = float(re.search(r"usual for .*?: (\S+)\)", found.verdict.next_step)[1])
    commands = np.column_stack([PLACE[0][rows], PLACE[1][rows]])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        stated = jaxcal.identify(
            commands, np.zeros((3, 3)), model=found.model, noise_std=usual
        )
    assert stated.confidence_intervals() is not None


def _moved(arm, joints, row, off):
    """Joints whose ball is ``off`` (3,) from where it was, of one row."""
    joints, at = joints.copy(), arm.calibrated(arm.nominal)
    there = at.predict(joints[row : row + 1])[0] + off
    for _ in range(6):
        lacks = there - at.predict(joints[row : row + 1])[0]
        rate = at.command_jacobian(joints[row : row + 1])[0]
        joints[row] += np.linalg.pinv(rate) @ lacks
    return joints


def _told(arm, joints, sockets, good=False):
    """Reasons of a verdict that is not good, or of any."""
    commands = np.column_stack([joints, sockets])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        zeros = np.zeros((len(joints), 3))
        verdict = jaxcal.identify(commands, zeros, model=arm).verdict
    return "" if verdict.good and not good else "\n".join(verdict.reasons)


@pytest.mark.slow
@pytest.mark.parametrize("count", [12, None])
@pytest.mark.parametrize("name", ["panda_1", "kuka_14"])
def test_wrong_contacts_of_every_place_are_told_by_name(name, count):
    """Rows of the other socket, radians, a tip 10 mm off, a contact 10 mm loose."""
    arm = contacts.arm(name)
    for seed, place in enumerate(contacts.load(name).values()):
        rng = np.random.default_rng(seed)
        rule = "I" if count else "all"
        rows = np.asarray(contacts.choose(rule, name, place, count, rng))
        joints, sockets = place[0][rows], place[1][rows]

        assert not _told(arm, joints, sockets)  # as they are
        wrong = rng.choice(len(rows), 2, replace=False)
        other = sockets.copy()
        other[wrong] = 1.0 - other[wrong]
        for row in wrong:
            instead = f"measurement {row} fits socket {sockets[row]:.0f} instead"
            assert instead in _told(arm, joints, other)
        with pytest.raises(ValueError, match="are they radians"):
            _told(arm, np.radians(joints), sockets)
        for axis in range(3):
            for off in (-0.01, 0.01):
                tool = arm.tool.copy()
                tool[axis, 3] += off
                wrong_tip = dataclasses.replace(arm, tool=tool)
                assert "is it another tip?" in _told(wrong_tip, joints, sockets, True)
        for _ in range(4):
            row, off = rng.integers(len(rows)), rng.normal(size=3)
            loose = _moved(arm, joints, row, 0.01 * off / np.linalg.norm(off))
            told = _told(arm, loose, sockets)
            assert re.search(rf"Rows? (.*, )?{row}\b.* outlier", told), told


@pytest.mark.parametrize("joint", range(6))
def test_a_reversed_joint_is_the_one_that_is_blamed(joint):
    commands, _, measured = ur5_data()
    rows = np.random.default_rng(joint).choice(len(commands), 12, replace=False)
    typed, measured = commands[rows].copy(), measured[rows]
    typed[:, joint] *= -1.0
    told = mistaken_columns(ur5(), typed, measured)
    # The tracker does not see the last joint turn: its reflector is on that axis.
    assert told.startswith(f"joint {joint + 1} seems reversed" if joint < 5 else "")
    assert (told == "") == (joint == 5)
    typed = commands[rows].copy()
    typed[:, [joint, joint - 1]] = typed[:, [joint - 1, joint]]
    told = mistaken_columns(ur5(), typed, measured)
    pair = sorted({joint + 1, (joint - 1) % 6 + 1})
    assert told.startswith(f"joint {pair[0]} and joint {pair[1]} seem exchanged")


def test_what_a_reversed_joint_leaves_is_not_good():
    """Held-out errors of 10 mm are a twentieth of the nominal ones, and no merit."""
    commands, _, measured = ur5_data()
    typed = commands[:20].copy()
    typed[:, 4] *= -1.0
    with pytest.warns(UserWarning, match="joint 5 seems reversed"):
        found = jaxcal.identify(typed, measured[:20], model=ur5(), measured_unit="mm")
    verdict = found.verdict
    assert not verdict.good and "; before calibration" in str(verdict)
    assert not any("theta" in why for why in verdict.reasons)
    assert str(verdict).endswith(
        "not good; next: correct the columns, then identify again"
    )


def test_contacts_of_a_reversed_joint_name_it():
    joints = PLACE[0].copy()
    joints[:, 1] *= -1.0
    with pytest.raises(ValueError, match="panda_joint2 seems reversed"):
        _fit("panda_1", joints, PLACE[1])
    joints = PLACE[0].copy()
    joints[:, 3] *= -1.0  # out of its limits, and all within them with the other sign
    with pytest.raises(ValueError, match="panda_joint4 seems reversed: with the other"):
        _fit("panda_1", joints, PLACE[1])


def test_a_straight_line_through_a_curve_is_told(rng):
    told = 0
    for _ in range(20):
        u = rng.uniform(0.1, 3.0, (20, 1))
        y = np.sqrt(u) + 0.002 * rng.standard_normal(u.shape)
        bent = jaxcal.identify(u, y).verdict
        quadratic = jaxcal.identify(u, y, model=jaxcal.models.Polynomial(3, 1)).verdict
        told += "Residuals follow a curve" in str(bent) and not bent.good
        assert "curve" not in str(quadratic)
    assert told >= 19
    for count in range(300):
        n, m = rng.integers(1, 4, 2)
        u = rng.uniform(-20.0, 20.0, (int(rng.integers(8, 60)), n))
        y = u @ rng.normal(size=(n, m)) + 0.05 * rng.standard_t(5, (len(u), m))
        assert "curve" not in str(jaxcal.identify(u, y).verdict), count


@pytest.mark.parametrize("outputs", [[0], [0, 1]])
def test_a_sensor_that_froze_is_told(outputs):
    rng = np.random.default_rng(1)
    u = rng.uniform(-5.0, 5.0, (20, 2))
    y = u @ [[1.1, 0.3], [-0.2, 0.9]] + 0.05 * rng.normal(size=(20, 2))
    y[12:, outputs] = y[11, outputs]
    with pytest.warns(jaxcal.CalibrationWarning, match="froze"):
        verdict = jaxcal.identify(u, y).verdict
    assert not verdict.good
    assert "in every row from 11 to 19" in verdict.reasons[0]


def test_a_coarse_sensor_on_a_plateau_did_not_freeze():
    u = np.linspace(-1.0, 1.0, 24)[:, None]
    y = np.round(8.0 * u**3)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        verdict = jaxcal.identify(u, y, model=jaxcal.models.Polynomial(3, 1)).verdict
    assert "froze" not in str(verdict)


def _plane(rng, count, outputs, noise=0.05):
    u = rng.uniform(-20.0, 20.0, (count, 2))
    gain = 0.1 * rng.normal(size=(2, outputs))
    gain[:, :2] += np.eye(2)
    return u, u @ gain + 1.0 + rng.normal(0.0, noise, (count, outputs))


@pytest.mark.parametrize("outputs", [2, 3])
@pytest.mark.parametrize("count", [9, 12, 20])
def test_one_wrong_cell_hides_in_no_noise(count, outputs):
    told = []
    for seed in range(20):
        rng = np.random.default_rng([seed, count, outputs])
        u, y = _plane(rng, count, outputs)
        told.append(jaxcal.identify(u, y).verdict.good)
        row, column = rng.integers(count), rng.integers(outputs)
        y[row, column] += 10.0
        with pytest.warns(jaxcal.CalibrationWarning):
            wrong = jaxcal.identify(u, y)
        assert row in wrong.outliers or "chance" in str(wrong.verdict), wrong.verdict
    assert told.count(True) >= 19


@pytest.mark.parametrize(
    ("what", "step"), [("calliper", 0.01), ("display", 0.1), ("steps", 0.25)]
)
def test_coarse_digits_are_no_fault(what, step, rng):
    u = np.repeat(np.arange(0.0, 101.0, 10.0), 2)
    for _ in range(10):
        y = u + 0.3 + (what == "calliper") * rng.normal(0.0, 0.004, len(u))
        y = step * np.round(y / step)
        assert jaxcal.identify(u[:, None], y[:, None]).verdict.good


@pytest.mark.parametrize(
    "curve",
    [
        lambda u: 15.0 * np.tanh(u / 12.0),
        lambda u: u + 2e-3 * u**3,
        lambda u: np.clip(u, -12.0, 12.0),
        lambda u: np.sign(u) * np.maximum(np.abs(u) - 3.0, 0.0),
    ],
)
@pytest.mark.parametrize("inputs", [1, 3])
def test_a_line_through_an_s_is_not_good(curve, inputs, rng):
    swept = np.linspace(-20.0, 20.0, 31)[:, None]
    u = swept if inputs == 1 else rng.uniform(-20.0, 20.0, (40, inputs))
    noise = rng.normal(0.0, 0.02, u.shape)
    assert jaxcal.identify(u, u + noise).verdict.good
    with pytest.warns(jaxcal.CalibrationWarning):
        assert not jaxcal.identify(u, curve(u) + noise).verdict.good


@pytest.mark.parametrize("bits", [16, 32])
def test_counts_that_were_read_without_their_sign_are_told(bits, rng):
    u = np.linspace(-9.0, 9.0, 16)[:, None]
    y = np.round(0.05 * 2.0**bits * u + rng.normal(0.0, 20.0, u.shape))
    assert jaxcal.identify(u, y).verdict.good
    high = y + 0.46 * 2.0**bits
    assert "unsigned" not in str(jaxcal.identify(u, high).verdict)
    with pytest.warns(jaxcal.CalibrationWarning, match="read as unsigned"):
        assert not jaxcal.identify(u, y % 2.0**bits).verdict.good
