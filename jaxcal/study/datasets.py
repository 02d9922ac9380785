"""The paper's simulated Datasets 1, 2 and 3 (Table 3), each by seed.

==========  ========  ==  ===  ========================================================
name        episodes   M  dim  for
==========  ========  ==  ===  ========================================================
dataset1     200,000  50    3  training; read it in chunks
dataset2       1,000  50    3  evaluation
dataset3         100  50    6  independent evaluation, with measured outputs
==========  ========  ==  ===  ========================================================

Commands are uniform within ``RANGES`` and stored normalised to [0, 1], as in the paper.
The outputs of dataset3 are ``y = diag(scale) u + bias`` (Table 1) of the commands in
degrees, with white Gaussian noise of ``NOISE_STD_DEG`` on every output.

Every block of 1,000 episodes of every dataset has a random stream of its own, spawned
from the seed, the dataset's number and the block's. So no dataset shares candidates
with another, and asking for fewer episodes gives the first of them. Training draws from
JAX's generator, which is a different one altogether.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from jaxcal.candidates import JointRanges, uniform_candidates

__all__ = [
    "BIAS_DEG",
    "EPISODES",
    "NAMES",
    "NOISE_STD_DEG",
    "NUM_CANDIDATES",
    "RANGES",
    "SCALE",
    "Dataset",
    "chunks",
    "make_dataset",
]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

NAMES = ("dataset1", "dataset2", "dataset3")
NUM_CANDIDATES = 50
SCALE = np.array([0.43, 0.71, 0.87])  # pitch, yaw, roll; Table 1 lists roll before yaw
BIAS_DEG = np.array([3.1, -5.8, 2.41])
NOISE_STD_DEG = 0.1
RANGES = JointRanges([-20.0] * 3, [20.0] * 3, ("pitch", "yaw", "roll"))  # degrees

EPISODES = {"dataset1": 200_000, "dataset2": 1_000, "dataset3": 100}
_BLOCK = 1_000  # episodes that share a stream


@dataclasses.dataclass(frozen=True, eq=False)
class Dataset:
    """Candidate sets, and what was measured at them where that is known."""

    name: str
    candidates: Array  # (E, M, n) commands
    measured: Array | None = None  # (E, M, m) postures reached
    available: Mask | None = None  # (E, M) True where a candidate may be chosen
    ranges: JointRanges | None = None  # what [0, 1] stands for, where normalised
    seed: int | None = None  # of a generated dataset
    sha256: str | None = None  # of the file it was read from

    def __post_init__(self) -> None:
        if self.candidates.ndim != 3 or 0 in self.candidates.shape:
            raise ValueError(
                "candidates must have shape (episodes, M, n), none of them 0, got "
                f"{self.candidates.shape}"
            )
        if self.measured is not None and (
            self.measured.ndim != 3
            or self.measured.shape[:2] != self.candidates.shape[:2]
            or self.measured.shape[2] < 1
        ):
            raise ValueError(
                f"measured must have shape {(*self.candidates.shape[:2], 'm')}, got "
                f"{self.measured.shape}"
            )
        if self.available is not None and (
            self.available.shape != self.candidates.shape[:2]
        ):
            raise ValueError(
                f"available must have shape {self.candidates.shape[:2]}, got "
                f"{self.available.shape}"
            )

    @property
    def num_episodes(self) -> int:
        """E."""
        return self.candidates.shape[0]

    @property
    def num_candidates(self) -> int:
        """M."""
        return self.candidates.shape[1]

    @property
    def num_inputs(self) -> int:
        """n."""
        return self.candidates.shape[2]

    @property
    def num_outputs(self) -> int:
        """m: that of ``measured``, or n where nothing was measured."""
        return self.num_inputs if self.measured is None else self.measured.shape[2]

    def first(self, episodes: int) -> Dataset:
        """The first episodes only.

        Raises:
            ValueError: fewer than one, or more than there are.
        """
        if not 1 <= episodes <= self.num_episodes:
            raise ValueError(
                f"episodes must be in [1, {self.num_episodes}] for {self.name}, "
                f"got {episodes}"
            )
        cut = slice(episodes)
        return dataclasses.replace(
            self,
            candidates=self.candidates[cut],
            measured=None if self.measured is None else self.measured[cut],
            available=None if self.available is None else self.available[cut],
        )


def make_dataset(name: str, seed: int = 0, episodes: int | None = None) -> Dataset:
    """One of the paper's datasets, whole.

    The whole of dataset1 takes 240 MB; ``chunks`` gives it in pieces.

    Args:
        name: dataset1, dataset2 or dataset3.
        seed: of the streams.
        episodes: the first so many; all when not given.
    """
    blocks = list(chunks(name, seed, episodes))
    measured = [block.measured for block in blocks if block.measured is not None]
    return Dataset(
        name=name,
        candidates=np.concatenate([block.candidates for block in blocks]),
        measured=np.concatenate(measured) if measured else None,
        ranges=RANGES,
        seed=seed,
    )


def chunks(name: str, seed: int = 0, episodes: int | None = None) -> Iterator[Dataset]:
    """The same episodes as ``make_dataset``, at most 1,000 at a time.

    Args:
        name: dataset1, dataset2 or dataset3.
        seed: of the streams, 0 or greater.
        episodes: the first so many; all when not given.

    Raises:
        ValueError: naming the argument; raised before the first chunk is drawn.
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
    return _blocks(name, seed, total)


def _blocks(name: str, seed: int, total: int) -> Iterator[Dataset]:
    number = NAMES.index(name) + 1
    for block, begin in enumerate(range(0, total, _BLOCK)):
        count = min(_BLOCK, total - begin)
        stream = np.random.SeedSequence(seed, spawn_key=(number, block))
        draw, noise = (np.random.default_rng(child) for child in stream.spawn(2))
        candidates = uniform_candidates(draw, count, NUM_CANDIDATES, 3)
        measured = None
        if name == "dataset3":
            measured = RANGES.denormalise(candidates) * SCALE + BIAS_DEG
            measured += noise.normal(0.0, NOISE_STD_DEG, measured.shape)
        yield Dataset(name, candidates, measured, ranges=RANGES, seed=seed)
