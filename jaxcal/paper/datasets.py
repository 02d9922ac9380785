"""Datasets 1 to 5 of the paper's Table 3 (docs/datasets.md), each by seed.

Commands are uniform within ``RANGES`` and stored normalised to [0, 1], as in the paper.
The outputs of dataset3 are ``y = diag(scale) u + bias`` (Table 1) of the commands in
degrees, with white Gaussian noise of ``NOISE_STD_DEG`` on every output. ``recordings``
reads what 4 and 5 are made from.

Every block of 1,000 episodes of every simulated dataset has a random stream of its own,
spawned from the seed, the dataset's number and the block's.
So no dataset shares candidates with another, and asking for fewer episodes gives the
first of them. Training draws from JAX's generator, a different generator.
"""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Iterator

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
from jaxcal.paper.recordings import recorded_dataset

__all__ = ["BIAS_DEG", "SCALE", "chunks", "drawn", "make_dataset", "streams"]


def make_dataset(
    name: str,
    seed: int = 0,
    episodes: int | None = None,
    *,
    recordings: pathlib.Path | str | None = None,
) -> Dataset:
    """One of the paper's datasets, whole; the arguments are those of ``chunks``.

    The whole of dataset1 takes 240 MB; ``chunks`` gives it in pieces.
    """
    return _joined(list(chunks(name, seed, episodes, recordings=recordings)))


def chunks(
    name: str,
    seed: int = 0,
    episodes: int | None = None,
    *,
    recordings: pathlib.Path | str | None = None,
) -> Iterator[Dataset]:
    """One of the paper's datasets, at most 1,000 episodes at a time.

    Args:
        name: dataset1 to dataset5.
        seed: of the streams, 0 or greater; of the draws from the pool (dataset4).
        episodes: the first so many; all when not given.
        recordings: folder of dataset4.csv and dataset5.csv; the shipped one when not
            given.

    Raises:
        OSError: a recording cannot be read.
        ValueError: naming the argument, or the line of a recording; an argument is
            refused before the first chunk is drawn.
    """
    if name == "dataset0":
        raise ValueError(
            "dataset0 is simulated in MuJoCo. Make dataset0.npz with python -m "
            "benchmarks.paper.datasets dataset0 --out DIR, in the repository"
        )
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
            f"a streamed dataset must be one of {', '.join(DRAWN)} (drawn from a seed "
            f"without end), got {name!r}"
        )
    parts = []
    for first in range(begin, end, BLOCK):
        draw, noise = streams(name, seed, first // BLOCK)
        count = min(BLOCK, end - first)
        candidates = draw.random((count, NUM_CANDIDATES, 3))
        measured = None
        if name == "dataset3":
            measured = RANGES.denormalise(candidates) * SCALE + BIAS_DEG
            measured += noise.normal(0.0, NOISE_STD_DEG, measured.shape)
        parts.append(Dataset(name, candidates, measured, ranges=RANGES, seed=seed))
    return _joined(parts)


def streams(
    name: str, seed: int, block: int
) -> tuple[np.random.Generator, np.random.Generator]:
    """Random streams of the commands and of the noise in one block of a dataset."""
    key = (NAMES.index(name), block)
    draw, noise = np.random.SeedSequence(seed, spawn_key=key).spawn(2)
    return np.random.default_rng(draw), np.random.default_rng(noise)
