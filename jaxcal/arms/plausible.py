"""Arms with their sensors where commands and readings put them, and commands and
readings that no arm like this one can take or give, refused by name.
"""

from __future__ import annotations

import dataclasses
import itertools
import warnings
from collections.abc import Sequence
from typing import cast

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from jaxcal.arms.chain import SerialChain as Chain
from jaxcal.arms.chains import Chains, ChainTable
from jaxcal.arms.postures import seen_by
from jaxcal.arms.sensors import Board, Sensor, Socket, Tip
from jaxcal.arms.sensors.sensor import Readings
from jaxcal.checks import Array, in_words, numbers
from jaxcal.models.model import as_commands

# Of the arm's length: positions so far off are in another frame; so alike, of this arm.
_NEAR, _ALIKE = 0.2, 0.05

# Farther away, or turned by more than 37 degrees (a cosine), no fit of poses finds it.
_AWAY, _ASIDE = 1.5, 0.8
_BEYOND_TURNS = 20.0  # degrees: as radians, more turns than a joint makes
_BEYOND = 2.0  # degrees beyond a limit, or percent of a slide's stroke
_OTHER_ARM = "wrong tip, unit, sign or order of columns, or rows of another place?"

_NOMINAL = 0.1  # of its length: no arm is so far off, tip included, before it is fitted
_APART = 0.2  # of it: what two sockets may seem to be off their distance
_TURNED = 20.0  # degrees on the flange, from which no fit finds the tool
_EDGE = 4.0  # times the noise of a corner, which is in the picture or next to it
_SAME = 1.25  # times the least error: no worse
_EXPLAINED = 0.2  # of the errors as given: what is left when the mistake is undone
_OTHER_UNIT = 0.01  # of it: so far off and tenfold, a distance is in another unit


def require_readings(arm: Chain, commands: Array, measured: Array | None) -> None:
    """Refuse what no arm like this one takes or gives; None, candidates."""
    for part in () if measured is None else arm.readings(commands, measured):
        if len(part.rows):
            _require_part(part, commands[part.rows, : arm.num_joints])
    arm.fitting.require_commands(commands)
    turning = np.array(arm.command_units) == "deg"
    largest = np.abs(commands[:, : arm.num_joints][:, turning]).max(initial=0.0)
    if measured is None and 0.0 < largest < 2.0 * np.pi:  # all within one turn
        warnings.warn(
            f"no joint of any candidate exceeds {largest:.3g} degrees: if these are "
            "radians, use numpy.degrees",
            stacklevel=2,
        )


def require_places(arm: Chain, commands: Array, measured: Array | None) -> None:
    """Refuse contacts of other places; warn of views without the board."""
    if measured is None:
        _warn_of_picture(arm, commands)
        return
    for part in arm.readings(commands, measured):
        if isinstance(part.sensor, Socket) and len(part.rows):
            _require_sockets(arm, part, commands[part.rows, : arm.num_joints])


def require_commands(arm: Chain, commands: Array) -> None:
    """Refuse radians for degrees, and joints far beyond their limits."""
    low, high = arm.limits.T
    turning = np.array(arm.command_units) == "deg"
    joints, inputs = np.split(commands, [arm.num_joints], axis=1)
    for _, one, rows, _ in arm.sensor.parts(inputs):
        largest = np.abs(joints[rows][:, turning]).max(initial=0.0)
        small = arm.num_joints > 2 and 1.0 < largest < 7.0
        if small and not one.positions:  # readings tell of these
            raise ValueError(
                f"commands must be in degrees, but no angle exceeds {largest:.3g}: "
                "are they radians? Use np.degrees(commands), --radians"
            )
    largest = np.abs(joints[:, turning]).max(initial=0.0)
    if largest > np.degrees(_BEYOND_TURNS) and arm.num_joints > 2:
        raise ValueError(
            f"commands must be in degrees, but angles reach {largest:.6g}: were "
            "degrees converted as if they were radians? Leave out np.degrees, --radians"
        )
    slack = np.where(turning, _BEYOND, 0.01 * _BEYOND * (high - low))
    far = np.argwhere((joints < low - slack) | (joints > high + slack))
    for row, joint in far[:1]:
        name, column = arm.joint_names[joint], joints[:, joint]
        ends = (low - slack)[joint], (high + slack)[joint]
        around = np.where(column > 180.0, column - 360.0, column)
        beyond = column.max() >= 0.0 and (around == around.clip(*ends)).all()
        if turning[joint] and beyond:
            advice = (
                f"{name} seems to be read in 0 to 360: subtract 360 from what is above "
                "180."
            )
        elif (-column == (-column).clip(*ends)).all():
            advice = (
                f"{name} seems reversed: with the other sign all rows are within the "
                "limits. Negate that column."
            )
        elif len(column) > 1 and not np.ptp(column):
            advice = f"it is the same in all {len(column)} rows: was it recorded?"
        else:
            order = ", ".join(arm.joint_names)
            advice = f"are the columns in this order: {order}?"
        raise ValueError(
            f"row {row}: {name} = {joints[row, joint]:g} is outside its limits "
            f"({low[joint]:g} to {high[joint]:g}) by more than {slack[joint]:g}; "
            f"{advice} If the file's limits are wrong, give "
            f"limits={{name: (low, high)}}, --limits"
        )


def _require_part(part: Readings, joints: Array) -> None:
    """Refuse millimetres for metres, radians for degrees (no arm is off tenfold), a
    turned tool frame, and a board's corners outside of the picture."""
    if len(joints) > 2 and (joints == joints[0]).all():
        raise ValueError(
            f"the joints are the same in all {len(joints)} rows: were they recorded?"
        )
    measured, length = np.asarray(part.measured), part.tip.length
    if part.sensor.relative:
        _require_tool(part.tip, measured)
    if isinstance(part.sensor, Board):
        _require_in_picture(part.sensor, measured, length or 1.0)
    if not part.sensor.positions:
        return
    points = np.array([measured[:, :3], part.tip.position])
    apart = points - np.median(points, axis=1, keepdims=True)
    spread = np.median(np.linalg.norm(apart, axis=2), axis=1)
    if max(spread) > max(10.0 * min(spread), 0.01 * length):
        raise ValueError(
            "measured must be in the model's unit of length and commands in degrees: "
            f"measured positions spread over {spread[0]:g}, predicted ones over "
            f"{spread[1]:g}"
        )


def _require_tool(tip: Tip, poses: Array) -> None:
    """Refuse a tool frame that is turned on the flange, which no fit finds."""
    nominal = tip.nominal()
    turns = Rotation.from_rotvec(poses[:, 3:], degrees=True).as_matrix()
    turn, apart = _mean_turn(np.matrix_transpose(nominal) @ turns @ nominal)
    of_base = _mean_turn(turns)[1]
    angle = float(np.linalg.norm(turn))
    if angle > _TURNED and apart < min(angle, of_base) / 3.0:
        raise ValueError(
            f"poses fit a tool frame turned by {angle:.0f} degrees on the flange. "
            "Multiply the rotation of tool= from the right by the rotation with the "
            f"vector {in_words(turn.round() + 0.0)} in degrees, or name the tip link "
            "whose axes the readings use"
        )


def _mean_turn(turns: Array) -> tuple[Array, float]:
    """Mean of rotations (N, 3, 3) as a vector in degrees, and their median from it."""
    whole = Rotation.from_matrix(turns)
    mean = whole.mean()
    apart = np.degrees((mean.inv() * whole).magnitude())
    return np.asarray(mean.as_rotvec(degrees=True)), float(np.median(apart))


def _require_in_picture(board: Board, pixels: Array, length: float) -> None:
    size = board.picture
    if size is None or board.corners is None:
        return
    spots = pixels.reshape(len(pixels), -1, 2)
    outside = ~board.in_picture(spots, _EDGE * float(board.stds(length).max()))
    for row, corner in np.argwhere(outside)[:1]:
        count = np.count_nonzero(outside.any(axis=1))
        raise ValueError(
            f"corners must be in the camera's picture of {size[0]:g} by {size[1]:g} "
            f"pixels, but {count} of {len(spots)} board rows have some outside: corner "
            f"{corner + 1} of row {row} is at {in_words(spots[row, corner])}. Is the "
            "width first, and is it this camera? Of a wide lens, whose undistorted "
            "corners leave the picture, give camera=(fx, fy, cx, cy)"
        )


def _warn_of_picture(arm: Chain, candidates: Array) -> None:
    """Warn of candidates from which a camera does not have the whole board in view."""
    board = arm.sensor
    if not isinstance(board, Board) or board.picture is None:
        return
    if board.corners is None or board.place is None:
        return
    _, place, turn = seen_by(arm, candidates)
    depth = turn[:, 2] @ board.outline.T + place[:, 2:]
    spots = arm.predict(candidates).reshape(len(candidates), -1, 2)
    lost = np.flatnonzero(~(board.in_picture(spots) & (depth > 0.0)).all(axis=1))
    if lost.size:
        warnings.warn(
            f"{lost.size} of {len(candidates)} candidates do not show the whole board "
            f"in the picture, the first is row {lost[0]} of the available ones; "
            "arm.postures() generates views that do",
            stacklevel=2,
        )


def _require_sockets(arm: Chain, part: Readings, joints: Array) -> None:
    """Refuse contacts that no arm near the nominal one can have made."""
    sensor, measured = cast(Socket, part.sensor), np.asarray(part.measured)
    which = sensor.of_rows(part.columns)
    _, first, groups = np.unique(joints, axis=0, return_index=True, return_inverse=True)
    for row in np.flatnonzero(which != which[first][groups.ravel()])[:1]:
        raise ValueError(
            f"a posture can touch only one socket, but rows {row} and "
            f"{first[groups.ravel()[row]]} are one posture with two sockets: rows of "
            "another file?"
        )
    if measured.any():  # offsets that were measured, as in a simulation, are of any tip
        return
    points = part.tip.position
    most, middles = _NOMINAL * arm.length, {}
    constant = np.flatnonzero((joints == joints[0]).all(axis=0))
    still = ", ".join(arm.joint_names[i] for i in constant)
    still = still and f"{still} never changes: was it recorded?"
    for i in np.unique(which):
        rows = np.flatnonzero(which == i)
        middles[i] = np.median(points[rows], axis=0)
        far = np.linalg.norm(points[rows] - middles[i], axis=1)
        if len(rows) > 2 and np.median(far) > most:
            touching, commands = arm.measured_with(sensor), [joints, part.columns]
            columns = mistaken_columns(touching, np.hstack(commands), measured)
            raise ValueError(
                f"contacts of socket {i} must be at one point within {most:.2g}, but "
                f"with the nominal arm they scatter by {np.median(far):.2g}: "
                + (still or columns or _OTHER_ARM)
            )
        lost = rows[far > most + 4.0 * np.median(far)]
        if lost.size:
            raise ValueError(
                f"contacts of socket {i} must be at one point within {most:.2g}, but "
                f"rows {in_words(lost)} are {far.max():.2g} from the others: rows of "
                "another place?"
            )
    for one, other, distance, _ in sensor.distances:
        if not {int(one), int(other)} <= middles.keys():  # another arm's
            continue
        distance_seen = float(np.linalg.norm(middles[int(one)] - middles[int(other)]))
        off = abs(distance_seen - distance) / arm.length
        unit = off > _OTHER_UNIT and not 0.1 < distance_seen / distance < 10.0
        if off > _APART or unit:
            raise ValueError(
                f"sockets {int(one)} and {int(other)} must be {distance:g} apart, but "
                f"with the nominal arm they are {distance_seen:.3g} apart: rows of "
                "another place or unit?"
            )


def require_touched(sensor: Sensor, inputs: Array) -> None:
    """Refuse a distance of a socket that no contact is of."""
    for place in sensor.lacking(inputs):
        raise ValueError(
            f"commands have no contacts of {sensor.kind} {place}, whose distance from "
            "another is given"
        )


def mistaken_columns(arm: Chain, commands: Array, measured: Array) -> str:
    """Which joints' columns are reversed or exchanged, or that the readings are
    mirrored, as a sentence; "" of none.

    Undone on the arm as described, one or two joints reversed or two exchanged, it must
    leave a fifth of the errors, and the least of all of these.
    """
    turning = [i for i, unit in enumerate(arm.command_units) if unit == "deg"]
    pairs = [*itertools.combinations(turning, 2)]
    tried = [(joints, "reversed") for joints in [*((i,) for i in turning), *pairs]]
    tried += [(pair, "exchanged") for pair in pairs]
    errors = np.zeros(len(tried))
    for k, (joints, word) in enumerate(tried):
        right, as_given = commands.copy(), commands[:, joints]
        right[:, joints] = -as_given if word == "reversed" else as_given[:, ::-1]
        errors[k] = _error(arm, right, measured)
    # The first, of one joint rather than two, that is as good as the best.
    best = int((errors > _SAME * errors.min()).argmin()) if len(errors) else -1
    if best < 0 or not errors[best] < _EXPLAINED * _error(arm, commands, measured):
        return ""
    mirrored = measured[:, [1, 0, 2]] if measured.shape[1] == 3 else measured
    if measured.any() and _error(arm, commands, mirrored) <= _SAME * errors[best]:
        return (
            "the readings seem mirrored: with two columns exchanged, or one of the "
            "other sign, they agree with the nominal arm; compare their axes with the "
            "instrument's"
        )
    joints, word = tried[best]
    names = " and ".join(arm.joint_names[joint] for joint in joints)
    remedy = "exchange" if word == "exchanged" else "negate"
    verb, which = ("seem", "these columns") if len(joints) > 1 else ("seems", "it")
    return (
        f"{names} {verb} {word}: with that corrected, the readings agree with the "
        f"nominal arm; {remedy} {which}"
    )


def _error(arm: Chain, commands: Array, measured: Array) -> float:
    """Median error of the arm as described, its sensor where the readings put it."""
    try:
        at = arm.located(commands, measured)
    except ValueError:  # no such arm
        return np.inf
    off = measured - at.predict(commands)
    for part in at.readings(commands, off):
        for rows in filter(len, part.groups()):  # its place is no merit of the arm
            off[rows] -= np.median(off[rows], axis=0)
    usual = np.asarray(at.default_noise().std)
    return float(np.median(np.linalg.norm(off / (usual / usual[0]), axis=1)))


def anew(arm: Chain, commands: Array, measured: Array) -> Chain:
    """This arm located again, what its sensor reads forgotten."""
    names = {field.name for field in dataclasses.fields(arm.sensor)}
    places = {name: None for name in ("place", "places") if name in names}
    arm = arm.measured_with(dataclasses.replace(arm.sensor, **places))
    return located(arm, commands, measured if measured.any() else None)


def apart(arm: Chain, commands: Array, measured: Array) -> tuple[Array, Array] | None:
    """Angles from row to row, by the nominal tip and as it is seen: alike wherever
    camera and board are. Of positions, how far they are apart."""
    tip = arm.nominal_tip(commands)
    seen = arm.sensor.seen_poses(commands[:, arm.num_joints :], measured)
    if seen is not None:
        turns = tip.rotation, seen[0]
        twice = [np.einsum("nij,mij->nm", turn, turn) - 1.0 for turn in turns]
        by_tip, by_view = np.arccos(np.clip(twice, -2.0, 2.0) / 2.0)
        return by_tip, by_view
    if not arm.sensor.positions:
        return None
    by_tip, by_view = (
        np.linalg.norm(x[:, None] - x, axis=-1) for x in (tip.position, measured[:, :3])
    )
    return by_tip, by_view


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
    if measured is None:
        return arm.base
    parts = arm.readings(commands, measured)
    part = next((x for x in parts if x.sensor.positions and len(x.rows)), None)
    if part is None:
        return arm.base
    moved = _far(part.tip.position, np.asarray(part.measured)[:, :3], arm.length)
    if moved is None:
        return arm.base
    base = moved @ arm.base
    if not part.sensor.relative:
        return base
    shift = np.linalg.norm((base - arm.base)[:3, 3])
    turned = np.trace(moved[:3, :3]) < 1.0 + 2.0 * _ASIDE
    if turned or shift > _AWAY * arm.length:
        raise ValueError(
            "base is missing: with Pose, turns are relative to the nominal ones, "
            f"so give base roughly. The positions fit base={base.round(7).tolist()}"
            "; then compute the turns with its rotation_vectors"
        )
    return arm.base


def _standing_at(arm: Chain, base: Array) -> Chain:
    return arm if base is arm.base else dataclasses.replace(arm, base=base)


def _far(points: Array, measured: Array, length: float) -> Array | None:
    """(4, 4) that takes nominal points (N, 3) to those measured, if those are far off
    and it explains them; else None."""
    moved, off = np.eye(4), np.linalg.norm(measured - points, axis=1)
    if len(points) < 4 or np.median(off) < _NEAR * length:
        return None
    middle, there = points.mean(axis=0), measured.mean(axis=0)
    turn = Rotation.align_vectors(measured - there, points - middle)[0].as_matrix()
    moved[:3, :3], moved[:3, 3] = turn, there - turn @ middle
    errors = np.linalg.norm(points @ turn.T + moved[:3, 3] - measured, axis=1)
    return moved if np.median(errors) < _ALIKE * length else None


def prepared(arm: Chain, commands: Array, measured: Array | None = None) -> Chain:
    """The arm with its sensor where commands (and readings) put it.

    Raises:
        ValueError: readings in another unit, of another arm or place, radians for
            degrees, joints beyond their limits.
    """
    require_readings(arm, commands, measured)
    arm = arm.located(commands, measured)
    for part in () if measured is None else arm.readings(commands, measured):
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
    of_members = {} if measured is None else model._by_member(arms, tables)
    for readings in of_members.values():
        columns = np.vstack([of_chain.columns for of_chain in readings])
        require_touched(readings[0].sensor, columns)
    for k, arm_commands, read in tables:
        with model._naming(k):
            require_places(arms[k], arm_commands, read)
    return dataclasses.replace(model, chains=tuple(arms))


def _located(model: Chains, tables: Sequence[ChainTable]) -> list[Chain]:
    """The chains, what they share where the one that reads it most has it."""
    arms, first = list(model.chains), model._firsts
    bases: dict[int, Array] = {}  # by the first chain that stands there
    for k, arm_commands, read in tables:
        base = _base_of(arms[k], arm_commands, read)
        if base is not arms[k].base:
            bases.setdefault(first[k], base)
    for k, arm in enumerate(model.chains):
        arms[k] = _standing_at(arm, bases.get(first[k], arm.base))
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
