"""Postures that can be measured: within the limits, and where the sensor reads."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import numbers, whole_number
from jaxcal.models.sensors import Board, Placed, Plane, Several, Socket

__all__ = ["in_turn", "postures"]

Array = NDArray[np.float64]
Chain = Any  # a SerialChain, whose module imports this one

_ROUNDS, _STEPS = 40, 80  # batches of starts; steps of the inverse kinematics
_BATCH = 2_000  # starts at a time, where few are any good
_VAIN = 8  # batches in which nothing is found: there is nothing
_REACHED = 1e-7  # of the arm's length
_APART = 2.0  # degrees (of a slide: percent of its stroke) between two postures
_VIEW = np.cos(np.radians(25.0))  # of the board from the camera's axis, and its face


def postures(
    arm: Chain,
    count: int,
    seed: int,
    near: ArrayLike | None,
    allowed: Callable[[Array], bool] | None,
) -> Array:
    """See ``jaxcal.models.SerialChain.postures``."""
    whole_number("count", count, 1)
    if isinstance(arm.sensor, Several):
        raise ValueError(
            "postures are of one sensor at a time: arm.measured_with(sensor).postures()"
        )
    arm, targets = _aimed(arm, near)
    rng = np.random.default_rng(seed)
    low, high = arm.limits.T
    turns = np.array(arm.command_units) == "deg"
    if not np.isfinite(arm.limits[~turns]).all():
        raise ValueError("limits of sliding joints must be known: limits=...")
    low, high = np.maximum(low, -180.0), np.minimum(high, 180.0)
    unit = np.where(turns, 1.0, (high - low) / 100.0)
    found = np.zeros((0, arm.num_inputs))
    lost: Counter[str] = Counter()
    tried = 0
    for batch in range(_ROUNDS):
        if batch == _VAIN and not len(found):
            break
        size = max(2 * (count - len(found)), 64)
        if len(found):  # more where few were any good: a board is seldom in view
            size = max(size, min(size * tried // (4 * len(found)), _BATCH))
        tried += size
        starts = rng.uniform(low, high, (size, arm.num_joints))
        labels = np.zeros((size, len(arm.sensor.inputs)))
        if isinstance(arm.sensor, Placed) and arm.sensor.count > 1:
            labels[:, 0] = (len(found) + np.arange(size)) % arm.sensor.count
        trial, reason = _reach(arm, np.hstack([starts, labels]), low, high, targets)
        for row, why in zip(trial, reason, strict=True):
            joints = row[: arm.num_joints]
            if not why:
                apart = np.abs((found[:, : arm.num_joints] - joints) / unit)
                if len(found) and apart.max(axis=1).min() < _APART:
                    why = "are next to another one"
                elif allowed is not None and not allowed(joints.copy()):
                    why = "are not allowed"
            if why:
                lost[why] += 1
                continue
            found = np.vstack([found, row])
            if len(found) == count:
                return found[in_turn(found, arm.num_joints)]
    reasons = ", ".join(f"{number} {why}" for why, number in lost.most_common())
    raise ValueError(
        f"count must be at most {len(found)} here, got {count}: of {tried} postures "
        f"tried {reasons}"
    )


def _aimed(arm: Chain, near: ArrayLike | None) -> tuple[Chain, Array | None]:
    """The arm with its sensor at ``near``, or points that the tip should be near."""
    sensor = arm.sensor
    places = None if near is None else np.atleast_2d(numbers("near", near))
    if isinstance(sensor, Socket | Plane):
        if places is None and sensor.places is None:
            raise ValueError(
                f"near must be given: where each {sensor.kind} is, roughly, "
                f"(S, {sensor.width}); contacts that were made by hand show it, "
                "arm.located(commands)"
            )
        if places is not None:
            aimed = dataclasses.replace(sensor, count=len(places), places=places)
            arm = arm.measured_with(aimed)
        return arm, None
    if isinstance(sensor, Board):
        if sensor.place is None:
            raise ValueError(
                "place must be given, Board(place=...): where the board or camera "
                "stands is not known, and near does not say it; three views show it, "
                "arm.located(commands, measured), in the shell --measured"
            )
        return arm, None
    if places is not None and places.shape[1] != 4:
        raise ValueError(
            f"near must be rows (x, y, z, radius) for {sensor.kind}, got "
            f"{places.shape[1]} columns"
        )
    return arm, places


def _reach(
    arm: Chain, commands: Array, low: Array, high: Array, targets: Array | None
) -> tuple[Array, list[str]]:
    """Commands moved to where the sensor reads, and why not ("" where it does)."""
    if isinstance(arm.sensor, Board):
        return _in_view(arm, commands)
    if arm.sensor.zeros:
        return _touching(arm, commands, low, high)
    if targets is None:
        return commands, [""] * len(commands)
    from jaxcal.models.sensors import Position

    points = arm.calibrated(arm.nominal, Position()).predict(
        commands[:, : arm.num_joints]
    )
    far = np.linalg.norm(points[:, None] - targets[:, :3], axis=-1)
    near = (far <= targets[:, 3]).any(axis=1)
    return commands, ["" if one else "are not near" for one in near]


def _touching(
    arm: Chain, commands: Array, low: Array, high: Array
) -> tuple[Array, list[str]]:
    """Damped steps of least length until the readings are zero, within the limits."""
    commands, j = commands.copy(), arm.num_joints
    limit = _REACHED * (arm.length or 1.0)
    # Degrees and lengths are made comparable by how far each may go.
    scale = np.minimum(high - low, 360.0)
    for _ in range(_STEPS):
        off = arm.predict(commands)
        size = np.linalg.norm(off, axis=1)
        going = size > limit
        if not going.any():
            break
        slopes = arm.command_jacobian(commands[going])[..., :j] * scale
        # A joint at its limit that is pushed on beyond it stays where it is.
        wish = -np.einsum("nqj,nq->nj", slopes, off[going])
        at = commands[going, :j]
        held = ((at <= low) & (wish < 0.0)) | ((at >= high) & (wish > 0.0))
        slopes = np.where(held[:, None], 0.0, slopes)
        gram = slopes @ np.matrix_transpose(slopes)
        trace = np.trace(gram, axis1=1, axis2=2)[:, None, None] + 1e-300
        gram = gram + 1e-6 * trace * np.eye(gram.shape[-1])
        step = np.linalg.solve(gram, -off[going][..., None])
        step = (np.matrix_transpose(slopes) @ step)[..., 0]
        step *= 0.1 / np.maximum(np.abs(step).max(axis=1, keepdims=True), 0.1)
        commands[going, :j] = np.clip(at + step * scale, low, high)
    reached = np.linalg.norm(arm.predict(commands), axis=1) <= limit
    why = "do not reach within the limits"
    return commands, ["" if one else why for one in reached]


def _in_view(arm: Chain, commands: Array) -> tuple[Array, list[str]]:
    """The board before the camera and turned to it; ``seen`` as it is predicted."""
    commands = commands.copy()
    j = arm.num_joints
    posed = arm.measured_with(dataclasses.replace(arm.sensor, corners=None))
    # Of a board seen at zero: its pose in the camera.
    seen = posed.predict(np.hstack([commands[:, :j], np.zeros((len(commands), 6))]))
    if arm.sensor.corners is None:
        commands[:, j:] = seen
    from scipy.spatial.transform import Rotation

    face = Rotation.from_rotvec(seen[:, 3:], degrees=True).as_matrix()[:, :, 2]
    far = np.linalg.norm(seen[:, :3], axis=1)
    ahead = seen[:, 2] / np.where(far > 0.0, far, 1.0) > _VIEW
    turned = np.abs(face[:, 2]) > 0.5  # less than 60 degrees from facing it
    reasons = np.where(turned, "", "see the board too much from the side")
    reasons = np.where(ahead, reasons, "do not have the board before the camera")
    return commands, reasons.tolist()


def in_turn(found: Array, joints: int) -> NDArray[np.int64]:
    """Socket after socket, and in each the nearest posture next: rows in that order."""
    order: list[int] = []
    left = list(range(len(found)))
    while left:
        last = found[order[-1]] if order else found[left[0]]
        other = (found[left, joints:] != last[joints:]).any(axis=1)
        other = other if found.shape[1] - joints == 1 else np.zeros(len(left), bool)
        far = np.abs(found[left, :joints] - last[:joints]).max(axis=1)
        nearest = int(np.lexsort((far, other))[0])
        order.append(left.pop(nearest))
    return np.array(order)
