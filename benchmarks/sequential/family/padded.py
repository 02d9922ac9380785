"""Tasks of different sizes in arrays of one shape: one program plays them all."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from flax import struct
from numpy.typing import ArrayLike

from benchmarks.sequential.family.draws import draw
from benchmarks.sequential.family.structures import Limits
from jaxcal.adaptive.grid import GridBelief, GridTask, Part
from jaxcal.adaptive.session import Options, Session

__all__ = ["SHAPE", "Padded", "batch", "pad", "stack"]

SHAPE = Limits(states=256, designs=48, outcomes=4, measurements=32)
"""Sizes of ``batch``: a CPU plays thousands of such sessions in seconds."""


@struct.dataclass
class Padded(GridTask):
    """A grid task in the shapes of ``Limits``.

    States added have no weight, designs added are not allowed, and outcomes added have
    probability 0.
    """

    allowed: jax.Array  # (A,) bool
    first: jax.Array  # () int32 initial ``Session.made``: padded less own horizon

    def options(
        self,
        belief: GridBelief | None,
        session: Session,
        key: jax.Array | None = None,
    ) -> Options:
        """The task's own designs that what is left pays for."""
        every = super().options(belief, session, key)
        allowed = every.allowed & self.allowed
        return every.replace(allowed=allowed)  # type: ignore[attr-defined]  # flax

    def session(self, seconds: object, uses: object) -> Session:
        """A session with this budget; ``made`` counts from ``first`` to ``horizon``."""
        begun = super().session(seconds, uses)
        return begun.replace(made=self.first)  # type: ignore[attr-defined]  # flax


def pad(task: GridTask, limits: Limits) -> Padded:
    """A task in larger arrays, as numpy.

    Raises:
        ValueError: naming the limit that the task breaks.
    """
    count, num_outcomes, num_states = task.likelihood.shape
    ends = np.asarray(task.num_uses)
    sizes = {
        "states": num_states,
        "designs": count,
        "outcomes": num_outcomes,
        "uses": int(ends.max()),
        "measurements": task.horizon,
        "groups": task.num_groups,
    }
    for name, size in sizes.items():
        if size > getattr(limits, name):
            raise ValueError(
                f"task must have at most {getattr(limits, name):,} {name}, got {size:,}"
            )
    if len(task.travel) > count + 1:
        raise ValueError(
            f"task must have at most {count + 1} places, one for each design and the "
            f"start, got {len(task.travel)}"
        )

    def larger(leaf: ArrayLike, *shape: int) -> Any:
        array = np.asarray(leaf)
        out = np.zeros(shape, array.dtype)
        out[tuple(slice(n) for n in array.shape)] = array
        return out

    designs, outcomes = limits.designs, limits.outcomes
    table = larger(task.likelihood, designs, outcomes, limits.states)
    table[count:, 0] = 1.0
    table[:count, 0, num_states:] = 1.0
    with np.errstate(divide="ignore", invalid="ignore"):
        p_log_p: Any = np.where(table > 0.0, table * np.log(table), 0.0)
    start = np.asarray(task.place)
    # In every padded task the start is the place after all designs.
    times = np.asarray(task.travel)
    travel = larger(times[:count], designs + 1, designs)
    travel[-1, :count] = times[-1]
    after = np.asarray(task.place_after)
    after = (
        np.where(after == count, designs, after) if len(task.travel) > count else after
    )
    if len(task.travel) > count:
        start = np.where(start == count, designs, start)
    fields: dict[str, Any] = dict(
        theta=np.zeros((limits.states, 1), np.float32),  # not used
        prior=larger(task.prior, limits.states),
        designs=np.zeros((designs, 1), np.float32),
        likelihood=table,
        parts=(Part(table, p_log_p, (0,)),),
        order=np.arange(designs, dtype=np.int32),
        travel=travel,
        place_after=larger(after.astype(np.int32), designs, outcomes),
        extra=larger(task.extra, designs, outcomes),
        uses=larger(task.uses, designs, outcomes),
        most_extra=larger(task.most_extra, designs),
        most_uses=larger(task.most_uses, designs),
        seconds=np.asarray(task.seconds),
        num_uses=np.resize(ends, 60).astype(np.int32),
        place=start.astype(np.int32),
        groups=larger(task.groups, designs),
        num_groups=limits.groups,
        shape=(limits.states,),
        horizon=limits.measurements,
        overrun=task.overrun,
        theta_names=(),
        allowed=np.arange(designs) < count,
        first=np.int32(limits.measurements - task.horizon),
    )
    return Padded(**fields)


def stack(tasks: Sequence[Padded]) -> Padded:
    """One tree with a leading axis of tasks."""
    whole: Padded = jax.tree.map(lambda *leaves: np.stack(leaves), *tasks)
    return whole


def batch(number: int = 0, tasks: int = 128) -> Padded:
    """Tasks of one shape on a leading axis; each ``number`` gives other tasks."""
    seeds = range(number * tasks, (number + 1) * tasks)
    return stack([pad(draw(seed, limits=SHAPE), SHAPE) for seed in seeds])
