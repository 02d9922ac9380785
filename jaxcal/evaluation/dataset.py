"""Candidate sets to evaluate on, and what was measured at them."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.candidates import JointRanges
from jaxcal.checks import Array, array_of, require_none

Mask = NDArray[np.bool_]


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
        u = array_of("candidates", self.candidates, "episodes", "M", "n")
        if 0 in u.shape:
            raise ValueError(f"candidates must have no axis of length 0, got {u.shape}")
        object.__setattr__(self, "candidates", u)
        if self.measured is not None:
            y = array_of("measured", self.measured, *u.shape[:2], "m")
            if 0 in y.shape:
                raise ValueError(f"measured must have no axis of length 0: {y.shape}")
            object.__setattr__(self, "measured", y)
        if self.available is not None:
            mask = array_of("available", self.available, *u.shape[:2])
            require_none(~np.isin(mask, (0, 1)), mask, "available must be 1 or 0")
            object.__setattr__(self, "available", mask == 1)
        if self.ranges is not None and len(self.ranges.low) != u.shape[2]:
            raise ValueError(
                f"ranges must hold {u.shape[2]} numbers, got {len(self.ranges.low)}"
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

    def facts(self) -> dict[str, Any]:
        """Name, sizes and origin, as reports and JSON documents give them."""
        return {
            "name": self.name,
            "episodes": self.num_episodes,
            "num_candidates": self.num_candidates,
            "num_inputs": self.num_inputs,
            "num_outputs": self.num_outputs,
            "seed": self.seed,
            "sha256": self.sha256,
        }

    def part(self, begin: int, end: int) -> Dataset:
        """Episodes ``begin`` to ``end``, the last one not included."""
        held = {name: getattr(self, name) for name in ("measured", "available")}
        cut = {
            name: array[begin:end] for name, array in held.items() if array is not None
        }
        return dataclasses.replace(self, candidates=self.candidates[begin:end], **cut)
