"""Joints whose column has the other sign, or stands in the place of another's."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np

from jaxcal.checks import Array

if TYPE_CHECKING:
    from jaxcal.arms.chain import SerialChain as Chain


_SAME = 1.25  # times the least error: no worse
_EXPLAINED = 0.2  # of the errors as given: what is left when the mistake is undone


def mistaken_columns(arm: Chain, commands: Array, measured: Array) -> str:
    """Which joints' columns are reversed or exchanged, as a sentence; "" of none.

    Undone on the arm as described, one or two joints reversed or two exchanged, it
    must leave a fifth of the errors, and the least of all of these. A joint that the
    sensor does not see turn (the last, with the tip on its axis) is not told.

    Args:
        arm: as described.
        commands: (N, n).
        measured: (N, q).
    """
    turning = [i for i, unit in enumerate(arm.command_units) if unit == "deg"]
    pairs = [*itertools.combinations(turning, 2)]
    tried: list[tuple[tuple[int, ...], str]]
    tried = [((joint,), "reversed") for joint in turning]
    tried += [(pair, "reversed") for pair in pairs]
    tried += [(pair, "exchanged") for pair in pairs]
    errors = np.array(
        [_error(arm, _undone(commands, *mistake), measured) for mistake in tried]
    )
    # The first, of one joint rather than two, that is as good as the best.
    best = int((errors > _SAME * errors.min()).argmin()) if len(errors) else -1
    if best < 0 or not errors[best] < _EXPLAINED * _error(arm, commands, measured):
        return ""
    joints, word = tried[best]
    names = " and ".join(arm.joint_names[joint] for joint in joints)
    remedy = "exchange" if word == "exchanged" else "negate"
    verb, which = ("seem", "these columns") if len(joints) > 1 else ("seems", "it")
    return (
        f"{names} {verb} {word}: with that corrected, the readings agree with the "
        f"nominal arm; {remedy} {which}"
    )


def _undone(commands: Array, joints: tuple[int, ...], word: str) -> Array:
    right = commands.copy()
    if word == "reversed":
        right[:, joints] *= -1.0
    else:
        right[:, joints] = commands[:, joints[::-1]]
    return right


def _error(arm: Chain, commands: Array, measured: Array) -> float:
    """Median error of the arm as described, its sensor where the readings put it."""
    try:
        at = arm.located(commands, measured)
    except ValueError:  # no such arm
        return np.inf
    off = measured - at.predict(commands)
    tip, inputs = at.nominal_tip(commands), commands[:, at.num_joints :]
    for part in at.sensor.of_members(tip, inputs, off):
        if part.sensor.num_places:  # its place is no merit of the arm
            which = part.sensor.of_rows(part.columns)
            for i in np.unique(which):
                rows = part.rows[which == i]
                off[rows] -= np.median(off[rows], axis=0)
    usual = np.asarray(at.default_noise().std)
    return float(np.median(np.linalg.norm(off / (usual / usual[0]), axis=1)))
