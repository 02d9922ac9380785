"""From the arguments of ``identify`` to the fit of a model and its covariance."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.calibration.sizes import Sizes, group_sizes, misfit_size, of_sizes
from jaxcal.calibration.solve import (
    Solution,
    Task,
    singular,
    solve,
    student_constants,
    whiten,
)
from jaxcal.checks import one_of, require_kind
from jaxcal.information.singular import exact_zeros, null_directions, significant
from jaxcal.models.identifiability import unknown
from jaxcal.models.model import Model, as_model, derivative
from jaxcal.models.uncertainty import Noise, Prior, ResolvedPrior

__all__ = ["fit_model", "require_fitting"]

Array = NDArray[np.float64]

# Of -2 log likelihood, what misfit must gain where readings of one place do not tell
# how it goes on elsewhere.
_TOLD = 20.0
_MANY = 64  # readings of a measurement from which no matrix of their noise is made


def require_fitting(model: Any, commands: Array, measured: Array) -> Model:
    """The model; refused if it is none, or one of other commands or outputs."""
    model = as_model(model)
    if not len(commands):
        raise ValueError("commands must hold at least one row, got none")
    try:
        shapes = model.num_inputs, model.num_outputs
    except ValueError:  # of a function, not known before its first commands
        model.predict(commands[:1], None)
        shapes = model.num_inputs, model.num_outputs
    for name, table, width in zip(
        ("commands", "measured"), (commands, measured), shapes, strict=True
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
    noise: Noise | None,
    loss: str,
    common_noise: bool | None,
) -> dict[str, Any]:
    """The fields of a ``Calibration`` but names, units and provenance."""
    one_of("loss", loss, ("student", "gaussian"))
    require_kind("prior", prior, Prior)
    rows = np.flatnonzero(weights > 0.0)
    once = np.zeros_like(weights)
    first = rows[model.distinct(commands[rows], measured[rows])]
    once[first] = weights[first]
    weights = once
    used = weights > 0.0
    if not used.any():
        raise ValueError("weights must be positive for one measurement at least")
    noise = noise or Noise()
    known = noise.std is not None or noise.covariance is not None
    white, reading_std = _of_readings(noise, weights, measured.shape[1])
    spread = _of_commands(noise, commands, measured.shape[1])
    outputs = np.arange(measured.shape[1])
    if spread.any() and model.relative:
        raise ValueError(
            "command_std must not be given with a Pose: the orientations are "
            "compared with those of the commands given; raise the std of the noise"
        )
    model = model.prepared(commands[used], measured[used])
    usual, levels = model.default_noise(), outputs
    if usual is not None and not known:
        of_reading = np.broadcast_to(np.asarray(usual.std), outputs.shape)
        white = white / (of_reading if white.ndim == 2 else of_reading[:, None])
        reading_std = reading_std * of_reading
        levels = np.unique(of_reading, return_inverse=True)[1]  # positions and turns
    if common_noise or spread.any():
        levels = 0 * outputs
    elif common_noise is False:
        levels = outputs
    asked = prior is not None
    whole, bent = model, model
    if not (asked or spread.any()):
        bent = model.with_misfit()
        if model.fits_misfit:
            whole = bent
    prior = prior or whole.default_prior()
    resolved = prior.resolve(whole)
    centre, to_centred = _centre(whole, commands, weights, resolved, spread)
    task = Task(
        model=whole,
        commands=commands[used] - (0.0 if centre is None else centre),
        measured=measured[used],
        white=white[used],
        reading_std=reading_std[used],
        mean=to_centred @ resolved.mean,
        precision=np.diagonal(resolved.precision),
        free=resolved.free,
        command_std=spread,
        known=known,
        levels=levels,
        student=loss == "student",
    )
    sizes: Sizes | None = None
    times = 1.0
    if prior.by_data and (asked or not spread.any()):
        if whole.error_groups() is None or spread.any():
            raise ValueError("Prior.sized() is of arms, without command_std")
        found, sizes, scaled = _sized(task)
        if bent is not whole:
            gain, times = misfit_size(bent, task, found, sizes)
            if gain > _TOLD:
                whole = bent
                resolved = bent.default_prior().resolve(bent)
                task = dataclasses.replace(
                    task,
                    model=bent,
                    mean=resolved.mean,
                    precision=np.diagonal(resolved.precision),
                    free=resolved.free,
                )
                found, sizes, scaled = _sized(task)
        task = scaled
    else:
        found = solve(task)
    if common_noise is None and usual is not None and _levels_differ(task, found):
        apart = dataclasses.replace(task, levels=outputs)
        other = solve(apart, found)
        if other.freedom.min() >= 1.0:
            task, found = apart, other
    fields = _fields(task, found, commands, measured, weights, centre)
    if fields["joint_covariance"] is not None:
        within = fields["joint_covariance"].copy()
        if sizes is not None:
            fields["joint_covariance"] += of_sizes(task, found, sizes)
        if bent is not whole:
            fields |= _misfit(bent, task, found, fields, within, times)
    return fields | {"model": model, "loss": loss}


def _sized(task: Task) -> tuple[Solution, Sizes, Task]:
    """The fit with sizes from the readings, these, and the task with them."""
    found, scaled = solve(task, rough=True), task
    sizes: Sizes | None = None
    for last in (False, True):
        sizes = group_sizes(task, found, sizes)
        scaled = dataclasses.replace(task, precision=task.precision / sizes.factors**2)
        found = solve(scaled, found, rough=not last)
    assert sizes is not None
    return found, sizes, scaled


def _centre(
    model: Model, commands: Array, weights: Array, prior: ResolvedPrior, spread: Array
) -> tuple[Array | None, Array]:
    """(n,) what commands are counted from where that changes the parameters alone.

    Far from zero a bias and slopes can hardly be told apart. None where the prior knows
    something of the parameters as they are, or the commands say little. With it (p, p)
    what makes of parameters those from there.
    """
    same = np.eye(len(prior.mean))
    if prior.precision.any() or not prior.free.all() or spread.any():
        return None, same
    used = weights > 0.0
    centre = weights[used] @ commands[used] / weights[used].sum()
    to_centred = model.centred(centre)
    if to_centred is None:
        return None, same
    rows, largest = commands[used], np.abs(commands[used]).max(axis=0)
    flat = len(rows) <= len(centre) or null_directions(rows - centre, largest)
    return (None, same) if flat else (centre, to_centred)


def _of_readings(noise: Noise, weights: Array, q: int) -> tuple[Array, Array]:
    """Whitening (N, q, q) at these weights, and standard deviations (N, q) at 1.

    Of many independent readings the diagonal (N, q).
    """
    if noise.command_std is not None:
        noise = Noise(std=noise.std, covariance=noise.covariance)
    white = noise.whitening(len(weights), q)
    if noise.covariance is None:
        diagonal = white.diagonal(axis1=1, axis2=2)
        std = 1.0 / diagonal
        if q > _MANY:
            return diagonal * np.sqrt(weights)[:, None], std
    else:
        std = np.sqrt((np.linalg.inv(white) ** 2).sum(axis=2))
    return white * np.sqrt(weights)[:, None, None], std


def _of_commands(noise: Noise, commands: Array, q: int) -> Array:
    """(n,) command_std, zero where it is not given."""
    if noise.command_std is None:
        return np.zeros(commands.shape[1])
    spread = noise.of_commands(commands.shape[1])
    if np.isinf(spread).sum() >= q:
        raise ValueError(
            f"command_std must leave fewer unknown commands than the {q} readings of a "
            f"measurement, got {int(np.isinf(spread).sum())}"
        )
    return spread


def _levels_differ(task: Task, found: Solution) -> bool:
    """Whether levels that are shared contradict the residuals (F test, 0.1 %)."""
    q = len(found.freedom)
    if task.known or q == 1 or found.freedom.min() < 1.0 or task.command_std.any():
        return False
    from scipy import special

    white = whiten(task.white, found.residuals[..., None])[..., 0]
    variance = found.weights @ (white / found.level) ** 2 / found.freedom
    high, low = int(variance.argmax()), int(variance.argmin())
    ratio = variance[high] / max(variance[low], np.finfo(np.float64).tiny)
    chance = special.fdtrc(found.freedom[high], found.freedom[low], ratio)
    return bool(chance * q * (q - 1) < 1e-3)


def _misfit(
    bent: Model,
    task: Task,
    found: Solution,
    fields: dict[str, Any],
    within: Array,
    times: float,
) -> dict[str, Any]:
    """The fields with harmonics that were not fitted, but may be there.

    They bend what was fitted and go on where nothing was measured, so predictions err
    by more than the noise explains.

    Args:
        bent: the arm with them.
        task: that was solved.
        found: its solution.
        fields: of it, with the covariance (P, P) that is returned.
        within: (P, P) covariance of the parameters by the noise alone.
        times: their size, of the default prior's.
    """
    count = len(bent.names) - len(task.mean)
    std = times * np.asarray(bent.default_prior().std)[-count:]
    none = np.zeros(count)
    theta = np.concatenate([found.parameters, none])
    waves = derivative(bent, task.commands, theta)[..., -count:]
    level = found.level if task.white.ndim == 2 else found.level[:, None]
    white = whiten(task.white / level, waves * std)
    gram = np.einsum("n,nrf,nrw->fw", _informs(task, found), found.rows, white)
    turned = within[:, task.free] @ gram
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
        "prior_mean": np.concatenate([task.mean, none]),
        "prior_precision": np.concatenate([task.precision, std**-2.0]),
        "free": np.concatenate([fields["free"], none + 1.0]),
    }


def _informs(task: Task, found: Solution) -> Array:
    """(N,) how much each measurement says, one in full."""
    if not task.student:
        return found.weights
    _, mean, efficiency = student_constants(found.left)
    return np.asarray(efficiency * np.minimum(1.0, found.weights / mean))


def _fields(
    task: Task,
    found: Solution,
    commands: Array,
    measured: Array,
    weights: Array,
    centre: Array | None,
) -> dict[str, Any]:
    used = weights > 0.0
    covariance, null = _covariance(task, found)
    freedom = float(found.freedom.sum())
    noise_std: Array | None = found.level * np.sqrt((task.reading_std**2).mean(axis=0))
    noise_dof = 0.0
    if not task.known:
        same = found.level[:, None] == found.level
        noise_dof = float((same @ found.freedom).min())
        if freedom < 1.0 or noise_dof <= 0.0:
            noise_std, noise_dof = None, 0.0
    residuals = np.empty_like(measured)
    residuals[used] = found.residuals
    if not used.all():
        left_out = commands[~used] - (0.0 if centre is None else centre)
        outputs = task.model.predict(left_out, found.parameters)
        residuals[~used] = task.model.wrapped(measured[~used] - outputs, left_out)
    estimate, mean = found.parameters, task.mean
    if centre is not None:
        back = np.asarray(task.model.centred(-centre))
        estimate, mean = back @ estimate, back @ mean
        null = None if null is None else null @ back.T
    estimated = None
    if task.command_std.any():
        estimated = commands.copy()
        estimated[used] = found.commands
    loss_weights, distance = np.zeros((2, len(commands)))
    loss_weights[used], distance[used] = found.weights, found.deleted
    return {
        "estimate": estimate,
        "joint_covariance": None if noise_std is None else covariance,
        "centre": centre,
        "unidentified": null,
        "prior_mean": mean,
        "prior_precision": task.precision,
        "free": task.free.astype(np.float64),
        "commands": commands,
        "estimated_commands": estimated,
        "residuals": residuals,
        "loss_weights": loss_weights,
        "distance": distance,
        "dof": max(freedom, 0.0),
        "square": float(found.distance.sum()),
        "num_readings": float(found.left),
        "noise_std": noise_std,
        "noise_dof": noise_dof,
    }


def _covariance(task: Task, found: Solution) -> tuple[Array, Array | None]:
    """(P, P) of what is determined, and directions (z, P) of what is not.

    Raises:
        ValueError: every reading is used up and parameters are still undetermined.
    """
    size, free = len(task.mean), np.flatnonzero(task.free)
    if found.root is not None:
        covariance = found.root @ found.root.T
        return _among(size, free, covariance), None
    rows = np.sqrt(_informs(task, found))[:, None, None] * found.rows
    rows = rows.reshape(-1, rows.shape[-1])
    rows = np.concatenate([rows, task.model.facts(found.parameters)[1][:, free]])
    precision = task.precision[free]
    scale = np.sqrt((rows**2).sum(axis=0) + precision)
    scale = np.where(scale > 0.0, scale, 1.0)
    whole = np.concatenate([rows, np.diag(np.sqrt(precision))]) / scale
    root, null = [np.zeros((0, len(free)))], [np.zeros((0, len(free)))]
    off = task.model.resolution
    of_rows = 0  # combinations of the parameters that the readings use up
    for columns, of_columns, right in singular(whole):
        known = significant(of_columns, off=off)
        turned = np.zeros((len(columns), len(free)))
        turned[:, columns] = right
        root.append(turned[known] / of_columns[known, None])
        null.append(exact_zeros(turned[~known], off))
        alone = of_columns
        if not known.all():
            of_readings = rows[:, columns] / scale[columns]
            alone = np.asarray(np.linalg.svd(of_readings, compute_uv=False), np.float64)
        of_rows += int(significant(alone, off=off).sum())
    factor, unseen = np.concatenate(root) / scale, np.concatenate(null) / scale
    readings = found.left * len(task.commands)
    if len(unseen) and of_rows >= readings:
        prior = found.parameters, task.precision, task.free
        left = "; ".join(
            each.words for each in unknown(task.model, task.commands, *prior)
        )
        raise ValueError(
            f"measured holds {readings} independent readings, too few for "
            f"{len(free)} free parameters: {len(unseen)} combinations of them "
            f"stay unknown{f' ({left})' if left else ''}; measure more, or give a "
            "prior or fixed parameters"
        )
    directions = np.zeros((len(unseen), size))
    directions[:, free] = unseen
    covariance = _among(size, free, factor.T @ factor)
    return covariance, directions if len(directions) else None


def _among(size: int, free: NDArray[np.intp], covariance: Array) -> Array:
    """(P, P) covariance of all ``size`` parameters, from that of the free ones."""
    if len(free) == size:
        return covariance
    whole = np.zeros((size, size))
    whole[np.ix_(free, free)] = covariance
    return whole
