"""What small moves say, against a chain of joints built by products of rotations."""

from typing import get_args
from unittest import mock

import numpy as np
import pytest
from harness import arm_text, changed, fast_config
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rig.config import AXIS_NAMES, parse_config
from rig.config.settings import Order
from rig.faults import MotionFault
from rig.prove import axis_check
from rig.prove.axis_check import (
    Stand,
    corner_name,
    corners_of,
    find,
    proposals,
)  # fmt: skip
from rig.prove.axis_moves import _Tour
from rig.readings.geometry import angle_between_deg, euler_to_matrix

CONFIG = fast_config()
GAINS = (0.43, 0.71, 0.87)  # of the paper's device
START = (0, 0, 0)  # the zero posture: the axes are at right angles
AXIS = {"X": [1.0, 0, 0], "Y": [0, 1.0, 0], "Z": [0, 0, 1.0]}


class Chain:
    """Three joints in an order; ``drives[j]`` turns joint ``joints[j]``."""

    def __init__(self, order="ZXY", joints=(0, 1, 2), deg_per_pulse=None, turned=None):
        self.order, self.joints = order, joints
        config_scale = [1.0 / axis.pulses_per_deg for axis in CONFIG.axes]
        self.deg_per_pulse = np.array(
            config_scale if deg_per_pulse is None else deg_per_pulse
        )
        self.mounting = np.eye(3) if turned is None else turned
        self.play = np.zeros(3)
        self.noise = np.random.default_rng(0)
        self.std = 0.0

    def attitude(self, pulses, lag=(0, 0, 0)):
        """Phone to its world; the joints are turned one after another from the base."""
        angle = np.zeros(3)
        for drive, joint in enumerate(self.joints):
            angle[joint] = self.deg_per_pulse[drive] * pulses[drive] + lag[drive]
        whole = Rotation.from_rotvec([0, 0, 170.0], degrees=True)
        for letter in self.order:
            joint = CONFIG.letters.index(letter)
            whole *= Rotation.from_rotvec(
                np.multiply(AXIS[letter], angle[joint]), degrees=True
            )
        whole *= Rotation.from_matrix(self.mounting)
        return whole.as_matrix()

    def stands(self, reach_deg=3.0, samples=25, corner_deg=(3.0, 3.0, 3.0)):
        """The places of the axis check, visited as it visits them."""
        stands, end = {}, np.array([0.0, 0.0, 0.0])  # sense of each drive's last move
        here = np.array(START, dtype=float)

        def stand(name, offset):
            nonlocal here, end
            target = np.array(START, dtype=float)
            for axis, way in offset.items():
                target[axis] += CONFIG.axes[axis].to_pulses(way)
            sense = np.sign((target - here) * self.deg_per_pulse)
            end = np.where(sense, sense, end)
            here = target
            matrix = self.attitude(target, -end * self.play / 2.0)
            noise = self.noise.normal(0.0, self.std / np.sqrt(samples), 3)
            matrix = matrix @ Rotation.from_rotvec(noise, degrees=True).as_matrix()
            stands[name] = Stand(target, matrix, self.std, samples)

        stand("start", {})
        for j, name in enumerate(AXIS_NAMES):
            for part, way in (
                ("look", 0.5), ("plus", reach_deg), ("back", 0.0),
                ("minus", -reach_deg), ("up", 0.0),
            ):  # fmt: skip
                stand(f"{name}:{part}", {j: way})
        for signs in corners_of(3):
            stand(
                corner_name(CONFIG, signs),
                dict(enumerate(np.multiply(corner_deg, signs))),
            )
        return stands


signs = st.tuples(*[st.sampled_from((-1.0, 1.0))] * 3)
gains = st.tuples(*[st.floats(0.4, 1.4)] * 3)


@settings(max_examples=60, deadline=None)
@given(
    order=st.sampled_from(get_args(Order)),
    joints=st.permutations(range(3)),
    signs=signs,
    gains=gains,
    turned=st.tuples(*[st.floats(-15.0, 15.0)] * 3),
)
def test_units_signs_gains_order_and_placement_are_found(
    order, joints, signs, gains, turned
):
    base = [1.0 / abs(axis.pulses_per_deg) for axis in CONFIG.axes]
    rates = np.multiply(np.multiply(base, gains), signs)
    mounting = euler_to_matrix(turned, "ZYX")
    chain = Chain(order, tuple(joints), rates, mounting)
    found = find(CONFIG, chain.stands())
    assert found.joints == tuple(joints)
    np.testing.assert_allclose(found.deg_per_pulse, rates, rtol=2e-3)
    assert found.order == order
    assert angle_between_deg(found.mounting, mounting) < 0.3


def test_joints_of_an_arm_have_no_letters_and_are_found_by_its_axes():
    config = parse_config(arm_text())
    expected = np.random.default_rng(3).normal(size=(3, 5))
    expected /= np.linalg.norm(expected, axis=0)
    rates = expected * [0.01, -0.02, 0.01, 0.03, 0.01]
    with mock.patch.object(axis_check, "rates_of", return_value=rates):
        found = find(config, {}, expected)
    assert found.joints == (0, 1, 2, 3, 4) and found.order is None
    np.testing.assert_allclose(found.deg_per_pulse, [0.01, -0.02, 0.01, 0.03, 0.01])


def test_a_device_as_configured_needs_no_correction():
    assert proposals(CONFIG, find(CONFIG, Chain().stands()), [None] * 3) == []


def test_play_does_not_enter_the_gains():
    chain = Chain()
    chain.play = np.array([0.5, 0.1, 0.0])
    found = find(CONFIG, chain.stands())
    own = [
        abs(r * a.pulses_per_deg)
        for r, a in zip(found.deg_per_pulse, CONFIG.axes, strict=True)
    ]
    np.testing.assert_allclose(own, 1.0, atol=0.01)


def test_a_phone_placed_quite_otherwise_is_refused_not_explained_by_exchanged_axes():
    chain = Chain(turned=euler_to_matrix((45, 35, 40), "ZYX"))
    with pytest.raises(MotionFault, match=r"imu\.mounting_deg"):
        find(CONFIG, chain.stands())


@pytest.mark.parametrize("changes", [{"signs": (1, -1, -1)}, {"signs": (-1, 1, -1)}])
def test_mirrored_readings_are_not_taken_for_a_reversed_axis(changes):
    told, read = CONFIG.imu, changed(CONFIG.imu, **changes)
    stands = Chain().stands()
    for name, stand in stands.items():
        angles = Rotation.from_matrix(stand.attitude).as_euler(told.order, degrees=True)
        sent = angles * told.signs
        matrix = euler_to_matrix(sent * read.signs, read.order)
        stands[name] = Stand(stand.pulses, matrix, 0.0, 25)
    config = CONFIG.model_copy(update={"imu": read})
    with pytest.raises(
        MotionFault, match=r"imu.order, imu.columns or imu.signs is wrong"
    ):
        find(config, stands)


@pytest.mark.parametrize("play", [0.0, 0.4])
def test_the_noise_of_a_sound_phone_is_not_taken_for_a_wrong_order(play):
    """The error of an axis's direction does not enter how the axes combine."""
    rates = [g / a.pulses_per_deg for g, a in zip(GAINS, CONFIG.axes, strict=True)]
    chain = Chain(deg_per_pulse=rates)
    chain.std, chain.play = 0.03, np.full(3, play)
    stands = [chain.stands(corner_deg=(6.0, 4.2, 3.4)) for _ in range(60)]
    assert {find(CONFIG, each).order for each in stands} == {"ZXY"}


def test_a_noisy_phone_leaves_the_order_open_and_mirrored_axes_uncorrected():
    chain = Chain()
    chain.std = 0.3
    assert find(CONFIG, chain.stands()).order is None
    rates = [1.0 / axis.pulses_per_deg for axis in CONFIG.axes]
    rates[0] = -rates[0]
    chain = Chain(deg_per_pulse=rates)
    chain.std = 0.3
    with pytest.raises(MotionFault, match="too noisy"):
        find(CONFIG, chain.stands())


def test_the_drives_word_goes_before_the_measured_ratio():
    rates = np.array([1.0 / axis.pulses_per_deg for axis in CONFIG.axes])
    found = find(CONFIG, Chain(deg_per_pulse=rates * 2.5).stands())
    told = [CONFIG.axes[0].pulses_per_rev * 2 // 5] * 3
    keys = {change.key: change.new for change in proposals(CONFIG, found, told)}
    assert keys == {f"axes.{name}.pulses_per_rev": told[0] for name in AXIS_NAMES}
    keys = {change.key: change.new for change in proposals(CONFIG, found, [None] * 3)}
    for name in AXIS_NAMES:
        assert keys[f"axes.{name}.reduction"] == pytest.approx(4.0, rel=2e-3)


@pytest.mark.parametrize(("play", "taken"), [(0, 1), (0.2, 1), (0.7, 0), (1.5, 0)])
def test_places_on_the_way_out_count_where_play_was_taken_up_at_both(play, taken):
    tour = object.__new__(_Tour)
    tour.turned = lambda turned: turned  # a place is how far the phone turned
    places = [(-at, max(0.0, at - 1000 * play)) for at in (0, 90, 270, 800, 3000)]
    assert tour.taken_up(places) is bool(taken)
    assert not tour.taken_up(places[:2])
    assert not tour.taken_up([*places[:-1], (-1500, 1.0)])  # hardly further
