"""What is asked of a plan: the problem of measuring all, the targets and the region."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import levels, numbers, whole_number
from jaxcal.information.blocks import largest_rank
from jaxcal.models.uncertainty import Noise
from jaxcal.selection.criteria import positions
from jaxcal.selection.exchange.exchange import greedy_indices
from jaxcal.selection.problem import Asked, Problem
from jaxcal.selection.problem.sources import shares_regressor

__all__ = ["Request", "fewest", "make_request"]

Array = NDArray[np.float64]


class Request(NamedTuple):
    """What a design is judged by: the errors of m outputs or parameters."""

    problem: Problem  # measuring all that may be, as often as it may
    points: Array  # (R, s, p) whitened rows; a variance of 1 there is accurate enough
    unit: Array  # (m,) or (1,) standard error that is 1 at ``points``, measured unit
    target: Array  # (m,) measured unit
    noise_std: Array | None  # one an output, measured unit; None where Noise says more
    names: tuple[str, ...]  # (m,)


def make_request(
    asked: Asked,
    criterion: str,
    accuracy: ArrayLike,
    noise_std: ArrayLike | None,
    parameters: Any,
    region: ArrayLike | None,
) -> Request:
    """Check the arguments of ``Design.plan``."""
    of_parameters = criterion == "parameters"
    if parameters is not None and not of_parameters:
        raise ValueError("parameters must come with criterion parameters only")
    cap = whole_number("max_replicates", asked.max_replicates, 1)
    total = max(1, int(asked.available.sum()) * cap)
    model, noise = asked.model, asked.noise
    shared = False  # one regressor for all outputs?
    if model is None:
        if not (noise_std is noise is None):
            raise ValueError(
                "noise and noise_std must be left out with blocks, which are in units "
                "of the noise"
            )
    else:
        if noise_std is None:
            if noise is None:
                raise ValueError("noise_std must be given: the design has no noise")
            if noise.covariance is noise.command_std is None:
                std = 1.0 if noise.std is None else noise.std
                noise_std = std if np.ndim(std) < 2 else None
        if noise_std is not None:
            noise_std = levels("noise_std", noise_std, model.num_outputs)
            shared = not of_parameters and shares_regressor(model, asked.prior, None)
            # Where outputs share a regressor the noise is in the targets.
            asked = asked.with_noise(None if shared else Noise(noise_std))
    problem = asked.problem(total, "D")
    rows, names = _region(asked, problem, region, shared)
    if of_parameters:
        at = positions(names if parameters is None else parameters, names)
        rows, names = np.eye(len(names))[None, at], tuple(names[i] for i in at)
    if not len(rows):
        raise ValueError("region must hold at least one row, got none")
    m = model.num_outputs if shared and model is not None else rows.shape[1]
    if not of_parameters:
        names = tuple(f"output {i + 1}" for i in range(m))
    target = levels("accuracy", accuracy, m)
    scale = unit = target
    if noise_std is not None and shared:
        scale = (target / noise_std).min(keepdims=True)
        unit = noise_std * scale
    elif model is None:
        noise_std = np.ones(m)
    points = rows @ problem.basis / scale[:, None]
    if criterion == "I" and len(points) > points.shape[2]:  # fewer rows, the same mean
        root = np.linalg.qr(np.moveaxis(points, 1, 0))[1]
        points = np.moveaxis(root, 0, 1) * np.sqrt(root.shape[1] / len(points))
    return Request(problem, points, unit, target, noise_std, names)


def _region(
    asked: Asked, problem: Problem, region: ArrayLike | None, shared: bool
) -> tuple[Array, tuple[str, ...]]:
    """What is predicted: rows (R, s, p) in the outputs' unit; names of p parameters."""
    names = asked.source(not shared).names
    if asked.model is None:
        if region is None:
            return problem.raw[problem.available], names
        rows = numbers("region", region)
        if rows.ndim != 3 or rows.shape[2] != len(names):
            raise ValueError(
                f"region must have shape (R, m, {len(names)}), got {rows.shape}"
            )
        return rows, names
    assert problem.candidates is not None
    where = problem.candidates[problem.available] if region is None else region
    source = asked.with_noise(None).source(not shared)
    return source.at("region", where, False), names


def fewest(problem: Problem) -> tuple[int, int]:
    """Measurements below which none identify, and the fewest found that do.

    The two differ only where blocks of several rows overlap in what they tell.
    """
    missing = problem.num_regressors - problem.held_rank
    most = largest_rank(problem.blocks)
    least = k = max(1, len(problem.required) - (-missing // most))
    if problem.blocks.shape[1] > 1:
        while k < problem.k and np.isneginf(
            problem.log_det(greedy_indices(dataclasses.replace(problem, k=k)))
        ):
            k += 1
    return least, k
