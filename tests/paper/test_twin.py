"""The robot at rest against rotations written out, MuJoCo against laws of mechanics."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.optimize import minimize

import jaxcal
from benchmarks.paper.twin import (
    GRAVITY,
    ORDERS,
    RobotConfig,
    load_model,
    read_out,
    simulate,
)

SCALE, BIAS = np.array([0.43, 0.71, 0.87]), np.array([3.1, -5.8, 2.41])


def postures(seed: int = 0, count: int = 60, reach: float = 20.0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-reach, reach, (count, 3))


def groups(seed: int = 0, count: int = 2, length: int = 15) -> np.ndarray:
    return postures(seed, count * length).reshape(count, length, 3)


def rotation(angles_deg: np.ndarray, order: str) -> np.ndarray:
    """(3, 3) of three angles about x, y, z, turned in an order: Rodrigues' formula."""
    turned = np.eye(3)
    for letter in order:
        axis = "XYZ".index(letter)
        angle = np.radians(angles_deg[axis])
        cross = np.cross(np.eye(3), np.eye(3)[axis])
        turned = turned @ (
            np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
        )
    return turned


# -- at rest ---------------------------------------------------------------------------


@pytest.mark.parametrize("order", ORDERS)
def test_read_in_the_order_of_its_axes_the_robot_is_exactly_table_1(order: str) -> None:
    config = RobotConfig(mechanism_order=order, read_out_order=order)
    commands = postures(reach=60.0)
    found = read_out(config, commands)
    np.testing.assert_allclose(found, commands * SCALE + BIAS, atol=1e-12)
    found = read_out(config, commands.reshape(3, 4, 5, 3))
    assert found.shape == (3, 4, 5, 3)


@pytest.mark.parametrize("mechanism", ORDERS)
@pytest.mark.parametrize("read", ORDERS)
def test_what_is_read_turns_as_the_phone_does(mechanism: str, read: str) -> None:
    mounting = np.array([3.0, -4.0, 5.0])
    config = RobotConfig(
        mechanism_order=mechanism, read_out_order=read, mounting_deg=tuple(mounting)
    )
    commands = postures(1, 12, reach=40.0)
    phone = rotation(mounting, "XYZ")
    for command, found in zip(commands, read_out(config, commands), strict=True):
        turned = phone.T @ rotation(command * SCALE + BIAS, mechanism) @ phone
        np.testing.assert_allclose(rotation(found, read), turned, atol=1e-12)
        assert np.abs(found["XYZ".index(read[1])]) <= 90.0


def test_a_wrong_order_is_not_linear_and_fakes_cross_coupling() -> None:
    config = RobotConfig(mechanism_order="YXZ", read_out_order="XYZ")
    commands = postures(2, 400)
    read = read_out(config, commands)
    found = jaxcal.identify(commands, read)
    apart = read - commands @ found.matrix.T - found.bias
    assert 0.2 < np.sqrt((apart**2).mean()) < 2.0
    assert np.abs(found.matrix - np.diag(np.diag(found.matrix))).max() > 0.02


def test_a_phone_askew_turns_up_as_cross_coupling_of_the_predicted_size() -> None:
    """By a small angle d about (1, 1, 1) / sqrt(3): off-diagonals of d / sqrt(3)."""
    config = RobotConfig((1, 1, 1), (0, 0, 0), mounting_deg=(1 / np.sqrt(3),) * 3)
    commands = postures(3, 2000, reach=2.0)
    found = jaxcal.identify(commands, read_out(config, commands)).matrix
    off = np.abs(found[~np.eye(3, dtype=bool)])
    np.testing.assert_allclose(off, np.radians(1.0) / np.sqrt(3), rtol=0.05)


# -- in MuJoCo -------------------------------------------------------------------------


@pytest.mark.parametrize("order", ORDERS)
def test_the_robot_settles_where_the_closed_form_says(order: str) -> None:
    for config in (
        RobotConfig(mechanism_order=order, read_out_order=order),
        RobotConfig(
            mechanism_order=order, read_out_order="ZXY", mounting_deg=(3.0, -2.0, 40.0)
        ),
    ):
        apart = simulate(config, groups()) - read_out(config, groups())
        assert np.abs(apart).max() < 1e-6  # degrees; 3e-13 was measured


@pytest.mark.parametrize("order", ["XYZ", "YXZ"])
def test_joints_that_bend_settle_where_the_energy_is_least(order: str) -> None:
    """Springs and weight; the oracle is scipy's minimiser of their energy."""
    config = RobotConfig(
        mechanism_order=order,
        read_out_order=order,
        compliance_deg_per_nm=(0.5, 0.9, 0.7),
        load_kg=2.0,
    )
    commands = groups(7, 1, 5)
    soft = np.radians(config.compliance_deg_per_nm)
    for command, found in zip(commands[0], simulate(config, commands)[0], strict=True):
        target = np.radians(command * SCALE + BIAS)

        def energy(joints: np.ndarray, target: np.ndarray = target) -> float:
            place = rotation(np.degrees(joints), order) @ config.load_offset_m
            springs = 0.5 * ((joints - target) ** 2 / soft).sum()
            return float(springs + config.load_kg * GRAVITY * place[1])

        least = minimize(energy, target, method="BFGS", options={"gtol": 1e-10}).x
        np.testing.assert_allclose(found, np.degrees(least), atol=1e-5)
        assert np.degrees(np.abs(least - target)).max() > 0.1  # it bends


def dragged(commands: np.ndarray, gap_deg: np.ndarray) -> np.ndarray:
    """(N, 3) loose joints: each rests until one of its two stops reaches it."""
    loose, found = BIAS, []
    for driven in commands * SCALE + BIAS:
        loose = np.clip(loose, driven - gap_deg / 2, driven + gap_deg / 2)
        found.append(loose)
    return np.array(found)


def test_loose_joints_are_dragged_by_their_stops() -> None:
    """Stops are soft in MuJoCo and a loose joint has inertia: not to 1e-6."""
    gap = np.array([0.5, 0.0, 0.3])
    config = RobotConfig(backlash_deg=tuple(gap))
    commands = groups(3, 4, 25)
    apart = simulate(config, commands) - np.stack([dragged(c, gap) for c in commands])
    apart = np.abs(apart)
    assert np.median(apart) < 1e-4 and np.mean(apart < 1e-3) > 0.95
    assert apart.max() < 0.05
    stiff = np.abs(read_out(config, commands) - simulate(config, commands))
    assert np.median(stiff[..., [0, 2]]) > 0.1  # the play is there


def test_groups_do_not_depend_on_one_another() -> None:
    config = RobotConfig(backlash_deg=0.5)
    together = simulate(config, groups(5, 3, 6))
    np.testing.assert_array_equal(together[2:], simulate(config, groups(5, 3, 6)[2:]))


def test_a_shorter_hold_is_read_before_the_robot_has_settled() -> None:
    early = simulate(RobotConfig(), groups(6), hold_s=0.05)
    assert np.abs(early - read_out(RobotConfig(), groups(6))).max() > 0.1


@pytest.mark.parametrize("order", ORDERS)
def test_every_link_turns_about_its_axis_and_has_its_mass(order: str) -> None:
    model = load_model(RobotConfig(mechanism_order=order))
    np.testing.assert_array_equal(model.body_parentid, [0, 0, 1, 2])
    turned = np.eye(3)[["XYZ".index(letter) for letter in order]]
    np.testing.assert_array_equal(model.jnt_axis, turned)
    np.testing.assert_allclose(model.body("link3").mass, RobotConfig().load_kg)
    np.testing.assert_allclose(model.body_mass[1:3], 0.5)
    model = load_model(RobotConfig(mechanism_order=order, backlash_deg=1.0))
    assert model.nq == 6 and model.nu == 3


def test_mujoco_is_not_the_release_that_solves_wrongly() -> None:
    assert mujoco.__version__ != "4.0.0"


def test_the_closed_form_loads_neither_mujoco_nor_jax() -> None:
    code = (
        "import sys\nfrom benchmarks.paper.twin import RobotConfig, read_out\n"
        "read_out(RobotConfig(), [[1, 2, 3]])\n"
        "assert not {'mujoco', 'matplotlib', 'jax'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


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
        ({"backlash_deg": -0.1}, "backlash_deg must be one number or three, finite"),
        ({"backlash_deg": (1, 2)}, "backlash_deg must be one number or three"),
        ({"compliance_deg_per_nm": np.inf}, "finite and not negative, got inf"),
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
    with pytest.raises(ValueError, match=r"must have shape \(\.\.\., N, 3\), got \(3,"):
        simulate(config, np.zeros(3))
