"""Checks of what describes an arm."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from jaxcal.arms.arm import Load
from jaxcal.arms.sensors import SENSORS, Position, Sensor
from jaxcal.checks import Array, array_of, in_words, numbers, one_of, whole_number
from jaxcal.tables import limits_of_frame


def rows_of(table: ArrayLike) -> Array:
    """(n, 5) a, alpha, d, theta, beta of a DH table (n, 4) or (n, 5), in degrees."""
    rows = numbers("table", table)
    if rows.ndim != 2 or rows.shape[1] not in (4, 5) or not len(rows):
        raise ValueError(
            "table must have shape (n, 4), rows (a, alpha, d, theta), or (n, 5) "
            f"with beta, got {rows.shape}"
        )
    alpha = rows[rows[:, 1] != 0.0, 1]
    right = np.isclose(np.abs(alpha), np.pi / 2, atol=2e-3)
    if alpha.size and (right | np.isclose(np.abs(alpha), np.pi, atol=2e-3)).all():
        raise ValueError(
            f"alpha of table must be in degrees, got {in_words(alpha)}, which look "
            "like right angles in radians"
        )
    return np.column_stack([rows, np.zeros((len(rows), 5 - rows.shape[1]))])


def joint_kinds(joints: str | None, n: int) -> str:
    """n letters R or P; all R for None."""
    kinds = "R" * n if joints is None else joints
    if len(kinds) != n or set(kinds) - set("RP"):
        raise ValueError(
            f"joints must be {n} letters R (revolute) or P (prismatic), got {kinds!r}"
        )
    return kinds


def sensor_of(sensor: Sensor | Mapping[str, Any] | None) -> Sensor:
    """A sensor, that of its ``to_dict()``, or ``Position()`` for None."""
    if sensor is None:
        return Position()
    if isinstance(sensor, Mapping):
        kind = one_of("kind of the sensor", sensor.get("kind"), tuple(SENSORS))
        sensor = SENSORS[kind].from_dict(sensor)
    if not isinstance(sensor, Sensor):
        raise ValueError(
            f"sensor must be of jaxcal.models, such as Position(), got {sensor!r}"
        )
    return sensor


def limits_of(pairs: ArrayLike | None, columns: int) -> Array:
    """(J, 2) least and greatest; None of a pair is not known."""
    open_ended = np.tile([-np.inf, np.inf], (columns, 1))
    if pairs is None:
        return open_ended
    pairs = limits_of_frame(pairs, ())
    limits = array_of("limits", pairs, columns, 2, finite=False)  # None becomes NaN
    limits = np.where(np.isnan(limits), open_ended, limits)
    bad = np.flatnonzero(limits[:, 0] > limits[:, 1])
    if bad.size:
        raise ValueError(
            f"limits must be LOW, HIGH of each command, got {in_words(limits[bad[0]])}"
        )
    return limits


def transform(argument: str, given: ArrayLike | None) -> Array:
    """(4, 4) of a translation (3,) or a transform (4, 4)."""
    matrix = np.eye(4)
    array = numbers(argument, matrix if given is None else given)
    if array.shape == (3,):
        matrix[:3, 3] = array
        return matrix
    if array.shape != (4, 4):
        raise ValueError(
            f"{argument} must be a translation (3,) or a transform (4, 4), "
            f"got {array.shape}"
        )
    error = np.abs(array[:3, :3] @ array[:3, :3].T - np.eye(3)).max()
    if error > 1e-6 or np.linalg.det(array[:3, :3]) < 0.0:
        raise ValueError(f"the rotation of {argument} must be a rotation matrix")
    return array


def pose_matrix(pose: Array) -> Array:
    """(4, 4) of x, y, z and then turns about x, y, z in degrees (6,)."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("XYZ", pose[3:], degrees=True).as_matrix()
    matrix[:3, 3] = pose[:3]
    return matrix


def joint_numbers(
    argument: str, given: Sequence[int], joints: str, kinds: str = "RP"
) -> tuple[int, ...]:
    n = len(joints)
    result = tuple(whole_number(argument, joint, 1) for joint in given)
    if len(set(result)) < len(result) or max(result, default=1) > n:
        raise ValueError(
            f"{argument} must be joints of 1 to {n}, each once, got {given!r}"
        )
    for joint in result:
        if joints[joint - 1] not in kinds:
            raise ValueError(
                f"{argument} must name revolute joints, joint {joint} is prismatic"
            )
    return result


def load(given: tuple[int, float, ArrayLike], n: int) -> Load:
    if len(given) != 3:
        raise ValueError(f"loads must be (link, weight, centre) each, got {given!r}")
    link, weight, centre = given
    if whole_number("link of a load", link, 1) > n:
        raise ValueError(f"link of a load must be at most {n}, got {link}")
    weight = float(numbers("weight of a load", weight))
    return int(link), weight, tuple(array_of("centre of a load", centre, 3).tolist())
