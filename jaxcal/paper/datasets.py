"""Datasets 1 to 3 of the paper's Table 3 (docs/datasets.md), each by seed.

Commands are uniform within ``RANGES`` and stored normalised to [0, 1], as in the paper.
Every block of 1,000 episodes has a random stream of its own, spawned from the seed, the
dataset's number and the block's: no dataset shares candidates with another, and fewer
episodes are the first of them.

Datasets 0, 4 and 5, simulated and recorded, are made in the repository:
``python -m benchmarks.paper.datasets``.
"""

from __future__ import annotations

import numpy as np

from jaxcal.candidates import JointRanges
from jaxcal.evaluation.dataset import Dataset

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
MADE = ("dataset0", "dataset4", "dataset5")  # in the repository: the others are drawn
NUM_CANDIDATES = 50
BLOCK = 1_000  # episodes of a drawn dataset that share a random stream


def make_dataset(name: str, seed: int = 0, episodes: int | None = None) -> Dataset:
    """One of the paper's datasets (the whole of dataset1: 240 MB).

    Args:
        name: dataset1, dataset2 or dataset3; others are refused, as are the numbers
            below.
        seed: of the streams, 0 or greater.
        episodes: the first so many; all when not given.
    """
    total = checked_size(name, seed, episodes)
    if name in MADE:
        raise ValueError(
            f"{name} is simulated or recorded. Make {name}.npz with python -m "
            f"benchmarks.paper.datasets {name} --out DIR, in the repository"
        )
    pairs = [streams(name, seed, block) for block in range(-(-total // BLOCK))]
    blocks = [
        draw.random((min(BLOCK, total - number * BLOCK), NUM_CANDIDATES, 3))
        for number, (draw, _) in enumerate(pairs)
    ]
    candidates, measured = np.concatenate(blocks), None
    if name == "dataset3":  # one block
        measured = RANGES.denormalise(candidates) * SCALE + BIAS_DEG
        measured += pairs[0][1].normal(0.0, NOISE_STD_DEG, measured.shape)
    return Dataset(name, candidates, measured, ranges=RANGES, seed=seed)


def checked_size(name: str, seed: int, episodes: int | None) -> int:
    """How many episodes of a dataset are asked for, at most those that it has."""
    if name not in NAMES:
        raise ValueError(f"name must be one of {', '.join(NAMES)}, got {name!r}")
    if seed < 0:
        raise ValueError(f"seed must not be negative, got {seed}")
    total = EPISODES[name] if episodes is None else episodes
    if not 1 <= total <= EPISODES[name]:
        raise ValueError(
            f"episodes must be in [1, {EPISODES[name]}] for {name}, got {total}"
        )
    return total


def streams(
    name: str, seed: int, block: int
) -> tuple[np.random.Generator, np.random.Generator]:
    """Random streams of the commands and of the noise in one block of a dataset."""
    key = (NAMES.index(name), block)
    draw, noise = np.random.SeedSequence(seed, spawn_key=key).spawn(2)
    return np.random.default_rng(draw), np.random.default_rng(noise)
