"""Table 1 and Table 3 of the paper: the set values, the datasets, their sizes."""

from __future__ import annotations

import numpy as np

from jaxcal.candidates import JointRanges

AXES = ("pitch", "yaw", "roll")
SCALE = np.array([0.43, 0.71, 0.87])  # pitch, yaw, roll; Table 1 lists roll before yaw
BIAS_DEG = np.array([3.1, -5.8, 2.41])
NOISE_STD_DEG = 0.1  # ours; the paper gives none
RANGES = JointRanges([-20.0] * 3, [20.0] * 3)  # degrees, ours as well

EPISODES = {
    "dataset0": 200,
    "dataset1": 200_000,
    "dataset2": 1_000,
    "dataset3": 100,
    "dataset4": 100,
    "dataset5": 1,
}
NAMES = tuple(EPISODES)
DRAWN = ("dataset1", "dataset2", "dataset3")
RECORDED = ("dataset4", "dataset5")
NUM_CANDIDATES = 50
BLOCK = 1_000  # episodes of a drawn dataset that share a random stream
