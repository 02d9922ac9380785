"""How much a report computes, and from what."""

from __future__ import annotations

import dataclasses
import pathlib

import numpy as np

__all__ = ["STUDIES", "Settings"]

STUDIES = pathlib.Path(__file__).resolve().parents[3] / "studies"
"""Where the repository keeps training runs"""


@dataclasses.dataclass(frozen=True)
class Settings:
    """How much to compute; everything random depends on ``seed``."""

    seed: int = 0
    quick: bool = False
    data: pathlib.Path | None = None  # real recordings in place of Datasets 4 and 5
    studies: pathlib.Path = STUDIES  # kept training runs

    @property
    def recorded(self) -> str:
        """What Datasets 4 and 5 are, for titles."""
        return "rig's simulator" if self.data is None else "rig recordings"

    @property
    def about_recordings(self) -> str:
        """Where Datasets 4 and 5 come from, in a sentence."""
        if self.data is not None:
            return f"Datasets 4 and 5: recordings given as --data {self.data}."
        return (
            "Datasets 4 and 5: shipped recordings, made by the rig's own code against "
            "its simulator (play, noise, a heading that drifts), not on a device."
        )

    @property
    def command(self) -> str:
        """What makes the same report again."""
        words = ["python -m jaxcal.paper"]
        words += [f"--seed {self.seed}"] if self.seed else []
        words += ["--quick"] if self.quick else []
        words += [f"--data {self.data}"] if self.data is not None else []
        return " ".join(words)

    @property
    def episodes(self) -> int:
        """Of dataset2."""
        return 200 if self.quick else 1_000

    @property
    def groups(self) -> int:
        """Of dataset0."""
        return 40 if self.quick else 200

    @property
    def random_draws(self) -> int:
        """Random selections per episode."""
        return 30 if self.quick else 100

    @property
    def resamples(self) -> int:
        """Of a bootstrap."""
        return 400 if self.quick else 2_000

    @property
    def repeats(self) -> int:
        """Simulated devices, or histories of one, in the accuracy studies."""
        return 100 if self.quick else 500

    def rng(self, *stream: int) -> np.random.Generator:
        """A stream of its own for each use."""
        return np.random.default_rng(
            np.random.SeedSequence(self.seed, spawn_key=stream)
        )
