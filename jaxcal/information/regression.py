"""The calibration model ``y = A u + b`` as a linear regression.

The m outputs of a command ``u`` share the regressor ``z = [u, 1]``, so the regression
matrix is a Kronecker product and all follows from ``Z`` of stacked regressors:

    S = A.T @ A  ~  I_m (x) (Z.T @ Z)      log det S = m log det(Z.T @ Z)

Leading axes (``...``) are batches. Source: paper, Equations 2, 9 and the D-criterion.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.checks import Array, numbers, require_finite, whole_number
from jaxcal.information.blocks import rank_of_blocks


def _as_commands(commands: ArrayLike) -> Array:
    """(..., N, n) finite float64, or a ValueError that says what is wrong."""
    array = numbers("commands", commands, finite=False)
    if array.ndim < 2 or array.shape[-1] < 1 or array.shape[-2] < 1:
        raise ValueError(
            "commands must have shape (..., N, n) with N >= 1 and n >= 1, "
            f"got {array.shape}"
        )
    require_finite("commands", array)
    return array


def regressors(commands: ArrayLike) -> Array:
    """Regressors ``Z = [commands, 1]`` (..., N, n + 1) of commands (..., N, n)."""
    commands = _as_commands(commands)
    *batch, n = commands.shape
    rows = np.empty((*batch, n + 1))
    rows[..., :n], rows[..., n] = commands, 1.0
    return rows


def regression_matrix(commands: ArrayLike, num_outputs: int | None = None) -> Array:
    """Regression matrix of the stacked measurements ``[y_1; y_2; ...; y_N]``.

    (..., m N, m (n + 1)) of commands (..., N, n), m as many as inputs by default.
    Columns are A row by row, then the biases, ``[a11 a12 a13 a21 ... a33 | bx by bz]``
    (Equation 9); rows the outputs of posture 1, then of posture 2, ... (Equation 2).
    """
    commands = _as_commands(commands)
    *batch, num_postures, num_inputs = commands.shape
    m = num_inputs if num_outputs is None else num_outputs
    whole_number("num_outputs", m, 1)
    rows, output = np.zeros((*batch, num_postures, m, m * (num_inputs + 1))), range(m)
    for i in output:
        rows[..., i, i * num_inputs : (i + 1) * num_inputs] = commands
    rows[..., output, m * num_inputs + np.arange(m)] = 1.0
    return rows.reshape(*batch, num_postures * m, m * (num_inputs + 1))


def log_det_gram(commands: ArrayLike) -> Array:
    """(...,) log det of ``Z.T @ Z`` of commands (..., N, n); ``-inf`` where singular.

    ``det(Z.T Z) = N det(C.T C)`` with C the commands less their mean, which keeps every
    digit when the commands lie far from zero (encoder pulses, say).
    """
    z = regressors(commands)
    *batch, count, p = z.shape
    sets = z.reshape(-1, count, 1, p)
    return rank_of_blocks(sets, np.zeros((0, p)))[1].reshape(batch)


def log_det_information(
    commands: ArrayLike, num_outputs: int | None = None
) -> float | Array:
    """Natural log det of the information matrix ``S``, ``m log det(Z.T @ Z)``, of
    commands (..., N, n): a float, or (...,) for batches; ``-inf`` where singular. m is
    ``num_outputs``, as many as inputs when not given."""
    commands = _as_commands(commands)
    m = commands.shape[-1] if num_outputs is None else num_outputs
    value = m * log_det_gram(commands)
    return float(value) if value.ndim == 0 else value
