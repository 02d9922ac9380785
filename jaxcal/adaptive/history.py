"""Checks of what was measured, entry by entry, and the belief that follows."""

from __future__ import annotations

import operator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.particles import ParticleBelief, outcome_shape
from jaxcal.adaptive.session import SequentialTask, Session, jit_by_class
from jaxcal.checks import Array, array_of, in_words, numbers, whole_number
from jaxcal.checks import seconds as checked_seconds

_NEAR = 1e-5  # of a coordinate's range: tolerance for coordinates of a design


def begin(
    task: SequentialTask, seconds: float | None, uses: int | None, seed: int
) -> tuple[Any, Session]:
    """The belief and the session at the start; a budget of None is the task's, and
    refused where the task draws it at random."""
    belief, session = task.begin(jax.random.key(seed))
    if isinstance(task, GridTask):
        low, high = np.asarray(task.seconds)
        ends = np.asarray(task.num_uses, float)
        if seconds is None and low < high:
            raise ValueError(
                f"seconds is missing: the task draws its budget from {low:g} to "
                f"{high:g} s"
            )
        if uses is None and len(ends) > 1:
            raise ValueError(
                f"uses is missing: the task draws its budget from {in_words(ends)}"
            )
    budget = {}
    if seconds is not None:
        budget["seconds"] = jnp.float32(checked_seconds("seconds", seconds))
    if uses is not None:
        budget["uses"] = jnp.int32(whole_number("uses", uses, 1))
    return belief, session.replace(**budget)  # type: ignore[attr-defined]  # flax


def step_keys(seed: int, number: int) -> jax.Array:
    """(4,) keys of measurement ``number``, from 0: of its options, the choice, the
    belief's update, and the gain that is told, which no choice was made by. They depend
    on seed and number alone: a resumed session goes on as uninterrupted."""
    return jax.random.split(jax.random.fold_in(jax.random.key(seed), number), 4)


def checked_entry(
    loop: Any, design: Any, outcome: Any, where: str
) -> tuple[Any, jax.Array]:
    """Design and outcome as the task has them, of a measurement that can be paid; a
    ValueError names the entry, the rule and the value.

    A task with a table ``designs`` (A, e) takes a whole number as an index of it and
    anything else as coordinates; other tasks take designs as their options have them.
    """
    table = getattr(loop.task, "designs", None)
    if table is not None:
        design = _row(f"{where}: design", design, np.asarray(table, np.float64))
    else:
        design = _as_options(loop, design, f"{where}: design")
    of_kind = _of_table if isinstance(loop.task, GridTask) else _of_particles
    return design, of_kind(loop, design, outcome, where)


def _of_table(loop: Any, design: jax.Array, outcome: Any, where: str) -> jax.Array:
    """Outcome of a design of a table, which the budget must have paid."""
    task, session = loop.task, loop.session
    index = _index(f"{where}: outcome", outcome, task.likelihood.shape[1])
    likelihood = np.asarray(task.likelihood[design, index], np.float64)
    if not (likelihood * np.asarray(loop.belief.weights, np.float64)).sum() > 0.0:
        raise ValueError(
            f"{where}: outcome {index} of design "
            f"{in_words(np.asarray(task.designs[design], np.float64))} is impossible "
            "after the earlier measurements: its probability is 0"
        )
    if not task.payable(session)[design]:
        cost = task.travel[session.place, design] + task.most_extra[design]
        raise ValueError(
            f"{where} takes up to {float(cost):.6g} s and "
            f"{int(task.most_uses[design])} uses: {what_is_left(session)}; tasks with "
            "overrun=True may exceed the budget"
        )
    return index


def _of_particles(loop: Any, design: Any, outcome: Any, where: str) -> jax.Array:
    belief, support = loop.belief, loop.belief.model.support
    values = array_of(f"{where}: outcome", outcome, *outcome_shape(belief.model))
    answer = jnp.asarray(values, jnp.float32)
    if support is not None and not (answer == support).any():
        raise ValueError(
            f"{where}: outcome must be one of the {len(support)} of model.support, "
            f"from {support[0]:g} to {support[-1]:g}, got {outcome!r}"
        )
    if not _can_answer(belief, design, answer):
        raise ValueError(
            f"{where}: outcome {outcome!r} is impossible after the earlier "
            "measurements: every particle gives it probability 0"
        )
    return answer


@jit_by_class
def after(
    task: SequentialTask,
    belief: Any,
    session: Session,
    design: Any,
    outcome: Any,
    key: jax.Array,
) -> tuple[Any, Session]:
    """Belief and session after one measurement."""
    updated = belief.update(task, design, outcome, key)
    return updated, task.spend(session, design, outcome)


_can_answer = jit_by_class(ParticleBelief.can_answer)


def _as_options(loop: Any, design: Any, where: str) -> Any:
    """A design in the structure, the shapes and the types of the task's options."""

    def typed(leaf: Any, values: Any) -> jax.Array:
        return jnp.asarray(array_of(where, values, *leaf.shape[1:]), leaf.dtype)

    like = _like(loop)
    structure: Any = jax.tree.structure(like)
    try:
        structure.flatten_up_to(design)
    except ValueError:
        raise ValueError(
            f"{where} must have the structure {structure}, got {design!r}"
        ) from None
    return jax.tree.map(typed, like, design)


def from_leaves(loop: Any, leaves: list[Any]) -> Any:
    """A design from the list of its leaves, as a journal has it."""
    return jax.tree.unflatten(jax.tree.structure(_like(loop)), leaves)


def _like(loop: Any) -> Any:
    """Shapes and types of the task's options, leaves (A, ...)."""
    now = loop.belief, loop.session, jax.random.key(0)
    return jax.eval_shape(loop.task.options, *now).designs


def _row(name: str, design: Any, table: Array) -> jax.Array:
    """() int32: the row of ``table`` (A, e) that an index or coordinates name."""
    try:
        operator.index(design)
    except TypeError:
        at = np.atleast_1d(numbers(name, design))
    else:
        return _index(name, design, len(table))
    if at.shape != table.shape[1:]:
        raise ValueError(
            f"{name} must be an index or have {table.shape[1]} coordinates, "
            f"got {design!r}"
        )
    span = np.ptp(table, axis=0)
    span = np.where(span > 0.0, span, np.abs(table).max() or 1.0)
    off = (np.abs(table - at) / span).max(axis=1)
    nearest = int(off.argmin())
    if off[nearest] > _NEAR:
        raise ValueError(
            f"{name} must be a design of the task, got {in_words(at)}; the nearest is "
            f"{nearest}, {in_words(table[nearest])}"
        )
    return jnp.int32(nearest)


def _index(name: str, value: Any, count: int) -> jax.Array:
    """() int32 of a whole number in [0, count)."""
    try:
        index = -1 if isinstance(value, bool | np.bool_) else operator.index(value)
    except TypeError:
        index = -1
    if not 0 <= index < count:
        raise ValueError(
            f"{name} must be a whole number in [0, {count}), got {value!r}"
        )
    return jnp.int32(index)


def what_is_left(session: Session) -> str:
    return f"{float(session.seconds):.6g} s and {int(session.uses)} uses were left"
