"""What small moves of three drives say about a device: axes, signs, gearing, placement.

Everything is taken from rotations of the phone against its attitude at the start, so
neither the heading of the phone's world nor the zero posture enters. A rotation vector
is (3,) degrees in the phone's own frame at the start.

A drive's axis there, with its sign, is the direction of its rotation vector for
positive pulses. With the three axes alone, a phone that is placed differently cannot be
told from drives whose names and signs are exchanged, so one of the two is taken as
known: the configured placement (as good as ``NEAREST``), or names and signs.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from rig.config import RigConfig
from rig.core.attitude import Array, euler_to_matrix
from rig.core.faults import MotionFault
from rig.workbench.commission.chain import chain
from rig.workbench.commission.stands import Stand, rates_of, turn

NEAREST = 0.7  # cosine: an axis within 45 degrees of where it is expected
LETTERS = ("X", "Y", "Z")
# A smaller turn of the phone cannot be told from cross-coupling of the axes, and the
# linear calibration takes it up as such.
MOUNTING_DEG = 3.0


@dataclasses.dataclass(frozen=True)
class Findings:
    """Of the drives in the order of the configuration's axes, unless said otherwise."""

    joints: tuple[int, ...]  # for each drive: the axis that it turns
    deg_per_pulse: Array  # (3,) of the phone, > 0 where pulses turn the joint positive
    backlash_deg: Array  # (3,) at the phone
    cross_talk: Array  # (3, 3) rotation about joint i, a share of drive j's own
    axes: Array  # (3, 3) columns: of each drive's joint in the phone's frame
    off_deg: Array  # (3,) each axis from where the placement that was found puts it
    mounting: Array  # (3, 3) phone to end-effector, nearest to the three axes
    turned_deg: float  # that from the configured one
    mirrored: bool  # the axes are a mirror image of those configured
    order: str | None  # axes of the mechanism from the base outwards; None: not clear
    skew_deg: float  # largest departure of two axes from a right angle


def find(
    config: RigConfig,
    stands: Mapping[str, Stand],
    names_known: bool = False,
) -> Findings:
    """Read the findings from the places that ``axes.measure`` went to.

    Args:
        config: as the moves were made.
        stands: ``start``; of each axis NAME ``NAME:look``, ``:plus``, ``:back``,
            ``:minus``, ``:up``; of each pair ``A+B+`` and ``A-B+``.
        names_known: units and directions are as configured, and the phone may be placed
            in any way; otherwise the phone is placed about as configured.

    Raises:
        MotionFault: the axes fit no three joints, or the readings are no rotations.
    """
    rates, backlash = rates_of(stands)
    size = np.linalg.norm(rates, axis=0)
    axes = rates / size
    joints, signs, mounting = _placed(config, axes, names_known)
    order = chain(config, stands, rates, joints)
    mirrored = np.linalg.det(axes * _directions(config) @ _expected(config)) < 0
    if mirrored and order is None and not names_known:
        raise MotionFault(
            "the axes are mirrored, and the phone is too noisy to tell whether a "
            "direction is wrong or imu.signs. Raise settle.samples, or jog each axis, "
            "correct axes.*.direction and imu.signs, and use --names-known"
        )
    expected = _expected(config)[:, joints] * signs
    found = mounting @ axes
    cosine = np.clip((found * expected).sum(axis=0), -1.0, 1.0)
    told = euler_to_matrix(config.imu.mounting_deg, "ZYX")
    turned = float(np.linalg.norm(turn(told, mounting)))
    kept = told if turned <= MOUNTING_DEG else mounting
    share = _expected(config).T @ kept @ rates
    own = share[list(joints), range(3)]
    return Findings(
        joints=joints,
        deg_per_pulse=signs * size,
        backlash_deg=backlash,
        cross_talk=share / own,
        axes=axes * signs,
        off_deg=np.degrees(np.arccos(cosine)),
        mounting=mounting,
        turned_deg=turned,
        mirrored=bool(mirrored),
        order=order,
        skew_deg=_skew(axes),
    )


def _expected(config: RigConfig) -> Array:
    """(3, 3) columns: axis of each joint in the end-effector's frame."""
    return np.eye(3)[:, [LETTERS.index(letter) for letter in config.letters]]


def _directions(config: RigConfig) -> Array:
    """(3,) the configured ones of the drives."""
    return np.array([float(axis.direction) for axis in config.axes])


def _placed(
    config: RigConfig, axes: Array, names_known: bool
) -> tuple[tuple[int, ...], Array, Array]:
    """Joint and sign of each drive, and the mounting that fits them best."""
    expected = _expected(config)
    joints: tuple[int, ...] = (0, 1, 2)
    signs = _directions(config)
    if names_known:
        if np.linalg.det(axes * signs) * np.linalg.det(expected) < 0:
            raise MotionFault(
                "the three axes are mirrored: one direction is wrong, or all three. "
                "Jog each axis, and set axes.*.direction of the one that turns the "
                "negative way"
            )
    else:
        told = euler_to_matrix(config.imu.mounting_deg, "ZYX")
        cosines = expected.T @ told @ axes  # rows: joints
        joints = max(
            itertools.permutations(range(3)),
            key=lambda order: np.abs(cosines[order, range(3)]).sum(),
        )
        own = cosines[joints, range(3)]
        signs = np.sign(own)
        if np.abs(own).min() < NEAREST:
            unit = config.axes[int(np.abs(own).argmin())].unit
            raise MotionFault(
                f"unit {unit} turns the phone about an axis more than 45 deg from "
                "every joint's, so the phone is not placed as imu.mounting_deg says. "
                "Correct that roughly; or, where you have seen that every unit turns "
                "its own joint the right way, use --names-known"
            )
    fitted, _ = Rotation.align_vectors((expected[:, joints] * signs).T, axes.T)
    return joints, signs, fitted.as_matrix()


def _skew(axes: Array) -> float:
    """Largest departure of two of three unit columns from a right angle, degrees."""
    cosines = (axes.T @ axes)[np.triu_indices(3, 1)]
    return float(np.degrees(np.arcsin(np.clip(np.abs(cosines), 0.0, 1.0))).max())
