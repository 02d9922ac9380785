"""Arms with their sensors, and what stands around them, where readings put them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from jaxcal.arms.chain import SerialChain as Chain
from jaxcal.arms.chains import Chains
from jaxcal.arms.plausible import require_places, require_readings, require_touched
from jaxcal.arms.sensors import Sensor, Tip
from jaxcal.arms.sensors.sensor import Readings
from jaxcal.checks import Array, numbers
from jaxcal.models.model import as_commands

# Of the arm's length: positions so far off are in another frame; so alike, of this arm.
_NEAR, _ALIKE = 0.2, 0.05

# Farther away, or turned by more than 37 degrees (a cosine), no fit of poses finds it.
_AWAY, _ASIDE = 1.5, 0.8


def anew(arm: Chain, commands: Array, measured: Array) -> Chain:
    """This arm located again, what its sensor reads forgotten."""
    names = {field.name for field in dataclasses.fields(arm.sensor)}
    places = {name: None for name in ("place", "places") if name in names}
    arm = arm.measured_with(dataclasses.replace(arm.sensor, **places))
    return located(arm, commands, measured if measured.any() else None)


def located(
    arm: Chain, commands: ArrayLike, measured: ArrayLike | None = None
) -> Chain:
    """This arm with its sensor located by nominal postures and readings.

    Sockets, planes, anchors, boards and cameras have no place, unless it was given,
    until the first readings. Of a tracker that is far from where it was said to be
    the base is found.

    Raises:
        ValueError: the readings fit no such arm, or that of a Pose in another base.
    """
    commands = as_commands(arm, commands)
    read = None if measured is None else numbers("measured", measured)
    arm = _standing_at(arm, _base_of(arm, commands, read))
    inputs = commands[:, arm.num_joints :]
    sensor, new = arm.sensor.located(arm.nominal_tip(commands), inputs, read)
    if sensor is arm.sensor and new is None:
        return arm
    tool = arm.tool if new is None else arm.tool @ new
    return dataclasses.replace(arm, sensor=sensor, tool=tool)


def _base_of(arm: Chain, commands: Array, measured: Array | None) -> Array:
    """(4, 4) where its first tracker sees the arm if far off, else the base."""
    parts = () if measured is None else arm.readings(commands, measured)
    for part in parts:
        if not part.sensor.positions or not len(part.rows):
            continue
        reached = np.asarray(part.measured)[:, :3]
        moved = _far(part.tip.position, reached, arm.length)
        base = moved @ arm.base
        if not part.sensor.relative:
            return arm.base if (moved == np.eye(4)).all() else base
        shift = np.linalg.norm((base - arm.base)[:3, 3])
        turned = np.trace(moved[:3, :3]) < 1.0 + 2.0 * _ASIDE
        if turned or shift > _AWAY * arm.length:
            raise ValueError(
                "base is missing: with Pose, turns are relative to the nominal "
                "ones, so give base roughly. The positions fit "
                f"base={base.round(7).tolist()}; then compute the turns with its "
                "rotation_vectors"
            )
        break
    return arm.base


def _standing_at(arm: Chain, base: Array) -> Chain:
    return arm if base is arm.base else dataclasses.replace(arm, base=base)


def _far(points: Array, measured: Array, length: float) -> Array:
    """(4, 4) that takes nominal points (N, 3) to those measured, if those are far off
    and it explains them; else one."""
    moved, off = np.eye(4), np.linalg.norm(measured - points, axis=1)
    if len(points) < 4 or np.median(off) < _NEAR * length:
        return moved
    middle, there = points.mean(axis=0), measured.mean(axis=0)
    turn = Rotation.align_vectors(measured - there, points - middle)[0].as_matrix()
    moved[:3, :3], moved[:3, 3] = turn, there - turn @ middle
    errors = np.linalg.norm(points @ turn.T + moved[:3, 3] - measured, axis=1)
    return moved if np.median(errors) < _ALIKE * length else np.eye(4)


def prepared(arm: Chain, commands: Array, measured: Array | None = None) -> Chain:
    """The arm with its sensor where commands (and readings) put it.

    Raises:
        ValueError: readings in another unit, of another arm or place, radians for
            degrees, joints beyond their limits.
    """
    require_readings(arm, commands, measured)
    arm = arm.located(commands, measured)
    if measured is not None:
        for part in arm.readings(commands, measured):
            require_touched(part.sensor, part.columns)
    require_places(arm, commands, measured)
    return arm


def prepared_chains(
    model: Chains, commands: Array, measured: Array | None = None
) -> Chains:
    """Chains with their sensors where commands (and readings) put them.

    Raises:
        ValueError: as of an arm; no chain touches a socket whose distance is given.
    """
    tables = []
    for k, arm, rows, arm_commands in model._parts(commands):
        read = None
        if measured is not None:
            read = measured[rows, : arm.num_outputs] * model._scale(k)
        tables.append((k, arm_commands, read))
        with model._naming(k):
            require_readings(arm, arm_commands, read)
    arms = _located(model, tables)
    if measured is not None:
        for readings in model._by_member(arms, tables).values():
            columns = [of_chain.columns for of_chain in readings]
            require_touched(readings[0].sensor, np.vstack(columns))
    for k, arm_commands, read in tables:
        with model._naming(k):
            require_places(arms[k], arm_commands, read)
    return dataclasses.replace(model, chains=tuple(arms))


def _located(
    model: Chains, tables: Sequence[tuple[int, Array, Array | None]]
) -> list[Chain]:
    """The chains, what they share where the one that reads it most has it."""
    arms, first = list(model.chains), model._firsts
    bases: dict[int, Array] = {}  # by the first chain that stands there
    for k, arm_commands, read in tables:
        base = _base_of(arms[k], arm_commands, read)
        if base is not arms[k].base:
            bases.setdefault(first[k], base)
    arms = [
        _standing_at(arm, bases.get(i, arm.base))
        for i, arm in zip(first, arms, strict=True)
    ]
    placed: dict[int, Sensor] = {}
    for number, of_chains in model._by_member(arms, tables).items():
        readings = [part for part in of_chains if len(part.columns)]
        shared = len(model._members[number]) > 1
        if shared and readings and readings[0].sensor.stands:
            sensor = _placed(readings)
            if sensor is not readings[0].sensor:  # where it was not given
                placed[number] = sensor
    standing = {number: sensor.standing for number, sensor in placed.items()}
    for k, arm_commands, read in tables:
        with model._naming(k):
            arm = model._with(standing, arms[k], k)
            arms[k] = arm.located(arm_commands, read)
        if not np.array_equal(arms[k].base, arms[first[k]].base):
            raise ValueError(
                f"chains {model.tips[first[k]]} and {model.tips[k]} share their base, "
                "but their positions are in different frames: give both in one frame, "
                "such as that of a tracker that stands still"
            )
    return [model._with(placed, arm, k) for k, arm in enumerate(arms)]


def _placed(readings: Sequence[Readings]) -> Sensor:
    """A sensor with each thing where the arm that reads it most has it."""
    sensor = readings[0].sensor
    which = [sensor.of_rows(of_arm.columns) for of_arm in readings]
    count = 1 + max(int(rows.max()) for rows in which)
    most = np.argmax([np.bincount(rows, minlength=count) for rows in which], axis=0)
    kept = [
        of_arm.at(np.flatnonzero(most[rows] == i))
        for i, (of_arm, rows) in enumerate(zip(readings, which, strict=True))
    ]
    measured = [of_arm.measured for of_arm in kept if of_arm.measured is not None]
    return sensor.located(
        Tip.together([of_arm.tip for of_arm in kept]),
        np.vstack([of_arm.columns for of_arm in kept]),
        np.vstack(measured) if measured else None,
    )[0]
