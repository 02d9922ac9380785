"""A calibrated arm as robots read it: the user's URDF file, a DH table, UR's YAML.

A joint of the file moves by ``M(v) = C^-1 Rz(v) C`` with a constant C, so the
constants between its joints follow from the table: ``K = C^-1 D C'``, D a row of it.
"""

from __future__ import annotations

import functools
import re
import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from jaxcal.arms.arguments import pose_matrix
from jaxcal.arms.arm import Arm
from jaxcal.arms.files.urdf import (
    UR,
    Part,
    described,
    joints_of,
    links_of,
    parts_of,
    row_matrix,
    turn_of_z,
)
from jaxcal.arms.sensors.sensor import BASE
from jaxcal.checks import Array, one_of
from jaxcal.files import AnyPath, write_over
from jaxcal.models.model import as_parameters

if TYPE_CHECKING:
    from jaxcal.arms.chain import SerialChain as Chain
    from jaxcal.arms.chains import Chains

_TAG = re.compile(rb"""(?:[^>"']+|"[^"]*"|'[^']*')*>""")
_SAME = 1e-13  # metres and radians: no correction
_AGREE = 1e-9  # metres and radians: the same correction
_POSTURES = 500  # that show where an arm stands


def write(
    model: Chain | Chains,
    form: str,
    path: AnyPath,
    parameters: ArrayLike,
    *,
    force: bool = False,
) -> str:
    """Write the arm with ``parameters`` as a file that robots read; of ``Chains`` the
    URDF file that all came from, every chain corrected.

    Args:
        form: "urdf" is the file that the arm came from, its origins corrected, base in
            the measuring frame included. "dh" is the table as CSV, without base, tool
            and convention; a warning names joints that follow others. "ur" is the YAML
            file of Universal Robots' ROS description, without base and tool.
        parameters: (p,) as ``identify`` found them.

    Returns:
        Of "urdf" the tip links, a new one where no fixed joint could hold the tool.

    Raises:
        ValueError: the arm is not of the form; a gear ratio, compliance or harmonics
            were found, which none can hold.
        FileExistsError: there is a file and ``force`` is not given.
    """
    theta, pairs, tips = as_parameters(model, parameters), [], [""]
    arms = getattr(model, "chains", (model,))
    members = getattr(model, "members", (slice(None),))
    names = getattr(model, "tips", ("",))  # of several arms
    for arm, name, of_arm in zip(arms, names, members, strict=True):
        ratios, yields, waves = arm._drives(theta[of_arm])
        at = np.flatnonzero(ratios != 1.0)
        lost = [f"gear{i + 1} is {ratios[i]:.6g}" for i in at]
        lost += [f"compliance{arm.compliance[i]}" for i in np.flatnonzero(yields)]
        bent = np.flatnonzero(waves.any(axis=1))
        lost += [f"harmonics of joint {arm.harmonics[i]}" for i in bent]
        if lost:
            whose = f"{name}: " if name else ""
            raise ValueError(
                f"{whose}{', '.join(lost)}, which this file format cannot hold"
            )
        pairs.append((arm, arm.calibrated(theta[of_arm])))
    one_of("form", form, ("urdf", "dh", "ur") if len(arms) == 1 else ("urdf",))
    if form == "urdf":
        text, tips = urdf_text(pairs)
    else:
        text = _dh_text(pairs[0][1]) if form == "dh" else _ur_text(*pairs[0])
    write_over(path, text, force)
    return ", ".join(tips)


def standing_as(arm: Chain, other: Any, parameters: Array, commands: Array) -> Array:
    """(p,) ``parameters``, the base where the tip is nearest to that of ``other``, over
    all postures within the limits, a turn or the range of ``commands``."""
    joints = commands[:, : arm.num_joints]
    turns = np.array(arm.command_units)[:, None] == "deg"
    limits = np.where(turns, arm.limits.clip(-180.0, 180.0), arm.limits)
    ranges = np.column_stack([joints.min(axis=0), joints.max(axis=0)])
    low, high = np.where(np.isfinite(limits), limits, ranges).T
    rng = np.random.default_rng(0)
    postures = rng.uniform(low, high, (_POSTURES, len(low)))
    tips = arm.calibrated(parameters).predict(postures)
    targets = np.asarray(other.predict(postures))
    middle, there = tips.mean(axis=0), targets.mean(axis=0)
    turn, _ = Rotation.align_vectors(targets - there, tips - middle)
    at = [arm.names.index(name) for name in BASE]
    base = pose_matrix(parameters[at])
    moved = parameters.copy()
    turned = (turn * Rotation.from_matrix(base[:3, :3])).as_euler("XYZ", True)
    moved[at] = [*(turn.apply(base[:3, 3] - middle) + there), *turned]
    return moved


def urdf_text(chains: Sequence[tuple[Arm, Arm]]) -> tuple[str, list[str]]:
    """The file of nominal chains with the origins of calibrated ones, and its tips."""
    source = chains[0][0].source
    if any(nominal.source is None for nominal, _ in chains) or source is None:
        raise ValueError("the arm must come from a URDF file: SerialChain.from_urdf")
    text = source["text"]
    links, joints = links_of(text), joints_of(text)
    origins: dict[str, Array] = {}
    more, tips = "", []
    for nominal, calibrated in chains:
        file = nominal.source or {}
        if file["text"] != text:
            raise ValueError("all chains must come from the same URDF file")
        corrected, extra = _origins(nominal, calibrated)
        for joint, origin in corrected.items():
            if joint in origins and np.abs(origin - origins[joint]).max() > _AGREE:
                raise ValueError(f"the chains have joint {joint} in different places")
        origins |= corrected
        name = file["tip"]
        if extra is not None:
            name += "_calibrated"
            while name in links or f"{name}_joint" in joints:  # calibrated before
                name += "_again"
            more += fixed_joint(file["tip"], name, extra)
        tips.append(name)
    return with_origins(text, origins, more), tips


def fixed_joint(parent: str, child: str, matrix: Array) -> str:
    """A link and the joint that fixes it in another, as a URDF file has them."""
    numbers, link = pose_words(matrix), quoteattr(child)
    return (
        f"  <link name={link}/>\n"
        f'  <joint name={quoteattr(f"{child}_joint")} type="fixed">\n'
        f"    <parent link={quoteattr(parent)}/>\n    <child link={link}/>\n"
        f'    <origin xyz="{numbers["xyz"]}" rpy="{numbers["rpy"]}"/>\n'
        "  </joint>\n"
    )


def _dh_text(calibrated: Arm) -> str:
    """The table as CSV: joint, a, alpha, d, theta (with the offset), beta."""
    names, others = _moved_by(calibrated)
    if others:
        warnings.warn(
            f"the table cannot hold coupled joints: {', '.join(others)}", stacklevel=3
        )
    table = calibrated.table.copy()
    at = [3 if kind == "R" else 2 for kind in calibrated.joints]  # theta or d
    table[range(len(at)), at] += calibrated.offset
    both = zip(names, table.tolist(), strict=True)
    rows = [",".join([name, *map(repr, row)]) for name, row in both]
    return "\n".join(["joint,a,alpha,d,theta,beta", *rows, ""])


def _moved_by(arm: Arm) -> tuple[list[str], list[str]]:
    """The joints' names, of columns that move them by one, and how others move."""
    names: list[str] = []
    others = []
    for i in range(len(arm.joints)):
        by = arm._driven_by(i)
        if list(by.values()) == [1.0] and not set(by) & set(names):
            names += by
            continue
        names.append(f"joint {i + 1}")
        terms = " + ".join(f"{times:g} {name}" for name, times in by.items())
        others.append(f"joint {i + 1} moves by {terms or 0}")
    return names, others


def _ur_text(nominal: Arm, calibrated: Arm) -> str:
    """The kinematics file of Universal Robots' ROS description, in metres."""
    if nominal.joints != "RRRRRR" or nominal.convention != "standard":
        raise ValueError(
            "the arm must have six revolute joints and a standard table, got "
            f"{nominal.joints} and {nominal.convention}"
        )
    if nominal.length > 20.0:
        raise ValueError(
            "the table must be in metres for this file, got a total length of "
            f"{nominal.length:g}"
        )
    for follows in _moved_by(nominal)[1]:
        raise ValueError(f"{follows}, which this file cannot hold")
    if nominal.source is not None:
        gaps, steps = _steps(nominal, calibrated)
        parts = [part for gap in gaps for part in gap if part.leader]
        # The file's joints turn about z: each frame is turned so that its axis is z.
        turns = [np.eye(4) for _ in parts]
        for turn, part in zip(turns, parts, strict=True):
            axis = part.joint.axis
            turn[:3, :3] = turn_of_z(axis if part.down else -axis)
        steps[0] = _product(gaps[0][-1:])  # what is before it is the base
        both = zip([np.eye(4), *turns], steps, turns, strict=False)
        frames = [np.linalg.inv(before) @ step @ turn for before, step, turn in both]
    else:
        frames, before = [], np.eye(4)
        for row in calibrated.table:
            frames.append(before @ row_matrix(row * [0.0, 0.0, 1.0, 1.0, 0.0]))
            before = row_matrix(row * [1.0, 1.0, 0.0, 0.0, 1.0])
    lines = ["kinematics:"]
    for name, frame, zero in zip(UR, frames, nominal.offset, strict=True):
        pose = pose_words(frame @ row_matrix(np.array([0.0, 0.0, 0.0, zero, 0.0])))
        values = f"{pose['xyz']} {pose['rpy']}".split()
        pairs = zip(("x", "y", "z", "roll", "pitch", "yaw"), values, strict=True)
        lines += [f"  {name}:", *(f"    {key}: {value}" for key, value in pairs)]
    return "\n".join([*lines, "  hash: calibrated_by_jaxcal", ""])


def _steps(nominal: Arm, calibrated: Arm) -> tuple[list[list[Part]], list[Array]]:
    """The gaps of the file, and what each of them is as calibrated, (4, 4)."""
    # What stands still before the first moving joint, between them, after the last.
    gaps: list[list[Part]] = [[]]
    for part in parts_of(nominal.source or {}):
        if part.leader and not part.down:
            gaps.append([])
        gaps[-1].append(part)
        if part.leader and part.down:
            gaps.append([])
    # The nominal base may be where a tracker sees it, and not the file's.
    base = described(nominal.source or {})["base"]
    rows = [row_matrix(row) for row in nominal.table]
    new = [row_matrix(row) for row in calibrated.table]
    turns = [np.linalg.inv(base) @ _product(gaps[0])]
    for row, gap in zip(rows[:-1], gaps[1:-1], strict=True):
        turns.append(np.linalg.inv(row) @ turns[-1] @ _product(gap))
    steps = [calibrated.base @ turns[0]]
    for turn, row, after in zip(turns, new, [*turns[1:], calibrated.tool], strict=True):
        steps.append(np.linalg.inv(turn) @ row @ after)
    return gaps, steps


def _origins(nominal: Arm, calibrated: Arm) -> tuple[dict[str, Array], Array | None]:
    """New origins by joint, and what no joint before the tip can hold, if anything."""
    origins: dict[str, Array] = {}
    extra = None
    for i, (gap, matrix) in enumerate(zip(*_steps(nominal, calibrated), strict=True)):
        if np.abs(matrix - _product(gap)).max() < _SAME:
            continue
        if not gap and i:
            extra = matrix
            continue
        if not gap:
            base = (nominal.source or {})["base"]
            raise ValueError(
                f"base {base!r} moves with its joint and cannot be "
                "corrected: choose or add a link fixed to it as base"
            )
        at = max((k for k, x in enumerate(gap) if x.leader), default=len(gap) - 1)
        before, after = _product(gap[:at]), _product(gap[at + 1 :])
        part, held = gap[at], np.linalg.inv(before) @ matrix @ np.linalg.inv(after)
        whole = held if part.down else np.linalg.inv(held)
        origins[part.joint.name] = whole @ np.linalg.inv(part.stands)
    return origins, extra


def _product(gap: list[Part]) -> Array:
    return functools.reduce(np.matmul, [part.matrix for part in gap], np.eye(4))


def pose_words(matrix: Array) -> dict[str, str]:
    """xyz and rpy as URDF files have them; exact near the poles of the angles too."""
    turn = matrix[:3, :3]
    yaw = np.arctan2(turn[1, 0], turn[0, 0])
    pitch = np.arctan2(-turn[2, 0], np.hypot(turn[0, 0], turn[1, 0]))
    across = np.array([-np.sin(yaw), np.cos(yaw), 0.0])  # the y axis before the roll
    roll = np.arctan2(-(across @ turn[:, 2]), across @ turn[:, 1])
    values = {"xyz": matrix[:3, 3].tolist(), "rpy": [roll, pitch, yaw]}
    return {key: " ".join(repr(float(x)) for x in row) for key, row in values.items()}


def with_origins(text: str, origins: Mapping[str, Array], more: str = "") -> str:
    """``text`` with other origins of some joints and ``more`` at the robot's end."""
    data = text.encode("utf-8", "surrogateescape")
    if b"\0" in data:
        raise ValueError(
            "the URDF file is in UTF-16, which cannot be written: save it as UTF-8"
        )
    places, last = _places(data)
    newline = "\r\n" if "\r\n" in text else "\n"
    more = more.replace("\n", newline)
    edits = [(last, last, more.encode("ascii", "xmlcharrefreplace"))]
    for name, matrix in origins.items():
        pose = pose_words(matrix)
        joint, origin = places[name]
        end = _end_of_tag(data, joint if origin is None else origin)
        if origin is None:
            tag = f'{newline}    <origin xyz="{pose["xyz"]}" rpy="{pose["rpy"]}"/>'
            edits.append((end, end, tag.encode()))
            continue
        tag = data[origin:end].decode("utf-8", "surrogateescape")
        for key, words in pose.items():
            there = re.compile(rf"""(\s{key}\s*=\s*)(["'])[^"']*\2""")
            if there.search(tag):
                tag = there.sub(rf'\g<1>"{words}"', tag)
            else:
                tag = tag.replace("<origin", f'<origin {key}="{words}"', 1)
        edits.append((origin, end, tag.encode("utf-8", "surrogateescape")))
    for start, end, new in sorted(edits, reverse=True):
        data = data[:start] + new + data[end:]
    text = data.decode("utf-8", "surrogateescape")
    joints = joints_of(text)
    for name, matrix in origins.items():
        if not np.abs(joints[name].origin - matrix).max() < 1e-9:
            raise ValueError(
                f"<origin> of joint {name} cannot be written: it must be plain "
                '<origin xyz="..." rpy="..."/>'
            )
    return text


def _places(data: bytes) -> tuple[dict[str, tuple[int, int | None]], int]:
    """For each joint of a URDF file where its tag and its origin's begin, in bytes; the
    end of the robot."""
    parser = expat.ParserCreate()
    path: list[str] = []
    places: dict[str, tuple[int, int | None]] = {}
    last = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        path.append(tag)
        if path == ["robot", "joint"]:
            places[attributes["name"]] = (parser.CurrentByteIndex, None)
        elif path == ["robot", "joint", "origin"]:
            name = [*places][-1]
            if places[name][1] is None:
                places[name] = (places[name][0], parser.CurrentByteIndex)

    def end(_tag: str) -> None:
        nonlocal last
        path.pop()
        last = parser.CurrentByteIndex

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.Parse(data, True)
    return places, last


def _end_of_tag(data: bytes, start: int) -> int:
    """One after the > of the tag that begins at ``start``."""
    return _TAG.match(data, start).end()  # type: ignore[union-attr]  # it was parsed
