"""``Ahead``: the next measurement by a tree of those that may follow."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.rules import SHARES, Shares
from jaxcal.adaptive.search_kernel import Tree
from jaxcal.adaptive.session import Options, Session, on_host


@struct.dataclass
class Ahead:
    """``shares`` on a tree of the next measurements and all of their outcomes.

    The measurement of the largest expected total of nats: exact where the session ends
    within the tree, with an estimate of what follows elsewhere; deterministic. It is
    ``shares`` on any class but ``GridTask`` itself, and where even a small tree takes
    more than ``effort`` multiplications per choice (7e5: about .04 ms of one core).
    """

    base: Shares = SHARES
    doubt: Any = 0.3  # share of the estimated nats by which to beat ``shares``
    hints: Any = None  # (N, A) multiples of the scores of the first N measurements
    effort: float = struct.field(pytree_node=False, default=7e5)

    def __call__(
        self, task: Any, belief: Any, session: Session, options: Options, key: jax.Array
    ) -> jax.Array:
        if type(task) is not GridTask:  # one of its own may not allow every design
            return self.base(task, belief, session, options, key)
        constants, hints = self.constants()
        return on_host(
            functools.partial(_chosen, task.horizon, self.effort),
            jax.ShapeDtypeStruct((), jnp.int32),
            *(task.likelihood, task.travel, task.extra, task.uses, task.place_after),
            *(*task.limits, jnp.stack(constants), hints, belief.weights),
            *(session.place, session.seconds, session.uses, session.made),
        )

    def constants(self) -> tuple[list[Any], Any]:
        """Constants of ``shares`` and ``doubt``; (N, A) hints, (1, 1) without any."""
        rule = self.base
        numbers = [rule.time, rule.use, rule.a, rule.b, rule.haste, self.doubt]
        return numbers, np.ones((1, 1)) if self.hints is None else self.hints


AHEAD = Ahead()

# Dimensions of the task's arrays, which come first.
_TABLES = (3, 2, 2, 2, 2, 1, 1, 1, 2)


def _chosen(horizon: int, effort: float, *arrays: Any) -> Any:
    """(...) int32 choices in sessions of one task; (...) are axes of ``vmap``."""
    tables: list[Any] = []
    for array, dims in zip(arrays, _TABLES, strict=False):
        if np.prod(array.shape[: array.ndim - dims]) > 1:
            raise ValueError("Ahead decides for one task at a time, got several")
        tables.append(np.reshape(array, array.shape[array.ndim - dims :]))
    belief, *session = map(np.asarray, arrays[len(_TABLES) :])
    batch = np.broadcast_shapes(belief.shape[:-1], *(leaf.shape for leaf in session))
    states = belief.shape[-1]
    beliefs = np.broadcast_to(belief, (*batch, states)).reshape(-1, states)
    kinds = np.int32, np.float32, np.int32, np.int32  # place, seconds, uses, made
    place, seconds, uses, made = (
        np.broadcast_to(leaf, batch).astype(kind).ravel()
        for leaf, kind in zip(session, kinds, strict=True)
    )
    chosen = np.empty(len(beliefs), np.int32)
    searched = tree(*[*tables, horizon, effort])
    searched.choose(_single(beliefs), place, seconds, uses, made, chosen)
    return chosen.reshape(batch)


def tree(
    likelihood: Any, travel: Any, extra: Any, uses: Any, place_after: Any,
    most_extra: Any, most_uses: Any, constants: Any, hints: Any,
    horizon: int, effort: float,
) -> Tree:  # fmt: skip
    """The kernel's object from tables as ``GridTask`` and its ``limits`` have them."""
    hints = np.broadcast_to(hints, (len(hints), len(likelihood)))
    return Tree(
        _single(likelihood), _single(travel), _single(np.transpose(extra)),
        _single(np.transpose(uses)), np.array(place_after, np.int32),
        _single(most_extra), _single(most_uses), horizon, constants, _single(hints),
        effort,
    )  # fmt: skip


def _single(array: Any) -> Any:
    return np.array(array, np.float32, order="C")  # JAX's cannot be written
