"""Checks of the tables that make a task on a grid."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import Array, array_of, in_words, numbers


def probabilities(likelihood: ArrayLike, at: Array, grid: Array) -> Array:
    """(A, Y, S) probabilities that sum to 1 over the outcomes."""
    table = array_of("likelihood", likelihood, len(at), "Y", len(grid))
    _require_not_negative("likelihood", table)
    total = table.sum(axis=1)
    if (bad := np.argwhere(np.abs(total - 1.0) > 1e-6)).size:
        a, s = bad[0]
        raise ValueError(
            "likelihood must sum to 1 over the outcomes, got "
            f"{total[a, s]:.9g} for design {in_words(at[a])} and theta "
            f"{in_words(grid[s])}"
        )
    return table / total[:, None]


def weights(prior: ArrayLike | None, table: Array) -> tuple[Array, NDArray[np.bool_]]:
    """(S,) prior weights, not normalised; (A, Y) outcomes that they make possible."""
    size = table.shape[2]
    weights = np.full(size, 1.0) if prior is None else numbers("prior", prior)
    if weights.shape != (size,) or (weights < 0.0).any() or not weights.sum() > 0.0:
        raise ValueError(
            f"prior must hold {size} weights, none below 0 and one above, "
            f"got shape {weights.shape}, least {weights.min():g}"
        )
    possible = table.astype(np.float32)[..., weights > 0.0] > 0.0
    return weights, np.asarray(possible.any(axis=-1))


def places(
    travel: ArrayLike, place_after: ArrayLike | None, shape: tuple[int, int]
) -> tuple[Array, Array]:
    """(P, A) seconds of travel, and (A, Y) places after outcomes."""
    times, count = numbers("travel", travel), shape[0]
    if times.ndim < 2:
        times = np.broadcast_to(times, (count + 1, count))
    if times.ndim != 2 or times.shape[1] != count or len(times) < count:
        raise ValueError(
            f"travel must be a number, ({count},) or (P, {count}) with at least "
            f"{count} places, got shape {times.shape}"
        )
    _require_not_negative("travel", times)
    if place_after is None:
        place_after = np.arange(count)[:, None]  # the design itself
    after = costs("place_after", place_after, shape)
    if (after % 1 != 0).any() or after.max() >= len(times):
        raise ValueError(
            f"place_after must hold places in [0, {len(times)}), "
            f"got {after.min():g} to {after.max():g}"
        )
    return times, after


def costs(name: str, values: ArrayLike, shape: tuple[int, int]) -> Array:
    """(A, Y) numbers of outcomes, at least 0."""
    array = numbers(name, values)
    try:
        table = np.broadcast_to(array, shape)
    except ValueError:
        raise ValueError(
            f"{name} must broadcast to {shape}, got shape {array.shape}"
        ) from None
    _require_not_negative(name, table)
    return table


def _require_not_negative(name: str, values: Array) -> None:
    if (values < 0.0).any():
        raise ValueError(f"{name} must be at least 0, got {values.min():g}")


def seconds(seconds: float | tuple[float, float]) -> Array:
    """(2,) least and largest budget of time."""
    budget = np.broadcast_to(numbers("seconds", seconds, finite=False), 2)
    if not 0.0 < budget[0] <= budget[1]:
        raise ValueError(
            f"seconds must be above 0, or (least, most), got {in_words(budget)}"
        )
    return budget


def ends(num_uses: int | Sequence[int]) -> Array:
    """(E,) equally likely budgets of uses."""
    ends = np.atleast_1d(numbers("num_uses", num_uses))
    if ends.ndim != 1 or (ends < 1).any() or (ends % 1 != 0).any():
        raise ValueError(
            f"num_uses must be whole numbers of at least 1, got {in_words(ends)}"
        )
    return ends


def groups(groups: ArrayLike | None, count: int) -> NDArray[np.int64]:
    """(A,) the group of each design."""
    group = np.zeros(count, int) if groups is None else np.asarray(groups)
    if group.shape != (count,) or group.min() < 0 or (group % 1 != 0).any():
        raise ValueError(
            f"groups must hold {count} whole numbers from 0, got {in_words(group)}"
        )
    return group


def grid(theta: Array) -> tuple[int, ...]:
    """Lengths of the axes that theta is the product of, the last the fastest."""
    axes = [np.unique(column) for column in theta.T]
    shape = tuple(len(axis) for axis in axes)
    if np.prod(shape) == len(theta):
        product = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        if (product.reshape(theta.shape) == theta).all():
            return shape
    return (len(theta),)


def single(values: ArrayLike) -> jax.Array:
    # ``jnp.asarray`` compiles a program for every shape.
    return jax.device_put(np.asarray(values, np.float32))


def whole(values: ArrayLike) -> jax.Array:
    return jax.device_put(np.asarray(values, np.int32))


def columns(name: str, values: ArrayLike) -> Array:
    array = numbers(name, values)
    array = array[:, None] if array.ndim == 1 else array
    if array.ndim != 2 or not array.size:
        raise ValueError(f"{name} must have shape (N, d) or (N,), got {array.shape}")
    return array


def names(given: Sequence[str], count: int) -> tuple[str, ...]:
    names = tuple(given) or tuple(f"theta{i + 1}" for i in range(count))
    if len(names) != count:
        raise ValueError(f"theta_names must hold {count} names, got {names}")
    return names
