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
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from rig.config import AXIS_NAMES, RigConfig
from rig.core.attitude import ORDERS, Array, euler_to_matrix, matrix_to_euler
from rig.core.faults import MotionFault

CLEAR = 4.0  # standard deviations that make a difference a finding
NEAREST = 0.7  # cosine: an axis within 45 degrees of where it is expected
LETTERS = ("X", "Y", "Z")
# A smaller turn of the phone cannot be told from cross-coupling of the axes, and the
# linear calibration takes it up as such.
MOUNTING_DEG = 3.0


@dataclasses.dataclass(frozen=True)
class Stand:
    """The device measured at one place."""

    pulses: Array  # (3,)
    attitude: Array  # (3, 3) phone to its world
    std_deg: float  # of one reading
    samples: int

    @classmethod
    def of(cls, record: Mapping[str, Any]) -> Stand:
        """From what ``Observer.measure`` returns."""
        return cls(
            np.array(record["pulses"], dtype=np.float64),
            np.array(record["attitude"]),
            float(np.max(record["std_deg"])),
            int(record["samples"]),
        )


def turn(base: Array, attitude: Array) -> Array:
    """(3,) rotation vector in degrees from one attitude to another, in the former."""
    return Rotation.from_matrix(base.T @ attitude).as_rotvec(degrees=True)


def rate(start: Stand, end: Stand, drive: int, base: Array) -> Array:
    """(3,) degrees for one pulse of a drive, between two places on one way."""
    way = end.pulses[drive] - start.pulses[drive]
    return (turn(base, end.attitude) - turn(base, start.attitude)) / way


def rates_of(stands: Mapping[str, Stand]) -> tuple[Array, Array]:
    """(3, 3) columns: rotation vector for one pulse of each drive; (3,) play."""
    base = stands["start"].attitude
    rates, backlash = np.empty((3, 3)), np.empty(3)
    for j, name in enumerate(AXIS_NAMES):
        look, plus, back, minus, up = (
            stands[f"{name}:{part}"] for part in ("look", "plus", "back", "minus", "up")
        )
        # On the way up and on the way down the play is taken up: no reversal between.
        ways = ((look, plus), (back, minus))
        weights = [abs(float(b.pulses[j] - a.pulses[j])) for a, b in ways]
        each = [rate(a, b, j, base) for a, b in ways]
        rates[:, j] = np.average(each, axis=0, weights=weights)
        direction = rates[:, j] / np.linalg.norm(rates[:, j])
        backlash[j] = (turn(base, back.attitude) - turn(base, up.attitude)) @ direction
        backlash[j] *= np.sign(plus.pulses[j] - look.pulses[j])
    return rates, backlash


def chain(
    config: RigConfig,
    stands: Mapping[str, Stand],
    rates: Array,
    joints: tuple[int, ...],
) -> str | None:
    """Axes from the base outwards; None where the phone is too noisy to tell."""
    inner = _inner(stands, rates)
    if inner is None:
        return None
    if not inner:
        others = ", ".join(_combining(config, stands))
        raise MotionFault(
            "the phone's readings do not combine as rotations of three joints do: "
            "imu.order, imu.columns or imu.signs is wrong, or the phone is loose. "
            "Nothing was corrected" + (others and f". They would combine with {others}")
        )
    letters = [config.letters[joints[drive]] for drive in np.argsort(inner)[::-1]]
    return "".join(letters)


def _inner(stands: Mapping[str, Stand], rates: Array) -> list[int] | None:
    """For each drive how many joints its own carries; [] where nothing fits.

    With A nearer to the base the phone turns by exp(a) exp(b), otherwise by exp(b)
    exp(a). The two differ by a x b: half of it, up or down, in the direction in which
    neither turns alone. From A- to A+ at the same B that component changes by a x b.
    Angles read in a wrong order or with wrong signs turn like a mirror image, and
    combine like nothing. None: the phone is too noisy to tell.
    """
    base = stands["start"]
    inner = [0, 0, 0]
    for a, b in itertools.combinations(range(3), 2):
        high, low = (stands[f"{AXIS_NAMES[a]}{s}{AXIS_NAMES[b]}+"] for s in "+-")
        normal = np.cross(rates[:, a], rates[:, b])
        scale = np.linalg.norm(normal)
        change = turn(base.attitude, high.attitude) - turn(base.attitude, low.attitude)
        seen = change @ normal / scale
        ways = (high.pulses - low.pulses)[a], (high.pulses - base.pulses)[b]
        whole = np.radians(ways[0] * ways[1] * scale) / 2.0
        noise = base.std_deg * np.sqrt(1 / high.samples + 1 / low.samples)
        if CLEAR * noise > abs(whole) / 2:
            return None
        if not abs(whole) / 2 < abs(seen) < 2 * abs(whole):
            return []
        inner[a if seen * whole > 0 else b] += 1
    return inner if sorted(inner) == [0, 1, 2] else []


def _combining(config: RigConfig, stands: Mapping[str, Stand]) -> Iterator[str]:
    """Other orders or signs of the phone's angles under which the readings combine."""
    told, signs = config.imu.order, np.array(config.imu.signs)
    if told is None or config.imu.format == "sensorlogger":
        return
    sent = {
        name: matrix_to_euler(stand.attitude, told) * signs
        for name, stand in stands.items()
    }
    tries = [(f'imu.order = "{order}"', order, signs) for order in ORDERS]
    tries += [
        (f"imu.signs = {list(other)}", told, np.array(other))
        for other in itertools.product((-1, 1), repeat=3)
    ]
    for text, order, other in tries:
        sequence = [told.index(letter) for letter in order]
        read = {
            name: dataclasses.replace(
                stand,
                attitude=euler_to_matrix((sent[name] * other)[sequence], order),
            )
            for name, stand in stands.items()
        }
        if _inner(read, rates_of(read)[0]):
            yield text


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
