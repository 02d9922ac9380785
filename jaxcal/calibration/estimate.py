"""From the arguments of ``identify`` to the fit of a model and its covariance."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.calibration.sizes import Sizes, group_sizes, of_sizes
from jaxcal.calibration.solve import Solution, Task, solve, student_constants
from jaxcal.checks import array_of, in_words, one_of, require_kind
from jaxcal.information.blocks import triangle
from jaxcal.information.singular import exact_zeros, significant
from jaxcal.models import (
    Model,
    Noise,
    Pose,
    Position,
    Prior,
    SerialChain,
    Socket,
)
from jaxcal.models.identifiability import unknown
from jaxcal.models.model import derivative, facts, require_model

__all__ = ["fit_model", "require_fitting"]

Array = NDArray[np.float64]

_NOMINAL = 0.1  # of its length: no arm is so far off, tip included, before it is fitted
_APART = 0.2  # of it: what two sockets may seem to be off their distance
_OTHER_UNIT = 0.01  # of it: so far off and tenfold, a distance is in another unit


def require_fitting(model: Any, commands: Array, measured: Array) -> None:
    """Refuse what is no model, and a model of other commands or outputs."""
    require_model(model)
    if not len(commands):
        raise ValueError("commands must hold at least one row, got none")
    model.predict(commands, None)  # tells some models their number of inputs
    rule = " for this model"
    array_of("commands", commands, "N", model.num_inputs, rule=rule)
    array_of("measured", measured, "N", model.num_outputs, rule=rule)


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
    contacts = isinstance(model, SerialChain) and model.sensor.zeros
    if contacts and not measured.any():  # one that is written twice counts once
        once, rows = np.zeros_like(weights), np.flatnonzero(weights > 0.0)
        first = rows[np.unique(commands[rows], axis=0, return_index=True)[1]]
        once[first] = weights[first]
        weights = once
    used = weights > 0.0
    if not used.any():
        raise ValueError("weights must be positive for one measurement at least")
    white, known, spread = _noise_of(noise, weights, commands, measured.shape[1])
    each = np.arange(measured.shape[1])
    levels = 0 * each
    if isinstance(model, SerialChain):
        if spread.any() and isinstance(model.sensor, Pose):
            raise ValueError(
                "command_std must not be given with a Pose: the orientations are "
                "compared with those of the commands given; raise the std of the noise"
            )
        for part in model.of_each_sensor(commands[used], measured[used]):
            _require_unit(*part)
        model.require_postures(commands[used])
        model = model.located(commands[used], measured[used])
        for part in model.of_each_sensor(commands[used], measured[used]):
            _require_sockets(*part)
        if not known:
            usual = np.asarray(model.default_noise().std)
            white = white / usual[:, None]
            levels = np.unique(usual, return_inverse=True)[1]  # positions and turns
    if common_noise is not None or spread.any():
        levels = each if common_noise is False else 0 * each
    asked = prior is not None
    whole, bent = model, model
    if isinstance(model, SerialChain) and not (asked or spread.any()):
        bent = model.with_misfit()
        # Of a URDF file what is written back is what is predicted, without harmonics.
        if model.sensor.misfit and model.source is None:
            whole = bent
    prior = prior or whole.default_prior()
    resolved = prior.resolve(whole)
    task = Task(
        model=whole,
        commands=commands[used],
        measured=measured[used],
        white=white[used],
        mean=resolved.mean,
        precision=np.diagonal(resolved.precision),
        free=resolved.free,
        command_std=spread,
        known=known,
        levels=levels,
        student=loss == "student",
    )
    sizes: Sizes | None = None
    if prior.by_data and (asked or not spread.any()):
        if not isinstance(model, SerialChain) or spread.any():
            raise ValueError("Prior.sized() is of arms, without command_std")
        found, stated = solve(task, rough=True), task
        for last in (False, True):
            sizes = group_sizes(model, stated, found, sizes)
            scaled = stated.precision / sizes.factors**2
            task = dataclasses.replace(task, precision=scaled)
            found = solve(task, found, rough=not last)
    else:
        found = solve(task)
    if common_noise is None and _levels_differ(task, found):
        apart = dataclasses.replace(task, levels=each)
        other = solve(apart, found)
        if other.freedom.min() >= 1.0:
            task, found = apart, other
    fields = _fields(task, found, commands, measured, weights)
    if fields["joint_covariance"] is not None:
        within = fields["joint_covariance"].copy()
        if sizes is not None:
            fields["joint_covariance"] += of_sizes(task, found, sizes)
        if isinstance(bent, SerialChain) and bent is not whole:
            fields |= _misfit(bent, task, found, fields, within)
    return fields | {"model": model, "loss": loss}


def _require_unit(model: SerialChain, commands: Array, measured: Array) -> None:
    """Refuse millimetres for metres, radians for degrees: an arm is not off tenfold."""
    if not isinstance(model.sensor, Position | Pose):
        return
    spread = []
    for points in (measured[:, :3], model.predict(commands)[:, :3]):
        apart = np.linalg.norm(points - np.median(points, axis=0), axis=1)
        spread.append(float(np.median(apart)))
    if max(spread) > max(10.0 * min(spread), 0.01 * model.length):
        raise ValueError(
            "measured must be in the unit of the model's lengths and commands in "
            f"degrees: measured positions spread over {spread[0]:g}, those predicted "
            f"over {spread[1]:g}"
        )


def _require_sockets(arm: SerialChain, commands: Array, measured: Array) -> None:
    """Refuse contacts that no arm near the nominal one can have made."""
    if not isinstance(arm.sensor, Socket):
        return
    which = arm.sensor.of_rows(commands[:, arm.num_joints :])
    joints = commands[:, : arm.num_joints]
    _, first, groups = np.unique(joints, axis=0, return_index=True, return_inverse=True)
    for row in np.flatnonzero(which != which[first][groups.ravel()])[:1]:
        raise ValueError(
            f"a posture must have the ball in one socket, but row {row} is row "
            f"{first[groups.ravel()[row]]} with another socket: rows of the other file?"
        )
    if measured.any():  # offsets that were measured, as in a simulation, are of any tip
        return
    points = arm.calibrated(arm.nominal).predict(joints)
    most, middles = _NOMINAL * arm.length, {}
    for i in np.unique(which):
        rows = np.flatnonzero(which == i)
        middles[i] = np.median(points[rows], axis=0)
        far = np.linalg.norm(points[rows] - middles[i], axis=1)
        if len(rows) > 2 and np.median(far) > most:
            raise ValueError(
                f"contacts of socket {i} must be at one point within {most:.2g}, but "
                f"the arm as described scatters by {np.median(far):.2g} there: a wrong "
                "tip, unit, sign or order of columns, or rows of another place?"
            )
        lost = rows[far > most + 4.0 * np.median(far)]
        if lost.size:
            raise ValueError(
                f"contacts of socket {i} must be at one point within {most:.2g}, but "
                f"rows {in_words(lost)} are {far.max():.2g} from the others there: "
                "rows of another place?"
            )
    for one, other, distance, _ in arm.sensor.distances:
        missing = {int(one), int(other)} - set(middles)
        if missing:
            raise ValueError(
                f"commands must have contacts of socket {missing.pop()}, whose "
                "distance from another is given"
            )
        found = float(np.linalg.norm(middles[int(one)] - middles[int(other)]))
        off = abs(found - distance) / arm.length
        unit = off > _OTHER_UNIT and not 0.1 < found / distance < 10.0
        if off > _APART or unit:
            raise ValueError(
                f"sockets {int(one)} and {int(other)} must be {distance:g} apart, but "
                f"the arm as described puts them {found:.3g} apart: rows of another "
                "place or another unit?"
            )


def _noise_of(
    noise: Noise | None, weights: Array, commands: Array, q: int
) -> tuple[Array, bool, Array]:
    """Whitening (N, q, q), whether its level is known, and command_std (n,)."""
    noise = noise or Noise()
    readings = Noise(std=noise.std, covariance=noise.covariance)
    white = readings.whitening(len(commands), q) * np.sqrt(weights)[:, None, None]
    spread = noise.of_commands(commands.shape[1])
    if np.isinf(spread).sum() >= q:
        raise ValueError(
            f"command_std must leave fewer unknown commands than the {q} readings of a "
            f"measurement, got {int(np.isinf(spread).sum())}"
        )
    return white, noise.std is not None or noise.covariance is not None, spread


def _levels_differ(task: Task, found: Solution) -> bool:
    """Whether levels that are shared contradict the residuals (F test, 0.1 %)."""
    q = len(found.freedom)
    if task.known or q == 1 or found.freedom.min() < 1.0 or task.command_std.any():
        return False
    from scipy import special

    white = (task.white @ found.residuals[..., None])[..., 0]
    variance = found.weights @ (white / found.level) ** 2 / found.freedom
    high, low = int(variance.argmax()), int(variance.argmin())
    ratio = variance[high] / max(variance[low], np.finfo(np.float64).tiny)
    chance = special.fdtrc(found.freedom[high], found.freedom[low], ratio)
    return bool(chance * q * (q - 1) < 1e-3)


def _misfit(
    bent: SerialChain,
    task: Task,
    found: Solution,
    fields: dict[str, Any],
    within: Array,
) -> dict[str, Any]:
    """The fields with harmonics that were not fitted, but may be there.

    They bend what was fitted and go on where nothing was measured, so predictions err
    by more than the noise explains. Their size is the default prior's times the
    scatter of the readings over the sensor's usual noise.

    Args:
        bent: the arm with them.
        task: that was solved.
        found: its solution.
        fields: of it, with the covariance (P, P) that is returned.
        within: (P, P) covariance of the parameters by the noise alone.
    """
    count = bent.waves.size
    usual = np.asarray(bent.default_noise().std)
    times = np.sqrt(np.mean((fields["noise_std"] / usual) ** 2))
    std = times * np.asarray(bent.default_prior().std)[-count:]
    none = np.zeros(count)
    theta = np.concatenate([found.parameters, none])
    waves = derivative(bent, task.commands, theta)[..., -count:]
    white = task.white / found.level[:, None] @ (waves * std)
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
) -> dict[str, Any]:
    used = weights > 0.0
    rows = np.sqrt(_informs(task, found))[:, None, None] * found.rows
    rows = rows.reshape(-1, rows.shape[-1])
    known = facts(task.model, found.parameters)[1][:, task.free]
    rows = np.concatenate([rows, known])
    covariance, null = _covariance(task, found, rows)
    freedom = float(found.freedom.sum())
    noise_std: Array | None = _noise(task, found, weights[used])
    noise_dof = 0.0
    if not task.known:
        shared = np.unique(found.level, return_inverse=True)[1]
        noise_dof = float(np.bincount(shared, found.freedom).min())
        if freedom < 1.0 or noise_dof <= 0.0:
            noise_std, noise_dof = None, 0.0
    residuals = measured - task.model.predict(commands, found.parameters)
    residuals[used] = found.residuals
    estimated = None
    if task.command_std.any():
        estimated = commands.copy()
        estimated[used] = found.commands
    loss_weights, distance = np.zeros((2, len(commands)))
    loss_weights[used], distance[used] = found.weights, found.deleted
    return {
        "estimate": found.parameters,
        "joint_covariance": None if noise_std is None else covariance,
        "centre": None,
        "unidentified": null,
        "prior_mean": task.mean,
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


def _noise(task: Task, found: Solution, weights: Array) -> Array:
    """(q,) of a reading of weight 1; root mean square where they were given apart."""
    inverse = np.linalg.inv(task.white) * np.sqrt(weights)[:, None, None]
    each = inverse @ np.matrix_transpose(inverse)
    std = np.sqrt(np.diagonal(each, axis1=1, axis2=2).mean(axis=0))
    return np.asarray(std * found.level)


def _covariance(task: Task, found: Solution, rows: Array) -> tuple[Array, Array | None]:
    """(P, P) of what is determined, and directions (z, P) of what is not.

    Raises:
        ValueError: every reading is used up and parameters are still undetermined.
    """
    size, free = len(task.mean), np.flatnonzero(task.free)
    precision = task.precision[free]
    scale = np.sqrt((rows**2).sum(axis=0) + precision)
    scale = np.where(scale > 0.0, scale, 1.0)
    whole = np.concatenate([rows, np.diag(np.sqrt(precision))]) / scale
    _, singular, right = np.linalg.svd(triangle(whole))
    known = significant(singular)
    readings = found.left * len(task.commands)
    of_rows = 0
    if not known.all():
        of_rows = significant(np.linalg.svd(rows / scale, compute_uv=False)).sum()
    if of_rows >= readings:
        prior = found.parameters, task.precision, task.free
        left = "; ".join(
            each.words for each in unknown(task.model, task.commands, *prior)
        )
        raise ValueError(
            f"measured holds {readings} independent readings, too few for "
            f"{len(free)} free parameters: {int((~known).sum())} combinations of them "
            f"stay unknown{f' ({left})' if left else ''}; measure more, or give a "
            "prior or fixed parameters"
        )
    root = right[known] / singular[known, None] / scale
    covariance = np.zeros((size, size))
    covariance[np.ix_(free, free)] = root.T @ root
    null = np.zeros((int((~known).sum()), size))
    null[:, free] = exact_zeros(right[~known]) / scale
    return covariance, null if len(null) else None
