"""The affine fit in closed form: weighted least squares.

A singular value decomposition of centred and scaled regressors, so encoder pulses and
degrees fit equally well. With as many postures as regressors (four for three inputs)
the model fits exactly, no residual is left and no noise can be estimated.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.information.excitation import require_excited

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
    """The fields of an ``AffineCalibration`` but names, units and provenance.

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
    fitted = at_centre + ((commands - centre) / scale) @ slopes
    residuals = measured - fitted

    dof = len(u) - (n + 1)
    squares = share @ residuals[used] ** 2 * total
    residual_std = np.sqrt(squares / dof) if dof else None
    overall = float(np.sqrt(squares.sum() / (m * dof))) if dof else None
    known, noise_dof = noise is not None, 0
    if not known and dof:
        noise = np.full(m, overall) if common_noise else residual_std
        noise_dof = m * dof if common_noise else dof

    weighted_rows = root * np.column_stack([u, np.ones(len(u))])
    scaled = np.append(singular, np.sqrt(total))
    return {
        "matrix": matrix,
        "bias": at_centre - matrix @ centre,
        "residuals": residuals,
        "noise_std": noise,
        "noise_known": known,
        "noise_dof": noise_dof,
        "residual_std": residual_std,
        "residual_std_overall": overall,
        "dof": dof,
        "condition_number": float(np.linalg.cond(weighted_rows)),
        "scaled_condition_number": float(scaled.max() / scaled.min()),
        "num_measurements": len(u),
        "centre": centre,
        "scale": scale,
        "slope_covariance": inverse @ inverse.T,
        "total_weight": total,
    }
