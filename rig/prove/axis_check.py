"""What small moves of the drives say about a device: axes, signs, gearing, placement.

Everything is taken from rotations of the phone against its attitude at the start, in
(3,) degrees of its own frame there: neither heading nor zero posture enters. By these
alone a phone placed differently looks like drives whose names and signs are exchanged,
so the configured placement is known, as good as ``NEAREST``.
"""

from __future__ import annotations

import dataclasses
import itertools
import tomllib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from rig.command_run import Run
from rig.config import RigConfig
from rig.config.axis import Axis
from rig.core.device import Device, Posture
from rig.core.measure import measure
from rig.core.motion import move
from rig.core.proof import RADIANS
from rig.faults import MotionFault
from rig.readings.geometry import Array, geometry_of, matrix_to_euler, mounting_of

CLEAR = 4.0  # standard deviations that make a difference a finding
NEAREST = 0.7  # cosine: an axis within 45 degrees of where it is expected
EXCHANGED = 0.3  # of the sum of cosines: exchanged drives must explain more by it
LETTERS = ("X", "Y", "Z")
MOUNTING_DEG = 3.0  # a smaller turn is like cross-coupling, and A takes it up
SOUND_RATIO = (0.4, 1.5)  # measured against commanded: what A may take up
NEAR_UNIT = (0.3, 2.0)  # the same, once radians and degrees are exchanged
UNPROVED_FACTOR = 2.0  # by which a gearing is corrected on the phone's word alone
AGAIN = "then run `jaxcal-rig setup axes` again"
BY_PLATE = "Nothing was corrected. Set pulses_per_rev and reduction according to the "
BY_PLATE += f"drives and the gearboxes' name plates, {AGAIN}"
DIGITS = 4  # of a reduction that was measured
OF_DRIVE = ("unit", "map", "pulses_per_rev", "comm_timeout_s")  # go with the cable


@dataclasses.dataclass(frozen=True)
class Stand:
    pulses: Array  # (n,)
    attitude: Array  # (3, 3) phone to its world
    std_deg: float  # of one reading
    samples: int


def stand_at(run: Run, device: Device, posture: Posture, samples: int = 0) -> Stand:
    """Move and measure, with ``samples`` readings or as configured; journalled."""
    run.signals.check_pause()
    measured = measure(move(device, posture), samples or None)
    run.emit("stand", sync=True, name=posture.name, **measured)
    return Stand(
        np.array(measured["pulses"], dtype=np.float64),
        np.array(measured["attitude"]),
        float(np.max(measured["std_deg"])),
        int(measured["samples"]),
    )


def corners_of(count: int) -> list[tuple[int, ...]]:
    """Signs of combined moves of so many axes, one changed at a time; none of one."""
    signs: list[tuple[int, ...]] = [()]
    for _ in range(count):
        signs = [(*s, -1) for s in signs] + [(*s, 1) for s in reversed(signs)]
    return signs if count > 1 else []


def corner_name(config: RigConfig, signs: Sequence[int]) -> str:
    """Name of the corner with these signs, as ``pitch+ yaw- roll+``."""
    named = zip(config.axis_names, signs, strict=True)
    return " ".join(f"{name}{'+' if sign > 0 else '-'}" for name, sign in named)


def turn(base: Array, attitude: Array) -> Array:
    """(3,) rotation vector in degrees from one attitude to another, in the former."""
    return Rotation.from_matrix(base.T @ attitude).as_rotvec(degrees=True)


def rates_of(config: RigConfig, stands: Mapping[str, Stand]) -> Array:
    """(3, n) columns, rotation vector for one pulse of each drive; (m, n) numbers."""
    base, columns, way = stands["start"].attitude, [], geometry_of(config).way
    for j, name in enumerate(config.axis_names):
        parts = ("look", "plus", "back", "minus")
        places = [stands[f"{name}:{part}"] for part in parts]
        look, plus, back, minus = (way(base, stand.attitude) for stand in places)
        at = [stand.pulses[j] for stand in places]
        # On the way up and on the way down the play is taken up: no reversal between.
        moved = np.array([at[1] - at[0], at[3] - at[2]])
        rates = np.array([plus - look, minus - back]) / moved[:, None]
        columns.append(np.average(rates, axis=0, weights=abs(moved)))
    return np.column_stack(columns)


def _inner(
    config: RigConfig, stands: Mapping[str, Stand], rates: Array
) -> list[int] | None:
    """For each drive how many joints its own carries; [] where nothing fits.

    With A nearer to the base the phone turns by exp(a) exp(b), otherwise by exp(b)
    exp(a). The two differ by a x b: half of it, up or down, where neither turns alone.
    Its mean over the corners, each with the product of the two signs, is free of what
    A or B turn alone, of play and of a steady drift. Angles read in a wrong order or
    with wrong signs combine like nothing. None: the phone is too noisy to tell.
    """
    count, base = rates.shape[1], stands["start"]
    corners = [stands[corner_name(config, signs)] for signs in corners_of(count)]
    if not corners:  # of a single axis
        return [0]
    turned = np.array([turn(base.attitude, corner.attitude) for corner in corners])
    ways = np.array([corner.pulses - base.pulses for corner in corners])
    number = len(corners)
    noise = base.std_deg * sum(1 / corner.samples for corner in corners) ** 0.5 / number
    inner = [0] * count
    for a, b in itertools.combinations(range(count), 2):
        product = ways[:, a] * ways[:, b]  # as large at each
        normal = np.cross(rates[:, a], rates[:, b])
        scale = np.linalg.norm(normal)
        share = np.sign(product) @ turned @ normal / scale / number
        whole = np.radians(np.abs(product).mean() * scale) / 2
        if CLEAR * noise > whole / 2:
            return None
        if not whole / 2 < abs(share) < 2 * whole:
            return []
        inner[a if share > 0 else b] += 1
    return inner if sorted(inner) == [*range(count)] else []


def check_numbers(
    config: RigConfig, stands: Mapping[str, Stand], expected: Array | None = None
) -> tuple[list[Change], list[float]]:
    """Corrections of directions, and what numbers change for a unit of each axis.

    A number of an axis's name rises with it and, in its unit, about as far; or numbers
    change as a model says, ``expected`` (m, n) for a unit of each; else MotionFault.
    """
    rates, changes, (low, high) = rates_of(config, stands), [], SOUND_RATIO
    ratios = []
    for j, axis in enumerate(config.axes):
        per_unit, reason = rates[:, j] * axis.pulses_per_deg, ""
        ratios.append(float(np.linalg.norm(per_unit)))
        if expected is not None:
            reason = _against(axis, per_unit, expected[:, j])
        elif axis.name in config.output_names:
            rate = per_unit[config.output_names.index(axis.name)]
            same = config.output_unit == axis.unit_name
            if same and not low <= abs(rate) <= high:
                raise MotionFault(
                    f"{axis.name} moves {abs(rate):.3g} {axis.unit_name} per commanded "
                    f"{axis.unit_name}; allowed is {low:g} to {high:g}. {BY_PLATE}"
                )
            if rate < 0:
                reason = f"the reading {axis.name} falls when the axis is commanded up"
        if reason:
            key = f"axes.{axis.name}.direction"
            changes.append(Change(key, axis.direction, -axis.direction, reason))
    return changes, ratios


def _against(axis: Axis, seen: Array, expected: Array) -> str:
    """Why an axis is to be turned round, by what the model says; or MotionFault."""
    size, way = float(np.linalg.norm(seen)), float(np.linalg.norm(expected))
    cosine = float(seen @ expected) / max(size * way, 1e-12)
    low, high = SOUND_RATIO
    told = (
        f"{axis.name} changed the readings by {size:.3g} per commanded "
        f"{axis.unit_name}, the model predicts {way:.3g}"
    )
    if not low * way <= size <= high * way:
        raise MotionFault(f"{told}; allowed is {low:g} to {high:g} of it. {BY_PLATE}")
    if abs(cosine) < NEAREST:
        raise MotionFault(
            f"{told}, and in another direction: units, cables or readings are "
            "exchanged, or [model] is of another device. Nothing was corrected"
        )
    reason = "the readings change in the opposite direction to the model"
    return "" if cosine > 0 else reason


@dataclasses.dataclass(frozen=True)
class Findings:
    """Findings by drive, in the order of the configuration's axes if not said."""

    joints: tuple[int, ...]  # for each drive: the axis that it turns
    deg_per_pulse: Array  # (n,) of the phone, > 0 where pulses turn the joint positive
    mounting: Array  # (3, 3) phone to end-effector, nearest to the axes
    turned_deg: float  # that from the configured one
    order: str | None  # axes of the mechanism from the base outwards; None: not clear


def find(
    config: RigConfig, stands: Mapping[str, Stand], expected: Array | None = None
) -> Findings:
    """The findings of ``stands``, the places that ``measure_axes`` went to, by name.

    ``expected``: (3, n) axes of an arm's joints in its tip's frame at the start.
    MotionFault: the axes fit no joints, or the readings are no rotations.
    """
    rates, letters = rates_of(config, stands), config.letters
    if expected is not None:  # the order of an arm's joints, without letters, is known
        return _placed(config, rates, expected)
    expected = np.eye(3)[:, [LETTERS.index(letter) for letter in letters]]
    findings, inner = _placed(config, rates, expected), _inner(config, stands, rates)
    if inner:
        outwards = np.argsort(inner)[::-1]
        order = "".join(letters[findings.joints[i]] for i in outwards)
        return dataclasses.replace(findings, order=order)
    if inner is not None:
        raise MotionFault(
            "the phone's readings do not combine like rotations of joints: imu.order, "
            "imu.columns or imu.signs is wrong, or the phone is loose. Nothing was "
            "corrected"
        )
    as_told = rates * [axis.direction for axis in config.axes]
    # Of fewer axes nothing is a mirror.
    if rates.shape[1] == 3 and np.linalg.det(as_told @ expected) < 0:
        raise MotionFault(
            "the axes are mirrored, and the phone is too noisy to show whether a "
            f"direction or imu.signs is wrong. Raise settle.samples, {AGAIN}"
        )
    return findings


def _placed(config: RigConfig, rates: Array, expected: Array) -> Findings:
    """What each drive turns, and the mounting that fits them best."""
    size = np.linalg.norm(rates, axis=0)
    axes = rates / size
    told = mounting_of(config)
    cosines = expected.T @ told @ axes  # rows: joints
    joints: tuple[int, ...] = max(
        itertools.permutations(range(len(cosines))),  # the first is as named
        key=lambda order: (
            np.abs(cosines[order, range(len(order))]).sum()
            - EXCHANGED * (order != tuple(range(len(order))))
        ),
    )
    cosine = cosines[joints, range(len(joints))]
    signs = np.sign(cosine)
    if np.abs(cosine).min() < NEAREST:
        unit = config.axes[int(np.abs(cosine).argmin())].unit
        raise MotionFault(
            f"unit {unit} turns the phone about an axis more than 45 deg from every "
            f"joint's axis, so imu.mounting_deg is wrong. Correct it roughly, {AGAIN}"
        )
    goal, turned = expected[:, joints] * signs, told @ axes
    correction, _ = Rotation.align_vectors(goal.T, turned.T)  # of one the least turn
    mounting = correction.as_matrix() @ told
    turned_deg = float(np.linalg.norm(turn(told, mounting)))
    return Findings(joints, signs * size, mounting, turned_deg, None)


# What follows for rig.toml


@dataclasses.dataclass(frozen=True)
class Change:
    """One key of rig.toml; ``key`` is such as ``axes.roll.direction``."""

    key: str
    old: Any
    new: Any
    reason: str

    def __str__(self) -> str:
        what = f"{self.key} = {self.new!r}"
        what = f"remove {self.key}" if self.new is None else what
        return f"{what} (now {self.old!r}): {self.reason}"


def ratios_of(config: RigConfig, findings: Findings) -> list[float]:
    """What each drive turned the phone, as a share of what it was commanded."""
    scales = [axis.pulses_per_deg for axis in config.axes]
    return [float(ratio) for ratio in np.abs(findings.deg_per_pulse * scales)]


def require_unit(
    config: RigConfig, ratios: Sequence[float], proved: bool = False
) -> None:
    """MotionFault where the phone's unit is not the configured one, or not clear.

    Two gearings of the file that agree with the phone prove it (of a single axis the
    one): both would have to be wrong by 57.3. ``ratios``: measured against commanded by
    the drives' own registers; ``proved``: not all turn as if it were the other.
    """
    unit = config.phone.unit
    other, factor = ("rad", RADIANS) if unit == "deg" else ("deg", 1.0 / RADIANS)
    shown, (low, high) = _seen(config, ratios), NEAR_UNIT
    if all(low <= ratio * factor <= high for ratio in ratios):
        raise MotionFault(
            f'{shown}, about {1 / factor:.3g}: rig.toml has imu.unit = "{unit}", but '
            f'the phone sends {other}. Set imu.unit = "{other}", {AGAIN}'
        )
    low, high = SOUND_RATIO
    sound = sum(low <= ratio <= high for ratio in ratios)
    if not proved and sound < min(2, len(ratios)):
        raise MotionFault(
            f"{shown}, and no angle of the phone exceeds 6.3: either imu.unit or the "
            f"gearings are wrong. {BY_PLATE}"
        )


def require_gearing(
    config: RigConfig, ratios: Sequence[float], told: Sequence[int | None]
) -> None:
    """MotionFault where a gearing off by more than 2 has no second proof: the drive's
    own register (``told`` pulses for one turn, or None), or another axis that turns as
    it is told. What is off on all may be the phone, or the file."""
    low, high = SOUND_RATIO
    if any(low <= ratio <= high for ratio in ratios):
        return
    for axis, ratio, register in zip(config.axes, ratios, told, strict=True):
        if register is None and max(ratio, 1.0 / ratio) > UNPROVED_FACTOR:
            raise MotionFault(
                f"{_seen(config, ratios)}, and the drive of {axis.name} has no "
                f"register for its pulses per turn, so the cause is unknown. {BY_PLATE}"
            )


def _seen(config: RigConfig, ratios: Sequence[float]) -> str:
    *most, last = config.axis_names
    names = f"{', '.join(most)} and {last}" if most else last
    text = ", ".join(f"{ratio:.3g}" for ratio in ratios)
    return f"the phone turned {text} of what {names} were commanded"


def proposals(
    config: RigConfig, findings: Findings, told: Sequence[int | None]
) -> list[Change]:
    """Corrections of a configuration whose phone's unit is proved; ``told``: pulses for
    one turn by each drive's own word, None where it has none."""
    tables = {table["name"]: table for table in tomllib.loads(config.text)["axes"]}
    changes: list[Change] = []
    low, high = SOUND_RATIO
    for drive, joint in enumerate(findings.joints):
        source, axis = config.axes[drive], config.axes[joint]
        edits: dict[str, tuple[Any, Any, str]] = {}  # key: old, new, reason
        for name in OF_DRIVE:
            # A map stands in the file as its name or its path.
            old, new = tables[axis.name].get(name), tables[source.name].get(name)
            reason = f"unit {source.unit} turns {axis.name}"
            if name == "pulses_per_rev" and told[drive] not in (None, new):
                new, reason = told[drive], f"unit {source.unit} reports it"
            edits[name] = old, new, reason
        rate = findings.deg_per_pulse[drive]
        pulses = told[drive] or source.pulses_per_rev
        reason = f"positive pulses turn it in the {_way(rate)} direction"
        edits["direction"] = axis.direction, 1 if rate > 0 else -1, reason
        geared = axis.model_copy(update={"pulses_per_rev": pulses})
        ratio = abs(float(rate) * geared.pulses_per_deg)
        if not low <= ratio <= high:
            new = float(f"{axis.reduction / ratio:.{DIGITS}g}")
            reason = f"it turns {ratio:.3g} of the command; allowed is {low:g} to "
            edits["reduction"] = axis.reduction, new, f"{reason}{high:g}"
        for name, values in edits.items():
            if values[0] != values[1]:
                changes.append(Change(f"axes.{axis.name}.{name}", *values))
    if findings.turned_deg > MOUNTING_DEG:
        angles = matrix_to_euler(findings.mounting, "ZYX").round(2) + 0.0
        before, reason = list(config.phone.mounting_deg), "the axes place the phone"
        reason += f" {findings.turned_deg:.1f} deg from there"
        changes.append(Change("imu.mounting_deg", before, angles.tolist(), reason))
    if findings.order is not None and findings.order != config.joint_order:
        reason = "combined moves show which joint carries which"
        order, letters = config.mechanism.order, iter(str(findings.order))
        # What no joint turns about keeps its place.
        new = "".join(next(letters) if at in config.letters else at for at in order)
        changes.append(Change("mechanism.order", order, new, reason))
    return changes


def _way(rate: float) -> str:
    return "positive" if rate > 0 else "negative"


def lines(config: RigConfig, findings: Findings) -> list[str]:
    """The findings in words, a line for each drive and each thing found."""
    ratios = ratios_of(config, findings)
    text = ["  unit  turns   sense     measured/commanded"]
    for drive, joint in enumerate(findings.joints):
        axis, unit = config.axes[joint], config.axes[drive].unit
        text.append(
            f"  {unit:>4}  {axis.name:<6}  {_way(findings.deg_per_pulse[drive]):<8}  "
            f"{ratios[drive]:18.3f}"
        )
    text.append(f"  phone: turned {findings.turned_deg:.1f} deg from imu.mounting_deg")
    if config.is_arm:
        text.append("  parallel joints look alike: watch that the right one moves")
    else:
        order = findings.order or "not clear from these moves"
        text.append(f"  joints from the base outwards: {order}")
    return text
