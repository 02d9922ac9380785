"""Real data: what the pages claim, on the views and poses that were not used."""

import fr3
import numpy as np
import positioner
import pytest
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
