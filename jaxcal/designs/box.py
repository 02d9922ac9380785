"""Where commands may be: within limits, and where ``allowed`` says."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import Array, array_of, in_words
from jaxcal.deadline import Deadline
from jaxcal.models.model import Model
from jaxcal.tables import limits_of_frame

Allowed = Callable[[Array], Any]

_DRAWS = 200  # batches of points, until enough are allowed


@dataclasses.dataclass(frozen=True, eq=False)
class Box:
    """Limits (n, 2), within which ``allowed`` may refuse commands one by one."""

    limits: Array
    allowed: Any  # an Allowed; one that has ``onto`` moves commands to a surface

    @property
    def low(self) -> Array:
        """(n,)."""
        return self.limits[:, 0]

    @functools.cached_property
    def span(self) -> Array:
        """(n,)."""
        return np.ptp(self.limits, axis=1)

    @property
    def surface(self) -> bool:
        """Whether commands lie on a surface, as of an arm that touches something."""
        return hasattr(self.allowed, "onto")

    def within(self, commands: Array) -> Array:
        return commands.clip(self.limits[:, 0], self.limits[:, 1])

    def permitted(self, commands: Array) -> NDArray[np.bool_]:
        """(N,) whether commands (N, n) are allowed."""
        if self.allowed is None:
            return np.ones(len(commands), dtype=np.bool_)
        permitted = [bool(self.allowed(row.copy())) for row in commands]
        return np.array(permitted, dtype=np.bool_)

    def moved(self, commands: Array) -> Array:
        """(L, n) commands that are allowed; an arm's are moved to where it measures."""
        if not self.surface:
            return commands[self.permitted(commands)]
        moved, there = self.allowed.onto(commands)
        return np.asarray(moved[there])

    def drawn(self, count: int, seed: int) -> Array:
        """(count, n) allowed points that fill the limits evenly, corners among them;
        where few are allowed, points next to them too."""
        n, rng = len(self.limits), np.random.default_rng(seed)
        # The sequence of Roberts (2018): shares of the root of x^(n + 1) = x + 1.
        root = 2.0
        for _ in range(60):
            root = (1.0 + root) ** (1.0 / (n + 1.0))
        shares, shift = root ** -np.arange(1.0, n + 1.0), rng.random(n)

        def even(first: int) -> Array:
            return (shift + np.arange(first, first + count)[:, None] * shares) % 1.0

        drawn, unit = np.zeros((0, n)), even(0)
        if 1 << n <= count // 2:
            corners = np.array(np.meshgrid(*[[0.0, 1.0]] * n)).reshape(n, -1).T
            unit = np.concatenate([corners, unit])
        for batch in range(_DRAWS):
            points = self.low + unit * self.span
            drawn = np.concatenate([drawn, self.moved(points)])
            if len(drawn) >= count:
                return drawn[:count]
            unit = even((batch + 1) * count)
            if len(drawn) and batch % 2:
                near = drawn[rng.integers(len(drawn), size=count)] - self.low
                near = near / self.span + rng.normal(0.0, 0.05, (count, n))
                unit = near.clip(0.0, 1.0)
        if not len(drawn):
            raise ValueError(
                f"allowed is False at all {_DRAWS * count} points tried within the "
                "limits"
            )
        return drawn


def box_of(limits: ArrayLike, allowed: Allowed | None, names: Sequence[str]) -> Box:
    box = array_of("limits", limits_of_frame(limits, names), "n", 2)
    bad = box[~(box[:, 0] < box[:, 1])]
    if not len(box) or len(bad):
        got = in_words(bad[0]) if len(bad) else "none"
        raise ValueError(f"limits must be (n, 2), lower below upper, got {got}")
    if not (allowed is None or callable(allowed)):
        raise ValueError(f"allowed must be a function of one command, got {allowed!r}")
    return Box(box, allowed)


def affordable(
    model: Model, box: Box, deadline: Deadline, least: int, most: int
) -> int:
    """Points at which a model may be asked for derivatives in an eighth of the time:
    only a function's differences cost what it costs."""
    if not model.fitting.resolution:
        return most
    begun, points = time.perf_counter(), box.limits.mean(axis=1)[None].repeat(2, axis=0)
    points[1] += 0.1 * box.span
    model.jacobian(points, None)
    point_s = 0.5 * (time.perf_counter() - begun)
    return int(np.clip(0.125 * deadline.remaining_s / point_s, least, most))


def descended(
    down: Callable[[Array], tuple[float, Array]],
    x: Array,
    low: float,
    high: float,
    iterations: int,
    deadline: Deadline,
) -> Array:
    """The lowest point on the way down from x between low and high.

    Spectral projected gradients (Birgin, Martinez and Raydan, 2000). Unlike L-BFGS of
    scipy it calls no BLAS, whose threads wait for each other.
    """
    value, slope = down(x)
    best, least, history = x, value, [value]
    length = 0.1 / max(float(np.abs(slope).max()), 1e-300)
    for _ in range(iterations):
        step = (x - length * slope).clip(low, high) - x
        gain = float(slope @ step)
        if deadline.passed or gain > -1e-14 * max(1.0, abs(value)):
            break
        share = 1.0
        for _ in range(30):
            trial = x + share * step
            new_value, new_slope = down(trial)
            if new_value <= max(history) + 1e-4 * share * gain:
                break
            share *= 0.3
        else:
            break
        moved, turned = trial - x, new_slope - slope
        bent, square = float(moved @ turned), float(moved @ moved)
        length = min(max(square / bent, 1e-10), 1e10) if bent > 0.0 else 10.0 * length
        x, value, slope = trial, new_value, new_slope
        history = [*history[-6:], value]
        if value < least:
            best, least = x, value
    return best
