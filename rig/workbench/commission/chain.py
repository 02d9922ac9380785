"""Which joint carries which, and whether the phone's readings are rotations at all."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Mapping

import numpy as np

from rig.config import AXIS_NAMES, RigConfig
from rig.core.attitude import ORDERS, Array, euler_to_matrix, matrix_to_euler
from rig.core.faults import MotionFault
from rig.workbench.commission.stands import Stand, rates_of, turn

CLEAR = 4.0  # standard deviations that make a difference a finding


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
