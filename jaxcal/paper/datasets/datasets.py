"""The paper's Datasets 0 to 5 (Table 3), each by seed.

==========  ========  ==  ===  ========================================================
name        episodes   M  dim  for
==========  ========  ==  ===  ========================================================
dataset0         200  50    6  identification, driven open loop in MuJoCo
dataset1     200,000  50    3  training; read it in chunks
dataset2       1,000  50    3  evaluation
dataset3         100  50    6  independent evaluation, with measured outputs
dataset4         100  50    6  recorded on the rig: 50-of-500 draws from a pool
dataset5           1  50    6  recorded on the rig, in a session of its own
==========  ========  ==  ===  ========================================================

Commands are uniform within ``RANGES`` and stored normalised to [0, 1], as in the paper.
The outputs of dataset3 are ``y = diag(scale) u + bias`` (Table 1) of the commands in
degrees, with white Gaussian noise of ``NOISE_STD_DEG`` on every output; those of
dataset0 are what the robot of ``jaxcal.paper.twin.robot_model`` reads after a second at each
posture, with the same noise. ``jaxcal.paper.datasets.recordings`` reads what dataset4 and
dataset5 are made from.

Every block of 1,000 episodes of every simulated dataset (every group of dataset0) has a
random stream of its own, spawned from the seed, the dataset's number and the block's.
So no dataset shares candidates with another, and asking for fewer episodes gives the
first of them. Training draws from JAX's generator, which is a different one altogether.

``python -m jaxcal.paper.datasets.datasets --out DIR`` writes them all, with a data card.
"""

from __future__ import annotations

import dataclasses
import pathlib
import sys
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from jaxcal.candidates import JointRanges, uniform_candidates
from jaxcal.evaluation.dataset import Dataset

if TYPE_CHECKING:
    from jaxcal.paper.twin.robot import RobotConfig

__all__ = [
    "BIAS_DEG",
    "BLOCK",
    "DRAWN",
    "EPISODES",
    "NAMES",
    "NOISE_STD_DEG",
    "NUM_CANDIDATES",
    "RANGES",
    "RECORDED",
    "SCALE",
    "chunks",
    "dataset0_robot",
    "drawn",
    "make_dataset",
]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Progress = Callable[[str, int, int], None]

NAMES = tuple(f"dataset{number}" for number in range(6))
DRAWN = ("dataset1", "dataset2", "dataset3")
RECORDED = ("dataset4", "dataset5")
NUM_CANDIDATES = 50
SCALE = np.array([0.43, 0.71, 0.87])  # pitch, yaw, roll; Table 1 lists roll before yaw
BIAS_DEG = np.array([3.1, -5.8, 2.41])
NOISE_STD_DEG = 0.1
RANGES = JointRanges([-20.0] * 3, [20.0] * 3, ("pitch", "yaw", "roll"))  # degrees

EPISODES = {
    "dataset0": 200,
    "dataset1": 200_000,
    "dataset2": 1_000,
    "dataset3": 100,
    "dataset4": 100,
    "dataset5": 1,
}
BLOCK = 1_000  # episodes that share a stream


def make_dataset(
    name: str,
    seed: int = 0,
    episodes: int | None = None,
    *,
    recordings: pathlib.Path | str | None = None,
    progress: Progress | None = None,
) -> Dataset:
    """One of the paper's datasets, whole.

    The whole of dataset1 takes 240 MB; ``chunks`` gives it in pieces. The whole of
    dataset0 takes some seconds of simulation.

    Args:
        name: dataset0 to dataset5.
        seed: of the streams; of the draws from the pool (dataset4); none (dataset5).
        episodes: the first so many; all when not given.
        recordings: folder of dataset4.csv and dataset5.csv; the shipped one when not
            given.
        progress: told how far a simulation is.
    """
    blocks = list(
        chunks(name, seed, episodes, recordings=recordings, progress=progress)
    )
    measured = [block.measured for block in blocks if block.measured is not None]
    return dataclasses.replace(
        blocks[0],
        candidates=np.concatenate([block.candidates for block in blocks]),
        measured=np.concatenate(measured) if measured else None,
    )


def chunks(
    name: str,
    seed: int = 0,
    episodes: int | None = None,
    *,
    recordings: pathlib.Path | str | None = None,
    progress: Progress | None = None,
) -> Iterator[Dataset]:
    """The same episodes as ``make_dataset``, at most 1,000 at a time.

    Args:
        name: dataset0 to dataset5.
        seed: of the streams, 0 or greater.
        episodes: the first so many; all when not given.
        recordings: folder of recordings; the shipped one when not given.
        progress: told how far a simulation is.

    Raises:
        OSError: a recording cannot be read.
        ValueError: naming the argument, or the line of a recording; an argument is
            refused before the first chunk is drawn.
    """
    if name not in NAMES:
        raise ValueError(f"name must be one of {', '.join(NAMES)}, got {name!r}")
    if seed < 0:
        raise ValueError(f"seed must not be negative, got {seed}")
    total = EPISODES[name] if episodes is None else episodes
    if not 1 <= total <= EPISODES[name]:
        raise ValueError(
            f"episodes must be in [1, {EPISODES[name]}] for {name}, got {total}"
        )
    if name in RECORDED:
        from jaxcal.paper.datasets.recordings import recorded_dataset

        whole = recorded_dataset(
            name, EPISODES[name], NUM_CANDIDATES, seed, folder=recordings
        )
        return iter([whole.first(total)])
    if name == "dataset0":
        return _groups(seed, total, progress)
    return _blocks(name, seed, total)


def _blocks(name: str, seed: int, total: int) -> Iterator[Dataset]:
    for begin in range(0, total, BLOCK):
        yield drawn(name, seed, begin, min(begin + BLOCK, total))


def drawn(name: str, seed: int, begin: int, end: int) -> Dataset:
    """Episodes of a drawn dataset, which goes on beyond its size in the paper.

    Args:
        name: one of ``DRAWN``.
        seed: of the streams, 0 or greater.
        begin: the first episode, a multiple of ``BLOCK``.
        end: one after the last.
    """
    parts = []
    for first in range(begin, end, BLOCK):
        draw, noise = _streams(name, seed, first // BLOCK)
        count = min(BLOCK, end - first)
        candidates = uniform_candidates(draw, count, NUM_CANDIDATES, 3)
        measured = None
        if name == "dataset3":
            measured = RANGES.denormalise(candidates) * SCALE + BIAS_DEG
            measured += noise.normal(0.0, NOISE_STD_DEG, measured.shape)
        parts.append((candidates, measured))
    outputs = [measured for _, measured in parts if measured is not None]
    return Dataset(
        name,
        np.concatenate([candidates for candidates, _ in parts]),
        np.concatenate(outputs) if outputs else None,
        ranges=RANGES,
        seed=seed,
    )


def _streams(
    name: str, seed: int, block: int
) -> tuple[np.random.Generator, np.random.Generator]:
    """Commands and noise."""
    key = (NAMES.index(name), block)
    draw, noise = np.random.SeedSequence(seed, spawn_key=key).spawn(2)
    return np.random.default_rng(draw), np.random.default_rng(noise)


def _groups(seed: int, total: int, progress: Progress | None) -> Iterator[Dataset]:
    """Dataset0: groups of postures driven in MuJoCo, each with a stream of its own."""
    from jaxcal.paper.twin.robot_model import simulate

    candidates, noises = [], []
    for group in range(total):
        draw, noise = _streams("dataset0", seed, group)
        candidates.append(uniform_candidates(draw, 1, NUM_CANDIDATES, 3)[0])
        noises.append(noise.normal(0.0, NOISE_STD_DEG, candidates[-1].shape))
    unit = np.stack(candidates)
    read = simulate(dataset0_robot(), RANGES.denormalise(unit), progress=progress)
    yield Dataset("dataset0", unit, read + noises, ranges=RANGES, seed=seed)


def dataset0_robot() -> RobotConfig:
    """The ideal robot of Table 1."""
    from jaxcal.paper.twin.robot import RobotConfig

    return RobotConfig(
        scale=(SCALE[0], SCALE[1], SCALE[2]),
        bias_deg=(BIAS_DEG[0], BIAS_DEG[1], BIAS_DEG[2]),
    )


if __name__ == "__main__":
    from jaxcal.paper.datasets.dataset_command import main

    sys.exit(main())
