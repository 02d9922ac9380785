"""Errors, accuracies and tolerances, those of each unit by themselves."""

from __future__ import annotations

import numpy as np
import pytest

import jaxcal
from jaxcal.models import Pose, Position, SerialChain, Several, Socket
from tests.models.arms import UR5_TABLE


def _posed(off_mm=1.0, off_deg=0.2, **given):
    """Poses of an arm, with these errors of a coordinate; what was identified."""
    rng = np.random.default_rng(0)
    arm = SerialChain.from_dh(UR5_TABLE, tool=(0, 0, 31), sensor=Pose())
    joints = rng.uniform(-120.0, 120.0, (40, 6))
    theta = arm.nominal.copy()
    theta[: arm.table.size] += 0.2 * rng.normal(size=arm.table.size)
    read = arm.predict(joints, theta)
    read += rng.normal(size=read.shape) * np.repeat([off_mm, off_deg], 3)
    noise = np.repeat([off_mm, off_deg], 3)
    return (
        joints,
        read,
        jaxcal.identify(
            joints, read, model=arm, noise_std=noise, measured_unit="mm", **given
        ),
    )


def test_millimetres_and_degrees_are_told_apart():
    joints, read, found = _posed()
    lengths, turns = found.verdict.errors
    assert (lengths.unit, turns.unit) == ("mm", "deg")
    # Of noise alone the mean of a norm of three; some more, since they were left out.
    for errors, noise in ((lengths, 1.0), (turns, 0.2)):
        least = noise * np.sqrt(8.0 / np.pi)
        assert 0.95 * least < errors.held_out < 1.6 * least
    assert found.verdict.held_out == lengths.held_out
    off = np.linalg.norm(read[:, 3:] - found.model.predict(joints)[:, 3:], axis=1)
    assert turns.nominal == pytest.approx(off.mean(), rel=1e-6)
    assert f"{turns.held_out:.3g} deg (95 %" in str(found.verdict)
    said = found.check(joints, read)
    assert [*said.tolerances] == ["mm", "deg"] and " mm or " in str(said)
    coarse = found.check(joints, read, tolerance={"deg": 100.0})
    assert coarse.tolerances == {"deg": 100.0} and not coarse.unseen


def test_an_accuracy_is_of_a_unit():
    enough = {"mm": 3.0, "deg": 0.6}
    assert _posed(accuracy=enough)[2].verdict.good
    assert _posed(accuracy=3.0)[2].verdict.good  # of lengths
    few = _posed(accuracy=enough | {"deg": 0.1})[2].verdict
    assert (
        not few.good
        and "The accuracy you asked for is not reached: 0.1 deg." in str(few)
    )
    for wrong, words in (({"m": 1.0}, "one of mm, deg"), ({"mm": -1.0}, "positive")):
        with pytest.raises(ValueError, match=words):
            _posed(accuracy=wrong)
    joints = np.random.default_rng(0).uniform(size=(8, 2))
    with pytest.raises(ValueError, match="accuracy needs an arm"):
        jaxcal.identify(joints, joints + 1.0, accuracy=1.0)


def test_of_several_sensors_each_has_its_line():
    rng = np.random.default_rng(0)
    arm = SerialChain.from_dh(
        UR5_TABLE, tool=(0, 0, 31), sensor=Several((Position(), Pose(noise=0.1)))
    )
    joints = rng.uniform(-120.0, 120.0, (40, 6))
    commands, _ = arm.together((joints[:20], None), (joints[20:], None))
    read = arm.predict(commands) + 0.5 * rng.normal(size=(40, 6)) * (
        np.arange(6) < np.where(commands[:, 6:7] == 0, 3, 6)
    )
    errors = jaxcal.identify(commands, read, model=arm).verdict.errors
    names = [("position", "length"), ("pose", "length"), ("pose", "deg")]
    assert [(one.of, one.unit) for one in errors] == names
    assert Socket().quantities[0].unit == "length"
