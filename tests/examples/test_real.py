"""Real data: what the pages claim, on the views and poses that were not used."""

import dataclasses

import fr3
import numpy as np
import positioner
import pytest
import real_camera
from scipy.spatial.transform import Rotation

from .test_examples import EXAMPLES, quick


@pytest.mark.slow
def test_a_camera_on_an_arm_is_found_with_the_arm():
    every = np.arange(114)
    chosen = fr3.choose(20)
    rest = np.setdiff1d(every, chosen)
    alone, both = (fr3.errors(fr3.fitted(chosen, whole), rest) for whole in (0, 1))
    assert both[0] < 1.0 < 5.0 < alone[0]
    assert both[1] < 0.25 < alone[1]


def test_views_are_read_as_poses_of_the_board_in_the_camera():
    rows = np.genfromtxt(EXAMPLES / "fr3" / "views.csv", delimiter=",", names=True)
    camera = Rotation.from_quat([rows[f"cam_q{axis}"][3] for axis in "xyzw"])
    view = fr3.load()[3]
    board = Rotation.from_rotvec(view[10:], degrees=True)
    place = [rows[f"cam_{axis}_m"][3] for axis in "xyz"]
    np.testing.assert_allclose((camera * board).magnitude(), 0.0, atol=1e-7)
    np.testing.assert_allclose(camera.apply(view[7:10]) + place, 0.0, atol=1e-12)


@pytest.mark.slow
def test_a_positioner_is_predicted_where_it_was_not_measured(tmp_path):
    found, rows = quick("positioner", tmp_path)
    assert [row["rule"] for row in rows][:2] == ["all, nominal table", "all, fitted"]
    assert found["all, fitted", 205][0] < found["all, nominal table", 205][0]
    for k in positioner.COUNTS:
        assert found["chosen (I)", k][0] < 0.5  # theirs, of those fitted: 1.745 mm


def test_a_board_is_seen_as_by_rotation_and_the_published_terms():
    rng = np.random.default_rng(0)
    places = np.column_stack([rng.uniform(0.0, 0.3, (12, 2)), np.zeros(12)])
    theta = [800.0, 810.0, 640.0, 350.0, -0.3, 0.1, 2e-3, -3e-3]
    pose, seen = np.array([0.3, -0.5, 0.2, -0.1, 0.05, 0.7]), np.arange(12) % 3 > 0
    x, y, z = (Rotation.from_rotvec(pose[:3]).apply(places) + pose[3:]).T
    a, b, r = x / z, y / z, np.hypot(x / z, y / z) ** 2
    radial = 1.0 - 0.3 * r + 0.1 * r**2
    wanted = np.column_stack(
        [
            800.0 * (a * radial + 2 * 2e-3 * a * b - 3e-3 * (r + 2 * a**2)) + 640.0,
            810.0 * (b * radial + 2e-3 * (r + 2 * b**2) - 2 * 3e-3 * a * b) + 350.0,
        ]
    )
    found = real_camera.project(np.append(pose, seen), np.array(theta), places)
    wanted = np.where(seen[:, None], wanted, 0.0).ravel()
    np.testing.assert_allclose(found, wanted, rtol=1e-5)  # JAX in single precision


@pytest.mark.slow
@pytest.mark.parametrize("name", real_camera.CAMERAS)
def test_fifteen_chosen_views_leave_less_error_than_random_ones(name):
    views = real_camera.load(name)
    best = views.distances(views.fit(np.arange(len(views.seen))).parameters)

    def errors(rule, seed=0):
        """In the other views, and beyond that of the camera of all views."""
        chosen = real_camera.choose(views, rule, seed)
        off = views.others(views.distances(views.fit(chosen).parameters), chosen)
        return np.array([off, off - views.others(best, chosen)])

    by_random = np.array([errors("random", seed) for seed in range(60)])
    left, by_i = errors("chosen (error left)"), errors("chosen (I)")
    worse = (by_random > left).mean(axis=0)
    assert worse[0] >= 0.9
    assert worse[1] >= 0.35  # the camera is as good as by random views
    assert (by_random > by_i).mean(axis=0)[1] >= 0.7
    if name == "cam0":
        assert max(left[0], by_i[0]) < 0.237  # pixels, caliscope's rule


@pytest.mark.parametrize("stds", [(0.5, 0.5), (0.2, 0.8)])
def test_a_view_has_its_own_scatter(stds):
    rng = np.random.default_rng(0)
    views = real_camera.load("cam1")
    camera = views.model.nominal
    truth = np.where(np.arange(len(views.seen)) % 2, *stds)
    there = views.model.predict(views.commands, camera)
    noise = rng.normal(size=there.shape) * truth[:, None]
    seen = np.repeat(views.seen, 2, axis=1)
    noisy = dataclasses.replace(views, pixels=(there + noise) * seen)
    scatter = noisy.scattered(camera)
    even, odd = (np.median(scatter[at::2]) for at in (0, 1))
    if stds[0] == stds[1]:
        np.testing.assert_allclose([even, odd], 0.5, rtol=0.07)
    else:  # pooled with the usual one
        assert sorted([even, odd]) == pytest.approx(stds, rel=0.5)
