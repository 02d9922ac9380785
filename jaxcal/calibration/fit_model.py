"""From the arguments of ``identify`` to the fit of a model and its covariance."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxcal.calibration.fit_problem import LOSSES, FitProblem, Loss, constants, singular
from jaxcal.calibration.least_squares import FitSolution, solve
from jaxcal.calibration.noise_levels import are_shared, pooled, with_levels_apart
from jaxcal.calibration.prior_scales import (
    PriorScales,
    covariance_of_scales,
    group_scales,
    misfit_scale,
)
from jaxcal.checks import Array, Mask, one_of, require_kind
from jaxcal.information.singular import (
    exact_zeros,
    null_directions,
    require_excited,
    significant,
)
from jaxcal.models.identifiability import unknown
from jaxcal.models.model import Model, as_model
from jaxcal.models.predictions import derivative
from jaxcal.models.uncertainty import (
    Noise,
    Prior,
    command_noise,
    reading_noise,
    with_play,
)

# Of -2 log likelihood, what misfit must gain where readings of one place do not tell
# how it goes on elsewhere.
_DECISIVE = 20.0


def require_fitting(model: Any, commands: Array, measured: Array) -> Model:
    """The model; refused if it is none, or one of other commands or outputs."""
    model = as_model(model)
    if not len(commands):
        raise ValueError("commands must hold at least one row, got none")
    shaped = False
    with contextlib.suppress(ValueError):  # of a function, not before its first run
        shaped = model.num_inputs != commands.shape[1] or model.num_outputs > 0
    if not shaped:
        model.predict(commands, None)
    for name, table, width in (
        ("commands", commands, model.num_inputs),
        ("measured", measured, model.num_outputs),
    ):
        if table.shape[1] != width:
            raise ValueError(
                f"{name} must have shape (N, {width}) for this model, got {table.shape}"
            )
    return model


def fit_model(
    commands: Array,
    measured: Array,
    weights: Array,
    *,
    model: Model,
    prior: Prior | None,
    noise: Noise,
    loss: str,
    common_noise: bool | Sequence[Any] | None,
    excited: tuple[str, ...] = (),
) -> dict[str, Any]:
    """The fields of a ``Calibration`` but names and units. ``excited`` names commands
    that must vary in every direction."""
    one_of("loss", loss, tuple(LOSSES))
    require_kind("prior", prior, Prior)
    if not weights.any():
        raise ValueError("weights must be positive for at least one measurement")
    used: slice | Mask = slice(None) if weights.all() else weights > 0.0
    once = model.fitting.distinct(commands[used], measured[used])
    if len(once) < len(weights):  # what is written twice counts once
        rows = np.flatnonzero(weights)[once]
        weights, given = np.zeros_like(weights), weights
        weights[rows] = given[rows]
        used = weights > 0.0
    spread = command_noise(noise, commands, measured.shape[1])
    exact = not spread.any()
    model = model.fitting.prepared(commands[used], measured[used])
    if not exact and model.fitting.error_groups() is not None:
        noise, exact = with_play(model, noise, commands, spread), True
        spread = np.zeros_like(spread)
    with_misfit = model.fitting.misfit_model() if prior is None and exact else model
    fits_misfit = with_misfit is not model and model.fitting.fits_misfit
    fitted = with_misfit if fits_misfit else model
    scaled = prior is not None or exact  # as far as the prior wants it
    stated = prior is not None and not prior.by_data
    prior = prior or fitted.default_prior()
    observations = _Observations(commands, measured, weights, used, spread)
    problem, centre = _problem(
        observations, fitted, prior, noise, LOSSES[loss], common_noise, excited
    )
    scales, misfit_factor, shared = None, 1.0, ""
    if prior.by_data and scaled:
        if fitted.fitting.error_groups() is None or not exact:
            raise ValueError("Prior.sized() needs an arm, without command_std")
        solution, scales, misfit_factor = _solve_with_misfit(problem, with_misfit)
    elif common_noise is None and are_shared(problem):
        solution, shared = pooled(problem)
    else:
        solution = solve(problem)
    if common_noise is None and model.default_noise() is not None:
        solution = with_levels_apart(solution)
    fields = _fields(solution, observations, centre)
    by_noise = fields["joint_covariance"]
    if by_noise is not None:  # count what was estimated besides: scales and misfit
        if scales is not None:
            added = covariance_of_scales(solution, scales)
            fields["joint_covariance"] = by_noise + added
        if with_misfit is not solution.problem.model:
            fields |= _misfit(with_misfit, solution, fields, by_noise, misfit_factor)
    origin = {"noise_levels": shared} if shared else {}
    if stated:
        origin["prior"] = "stated"
    return fields | {"model": model, "loss": loss, "provenance": origin}


class _Observations(NamedTuple):
    commands: Array  # (N, n)
    measured: Array  # (N, q)
    weights: Array  # (N,)
    used: slice | Mask  # those of the fit; a slice: all
    command_std: Array  # (N, n)


def _problem(
    observations: _Observations,
    model: Model,
    prior: Prior,
    noise: Noise,
    loss: Loss | None,
    common_noise: bool | Sequence[Any] | None,
    excited: tuple[str, ...],
) -> tuple[FitProblem, Array | None]:
    """The problem of the ``used`` measurements, and (n,) what its commands are counted
    from, None: from zero."""
    commands, measured, weights, used, command_std = observations
    exact, resolved = not command_std.any(), prior.resolve(model)
    centre, to_centred = None, None
    if exact and resolved.free.all() and not resolved.precisions.any():
        centre, to_centred = _centre(model, commands[used], weights[used], excited)
    white, reading_std, levels = reading_noise(model, noise, weights, measured.shape[1])
    if not (common_noise is None or isinstance(common_noise, bool)):
        levels = np.unique(np.asarray(common_noise), return_inverse=True)[1]
    elif common_noise or not exact:
        levels = 0 * levels
    elif common_noise is False:
        levels = np.arange(len(levels))
    counted = commands[used] - (0.0 if centre is None else centre)
    mean = resolved.mean if to_centred is None else to_centred @ resolved.mean
    problem = FitProblem(
        model=model,
        commands=counted,
        measured=measured[used],
        white=white[used],
        reading_std=reading_std[used],
        mean=mean,
        precision=resolved.precisions,
        free=resolved.free,
        command_std=command_std[used],
        noise_known=noise.std is not None or noise.covariance is not None,
        levels=levels,
        loss=loss,
        first_log_size=model.fitting.log_size(counted, mean),
    )
    return problem, centre


def _solve_with_misfit(
    problem: FitProblem, with_misfit: Model
) -> tuple[FitSolution, PriorScales, float]:
    """The fit with scales of its prior by the readings, misfit fitted too where these
    tell it, and its factor."""
    solution, scales = _solve_with_scales(problem)
    if with_misfit is problem.model:
        return solution, scales, 1.0
    gain, factor = misfit_scale(with_misfit, problem, solution, scales)
    if gain <= _DECISIVE:
        return solution, scales, factor
    resolved = with_misfit.default_prior().resolve(with_misfit)
    problem = dataclasses.replace(
        problem,
        model=with_misfit,
        mean=resolved.mean,
        precision=resolved.precisions,
        free=resolved.free,
    )
    return *_solve_with_scales(problem), factor


def _solve_with_scales(problem: FitProblem) -> tuple[FitSolution, PriorScales]:
    solution = solve(problem, rough=True)
    scales: PriorScales | None = None
    for last in (False, True):
        scales = group_scales(problem, solution, scales)
        precision = problem.precision / scales.factors**2
        scaled = dataclasses.replace(problem, precision=precision)
        solution = solve(scaled, solution, rough=not last)
    assert scales is not None
    return solution, scales


def _centre(
    model: Model, commands: Array, weights: Array, excited: tuple[str, ...]
) -> tuple[Array | None, Array | None]:
    """(n,) what commands are counted from, as a bias and slopes far from zero can
    hardly be told apart, and (p, p) what makes of parameters those from there. None
    where that changes more than these, or commands say little (``excited``: refused).
    """
    centre = weights @ commands / weights.sum()
    to_centred = model.fitting.centred(centre)
    if to_centred is None:
        return None, None
    if len(commands) <= len(centre) or null_directions(
        commands - centre, np.abs(commands).max(axis=0)
    ):
        if excited:
            require_excited(commands, excited)
        return None, None
    return centre, to_centred


def _misfit(
    with_misfit: Model,
    solution: FitSolution,
    fields: dict[str, Any],
    within: Array,
    times: float,
) -> dict[str, Any]:
    """The fields with harmonics that were not fitted, but may be there, and bend what
    was fitted: ``times`` as large as by default; ``within`` (P, P) is the covariance by
    the noise alone."""
    problem = solution.problem
    count = len(with_misfit.names) - len(problem.mean)
    std = times * np.asarray(with_misfit.default_prior().std)[-count:]
    none = np.zeros(count)
    theta = np.concatenate([solution.parameters, none])
    waves = derivative(with_misfit, problem.commands, theta)[..., -count:]
    white = solution.whitened(waves * std) / solution.level[:, None]
    shares = _information_shares(solution)
    gram = np.einsum("n,nrf,nrw->fw", shares, solution.rows, white)
    turned = within[:, problem.free] @ gram
    joint = np.zeros((len(theta), len(theta)))
    joint[:-count, :-count] = fields["joint_covariance"] + turned @ turned.T
    joint[:-count, -count:] = -turned * std
    joint[-count:, :-count] = joint[:-count, -count:].T
    joint[-count:, -count:] = np.diag(std**2)
    null = fields["unidentified"]
    return {
        "estimate": theta,
        "joint_covariance": joint,
        "unidentified": null if null is None else np.pad(null, ((0, 0), (0, count))),
        "prior_mean": np.concatenate([problem.mean, none]),
        "prior_precision": np.concatenate([problem.precision, std**-2.0]),
        "free": np.concatenate([fields["free"], none + 1.0]),
    }


def _information_shares(solution: FitSolution) -> Array:
    """(N,) how much each measurement says, one in full."""
    if solution.problem.loss is None:
        return solution.weights
    _, mean, efficiency = constants(solution.problem.loss, solution.num_readings)
    return np.asarray(efficiency * np.minimum(1.0, solution.weights / mean))


def _fields(
    solution: FitSolution, observations: _Observations, centre: Array | None
) -> dict[str, Any]:
    problem = solution.problem
    commands, used = observations.commands, observations.used
    covariance, null = _covariance(solution)
    noise_std, noise_dof = _noise_level(solution)
    estimate, mean = solution.parameters, problem.mean
    if centre is not None:
        back = np.asarray(problem.model.fitting.centred(-centre))
        estimate, mean = back @ estimate, back @ mean
        null = None if null is None else null @ back.T
    estimated = None
    if problem.command_std.any():
        estimated = commands.copy()
        estimated[used] = solution.commands
    residuals = solution.residuals
    if not isinstance(used, slice):  # of those that were left out of the fit, too
        others = commands[~used] - (0.0 if centre is None else centre)
        off = observations.measured[~used]
        off = off - problem.model.predict(others, solution.parameters)
        residuals = np.empty_like(observations.measured)
        residuals[used] = solution.residuals
        residuals[~used] = problem.model.fitting.wrapped(off, others)
    loss_weights, distance = np.zeros((2, len(commands)))
    loss_weights[used], distance[used] = solution.weights, solution.deleted
    return {
        "estimate": estimate,
        "joint_covariance": None if noise_std is None else covariance,
        "centre": centre,
        "unidentified": null,
        "prior_mean": mean,
        "prior_precision": problem.precision,
        "free": problem.free.astype(np.float64),
        "commands": commands,
        "estimated_commands": estimated,
        "residuals": residuals,
        "loss_weights": loss_weights,
        "distance": distance,
        "dof": max(float(solution.freedom.sum()), 0.0),
        "square": float(solution.distance.sum()),
        "num_readings": float(solution.num_readings),
        "noise_std": noise_std,
        "noise_dof": noise_dof,
    }


def _noise_level(solution: FitSolution) -> tuple[Array | None, float]:
    """(q,) noise of a reading of weight 1, None where nothing tells, and its degrees of
    freedom, 0 where it was given."""
    reading_std = solution.problem.reading_std
    mean_square = (reading_std**2).sum(axis=0) / len(reading_std)
    std = solution.level * np.sqrt(mean_square)
    if solution.problem.noise_known:
        return std, 0.0
    same = solution.level[:, None] == solution.level
    freedom = float((same @ solution.freedom).min())
    if solution.freedom.sum() < 1.0 or freedom <= 0.0:
        return None, 0.0
    return std, freedom


def _covariance(solution: FitSolution) -> tuple[Array, Array | None]:
    """(P, P) of what is determined, and directions (z, P) of what is not."""
    problem = solution.problem
    size, free = len(problem.mean), np.flatnonzero(problem.free)
    covariance = np.zeros((size, size))
    if solution.root is not None:
        covariance[free[:, None], free] = solution.root @ solution.root.T
        return covariance, None
    root_shares = np.sqrt(_information_shares(solution))
    rows = (root_shares[:, None, None] * solution.rows).reshape(-1, len(free))
    rows = np.concatenate([rows, solution.fact_rows[:, free]])
    precision = problem.precision[free]
    scale = np.sqrt((rows**2).sum(axis=0) + precision)
    scale = np.where(scale > 0.0, scale, 1.0)
    whole = np.concatenate([rows, np.diag(np.sqrt(precision))]) / scale
    root, null = [np.zeros((0, len(free)))], [np.zeros((0, len(free)))]
    off = problem.model.fitting.resolution
    of_rows = 0  # combinations of the parameters that the readings use up
    for columns, of_columns, right in singular(whole):
        determined = significant(of_columns, off=off)
        turned = np.zeros((len(columns), len(free)))
        turned[:, columns] = right
        root.append(turned[determined] / of_columns[determined, None])
        null.append(exact_zeros(turned[~determined], off))
        alone = of_columns
        if not determined.all():
            of_readings = rows[:, columns] / scale[columns]
            alone = np.asarray(np.linalg.svd(of_readings, compute_uv=False), np.float64)
        of_rows += int(significant(alone, off=off).sum())
    factor, unseen = np.concatenate(root) / scale, np.concatenate(null) / scale
    if len(unseen):
        _require_readings(solution, of_rows, len(unseen))
    directions = np.zeros((len(unseen), size))
    directions[:, free] = unseen
    covariance[free[:, None], free] = factor.T @ factor
    return covariance, directions if len(directions) else None


def _require_readings(solution: FitSolution, used: int, undetermined: int) -> None:
    """Refuse readings of which all are ``used`` up, with parameters undetermined."""
    problem = solution.problem
    readings = solution.num_readings * len(problem.commands)
    if used < readings:
        return
    prior = solution.parameters, problem.precision, problem.free
    directions = unknown(problem.model, problem.commands, *prior)
    words = "; ".join(direction.words for direction in directions)
    raise ValueError(
        f"measured has {readings} independent readings, too few for "
        f"{int(problem.free.sum())} free parameters: {undetermined} combinations of "
        f"them stay unknown{f' ({words})' if words else ''}. Measure more, or give a "
        "prior or fixed parameters"
    )


def fitted_again(
    fit: Any, model: Any, prior: Prior | None, rows: Mask | None = None
) -> Any:
    """A calibration by another model of the machine and a prior, None: as of
    ``identify``; of the same readings, or of some ``rows`` (N,) of them."""
    used = fit.loss_weights > 0.0
    fields = fit_model(
        fit.commands,
        fit.measured,
        (used if rows is None else used & rows).astype(np.float64),
        model=model,
        prior=prior,
        noise=Noise(std=fit.noise_std if fit.noise_known else None),
        loss=fit.loss,
        common_noise=None,
    )
    ours = ("prior", "noise_levels")
    origin = {k: v for k, v in fit.provenance.items() if k not in ours}
    fields["provenance"] = origin | fields["provenance"]
    return dataclasses.replace(fit, **fields)
