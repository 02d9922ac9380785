"""The affine fit in closed form: weighted least squares.

A singular value decomposition of centred and scaled regressors, so encoder pulses and
degrees fit equally well. With as many postures as regressors (four for three inputs)
the model fits exactly, no residual is left and no noise can be estimated. Noise is
independent between postures and between outputs. Source: paper, Equations 2 to 4; Seber
and Lee, Linear Regression Analysis, chapter 3.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.information.singular import require_excited
from jaxcal.models import Affine

__all__ = ["fit_affine"]

Array = NDArray[np.float64]


def fit_affine(
    commands: Array,
    measured: Array,
    weight: Array,
    noise: Array | None,
    common_noise: bool,
    names: tuple[str, ...],
) -> dict[str, Any]:
    """The fields of a ``Calibration`` but names, units and provenance.

    Raises:
        ValueError: the commands leave a direction unexcited, which is named.
    """
    n, m = commands.shape[1], measured.shape[1]
    used = weight > 0.0
    u, y, w = commands[used], measured[used], weight[used]
    require_excited(u, names)

    total = float(w.sum())
    share = w / total
    centre = share @ u
    offset = u - centre
    scale = np.sqrt(share @ offset**2)
    at_centre = share @ y
    root = np.sqrt(w)[:, None]
    left, singular, right = np.linalg.svd(root * (offset / scale), full_matrices=False)
    inverse = right.T / singular
    slopes = inverse @ (left.T @ (root * (y - at_centre)))
    matrix = (slopes / scale[:, None]).T
    residuals = measured - (at_centre + ((commands - centre) / scale) @ slopes)

    free = len(u) - (n + 1)  # residual degrees of freedom of each output
    squares = w @ residuals[used] ** 2
    noise_dof = 0
    if noise is None and free:
        each = squares / free
        noise = np.sqrt(np.full(m, each.mean()) if common_noise else each)
        noise_dof = m * free if common_noise else free

    p = m * (n + 1)
    covariance, square, distance = None, 0.0, np.zeros(len(commands))
    if noise is not None:
        of_slopes = (inverse / scale[:, None]) @ (inverse / scale[:, None]).T
        covariance = np.zeros((p, p))
        covariance[: m * n, : m * n] = np.kron(np.diag(noise**2), of_slopes)
        covariance[m * n :, m * n :] = np.diag(noise**2) / total
        level = np.where(noise > 0.0, noise, 1.0)  # an exact fit may leave none
        square = float((squares / level**2).sum())
        left_out = np.maximum(1.0 - share - (left**2).sum(axis=1), 1e-9)
        off = ((residuals[used] / level) ** 2).sum(axis=1)
        distance[used] = w * off / left_out if free else 0.0
    return {
        "model": Affine(n, m),
        "loss": "gaussian",
        "estimate": np.concatenate([matrix.ravel(), at_centre - matrix @ centre]),
        "joint_covariance": covariance,
        "centre": centre,
        "unidentified": None,
        "prior_mean": np.zeros(p),
        "prior_precision": np.zeros(p),
        "free": np.ones(p),
        "commands": commands,
        "estimated_commands": None,
        "residuals": residuals,
        "loss_weights": used.astype(np.float64),
        "distance": distance,
        "dof": float(m * free),
        "square": square,
        "num_readings": float(m),
        "noise_std": noise,
        "noise_dof": float(noise_dof),
    }
