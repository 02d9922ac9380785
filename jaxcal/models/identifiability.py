"""Which parameters a set of candidates can identify, in the model's own names."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import Array, one_of, require_kind, table
from jaxcal.information.blocks import triangle
from jaxcal.information.singular import exact_zeros, flat, significant
from jaxcal.models.model import Model, as_model
from jaxcal.models.predictions import answered, derivative, without_effect
from jaxcal.models.uncertainty import Noise, Prior, as_noise


@dataclasses.dataclass(frozen=True, eq=False)
class Direction:
    """Parameters that can change together without any measurement showing it."""

    names: tuple[str, ...]
    words: str  # "theta6", "d2 = d3 = d4", "d1 with base z"
    vectors: Array  # (k, p) changes that no candidate shows, in the parameters' units


@dataclasses.dataclass(frozen=True, eq=False)
class Identifiability:
    """Which parameters candidates determine; ``print`` shows a short report."""

    names: tuple[str, ...]  # the p parameters asked about
    rank: int  # combinations of them that are identified
    directions: tuple[Direction, ...]  # the rest, p - rank vectors in all
    condition: float  # of the identified part, every column scaled to length one
    num_candidates: int
    held: tuple[str, ...] = ()  # not asked about: the model's default prior fixes them

    @property
    def identifiable(self) -> tuple[str, ...]:
        """Parameters that are identified individually."""
        tied = {name for direction in self.directions for name in direction.names}
        return tuple(name for name in self.names if name not in tied)

    def __str__(self) -> str:
        lines = [
            f"{self.rank} of {len(self.names)} parameters can be identified from "
            f"{self.num_candidates} candidates (condition {self.condition:.3g})."
        ]
        alone = [one.words for one in self.directions if len(one.names) == 1]
        tied = [f"  {one.words}" for one in self.directions if len(one.names) > 1]
        if tied:
            lines += ["Only in combination:", *tied]
        if alone:
            lines.append(f"No effect on the readings: {', '.join(alone)}")
        if self.identifiable:
            lines.append(f"Individually identifiable: {', '.join(self.identifiable)}")
        if self.held:
            lines.append(f"Held at the nominal value: {', '.join(self.held)}")
        return "\n".join(lines)


def identifiability(
    model: Model,
    candidates: ArrayLike,
    *,
    noise: Noise | None = None,
    prior: Prior | None = None,
    parameters: Sequence[str] | None = None,
) -> Identifiability:
    """Find every direction of the parameters that no candidate (N, n) excites.

    Args:
        model: with p parameters.
        candidates: (N, n) commands.
        noise: matters where commands are unknown in every measurement.
        prior: the model is evaluated at its mean, else at the nominal parameters. It
            counts where its std is finite, and parameters that it fixes are left out.
            Without one those that the model's default prior fixes are held.
        parameters: names of interest; the others are taken as known.
    """
    commands = table("candidates", candidates)
    if not len(commands):
        raise ValueError("candidates must hold at least one row, got none")
    model = as_model(model)
    noise = as_noise(noise)
    require_kind("prior", prior, Prior)
    resolved = None if prior is None else prior.resolve(model)
    mean = model.nominal if resolved is None else resolved.mean
    commands = commands[answered(model, commands, mean)]
    jacobian = _white(model, derivative(model, commands, mean), commands, mean, noise)
    rows = jacobian.reshape(-1, model.num_parameters)
    asked = np.ones(model.num_parameters, dtype=np.bool_)
    held: Sequence[str] = ()
    if resolved is not None:
        rows = np.vstack([rows, np.diag(np.sqrt(resolved.precisions))])
        asked &= resolved.free
    elif parameters is None:
        held = model.default_prior().fixed
        asked &= ~np.isin(model.names, list(held))
    rows = np.vstack([rows, model.fitting.facts(mean)[1]])
    if parameters is not None:
        parameters = [parameters] if isinstance(parameters, str) else parameters
        for name in parameters:
            one_of("parameters", name, model.names)
        asked &= np.isin(model.names, list(parameters))
    at = np.flatnonzero(asked)
    names = tuple(model.names[i] for i in at)
    std = np.sqrt(model.default_prior().resolve(model).precisions)[at]
    scale = 1.0 / np.where(std > 0.0, std, 1.0)
    null, size = _null_space(rows[:, at] * scale, model.fitting.resolution)
    directions = []
    for local in null:
        full = np.zeros((len(local), model.num_parameters))
        full[:, at] = local * scale
        full /= np.linalg.norm(full, axis=1, keepdims=True)
        told = tuple(names[i] for i in np.flatnonzero(local.any(axis=0))) or names
        same = np.allclose(np.abs(full[np.abs(full) > 0.0]), np.sqrt(0.5))
        directions.append(Direction(told, _in_words(told, same), full))
    rank = len(at) - sum(len(vectors) for vectors in null)
    condition = float(size[0] / size[rank - 1]) if rank else np.inf
    order = {name: i for i, name in enumerate(names)}
    directions.sort(key=lambda direction: order[direction.names[0]])
    return Identifiability(
        names, rank, tuple(directions), condition, len(commands), tuple(held)
    )


def _null_space(columns: Array, resolution: float) -> tuple[list[Array], Array]:
    """Changes (k, p) that columns (R, p) do not show, those that go together in one;
    and the singular values of the columns, each of length 1."""
    largest = np.abs(columns).max(axis=0, initial=0.0)
    nonzero, p = largest > 0.0, columns.shape[1]
    # A triangle of p rows holds all that is needed of the R.
    columns = triangle(columns / np.where(nonzero, largest, 1.0))
    lengths = np.linalg.norm(columns, axis=0)
    unit = columns / np.where(nonzero, lengths, 1.0)
    norms = np.where(nonzero, lengths * largest, 1.0)
    size = np.asarray(np.linalg.svd(unit, compute_uv=False), np.float64)
    if len(size) == p and significant(size, off=resolution).all():
        return [], size
    first, classes = _parallel(unit, np.flatnonzero(nonzero), resolution)
    null = [np.eye(p)[[i]] for i in np.flatnonzero(~nonzero)]
    null += [vectors / norms for vectors in classes]
    for vector in _sparse_null(unit[:, first], resolution):
        full = np.zeros((1, p))
        full[0, first] = vector / norms[first]
        null.append(full)
    return null, size


def _white(
    model: Model, jacobian: Array, commands: Array, mean: Array, noise: Noise | None
) -> Array:
    """(N, q, p) derivatives in comparable units, exactly zero where they are rounding.
    In the noise's, else the model's usual noise, else every output in its largest
    derivative's."""
    still = without_effect(jacobian, model.parameter_sizes())
    jacobian = np.where(still, 0.0, jacobian)
    noise = model.default_noise() if noise is None else noise
    if noise is None:
        largest = np.abs(jacobian).max(axis=0, initial=0.0)
        columns = largest.max(axis=0, initial=0.0)
        outputs = (largest / np.where(columns > 0.0, columns, 1.0)).max(axis=1)
        return np.asarray(jacobian / np.where(outputs > 0.0, outputs, 1.0)[:, None])
    readings = dataclasses.replace(noise, command_std=None)
    white = readings.weigh(jacobian)
    if noise.command_std is None:
        return white
    slopes = np.asarray(model.command_jacobian(commands, mean))
    rest = noise.weigh(jacobian, slopes)
    # What unknown commands take away whole leaves rounding.
    lost = flat(np.linalg.norm(rest, axis=(0, 1)), np.linalg.norm(white, axis=(0, 1)))
    return np.where(lost, 0.0, rest)


def unknown(
    model: Model,
    commands: Array,
    mean: Array,
    precision: Array,
    free: NDArray[np.bool_],
) -> tuple[Direction, ...]:
    """Directions that neither commands (N, n) nor a prior's precision (p,) determine,
    by the model at ``mean`` (p,); those not ``free`` (p,) are held."""
    flat_prior = precision == 0.0
    std = np.where(flat_prior, np.inf, 1.0 / np.sqrt(precision + flat_prior))
    held = [name for name, one in zip(model.names, free, strict=True) if not one]
    return identifiability(model, commands, prior=Prior(std, mean, held)).directions


def _in_words(names: tuple[str, ...], same: bool) -> str:
    """Names of one kind that act alike are equal; others are seen with each other."""
    kinds = {re.sub(r"\d+", "", name) for name in names}
    if len(names) > 1 and same and len(kinds) == 1:
        return " = ".join(names)
    *others, last = names[1:] or ("",)
    rest = f"{', '.join(others)} and {last}" if others else last
    return f"{names[0]} with {rest}" if rest else names[0]


def _parallel(
    unit: Array, at: NDArray[np.intp], off: float
) -> tuple[list[int], list[Array]]:
    """The first of columns ``at`` that are multiples of each other, and vectors (k, p)
    of each of the others against it."""
    classes: dict[int, list[Array]] = {}  # by the first column of each
    for i in at:
        first = [*classes]
        along = unit[:, first].T @ unit[:, i]
        apart = unit[:, [i]] - unit[:, first] * along
        sizes = np.append(1.0, np.linalg.norm(apart, axis=0))
        same = np.flatnonzero(~significant(sizes, off=off)[1:])
        if not same.size:
            classes[int(i)] = []
        for j in same[:1]:
            vector = np.zeros(unit.shape[1])
            vector[[first[j], i]] = 1.0, -np.sign(along[j])
            classes[first[j]].append(vector)
    return [*classes], [np.array(vectors) for vectors in classes.values() if vectors]


def _sparse_null(columns: Array, off: float) -> Array:
    """(k, m) a basis of the null space of columns (R, m) with few entries each."""
    _, size, right = np.linalg.svd(columns)
    null = right[int(significant(size, off=off).sum()) :].copy()
    for row in range(len(null)):  # reduced echelon form: a pivot of its own for each
        pivot = int(np.abs(null[row]).argmax())
        null[row] /= null[row, pivot]
        others = np.arange(len(null)) != row
        null[others] -= np.outer(null[others, pivot], null[row])
    null = exact_zeros(null, off)
    shorter = True
    while shorter:  # combine two where that leaves fewer entries
        shorter = False
        for i, j in np.ndindex(len(null), len(null)):
            for k in np.flatnonzero((null[i] != 0.0) & (null[j] != 0.0)):
                if i == j:
                    continue
                trial = exact_zeros(null[i] - null[i, k] / null[j, k] * null[j], off)
                if np.count_nonzero(trial) < np.count_nonzero(null[i]):
                    null[i] = trial / np.abs(trial).max()
                    shorter = True
                    break
    return null
