"""Each example runs in a few seconds and its claim holds against the known truth."""

import csv
import importlib
import pathlib

import common
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import jaxcal

EXAMPLES = pathlib.Path(__file__).parents[2] / "examples"


def quick(name, folder):
    """What a quick run found, and the rows that it wrote."""
    found = common.main(importlib.import_module(name), ["--out", str(folder)])
    assert (folder / f"{name}.png").stat().st_size > 5_000
    with (folder / f"{name}.csv").open(newline="") as file:
        return found, list(csv.DictReader(file))


def rms(rows):
    return np.sqrt((rows**2).mean(axis=0))


def test_force_sensor_loads_beat_one_axis_at_a_time(tmp_path):
    found, rows = quick("force_sensor", tmp_path)
    assert [row["loads"] for row in rows] == list(found)
    for rule in ("D", "I"):
        assert (rms(found[rule]) < 0.6 * rms(found["one axis at a time"])).all()
        assert (rms(found[rule]) < 0.9 * rms(found["random, 50 N"])).all()


def test_force_sensor_loads_are_a_weight_on_a_lever():
    example = importlib.import_module("force_sensor")
    loads, rows = example.wrenches()
    assert loads.shape == (100, 6) and len(set(rows)) == 100
    assert (np.abs(loads) <= example.RATED * (1.0 + 1e-12)).all()
    # a force and its moment about the origin are perpendicular
    assert np.abs((loads[:, :3] * loads[:, 3:]).sum(axis=1)).max() < 1e-12


@pytest.mark.slow
def test_camera_views_beat_covering_the_image(tmp_path):
    found, rows = quick("camera", tmp_path)
    assert [row["views"] for row in rows] == list(found)
    for rule in ("random", "cover the image"):
        assert rms(found["I"])[3] < 0.9 * rms(found[rule])[3]
        assert rms(found["I"])[0] < rms(found[rule])[0]


@pytest.mark.slow
def test_camera_fit_is_the_joint_fit_of_all_poses():
    """Oracle: scipy's least squares over 6 + 6 x 10 unknowns and its own rotations."""
    example = importlib.import_module("camera")
    rng = np.random.default_rng(3)
    true = example.views(rng, 10, example.NOMINAL)
    rough = true + rng.normal(size=true.shape) * ([0.02] * 3 + [0.005] * 3)
    pixels = example.MODEL.predict(true) + rng.normal(0.0, 0.2, (10, 70))

    def residuals(unknowns):
        focal, centre, (k1, k2) = unknowns[:2], unknowns[2:4], unknowns[4:6]
        off = []
        for pose, seen in zip(unknowns[6:].reshape(10, 6), pixels, strict=True):
            at = Rotation.from_rotvec(pose[:3]).apply(example.CORNERS) + pose[3:]
            xy = at[:, :2] / at[:, 2:]
            square = (xy**2).sum(axis=1, keepdims=True)
            xy = xy * (1.0 + k1 * square + k2 * square**2)
            off.append((focal * xy + centre).ravel() - seen)
        return np.concatenate(off)

    start = np.concatenate([example.NOMINAL, rough.ravel()])
    joint = least_squares(residuals, start, x_scale="jac", xtol=1e-14, ftol=1e-14)
    fit = jaxcal.identify(
        rough, pixels, model=example.MODEL, noise=example.NOISE, loss="gaussian"
    )
    error = np.sqrt(np.diag(np.linalg.inv(joint.jac.T @ joint.jac))[:6]) * 0.2
    assert np.abs(fit.parameters - joint.x[:6]).max() < 1e-3 * error.max()
    np.testing.assert_allclose(fit.standard_errors, error, rtol=1e-3)


@pytest.mark.slow
def test_ten_chosen_views_find_hand_and_eye_better_than_forty_by_algebra(tmp_path):
    found, _ = quick("hand_eye", tmp_path)
    assert np.mean(found["chosen (I)", 10]) < 0.5  # 0.38 is the noise
    assert np.mean(found["chosen (I)", 10]) < np.mean(found["random", 10])
    assert np.mean(found["closed form, random", 20]) > 1.0


@pytest.mark.slow
def test_two_chosen_postures_see_a_change_of_a_quarter_of_a_millimetre(tmp_path):
    found, _ = quick("drift", tmp_path)
    assert found["2 chosen", 0.25] > 0.9
    assert found["2 chosen", 0.0] < 0.25


@pytest.mark.slow
def test_tcp_error_is_lower_with_i_on_every_arm(tmp_path):
    found, rows = quick("tcp", tmp_path)
    assert [row["poses"] for row in rows] == list(found)
    for rule in ("random", "expert", "spread", "D", "A"):
        assert (found["I"][:, 0] < found[rule][:, 0]).all()
    for standard, true in (rows.T for rows in found.values()):
        assert 0.7 < (true / standard).mean() < 1.3  # the errors stated are the errors


def test_triad_needs_no_better_than_the_textbook_but_four_will_do(tmp_path):
    found, rows = quick("triad", tmp_path)
    assert len(rows) == len(found)
    everywhere = 2
    textbook = rms(found["any", 6, "textbook"])[everywhere]
    assert rms(found["any", 6, "I"])[everywhere] == pytest.approx(textbook, rel=0.15)
    four = rms(found["any", 4, "I"])[everywhere]
    assert textbook < four < 1.5 * textbook
    example = importlib.import_module("triad")
    assert 0.95 < example.efficiency(180.0) <= 1.0
    # six positions: the bias is a mean of six readings of each axis
    assert rms(found["any", 6, "textbook"])[0] == pytest.approx(1 / 6**0.5, rel=0.2)


@pytest.mark.slow
def test_the_ankle_session_leaves_a_hundredth_of_the_error(tmp_path):
    found, rows = quick("ankle", tmp_path)
    assert len(rows) == 8
    assert found["after"]["rms"] < 0.01 * found["before"]["rms"]


def test_chosen_baths_beat_evenly_spaced_ones_at_every_temperature(tmp_path):
    found, _ = quick("own_function", tmp_path)
    assert (rms(found["selected"]) < rms(found["evenly spaced"])).all()


@pytest.mark.slow
def test_two_chosen_postures_find_the_backlash_better_than_two_in_order(tmp_path):
    found, _ = quick("backlash", tmp_path)
    assert rms(found["chosen"])[1] < 0.7 * rms(found["in order"])[1]
    assert rms(found["chosen"])[-1] < 0.04


@pytest.mark.slow
def test_a_policy_trained_on_its_own_postures_beats_greedy():
    found = importlib.import_module("own_policy").study(False, episodes=20_000)
    assert (found["own policy"] <= 1.0 + 1e-9).all()
    assert found["own policy"].mean() > found["greedy"].mean()


@pytest.mark.parametrize("name", common.NAMES)
def test_the_picture_of_the_page_is_drawn_from_its_table(name):
    (EXAMPLES / f"{name}.md").read_text()
    assert common.picture(name).axes


@pytest.mark.slow
def test_the_closed_loop_finds_a_peak_with_fewer_readings(tmp_path):
    found, _ = quick("magnetometry", tmp_path)
    late = {rule: np.median(np.abs(error[:, 29:])) for rule, error in found.items()}
    assert late["closed loop"] < 0.75 * late["random"]
    assert late["closed loop"] < 0.75 * late["beforehand"]


@pytest.mark.slow
def test_doses_for_scenarios_hold_where_the_nominal_is_wrong(tmp_path):
    found, _ = quick("scenarios", tmp_path)
    off = {rule: rms(error.T) for rule, error in found.items()}
    for rule in ("30 scenarios", "worst of 30"):  # wrong by a factor of four
        assert off[rule].max() < 0.9 * off["nominal"].max()


@pytest.mark.slow
def test_four_chosen_postures_weigh_a_tool_better_than_four_far_apart(tmp_path):
    found, _ = quick("wrench", tmp_path)
    for rule in ("wrist alone", "random", "far apart"):
        assert (rms(found["chosen (I)", 4]) < 0.95 * rms(found[rule, 4])).all()


@pytest.mark.slow
def test_five_chosen_trajectories_tell_more_than_five_at_random(tmp_path):
    found, _ = quick("trajectories", tmp_path)
    held = 2  # the upper arm's inertia
    chosen, random = (np.delete(rms(found[x]), held) for x in ("chosen", "random"))
    assert np.exp(np.log(chosen / random).mean()) < 0.9
    assert (chosen < 0.01).all()


def test_only_the_sum_of_rotor_and_upper_arm_moves_the_simulated_arm():
    example = importlib.import_module("trajectories")
    signal, moved = example.candidates()[17], 0.003  # kg m² from one to the other
    theta = np.zeros(7)
    theta[2] = np.log(1.0 - moved / example.DESIGNED[2])
    theta[3] = np.log(1.0 + moved / example.DESIGNED[3])
    angles = example.trajectory(signal, np.zeros(7))
    assert np.ptp(angles) > 0.3
    np.testing.assert_allclose(example.trajectory(signal, theta), angles, atol=1e-9)


@pytest.mark.slow
def test_a_policy_of_a_slot_is_no_worse_than_the_rule_it_begins_as(tmp_path):
    """After 12 updates; the largest gain alone, which pays no price, is far behind."""
    found, rows = quick("slot", tmp_path)
    names = ["gain", "state", "shares", "ahead", "policy 0"]
    assert [row["method"] for row in rows] == names
    gains = {name: found.results[name].values[:, 0] for name in names}
    for row in rows:
        assert float(row["nats"]) == pytest.approx(
            gains[row["method"]].mean(), abs=1e-3
        )
    for name, errors in (("state", -3.0), ("gain", 10.0)):
        less = gains["policy 0"] - gains[name]
        assert less.mean() > errors * less.std() / np.sqrt(len(less))
