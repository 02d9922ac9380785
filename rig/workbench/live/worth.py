"""What each posture adds, and how uncertain the slopes are; shown, never a result.

With postures u and rows z = (u, 1) the information about the twelve parameters of
``y = A u + b`` has the log det ``3 log det(Z'Z)``. It grows posture by posture: by
``6 log d`` while one leads out of the flat that those before span, d degrees from it;
by ``3 log(1 + z'(Z'Z)^-1 z)`` from then on. The four first terms and the later ones add
up to the log det of the choice.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rig.core.attitude import Array

NUM_INPUTS = 3
FLAT_DEG = 1e-6  # nearer to the flat than this is in it
FLATS = ("", "from the first", "off the line of two", "off the plane of three")


def reasons(postures: ArrayLike) -> list[str]:
    """Why each of (N, 3) postures, visited in this order: its gain in log det."""
    points = np.asarray(postures, dtype=np.float64).reshape(-1, NUM_INPUTS)
    texts: list[str] = []
    basis = np.empty((0, NUM_INPUTS))  # orthonormal rows that span the flat
    gram = np.zeros((NUM_INPUTS + 1, NUM_INPUTS + 1))  # Z'Z of those before
    for count, (point, row) in enumerate(
        zip(points, np.column_stack([points, np.ones(len(points))]), strict=True)
    ):
        before, gram = gram, gram + np.outer(row, row)
        if count == 0:
            texts.append("the first: nothing to compare with")
            continue
        way = point - points[0]
        off = way - basis.T @ (basis @ way)
        distance = float(np.linalg.norm(off))
        if distance > FLAT_DEG:
            basis = np.vstack([basis, off / distance])
            gain, flat = 6.0 * np.log(distance), len(basis)
            text = f"{distance:.1f}° {FLATS[flat]}: {gain:+.1f} log det"
            if flat == NUM_INPUTS:
                text += "; with it all twelve are known"
            texts.append(text)
            continue
        variance = float(row @ np.linalg.pinv(before, hermitian=True) @ row)
        texts.append(f"{3.0 * np.log1p(variance):+.2f} log det given those before")
    return texts


def ellipsoid(postures: ArrayLike, noise_deg: float) -> tuple[Array, Array]:
    """Standard deviation of a slope of A along each principal direction of commands.

    Returns:
        (3,) in degrees per degree, ``inf`` along directions no posture has measured,
        and (3, 3) the directions, one a column, right-handed.
    """
    points = np.asarray(postures, dtype=np.float64).reshape(-1, NUM_INPUTS)
    if len(points) < 2:
        return np.full(NUM_INPUTS, np.inf), np.eye(NUM_INPUTS)
    off = points - points.mean(axis=0)
    spread, directions = np.linalg.eigh(off.T @ off)
    std = np.full(NUM_INPUTS, np.inf)
    std[spread > FLAT_DEG] = noise_deg / np.sqrt(spread[spread > FLAT_DEG])
    directions[:, 0] *= np.sign(np.linalg.det(directions))
    return std, directions


def prediction_std(
    postures: ArrayLike, candidates: ArrayLike, noise_deg: float
) -> tuple[float, float]:
    """Median and largest standard deviation, in degrees, of the predicted posture.

    Over (M, 3) candidates, and the same on each axis; ``inf`` until four postures that
    lie in no plane are measured.
    """
    points = np.asarray(postures, dtype=np.float64).reshape(-1, NUM_INPUTS)
    rows = np.column_stack([points, np.ones(len(points))])
    if np.linalg.matrix_rank(rows) <= NUM_INPUTS:
        return np.inf, np.inf
    wanted = np.asarray(candidates, dtype=np.float64)
    wanted = np.column_stack([wanted, np.ones(len(wanted))])
    solved = np.linalg.solve(rows.T @ rows, wanted.T)
    std = noise_deg * np.sqrt(np.einsum("ij,ji->i", wanted, solved))
    return float(np.median(std)), float(std.max())
