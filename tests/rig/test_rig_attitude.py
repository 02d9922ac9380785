"""Rotations: the six orders, Android's published formulas, and the zero reference."""

from typing import get_args

import numpy as np
import pytest
from harness import fast_config
from scipy.spatial.transform import Rotation

from rig.config.settings import Order
from rig.readings.geometry import (
    AttitudeFrame,
    Attitudes,
    angle_between_deg,
    euler_to_matrix,
    matrix_to_euler,
)

ORDERS = get_args(Order)


def elementary(letter, degrees):
    """One rotation, written out."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return {
        "X": np.array([[1, 0, 0], [0, c, -s], [0, s, c]]),
        "Y": np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]),
        "Z": np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]),
    }[letter]


@pytest.mark.parametrize("order", ORDERS)
def test_a_chain_of_joints_reads_its_own_angles_in_its_order(order, rng):
    angles = rng.uniform([-179, -89, -179], [179, 89, 179], size=(200, 3))
    for angle in angles:
        chain = np.eye(3)
        for letter, degrees in zip(order, angle, strict=True):
            chain = chain @ elementary(letter, degrees)
        np.testing.assert_allclose(euler_to_matrix(angle, order), chain, atol=1e-12)
        np.testing.assert_allclose(matrix_to_euler(chain, order), angle, atol=1e-8)
    np.testing.assert_array_equal(
        euler_to_matrix(angles, order)[7], euler_to_matrix(angles[7], order)
    )


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("middle", [90.0, -90.0, 90.0 - 1e-6])
def test_angles_give_their_matrix_where_only_a_sum_of_two_is_determined(order, middle):
    first, third = 25.0, -140.0
    chain = (elementary(order[0], first) @ elementary(order[1], middle)
             @ elementary(order[2], third))  # fmt: skip
    read = matrix_to_euler(np.stack([chain, chain.T]), order)
    np.testing.assert_allclose(
        euler_to_matrix(read, order), [chain, chain.T], atol=1e-14
    )
    assert read[0, 1] == pytest.approx(middle, abs=1e-5)


@pytest.mark.parametrize("order", ORDERS)
def test_another_order_reads_other_angles(order):
    chain = euler_to_matrix([15.0, -18.0, 12.0], order)
    for other in set(ORDERS) - {order}:
        read = matrix_to_euler(chain, other)
        by_letter = {a: v for a, v in zip(other, read, strict=True)}
        off = [
            by_letter[a] - v for a, v in zip(order, (15.0, -18.0, 12.0), strict=True)
        ]
        assert np.abs(off).max() > 0.5


def test_androids_legacy_orientation_is_zyx_with_all_signs_turned(rng):
    """Its published formulas, on a device-to-world matrix, against our reading."""
    for angles in rng.uniform(-80, 80, size=(50, 3)):
        r = euler_to_matrix(angles, "ZYX")
        published = np.degrees(
            [
                np.arctan2(-r[1, 0], r[0, 0]),
                np.arcsin(r[2, 0]),
                np.arctan2(-r[2, 1], r[2, 2]),
            ]
        )
        azimuth, roll, pitch = published
        back = euler_to_matrix([-azimuth, -roll, -pitch], "ZYX")
        np.testing.assert_allclose(back, r, atol=1e-12)


def test_mean_ignores_the_wrap_from_359_to_1():
    matrices = euler_to_matrix([[359.0, 0, 0], [1.0, 0, 0], [0.5, 0, 0]], "ZYX")
    mean = matrix_to_euler(Attitudes(fast_config()).mean(matrices), "ZYX")
    assert abs(mean[0] - 0.5 / 3) < 1e-4


def test_angle_between_is_exact_for_small_and_large_turns():
    for degrees in (1e-6, 0.01, 45.0, 179.0):
        turned = Rotation.from_rotvec([0.0, degrees, 0.0], degrees=True).as_matrix()
        assert angle_between_deg(np.eye(3), turned) == pytest.approx(degrees, rel=1e-6)


def test_frame_recovers_joint_angles_whatever_heading_and_mounting(rng):
    mounting = euler_to_matrix([12.0, -5.0, 7.0], "ZYX")
    for _ in range(30):
        world = euler_to_matrix(rng.uniform(-180, 180, 3), "XYZ")
        pitch, yaw, roll = rng.uniform(-40, 40, 3)
        joints = euler_to_matrix([yaw, pitch, roll], "ZXY")
        frame = AttitudeFrame(world @ mounting, mounting, "ZXY", ("X", "Z", "Y"))
        read = frame.angles(world @ joints @ mounting)
        np.testing.assert_allclose(read, [pitch, yaw, roll], atol=1e-9)


def test_subtracting_euler_angles_instead_would_be_wrong_by_degrees():
    zero = euler_to_matrix([170.0, 20.0, 10.0], "ZYX")
    joints = euler_to_matrix([10.0, 15.0, -12.0], "ZXY")
    subtracted = matrix_to_euler(zero @ joints, "ZXY") - matrix_to_euler(zero, "ZXY")
    assert np.abs(subtracted - [10.0, 15.0, -12.0]).max() > 2.0
