"""What is asked of a plan: the problem of measuring all, the targets and the region."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import numbers, whole_number
from jaxcal.models.affine import Affine
from jaxcal.models.model import Model
from jaxcal.models.uncertainty import Noise
from jaxcal.selection.greedy import greedy_indices
from jaxcal.selection.problem import Problem, make_block_problem, make_problem
from jaxcal.selection.problem.modelled import Modelled, as_commands, shares_regressor
from jaxcal.selection.problem.wanted import wanted_criterion

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
    candidates: ArrayLike | None,
    blocks: ArrayLike | None,
    criterion: str,
    target_accuracy: ArrayLike,
    noise_std: ArrayLike | None,
    *,
    model: Model | None,
    noise: Noise | None,
    num_outputs: int | None,
    parameters: Sequence[str | int] | None,
    region: ArrayLike | None,
    **rules: Any,
) -> Request:
    """Check the arguments of ``plan``; ``rules`` are those of a problem."""
    of_parameters = criterion == "parameters"
    if parameters is not None and not of_parameters:
        raise ValueError("parameters must come with criterion parameters only")
    given: Any = candidates if blocks is None else blocks
    cap = whole_number("max_replicates", rules["max_replicates"], 1)
    usable = rules["available"]
    usable = np.ones(np.shape(given)[:1]) if usable is None else usable
    rules |= {"max_replicates": cap, "k": max(1, int(np.count_nonzero(usable)) * cap)}
    shared = False  # one regressor for all outputs?
    if blocks is not None:
        if not (candidates is noise_std is noise is model is num_outputs is None):
            raise ValueError(
                "blocks must come without candidates, noise_std, noise, model and "
                "num_outputs: they are in units of the noise"
            )
        problem, rows, names = _of_blocks(blocks, region, rules)
    else:
        if candidates is None or (noise_std is None) == (noise is None):
            raise ValueError(
                "candidates and noise_std must be given, or else blocks; noise, a "
                "jaxcal.Noise, may stand for noise_std"
            )
        if model is None:
            m = num_outputs
            for level in (noise_std, None if of_parameters else target_accuracy):
                if m is None and level is not None and np.ndim(level) == 1:
                    m = np.size(level) or None
            n = (*np.shape(candidates), 1, 1)[1]
            model = Affine(n, n if m is None else m)
        elif num_outputs is not None:
            raise ValueError("num_outputs must not be given with a model, which has it")
        if isinstance(noise, Noise) and noise.covariance is noise.command_std is None:
            std = 1.0 if noise.std is None else noise.std
            noise_std = std if np.ndim(std) < 2 else None
        if noise_std is not None:
            noise_std = _level("noise_std", noise_std, model.num_outputs)
            noise = Noise(noise_std)
            plain = shares_regressor(model, rules["prior"], None)
            shared = plain and not of_parameters
        if shared:
            noise = None  # it is in the targets
        problem, rows, names = _of_model(
            candidates, model, noise, region, shared, rules
        )
    if of_parameters:
        asked = names if parameters is None else parameters
        at = wanted_criterion("As", asked, names, "").positions
        rows, names = np.eye(len(names))[None, at], tuple(names[i] for i in at or ())
    if not len(rows):
        raise ValueError("region must hold at least one row, got none")
    m = model.num_outputs if shared and model is not None else rows.shape[1]
    if not of_parameters:
        names = tuple(f"output {i + 1}" for i in range(m))
    target = _level("target_accuracy", target_accuracy, m)
    scale = unit = target
    if noise_std is not None and shared:
        scale = (target / noise_std).min(keepdims=True)
        unit = noise_std * scale
    elif blocks is not None:
        noise_std = np.ones(m)
    points = rows @ problem.basis / scale[:, None]
    if criterion == "I" and len(points) > points.shape[2]:  # fewer rows, the same mean
        root = np.linalg.qr(np.moveaxis(points, 1, 0))[1]
        points = np.moveaxis(root, 0, 1) * np.sqrt(root.shape[1] / len(points))
    return Request(problem, points, unit, target, noise_std, names)


def _of_blocks(
    blocks: ArrayLike, region: ArrayLike | None, rules: dict[str, Any]
) -> tuple[Problem, Array, tuple[str, ...]]:
    """The problem, the region's rows (R, m, p), and names of the p parameters."""
    problem = make_block_problem(blocks, **rules)
    p = problem.num_regressors
    rows = problem.raw[problem.available]
    if region is not None:
        rows = numbers("region", region)
        if rows.ndim != 3 or rows.shape[2] != p:
            raise ValueError(f"region must have shape (R, m, {p}), got {rows.shape}")
    return problem, rows, tuple(f"theta{i + 1}" for i in range(p))


def _of_model(
    candidates: ArrayLike,
    model: Model,
    noise: Noise | None,
    region: ArrayLike | None,
    shared: bool,
    rules: dict[str, Any],
) -> tuple[Problem, Array, tuple[str, ...]]:
    """Likewise; ``shared``: one row [u, 1] for all outputs of the affine model."""
    problem = make_problem(candidates, model=model, noise=noise, criterion="D", **rules)
    assert problem.candidates is not None
    where = problem.candidates[problem.available] if region is None else region
    if shared and isinstance(model, Affine):
        commands = as_commands("region", where, model.num_inputs)
        return problem, model.blocks(commands), ()
    modelled = Modelled(model, rules["prior"], None)  # in the outputs' unit
    return problem, modelled.blocks_at("region", where, False), modelled.names


def _level(name: str, value: ArrayLike, m: int) -> Array:
    """(m,) positive numbers; a copy that cannot be written to."""
    given = numbers(name, value)
    if given.shape not in ((), (m,)):
        raise ValueError(f"{name} must be one number or ({m},), got {given.shape}")
    if (given <= 0.0).any():
        raise ValueError(f"{name} must be positive, got {given.min():g}")
    own = np.array(np.broadcast_to(given, (m,)))
    own.flags.writeable = False
    return own


def fewest(problem: Problem) -> tuple[int, int]:
    """Measurements below which none identify, and the fewest found that do.

    The two differ only where blocks of several rows overlap in what they tell.
    """
    p = problem.num_regressors
    kept = problem.blocks[problem.required].reshape(-1, p)
    known = np.linalg.matrix_rank(np.vstack([kept, problem.prior]), rtol=1e-9)
    most = int(np.linalg.matrix_rank(problem.blocks, rtol=1e-9).max())
    least = k = max(1, len(problem.required) - (-(p - int(known)) // most))
    if problem.blocks.shape[1] > 1:
        while k < problem.k and np.isneginf(
            problem.log_det(greedy_indices(dataclasses.replace(problem, k=k)))
        ):
            k += 1
    return least, k
