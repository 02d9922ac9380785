"""Checks of what was measured, entry by entry, and the belief that follows."""

from __future__ import annotations

import operator
from collections.abc import Iterable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.particles import ParticleBelief, outcome_shape
from jaxcal.adaptive.session import SequentialTask, Session, jit_by_class
from jaxcal.checks import array_of, in_words, numbers, whole_number
from jaxcal.checks import seconds as checked_seconds

History = Iterable[tuple[Any, Any]]  # (design, outcome) of each measurement, in order

_NEAR = 1e-5  # of a coordinate's range: tolerance for coordinates of a design


def begin(
    task: SequentialTask, seconds: float | None, uses: int | None, seed: int
) -> tuple[Any, Session]:
    """The belief and the session at the start; a budget of None is the task's.

    Raises:
        ValueError: a budget is not given and the task draws it at random.
    """
    belief, session = task.begin(jax.random.key(seed))
    if isinstance(task, GridTask):
        low, high = np.asarray(task.seconds)
        ends = np.asarray(task.num_uses)
        if seconds is None and low < high:
            raise ValueError(
                f"seconds is missing: the task draws its budget from {low:g} to "
                f"{high:g} s"
            )
        if uses is None and len(ends) > 1:
            raise ValueError(
                "uses is missing: the task draws its budget from "
                f"{in_words(ends.astype(float))}"
            )
    if seconds is not None:
        budget = jnp.float32(checked_seconds("seconds", seconds))
        session = session.replace(seconds=budget)  # type: ignore[attr-defined]  # flax
    if uses is not None:
        budget = jnp.int32(whole_number("uses", uses, 1))
        session = session.replace(uses=budget)  # type: ignore[attr-defined]  # flax
    return belief, session


class StepKeys(NamedTuple):
    """PRNG keys of one measurement."""

    options: jax.Array
    choice: jax.Array
    update: jax.Array  # of the belief
    gain: jax.Array  # of the gain of the chosen design, independent of ``choice``


def step_keys(seed: int, number: int) -> StepKeys:
    """Keys of measurement ``number``, from 0.

    They depend on seed and number alone: a resumed session goes on as uninterrupted.
    """
    key = jax.random.fold_in(jax.random.key(seed), number)
    return StepKeys(*jax.random.split(key, 4))


class State(Protocol):
    """A session and what is known in it; a ``Loop``."""

    task: SequentialTask
    belief: Any
    session: Session


def checked_entry(
    state: State, design: Any, outcome: Any, where: str
) -> tuple[Any, Any]:
    """Design and outcome as the task has them, of a measurement that can be paid.

    A task with a table ``designs`` (A, e) takes a whole number as an index of it and
    anything else as coordinates; other tasks take designs as their options have them.

    Raises:
        ValueError: naming the entry, the rule and the value.
    """
    table = getattr(state.task, "designs", None)
    if table is not None:
        index = _index(np.asarray(table, np.float64), design, f"{where}: design")
        design = jnp.int32(index)
    else:
        design = _as_designs(state, design, f"{where}: design")
    of_kind = _of_table if isinstance(state.task, GridTask) else _of_particles
    return design, of_kind(state, design, outcome, where)


def _of_table(state: Any, design: jax.Array, outcome: Any, where: str) -> jax.Array:
    """Outcome of a design of a table, which the budget must have paid."""
    task, session = state.task, state.session
    count = task.likelihood.shape[1]
    index = _whole(outcome)
    if index is None or not 0 <= index < count:
        raise ValueError(
            f"{where}: outcome must be a whole number in [0, {count}), got {outcome!r}"
        )
    likelihood = np.asarray(task.likelihood[design, index], np.float64)
    if not (likelihood * np.asarray(state.belief.weights, np.float64)).sum() > 0.0:
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
    return jnp.int32(index)


def _of_particles(state: State, design: Any, outcome: Any, where: str) -> jax.Array:
    belief = state.belief
    values = array_of(f"{where}: outcome", outcome, *outcome_shape(belief.model))
    answer = jnp.asarray(values, jnp.float32)
    support = belief.model.support
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
    return (
        belief.update(task, design, outcome, key),
        task.spend(session, design, outcome),
    )


_can_answer = jit_by_class(ParticleBelief.can_answer)


def _as_designs(state: State, design: Any, where: str) -> Any:
    """A design in the structure, the shapes and the types of the task's options."""

    def typed(leaf: Any, values: Any) -> jax.Array:
        return jnp.asarray(array_of(where, values, *leaf.shape[1:]), leaf.dtype)

    like = _like(state)
    try:
        jax.tree.structure(like).flatten_up_to(design)  # type: ignore[attr-defined]  # jaxlib
    except ValueError:
        raise ValueError(
            f"{where} must have the structure {jax.tree.structure(like)}, got "
            f"{design!r}"
        ) from None
    return jax.tree.map(typed, like, design)


def from_leaves(state: State, leaves: list[Any]) -> Any:
    """A design from the list of its leaves, as a journal has it."""
    return jax.tree.unflatten(jax.tree.structure(_like(state)), leaves)


def _like(state: State) -> Any:
    """Shapes and types of the task's options, leaves (A, ...)."""
    now = state.belief, state.session, jax.random.key(0)
    return jax.eval_shape(state.task.options, *now).designs


def _index(table: NDArray[np.float64], design: Any, where: str) -> int:
    """The row of ``table`` (A, e) that a whole number or coordinates name."""
    index = _whole(design)
    if index is not None:
        if not 0 <= index < len(table):
            raise ValueError(f"{where} must lie in [0, {len(table)}), got {index}")
        return index
    coordinates = np.atleast_1d(numbers(where, design))
    if coordinates.shape != table.shape[1:]:
        raise ValueError(
            f"{where} must be an index or have {table.shape[1]} coordinates, "
            f"got {design!r}"
        )
    span = np.ptp(table, axis=0)
    off = np.abs(table - coordinates) / np.where(
        span > 0.0, span, np.abs(table).max() or 1.0
    )
    nearest = int(off.max(axis=1).argmin())
    if off[nearest].max() > _NEAR:
        raise ValueError(
            f"{where} must be a design of the task, got {in_words(coordinates)}; the "
            f"nearest is {nearest}, {in_words(table[nearest])}"
        )
    return nearest


def _whole(value: Any) -> int | None:
    if isinstance(value, bool | np.bool_):
        return None
    try:
        return operator.index(value)
    except TypeError:
        return None


def what_is_left(session: Session) -> str:
    return f"{float(session.seconds):.6g} s and {int(session.uses)} uses were left"
