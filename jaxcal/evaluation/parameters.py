"""A and b identified from the chosen postures, over many episodes at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxcal.checks import Array
from jaxcal.evaluation.dataset import Dataset


def estimate_parameters(dataset: Dataset, indices: NDArray[np.int64]) -> Array | None:
    """Least-squares parameters of every selection; the batched ``jaxcal.identify``.

    Args:
        dataset: candidates and what was measured there.
        indices: (E, R, k) chosen candidates.

    Returns:
        (E, R, m (n + 1)) A row by row, then b; in the unit of ``dataset.ranges`` where
        it has one, else in that of the candidates. None where nothing was measured.
    """
    if dataset.measured is None:
        return None
    commands = dataset.candidates
    if dataset.ranges is not None:
        commands = dataset.ranges.denormalise(commands)
    gather = indices[..., None]
    u = np.take_along_axis(commands[:, None], gather, axis=2)
    y = np.take_along_axis(dataset.measured[:, None], gather, axis=2)
    return least_squares(u, y)


def least_squares(commands: Array, measured: Array) -> Array:
    """(..., m (n + 1)) A row by row, then b, of many sets of postures at once.

    ``commands`` are (..., N, n), N > n and of full rank, ``measured`` (..., N, m).
    """
    mean_u = commands.mean(axis=-2, keepdims=True)
    mean_y = measured.mean(axis=-2, keepdims=True)
    q, r = np.linalg.qr(commands - mean_u)
    slopes = np.linalg.solve(r, np.matrix_transpose(q) @ (measured - mean_y))
    biases = (mean_y - mean_u @ slopes)[..., 0, :]
    matrix = np.matrix_transpose(slopes)
    return np.concatenate([matrix.reshape(*biases.shape[:-1], -1), biases], axis=-1)


def predict(parameters: Array, commands: Array) -> Array:
    """(..., N, m) outputs at (..., N, n) commands: the batched ``Calibration.predict``.

    ``parameters`` are (..., m (n + 1)), as those of ``least_squares``.
    """
    n = commands.shape[-1]
    m = parameters.shape[-1] // (n + 1)
    matrix = parameters[..., : m * n].reshape(*parameters.shape[:-1], m, n)
    return commands @ np.matrix_transpose(matrix) + parameters[..., None, m * n :]
