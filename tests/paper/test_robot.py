"""The robot's closed form against scipy's rotations, laws of play, gradients."""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

import jaxcal
from jaxcal.paper.twin.robot import (
    GRAVITY,
    ORDERS,
    RobotConfig,
    bias_drift,
    joint_angles,
    measure,
    play,
    read_out,
)

SCALE, BIAS = np.array([0.43, 0.71, 0.87]), np.array([3.1, -5.8, 2.41])


def postures(seed: int = 0, count: int = 60, reach: float = 20.0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-reach, reach, (count, 3))


def rotation(angles: np.ndarray, order: str) -> Rotation:
    """Scipy's rotation of (N, 3) angles about x, y, z, turned in an order."""
    columns = ["XYZ".index(letter) for letter in order]
    return Rotation.from_euler(order, angles[:, columns], degrees=True)


def angles(turned: Rotation, order: str) -> np.ndarray:
    sequence = turned.as_euler(order, degrees=True)
    columns = [order.index(letter) for letter in "XYZ"]
    return sequence[:, columns]


# -- an ideal robot --------------------------------------------------------------------


@pytest.mark.parametrize("order", ORDERS)
def test_read_in_the_order_of_its_axes_the_robot_is_exactly_table_1(order: str) -> None:
    config = RobotConfig(mechanism_order=order, read_out_order=order)
    commands = postures(reach=60.0)
    np.testing.assert_allclose(
        read_out(config, commands), commands * SCALE + BIAS, atol=1e-12
    )


def test_table_1_is_identified() -> None:
    commands = postures()
    found = jaxcal.identify(commands, read_out(RobotConfig(), commands))
    np.testing.assert_allclose(found.matrix, np.diag(SCALE), atol=1e-13)
    np.testing.assert_allclose(found.bias, BIAS, atol=1e-12)


@pytest.mark.parametrize("mechanism", ORDERS)
@pytest.mark.parametrize("read", ORDERS)
def test_reading_is_that_of_scipys_rotations(mechanism: str, read: str) -> None:
    mounting = np.array([[3.0, -4.0, 5.0]])
    config = RobotConfig(
        mechanism_order=mechanism, read_out_order=read, mounting_deg=tuple(mounting[0])
    )
    commands = postures(1, reach=40.0)
    phone = rotation(mounting, "XYZ")[0]
    turned = phone.inv() * rotation(commands * SCALE + BIAS, mechanism) * phone
    with jax.disable_jit():  # 36 compilations take longer than they tell
        found = read_out(config, commands)
    np.testing.assert_allclose(found, angles(turned, read), atol=1e-11)


def test_a_wrong_order_is_not_linear_and_fakes_cross_coupling() -> None:
    """Published nowhere: the figure of docs/robot.md, from scipy alone."""
    config = RobotConfig(mechanism_order="YXZ", read_out_order="XYZ")
    commands = postures(2, 400)
    found = jaxcal.identify(commands, read_out(config, commands))
    turned = rotation(commands * SCALE + BIAS, "YXZ")
    apart = angles(turned, "XYZ") - commands @ found.matrix.T - found.bias
    assert 0.2 < np.sqrt((apart**2).mean()) < 2.0
    assert np.abs(found.matrix - np.diag(np.diag(found.matrix))).max() > 0.02


def test_a_phone_askew_turns_up_as_cross_coupling_of_the_predicted_size() -> None:
    """By a small angle d about (1, 1, 1) / sqrt(3): off-diagonals of d / sqrt(3)."""
    turn = Rotation.from_rotvec(np.radians(1.0) * np.ones(3) / np.sqrt(3))
    mounting = turn.as_euler("XYZ", degrees=True)
    config = RobotConfig(
        scale=(1, 1, 1), bias_deg=(0, 0, 0), mounting_deg=tuple(mounting)
    )
    commands = postures(3, 2000, reach=2.0)
    found = jaxcal.identify(commands, read_out(config, commands)).matrix
    off = np.abs(found[~np.eye(3, dtype=bool)])
    np.testing.assert_allclose(off, np.radians(1.0) / np.sqrt(3), rtol=0.05)


# -- precision, transformations --------------------------------------------------------


def test_jax_arrays_stay_in_their_precision_and_numpy_gets_float64() -> None:
    commands = postures(4)
    single = read_out(RobotConfig(), jnp.asarray(commands, jnp.float32))
    assert isinstance(single, jax.Array) and single.dtype == jnp.float32
    double = read_out(RobotConfig(), commands)
    assert isinstance(double, np.ndarray) and double.dtype == np.float64
    np.testing.assert_allclose(single, double, atol=2e-5)
    assert read_out(RobotConfig(), commands.tolist()).shape == (60, 3)
    assert read_out(RobotConfig(), commands.reshape(3, 4, 5, 3)).shape == (3, 4, 5, 3)


CROOKED = RobotConfig(
    mechanism_order="YXZ",
    read_out_order="ZXY",
    mounting_deg=(3.0, -2.0, 4.0),
    compliance_deg_per_nm=(0.5, 0.9, 0.7),
    load_kg=2.0,
)


@pytest.mark.parametrize("config", [RobotConfig(), CROOKED])
def test_gradient_is_that_of_finite_differences(config: RobotConfig) -> None:
    with jax.enable_x64(True):
        slope = jax.jit(jax.jacrev(lambda u: read_out(config, u)))
        for command in postures(5, 4):
            exact = slope(jnp.asarray(command))
            step = 1e-4
            rows = command + step * np.concatenate([np.eye(3), -np.eye(3)])
            read = np.asarray(read_out(config, rows))
            differences = (read[:3] - read[3:]).T / (2 * step)
            np.testing.assert_allclose(exact, differences, atol=1e-8)


def test_vmap_and_jit_change_nothing() -> None:
    commands = jnp.asarray(postures(6), jnp.float32)
    mapped = jax.jit(jax.vmap(lambda u: read_out(CROOKED, u)))(commands)
    np.testing.assert_allclose(mapped, read_out(CROOKED, commands), atol=1e-5)


# -- compliance ------------------------------------------------------------------------


@pytest.mark.parametrize("order", ["XYZ", "YXZ"])
def test_bent_joints_are_where_the_energy_is_least(order: str) -> None:
    """Springs and weight; the oracle is scipy's minimiser of their energy."""
    config = RobotConfig(
        mechanism_order=order, compliance_deg_per_nm=(0.6, 0.9, 1.2), load_kg=2.0
    )
    soft = np.radians(config.per_axis("compliance_deg_per_nm"))

    for command in postures(7, 3):
        target = np.radians(command * SCALE + BIAS)

        def energy(joints: np.ndarray, target: np.ndarray = target) -> float:
            place = rotation(np.degrees(joints)[None], order)[0].apply(
                np.array(config.load_offset_m)
            )
            springs = 0.5 * ((joints - target) ** 2 / soft).sum()
            return float(springs + config.load_kg * GRAVITY * place[1])

        least = minimize(energy, target, method="BFGS", options={"gtol": 1e-10}).x
        found = np.radians(joint_angles(config, command))
        np.testing.assert_allclose(found, least, atol=1e-7)
        assert energy(found) <= energy(least) + 1e-15
        assert np.degrees(np.abs(found - target)).max() > 0.1


def test_a_stiff_joint_does_not_bend() -> None:
    commands = postures(8)
    config = RobotConfig(compliance_deg_per_nm=(0.0, 0.0, 1.0))
    bent = joint_angles(config, commands) - (commands * SCALE + BIAS)
    np.testing.assert_allclose(bent[:, :2], 0.0, atol=1e-14)
    assert np.abs(bent[:, 2]).max() > 1e-3


# -- play ------------------------------------------------------------------------------

steps = st.floats(-30, 30, allow_subnormal=False)  # XLA flushes those to zero
walks = st.lists(steps, min_size=12, max_size=12)
compiled_play = jax.jit(play)


def dragged(walk: list[float], gap: float, start: float = 0.0) -> np.ndarray:
    rows = np.repeat(np.array(walk)[:, None], 3, axis=1)
    with jax.enable_x64(True):
        loose = compiled_play(
            jnp.asarray(rows), jnp.full(3, float(gap)), jnp.full(3, float(start))
        )
        return np.array(loose)[:, 0]


@given(walks, st.floats(0, 5, allow_subnormal=False))
@settings(max_examples=50)
def test_play_keeps_within_its_stops_and_moves_only_when_pushed(
    walk: list[float], gap: float
) -> None:
    loose = dragged(walk, gap)
    before = np.concatenate([[0.0], loose[:-1]])
    driven = np.array(walk)
    assert (np.abs(loose - driven) <= gap / 2 + 1e-12).all()
    rests = np.abs(before - driven) <= gap / 2
    np.testing.assert_array_equal(loose[rests], before[rests])
    pushed = ~rests
    np.testing.assert_allclose(np.abs(loose - driven)[pushed], gap / 2, atol=1e-12)


@given(walks)
@settings(max_examples=20)
def test_no_gap_no_play(walk: list[float]) -> None:
    np.testing.assert_array_equal(dragged(walk, 0.0), walk)


@given(walks, st.floats(0.1, 5), st.integers(1, 2))
@settings(max_examples=30)
def test_play_forgets_the_speed_and_the_stops_on_the_way(
    walk: list[float], gap: float, between: int
) -> None:
    """Rate independence: postures visited on the way do not change where it ends."""
    way = [0.0, *walk]
    slow = np.concatenate(
        [np.linspace(a, b, between + 2)[1:] for a, b in itertools.pairwise(way)]
    )
    ends = dragged(slow.tolist(), gap)[between :: between + 1]
    np.testing.assert_allclose(ends, dragged(walk, gap), atol=1e-12)


def test_from_one_side_play_is_a_bias_and_nothing_else() -> None:
    config = RobotConfig(backlash_deg=0.5)
    rows = postures(9, 40)
    way = np.stack([rows - 5.0, rows], axis=1).reshape(-1, 3)  # always from below
    read = measure(config, way, jax.random.key(0))[1::2]
    found = jaxcal.identify(rows, read)
    np.testing.assert_allclose(found.matrix, np.diag(SCALE), atol=1e-12)
    np.testing.assert_allclose(found.bias, BIAS - 0.25, atol=1e-12)


def test_play_of_a_measurement_is_that_of_a_loop() -> None:
    config = RobotConfig(backlash_deg=(0.2, 0.5, 1.0))
    sets = postures(10, 60).reshape(2, 30, 3)
    read = measure(config, sets, jax.random.key(0))
    half = np.array([0.1, 0.25, 0.5])
    for commands, found in zip(sets, read, strict=True):
        loose = BIAS
        for command, angles_read in zip(commands, found, strict=True):
            driven = command * SCALE + BIAS
            loose = np.minimum(np.maximum(loose, driven - half), driven + half)
            np.testing.assert_allclose(angles_read, loose, atol=1e-12)


# -- noise and drift -------------------------------------------------------------------


def test_noise_is_white_of_the_level_of_each_axis() -> None:
    config = RobotConfig(noise_std_deg=(0.1, 0.2, 0.3))
    commands = postures(11, 4000)
    noise = measure(config, commands, jax.random.key(1)) - read_out(config, commands)
    np.testing.assert_allclose(noise.std(axis=0), [0.1, 0.2, 0.3], rtol=0.05)
    np.testing.assert_allclose(noise.mean(axis=0), 0.0, atol=0.02)
    assert np.abs(np.corrcoef(noise.T) - np.eye(3)).max() < 0.06
    again = measure(config, commands, jax.random.key(1))
    np.testing.assert_allclose(again, noise + read_out(config, commands), atol=1e-14)


def test_the_bias_wanders_from_session_to_session() -> None:
    config = RobotConfig(drift_std_deg=(0.0, 0.3, 0.1))
    walk = bias_drift(config, np.arange(2001))
    np.testing.assert_array_equal(walk[0], 0.0)
    np.testing.assert_array_equal(walk[:, 0], 0.0)
    steps = np.diff(walk, axis=0)
    np.testing.assert_allclose(steps.std(axis=0), [0.0, 0.3, 0.1], rtol=0.06)
    np.testing.assert_array_equal(bias_drift(config, 7), walk[7])
    other = dataclasses.replace(config, drift_seed=1)
    assert not np.array_equal(bias_drift(other, 7), walk[7])
    commands = postures(12)
    read = measure(config, commands, jax.random.key(0), 7)
    np.testing.assert_allclose(
        read, read_out(config, commands) + walk[7][None], atol=1e-12
    )
    each = measure(config, commands, jax.random.key(0), np.arange(60))
    np.testing.assert_allclose(each, read_out(config, commands) + walk[:60], atol=1e-12)


# -- refused ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (
            {"mechanism_order": "XYX"},
            "mechanism_order must be one of XYZ, .* got 'XYX'",
        ),
        ({"read_out_order": "xyz"}, "read_out_order must be one of"),
        ({"scale": (1, 2)}, "scale must be three finite numbers, got"),
        ({"bias_deg": (0, np.nan, 0)}, "bias_deg must be three finite numbers"),
        ({"backlash_deg": -0.1}, "backlash_deg must be one number or three, none neg"),
        ({"noise_std_deg": (1, 2)}, "noise_std_deg must be one number or three"),
        ({"drift_std_deg": np.inf}, "drift_std_deg must be finite"),
        ({"load_kg": -1.0}, "load_kg must be finite and >= 0, got -1"),
        ({"compliance_deg_per_nm": 80.0}, "bend the robot by at most 0.5 rad"),
    ],
)
def test_bad_robots_are_refused(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RobotConfig(**fields)


def test_bad_commands_are_refused() -> None:
    config = RobotConfig()
    with pytest.raises(ValueError, match=r"commands must have shape \(\.\.\., 3\)"):
        read_out(config, np.zeros((5, 2)))
    with pytest.raises(ValueError, match="commands must be finite, got nan"):
        read_out(config, [[0.0, np.nan, 0.0]])
    with pytest.raises(ValueError, match=r"must have shape \(\.\.\., N, 3\)"):
        measure(config, np.zeros(3), jax.random.key(0))
    with pytest.raises(ValueError, match="session must be whole and not negative"):
        measure(config, np.zeros((5, 3)), jax.random.key(0), -1)
