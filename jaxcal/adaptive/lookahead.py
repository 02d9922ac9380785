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
    ``shares`` on a task that is not a ``GridTask``, and where even a small tree takes
    more than ``effort`` multiplications per choice (7e5: about .04 ms of one core).
    """

    base: Shares = SHARES
    doubt: Any = 0.3  # share of the estimated nats by which to beat ``shares``
    hints: Any = None  # (N, A) multiples of the scores of the first N measurements
    effort: float = struct.field(pytree_node=False, default=7e5)

    def __call__(
        self, task: Any, belief: Any, session: Session, options: Options, key: jax.Array
    ) -> jax.Array:
        if not isinstance(task, GridTask):
            return self.base(task, belief, session, options, key)
        constants, hints = self.constants()
        return on_host(
            functools.partial(_chosen, task.horizon, self.effort),
            jax.ShapeDtypeStruct((), jnp.int32),
            *(task.likelihood, task.travel, task.extra, task.uses, task.place_after),
            *(*task.limits, _possible(task, session, options)),
            *(jnp.stack(constants), hints, belief.weights),
            *(session.place, session.seconds, session.uses, session.made),
        )

    def constants(self) -> tuple[list[Any], Any]:
        """Constants of ``shares`` and ``doubt``; (N, A) hints, (1, 1) without any."""
        rule = self.base
        numbers = [rule.time, rule.use, rule.a, rule.b, rule.haste, self.doubt]
        return numbers, np.ones((1, 1)) if self.hints is None else self.hints


def _possible(task: GridTask, session: Session, options: Options) -> jax.Array:
    """(A,) bool: designs that may be measured where they can be paid.

    What can be paid the tree finds. One tree serves all sessions of a batch unless a
    task of another kind decides by the session.
    """
    if type(task).options is GridTask.options:
        return jnp.ones(len(task.designs), bool)
    return options.allowed | ~task.payable(session)


AHEAD = Ahead()

_TABLES = 10  # arrays of the task come first, then those of the session
_DIMENSIONS = (3, 2, 2, 2, 2, 1, 1, 1, 1, 2, 1, 0, 0, 0, 0)


def _chosen(horizon: int, effort: float, *arrays: Any) -> Any:
    """(...) int32 choices; arrays have leading batch axes that broadcast."""
    inputs = [np.asarray(array) for array in arrays]
    sized = list(zip(inputs, _DIMENSIONS, strict=True))
    batches = [array.shape[: array.ndim - dims] for array, dims in sized]
    batch = np.broadcast_shapes(*batches)
    tasks = np.broadcast_shapes(*batches[:_TABLES])
    states = [
        np.broadcast_to(array, batch + array.shape[array.ndim - dims :])
        for array, dims in sized[_TABLES:]
    ]
    chosen = np.empty(batch, np.int32)
    for index in np.ndindex(tasks):  # one iteration per task
        tables = [
            array[
                tuple(min(i, n - 1) for i, n in zip(index, array.shape, strict=False))
            ]
            for array in inputs[:_TABLES]
        ]
        searched = tree(*[*tables, horizon, effort])
        at = tuple(
            slice(None) if n == 1 else i for i, n in zip(index, tasks, strict=True)
        )
        belief, place, seconds, uses, made = (state[at] for state in states)
        designs = np.empty(place.size, np.int32)
        searched.choose(
            _single(belief).reshape(designs.size, -1), _whole(place),
            _single(seconds).ravel(), _whole(uses), _whole(made), designs,
        )  # fmt: skip
        chosen[at] = designs.reshape(place.shape)
    return chosen


def tree(
    likelihood: Any, travel: Any, extra: Any, uses: Any, place_after: Any,
    most_extra: Any, most_uses: Any, allowed: Any, constants: Any, hints: Any,
    horizon: int, effort: float,
) -> Tree:  # fmt: skip
    """The kernel's object from tables as ``GridTask`` and its ``limits`` have them."""
    return Tree(
        _single(likelihood), _single(travel), _single(np.transpose(extra)),
        _single(np.transpose(uses)), np.array(place_after, np.int32),
        _single(most_extra), _single(most_uses), _single(allowed),
        horizon, constants, _single(hints), effort,
    )  # fmt: skip


def _single(array: Any) -> Any:
    return np.array(array, np.float32, order="C")  # JAX's cannot be written


def _whole(array: Any) -> Any:
    return np.array(array, np.int32).ravel()
