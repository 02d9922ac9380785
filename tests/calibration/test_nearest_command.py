"""``command_for(clip=True)``: the nearest output within limits, by brute force."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

import jaxcal


def calibrated(matrix, rng):
    commands = rng.uniform(-1.0, 1.0, (12, len(matrix)))
    noise = rng.normal(0.0, 1e-9, (12, len(matrix)))
    return jaxcal.identify(commands, commands @ matrix.T + noise)


def nearest_on_every_face(matrix, wanted):
    """Least distance over the cube [-1, 1]^n: each axis free or at one of its ends."""
    best = np.inf
    n = len(matrix)
    for face in itertools.product([None, -1.0, 1.0], repeat=n):
        free = [i for i in range(n) if face[i] is None]
        u = np.array([0.0 if end is None else end for end in face])
        if free:
            rest = wanted - matrix @ u
            u[free] = np.linalg.lstsq(matrix[:, free], rest, rcond=None)[0]
        if (np.abs(u) <= 1.0 + 1e-9).all():
            best = min(best, float(np.linalg.norm(matrix @ u - wanted)))
    return best


@pytest.mark.filterwarnings("ignore:.*targets (are clipped|(is|are) far outside)")
def test_the_clipped_command_is_not_each_axis_clipped(rng):
    """(1, -1) is 2.88 away, (1, 1) .72."""
    matrix, limits = np.array([[1.0, 0.9], [0.9, 1.0]]), [[-1.0, 1.0]] * 2
    calibration = calibrated(matrix, rng)
    command = calibration.command_for([2.5, 1.5], limits=limits, clip=True)
    np.testing.assert_allclose(command, [1.0, 1.0])
    with pytest.raises(ValueError, match="would have to be"):
        calibration.command_for([2.5, 1.5], limits=limits)


@pytest.mark.filterwarnings("ignore:.*targets (are clipped|(is|are) far outside)")
@pytest.mark.parametrize("n", [2, 3])
def test_the_clipped_command_is_nearest_of_random_maps(n, rng):
    for _ in range(40):
        matrix = rng.normal(size=(n, n))
        calibration, wanted = calibrated(matrix, rng), 3.0 * rng.normal(size=n)
        try:
            command = calibration.command_for(
                wanted, limits=[[-1.0, 1.0]] * n, clip=True
            )
        except ValueError:  # a map next to a singular one
            continue
        away = np.linalg.norm(matrix @ command - wanted)
        assert away == pytest.approx(nearest_on_every_face(matrix, wanted), abs=1e-6)
