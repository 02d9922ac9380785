"""Datasets 0 to 5 of the paper's Table 3 (docs/datasets.md), each by seed.

Commands are uniform within ``RANGES`` and stored normalised to [0, 1], as in the paper.
The outputs of dataset3 are ``y = diag(scale) u + bias`` (Table 1) of the commands in
degrees, with white Gaussian noise of ``NOISE_STD_DEG`` on every output; those of
dataset0 are what the robot of ``jaxcal.paper.twin`` reads after a second at
each posture, with the same noise. ``recordings`` reads what 4 and 5 are made from.

Every block of 1,000 episodes of every simulated dataset (every group of dataset0) has a
random stream of its own, spawned from the seed, the dataset's number and the block's.
So no dataset shares candidates with another, and asking for fewer episodes gives the
first of them. Training draws from JAX's generator, a different generator.
"""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from jaxcal.evaluation.dataset import Dataset
from jaxcal.paper.constants import (
    BIAS_DEG,
    BLOCK,
    DRAWN,
    EPISODES,
    NAMES,
    NOISE_STD_DEG,
    NUM_CANDIDATES,
    RANGES,
    RECORDED,
    SCALE,
)
from jaxcal.paper.datasets.recordings import recorded_dataset

if TYPE_CHECKING:
    from jaxcal.paper.twin import RobotConfig

__all__ = ["DRAWN", "chunks", "dataset0_robot", "drawn", "make_dataset"]

Progress = Callable[[str, int, int], None]


def make_dataset(
    name: str,
    seed: int = 0,
    episodes: int | None = None,
    *,
    recordings: pathlib.Path | str | None = None,
    progress: Progress | None = None,
) -> Dataset:
    """One of the paper's datasets, whole; the arguments are those of ``chunks``.

    The whole of dataset1 takes 240 MB; ``chunks`` gives it in pieces. The whole of
    dataset0 takes some seconds of simulation.
    """
    parts = list(chunks(name, seed, episodes, recordings=recordings, progress=progress))
    return _joined(parts)


def chunks(
    name: str,
    seed: int = 0,
    episodes: int | None = None,
    *,
    recordings: pathlib.Path | str | None = None,
    progress: Progress | None = None,
) -> Iterator[Dataset]:
    """One of the paper's datasets, at most 1,000 episodes at a time.

    Args:
        name: dataset0 to dataset5.
        seed: of the streams, 0 or greater; of the draws from the pool (dataset4).
        episodes: the first so many; all when not given.
        recordings: folder of dataset4.csv and dataset5.csv; the shipped one when not
            given.
        progress: told how much of dataset0 is simulated.

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
        return iter([recorded_dataset(name, seed, folder=recordings).part(0, total)])
    if name == "dataset0":
        return iter([_simulated(seed, total, progress)])
    begins = range(0, total, BLOCK)
    return (drawn(name, seed, begin, min(begin + BLOCK, total)) for begin in begins)


def _joined(parts: list[Dataset]) -> Dataset:
    measured = [part.measured for part in parts if part.measured is not None]
    return dataclasses.replace(
        parts[0],
        candidates=np.concatenate([part.candidates for part in parts]),
        measured=np.concatenate(measured) if measured else None,
    )


def drawn(name: str, seed: int, begin: int, end: int) -> Dataset:
    """Episodes of a drawn dataset, of any length: the paper's size is not a limit.

    Args:
        name: one of ``DRAWN``.
        seed: of the streams, 0 or greater.
        begin: the first episode, a multiple of ``BLOCK``.
        end: one after the last.

    Raises:
        ValueError: it is of another kind, which ends.
    """
    if name not in DRAWN:
        raise ValueError(
            f"a streamed dataset must be one of {', '.join(DRAWN)}, which are drawn "
            f"from a seed without end, got {name!r}"
        )
    parts = []
    for first in range(begin, end, BLOCK):
        draw, noise = _streams(name, seed, first // BLOCK)
        count = min(BLOCK, end - first)
        candidates = draw.random((count, NUM_CANDIDATES, 3))
        measured = None
        if name == "dataset3":
            measured = RANGES.denormalise(candidates) * SCALE + BIAS_DEG
            measured += noise.normal(0.0, NOISE_STD_DEG, measured.shape)
        parts.append(Dataset(name, candidates, measured, ranges=RANGES, seed=seed))
    return _joined(parts)


def _streams(
    name: str, seed: int, block: int
) -> tuple[np.random.Generator, np.random.Generator]:
    """Commands and noise."""
    key = (NAMES.index(name), block)
    draw, noise = np.random.SeedSequence(seed, spawn_key=key).spawn(2)
    return np.random.default_rng(draw), np.random.default_rng(noise)


def _simulated(seed: int, total: int, progress: Progress | None) -> Dataset:
    """Dataset0: groups of postures driven in MuJoCo, each with a stream of its own."""
    from jaxcal.paper.twin import simulate

    shape = (NUM_CANDIDATES, 3)
    streams = [_streams("dataset0", seed, group) for group in range(total)]
    unit = np.stack([draw.random(shape) for draw, _ in streams])
    noise = np.stack([rng.normal(0.0, NOISE_STD_DEG, shape) for _, rng in streams])
    read = simulate(dataset0_robot(), RANGES.denormalise(unit), progress=progress)
    return Dataset("dataset0", unit, read + noise, ranges=RANGES, seed=seed)


def dataset0_robot() -> RobotConfig:
    """The ideal robot of Table 1."""
    from jaxcal.paper.twin import RobotConfig

    return RobotConfig(tuple(SCALE), tuple(BIAS_DEG))
