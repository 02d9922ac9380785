"""The optimum of a small task, and its decider, by dynamic programming.

Where theta determines the outcomes, a belief is the prior restricted to the set of
values that all outcomes allow. The sets that can be reached are few, and with the
place, the time left in ticks and the uses left they are the states of a finite problem,
solved backwards in time. No decider gains more than its value.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from numpy.typing import NDArray
from scipy import special

from jaxcal.adaptive.grid import GridBelief, GridTask
from jaxcal.adaptive.session import Options, Session
from jaxcal.checks import seconds as checked_seconds

__all__ = ["Optimal", "Optimum", "solve"]

Array = NDArray[np.float64]

_MOST_STATES = 2**28


@struct.dataclass
class Optimal:
    """The decider of the optimum: the best measurement of every state, in a table."""

    chosen: jax.Array  # (T + 1, E + 1, P, B) int16
    codes: jax.Array  # (S,) uint32, random
    sums: jax.Array  # (B,) uint32, ascending: the codes of a belief's values, summed
    belief: jax.Array  # (B,) int32 the belief of each sum
    tick: Any  # seconds

    def __call__(
        self,
        task: GridTask,
        belief: GridBelief,
        session: Session,
        options: Options,
        key: jax.Array,
    ) -> jax.Array:
        code = jnp.where(belief.weights > 0.0, self.codes, 0).sum(dtype=jnp.uint32)
        at = jnp.minimum(jnp.searchsorted(self.sums, code), len(self.sums) - 1)
        ticks = jnp.ceil(session.seconds / self.tick - 1e-3).astype(jnp.int32)
        ticks = jnp.clip(ticks, 0, len(self.chosen) - 1)
        uses = jnp.clip(session.uses, 0, self.chosen.shape[1] - 1)
        best = self.chosen[ticks, uses, session.place, self.belief[at]]
        return best.astype(jnp.int32)


@dataclasses.dataclass(frozen=True)
class Optimum:
    """The largest expected information that any decider can gain."""

    values: NDArray[np.float32]  # (ticks + 1, uses + 1) nats at the start
    tick: float  # seconds
    task: GridTask
    decider: Optimal

    def value(self, seconds: float, uses: int) -> float:
        """Nats of a session with this budget."""
        ticks = int(np.ceil(seconds / self.tick - 1e-6))
        return float(self.values[ticks, uses])

    @property
    def mean(self) -> float:
        """Nats of the task's sessions: over its budgets, time uniform."""
        low, high = np.asarray(self.task.seconds, np.float64)
        edges = np.arange(len(self.values)) * self.tick  # tick k: (k - 1, k] seconds
        upper, lower = np.minimum(edges[1:], high), np.maximum(edges[:-1], low)
        share = np.maximum(upper - lower, 0.0)
        if high <= low:
            return float(np.mean([self.value(low, e) for e in self._uses]))
        return float(
            np.mean([share @ self.values[1:, e] for e in self._uses]) / share.sum()
        )

    @property
    def _uses(self) -> list[int]:
        return np.asarray(self.task.num_uses).tolist()


def solve(task: GridTask, tick: float) -> Optimum:
    """The optimum of a task whose outcomes are certain once theta is known.

    Args:
        task: every likelihood 0 or 1, a finite budget of time.
        tick: seconds of which every cost is a whole multiple.

    Raises:
        ValueError: an outcome that is not certain, a cost that is not a multiple or is
            zero, or more states than fit in memory.
    """
    checked_seconds("tick", tick)
    likelihood = np.asarray(task.likelihood, np.float64)
    if (np.abs(likelihood - np.rint(likelihood)) > 1e-6).any():
        raise ValueError(
            "task.likelihood must be 0 or 1 for dynamic programming: a noisy answer "
            "leaves more beliefs than can be listed"
        )
    travel = _ticks("task.travel", np.asarray(task.travel, np.float64), tick)
    extra = _ticks("task.extra", np.asarray(task.extra, np.float64), tick)
    if travel.min() < 1:
        raise ValueError(
            "task.travel must be at least one tick for every measurement, got "
            f"{travel.min()} of {tick:g} s"
        )
    high = float(np.asarray(task.seconds)[1])
    if not np.isfinite(high):
        raise ValueError(f"task.seconds must be finite, got {high}")
    ticks = int(np.ceil(high / tick - 1e-6))
    prior = np.asarray(task.prior, np.float64)
    sets, after, chance = _beliefs(likelihood > 0.5, prior)
    uses = int(np.asarray(task.num_uses).max())
    size = (ticks + 1) * (uses + 1) * len(travel) * len(after)
    if size > _MOST_STATES:
        raise ValueError(
            f"task must have at most {_MOST_STATES:,} states for dynamic programming, "
            f"got {size:,}: use fewer cells or a longer tick"
        )
    values, chosen = _backwards(task, after, chance, travel, extra, ticks, uses)
    codes = np.random.default_rng(0).integers(2**32, size=len(prior), dtype=np.uint32)
    sums = (sets * codes).sum(axis=1, dtype=np.uint32)
    ascending = np.argsort(sums)
    decider = Optimal(
        chosen=jnp.asarray(chosen),
        codes=jnp.asarray(codes),
        sums=jnp.asarray(sums[ascending]),
        belief=jnp.asarray(ascending, jnp.int32),
        tick=tick,
    )
    return Optimum(values[:, :, int(task.place), 0], tick, task, decider)


def _backwards(
    task: GridTask,
    after: NDArray[np.int64],
    chance: Array,
    travel: NDArray[np.int64],
    extra: NDArray[np.int64],
    ticks: int,
    uses: int,
) -> tuple[NDArray[np.float32], NDArray[np.int16]]:
    """Nats still to gain in every state (ticks + 1, uses + 1, P, B), and the best
    measurement there.

    Args:
        task: its uses, places and whether its budget may be overrun.
        after: (B, A, Y) the belief after outcome y of measurement a.
        chance: (B, A, Y) of that outcome.
        travel: (P, A) ticks to a from each place, at least 1.
        extra: (A, Y) ticks more.
        ticks, uses: of the longest session and of the largest budget.
    """
    taken, places = np.asarray(task.uses), np.asarray(task.place_after)
    gains = special.entr(chance).sum(axis=2)  # (B, A)
    shape = (ticks + 1, uses + 1, len(travel), len(after))
    values, chosen = np.zeros(shape, np.float32), np.zeros(shape, np.int16)
    possible = chance.any(axis=0)
    most_extra = np.where(possible, extra, 0).max(axis=1)
    most_uses = np.where(possible, taken, 0).max(axis=1)
    e = np.arange(uses + 1)[:, None]
    for t in range(1, ticks + 1):
        for a in np.flatnonzero(gains.any(axis=0)):
            total = np.broadcast_to(gains[:, a], shape[1:]).copy()
            for y in np.flatnonzero(possible[a]):
                left, more = t - travel[:, a] - extra[a, y], e - taken[a, y]
                going = (left > 0) & (more > 0)
                then = values[np.maximum(left, 0), np.maximum(more, 0), places[a, y]][
                    ..., after[:, a, y]
                ]
                total += np.where(going[..., None], chance[:, a, y] * then, 0.0)
            paid: Any = e > 0
            if not task.overrun:
                paid = (t >= travel[:, a] + most_extra[a]) & (e >= max(most_uses[a], 1))
            better = paid[..., None] & (total > values[t])
            values[t] = np.where(better, total, values[t])
            chosen[t][better] = a
    return values, chosen


def _ticks(name: str, values: Array, tick: float) -> NDArray[np.int64]:
    whole = np.rint(values / tick)
    off = np.abs(values - whole * tick)
    if (off > 1e-4 * tick).any():
        worst = values.ravel()[int(off.argmax())]
        raise ValueError(f"{name} must be multiples of {tick:g} s, got {worst:g}")
    return whole.astype(np.int64)


def _beliefs(
    answers: NDArray[np.bool_], prior: Array
) -> tuple[NDArray[np.bool_], NDArray[np.int64], Array]:
    """All reachable sets (B, S); the next set and its probability, (B, A, Y) each."""
    number: dict[bytes, int] = {}
    sets: list[NDArray[np.bool_]] = []

    def of(members: NDArray[np.bool_]) -> int:
        key = np.packbits(members).tobytes()
        if key not in number:
            number[key] = len(sets)
            sets.append(members)
        return number[key]

    of(prior > 0.0)
    after, chance = [], []
    done = 0
    while done < len(sets):
        mine = sets[done]
        weight = prior * mine
        p = answers @ weight / weight.sum()
        follow = np.zeros(p.shape, np.int64)
        for a, y in np.argwhere(p > 0.0):
            follow[a, y] = of(mine & answers[a, y])
        after.append(follow)
        chance.append(p)
        done += 1
    return np.stack(sets), np.stack(after), np.stack(chance)
