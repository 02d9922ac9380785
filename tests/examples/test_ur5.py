"""The UR5 example: its claims hold on two sub-pools."""

from __future__ import annotations

import numpy as np
import pytest
import ur5


@pytest.mark.slow
def test_eight_chosen_poses_do_what_the_thesis_needed_a_thousand_for(monkeypatch):
    monkeypatch.setattr(ur5, "RULES", ("random", "I"))
    monkeypatch.setattr(ur5, "COUNTS", (8,))
    found = ur5.study(full=False)
    chosen, random = found["I", 8].mean(axis=0), found["random", 8].mean(axis=0)
    assert chosen[2] < 0.18 < random[2]
    assert (chosen < random).all()


def test_students_loss_takes_no_harm_from_one_outlier():
    means = ur5.outliers(pools=2)
    assert means["student"] < 0.16 < 0.3 < means["gaussian"]


def test_the_uncalibrated_arm_is_off_by_millimetres():
    angles, reached = ur5.load("ur5_random_20.csv")
    off = np.linalg.norm(ur5.arm().predict(angles) - reached, axis=1)
    assert off.mean() == pytest.approx(2.566, abs=0.005)  # the thesis' own figure
