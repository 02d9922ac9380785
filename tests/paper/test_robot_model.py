"""The robot in MuJoCo against its closed form; they share nothing but the config."""

from __future__ import annotations

import subprocess
import sys

import jax
import mujoco
import numpy as np
import pytest

from jaxcal.paper.twin.robot import ORDERS, RobotConfig, joint_angles, measure, read_out
from jaxcal.paper.twin.robot_model import load_model, simulate


def groups(seed: int = 0, count: int = 2, length: int = 15) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-20.0, 20.0, (count, length, 3))


@pytest.mark.parametrize("order", ORDERS)
def test_the_ideal_robot_agrees_with_the_closed_form(order: str) -> None:
    config = RobotConfig(mechanism_order=order, read_out_order=order)
    apart = simulate(config, groups()) - read_out(config, groups())
    assert np.abs(apart).max() < 1e-6  # degrees; 3e-13 was measured


def test_any_read_out_and_mounting_agree() -> None:
    config = RobotConfig(
        mechanism_order="YXZ", read_out_order="ZXY", mounting_deg=(3.0, -2.0, 40.0)
    )
    apart = simulate(config, groups(1)) - read_out(config, groups(1))
    assert np.abs(apart).max() < 1e-6


@pytest.mark.parametrize("order", ["YXZ", "ZYX"])
def test_joints_that_bend_under_the_load_agree(order: str) -> None:
    config = RobotConfig(
        mechanism_order=order,
        read_out_order="YZX",
        mounting_deg=(3.0, -2.0, 4.0),
        compliance_deg_per_nm=(0.5, 0.9, 0.7),
        load_kg=2.0,
    )
    apart = simulate(config, groups(2)) - read_out(config, groups(2))
    assert np.abs(apart).max() < 1e-6
    stiff = RobotConfig(mechanism_order=order)
    bend = joint_angles(config, groups(2)) - joint_angles(stiff, groups(2))
    assert np.abs(bend).max() > 0.3  # there is something to agree on


def test_play_agrees_where_inertia_does_not_move_a_loose_joint() -> None:
    """Stops are soft in MuJoCo and a loose joint has inertia: not to 1e-6."""
    config = RobotConfig(backlash_deg=0.5)
    commands = groups(3, 4, 25)
    apart = np.abs(
        simulate(config, commands) - measure(config, commands, jax.random.key(0))
    )
    assert np.median(apart) < 1e-4
    assert np.mean(apart < 1e-3) > 0.95
    assert apart.max() < 0.05
    stiff = np.abs(read_out(config, commands) - simulate(config, commands))
    assert np.median(stiff) > 0.1  # the play is there


def test_one_axis_alone_agrees_in_its_play() -> None:
    config = RobotConfig(backlash_deg=(0.0, 0.5, 0.0))
    commands = np.zeros((1, 20, 3))
    commands[0, :, 1] = np.random.default_rng(4).uniform(-20, 20, 20)
    apart = simulate(config, commands) - measure(config, commands, jax.random.key(0))
    assert np.abs(apart).max() < 1e-4


def test_groups_do_not_depend_on_one_another() -> None:
    config = RobotConfig(backlash_deg=0.5)
    together = simulate(config, groups(5, 3, 6))
    alone = simulate(config, groups(5, 3, 6)[2])
    np.testing.assert_array_equal(together[2], alone)


def test_a_shorter_hold_is_read_before_the_robot_has_settled() -> None:
    config = RobotConfig()
    early = simulate(config, groups(6), hold_s=0.05)
    assert np.abs(early - read_out(config, groups(6))).max() > 0.1


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


def test_bad_requests_are_refused() -> None:
    with pytest.raises(
        ValueError, match=r"must have shape \(\.\.\., N, 3\), got \(3,\)"
    ):
        simulate(RobotConfig(), np.zeros(3))
    with pytest.raises(ValueError, match="a step must be above 0 s"):
        simulate(RobotConfig(), groups(), timestep_s=2.0)


def test_the_closed_form_loads_neither_mujoco_nor_matplotlib() -> None:
    code = (
        "import sys\nfrom jaxcal.paper.twin import RobotConfig, read_out\n"
        "assert not {'mujoco', 'matplotlib'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
