"""``Deadline``: when a search stops, one object from the argument to the kernel."""

from __future__ import annotations

import math
import time


class Deadline:
    """The time at which a search stops: ``limit_s`` from when it is made, infinite
    where the search ends by itself."""

    def __init__(self, limit_s: float = math.inf) -> None:
        self._begun = time.perf_counter()
        self.limit_s = limit_s

    @property
    def elapsed_s(self) -> float:
        """Seconds since it was made."""
        return time.perf_counter() - self._begun

    @property
    def remaining_s(self) -> float:
        """Seconds left, at least 0: what a compiled loop takes."""
        return max(self.limit_s - self.elapsed_s, 0.0)

    @property
    def passed(self) -> bool:
        """Whether no time is left."""
        return self.remaining_s == 0.0

    def part(self, share: float) -> Deadline:
        """A deadline after ``share`` of the time left, for one stage of a search."""
        return Deadline(share * self.remaining_s)


NEVER = Deadline()
