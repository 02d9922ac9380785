"""The chain between two links of a URDF file, as a DH table.

The joint axes at zero are lines in space; the table follows from them alone, so every
arm gets the same five parameters a joint, whatever frames its file uses.
"""

from __future__ import annotations

import functools
import os
import pathlib
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np
from scipy.spatial.transform import Rotation

from jaxcal.checks import Array, numbers, one_of
from jaxcal.files import AnyPath

_PARALLEL = 0.2  # sine; below it the common normal of two axes is far away


class Joint(NamedTuple):
    """A joint of the file."""

    name: str
    kind: str  # "R", "P" or "" for fixed
    parent: str
    child: str
    origin: Array  # (4, 4)
    axis: Array  # (3,) unit
    mimic: tuple[str, float, float] | None  # leader, multiplier, offset as in the file
    limits: tuple[float, float]  # as in the file, infinite where not known


_XACRO = "xacro file: expand it first, xacro arm.xacro > arm.urdf"
_KINDS = {"revolute": "R", "continuous": "R", "prismatic": "P", "fixed": ""}


def read_urdf(
    path: AnyPath, tip: str | None, base: str | None, locked: Mapping[str, float]
) -> dict[str, Any]:
    """Arguments of ``SerialChain.from_dh``; angles in degrees, lengths in metres.

    Raises:
        ValueError: the file is malformed or a xacro file, a joint of the chain is of
            another type, the links form a loop, or ``tip``, ``base`` or ``locked`` is
            not in it.
    """
    name = os.fspath(path)
    # Bytes of any encoding and ends of lines come through text unchanged.
    text = pathlib.Path(path).read_bytes().decode("utf-8", "surrogateescape")
    try:
        chain = list(walk(text, base, tip, locked))
        (first, down), (last, ends_down) = chain[0], chain[-1]
        base = first.parent if down else first.child
        tip = last.child if ends_down else last.parent
        source = {"text": text, "locked": dict(locked), "base": base, "tip": tip}
        return described(source)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


def walk(
    text: str, base: str | None, tip: str | None, locked: Mapping[str, float]
) -> Iterator[tuple[Joint, bool]]:
    """The joints from ``base`` to ``tip``, and whether each is passed downwards."""
    joints = joints_of(text)
    for name, value in locked.items():
        one_of("locked joint", name, tuple(joints))
        numbers(f"locked[{name!r}]", value)
    above: dict[str, Joint] = {}
    for joint in joints.values():
        if joint.child in above:
            raise ValueError(
                f"link {joint.child} is the child of two joints, "
                f"{above[joint.child].name} and {joint.name}; a chain cannot have loops"
            )
        above[joint.child] = joint
    links = links_of(text)
    for argument, link in (("tip", tip), ("base", base)):
        if link is not None:
            one_of(f"{argument} link", link, links)
    if tip is None:
        parents = {joint.parent for joint in above.values()}
        leaves = [link for link in links if link not in parents]
        if len(leaves) != 1:
            raise ValueError(
                f"--tip (tip=) is missing: the file has {len(leaves)} end links "
                f"({', '.join(leaves) or 'a loop'})"
            )
        tip = leaves[0]
    down = _up(tip, above)
    up = [] if base is None else _up(base, above)
    while up and down and up[-1].name == down[-1].name:
        up.pop()
        down.pop()
    top = {up[-1].parent if up else base, down[-1].parent if down else tip}
    if base is not None and len(top) > 1:
        raise ValueError(f"base {base!r} and tip {tip!r} are not connected")
    if not up and not down:
        raise ValueError(f"no movable joint between base {base!r} and tip {tip!r}")
    yield from ((joint, False) for joint in up)
    yield from ((joint, True) for joint in reversed(down))


def _up(link: str, above: dict[str, Joint]) -> list[Joint]:
    """Joints from a link up to its root."""
    found: list[Joint] = []
    while link in above:
        if len(found) == len(above):
            names = ", ".join(dict.fromkeys(joint.name for joint in reversed(found)))
            raise ValueError(f"the joints {names} form a loop")
        found.append(above[link])
        link = above[link].parent
    return found


def _robot(text: str) -> ElementTree.Element:
    # Without name spaces: files of robots have prefixes that nothing declares.
    builder, parser = ElementTree.TreeBuilder(), expat.ParserCreate()
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    try:
        parser.Parse(text.encode("utf-8", "surrogateescape"), True)
    except expat.ExpatError as error:
        raise ValueError(f"is not a URDF file: {error}") from error
    robot = builder.close()
    # Expanded files may keep the name space, and comments with it.
    if any(element.tag.startswith("xacro:") for element in robot.iter()):
        raise ValueError(f"it is a {_XACRO}")
    if robot.tag != "robot":
        raise ValueError(f"the root element must be <robot>, got <{robot.tag}>")
    return robot


@functools.lru_cache(4)
def links_of(text: str) -> tuple[str, ...]:
    return tuple(_name(link, "link") for link in _robot(text).findall("link"))


@functools.lru_cache(4)
def joints_of(text: str) -> Mapping[str, Joint]:
    """The joints of a file by name."""
    links, joints = links_of(text), {}
    for element in _robot(text).findall("joint"):
        joint = _read_joint(element)
        for link in (joint.parent, joint.child):
            if link not in links:
                raise ValueError(
                    f"joint {joint.name} names the link {link!r}, which is not in the "
                    "file"
                )
        if joint.name in joints:
            raise ValueError(f"two joints are named {joint.name}")
        joints[joint.name] = joint
    return joints


def _name(element: ElementTree.Element, what: str) -> str:
    name = element.get("name")
    if not name:
        raise ValueError(f"a <{what}> has no name")
    return name


def _read_joint(element: ElementTree.Element) -> Joint:
    name = _name(element, "joint")
    kind = element.get("type", "none")

    def text(tag: str, attribute: str) -> str | None:
        child = element.find(tag)
        return None if child is None else child.get(attribute)

    def reference(tag: str, attribute: str) -> str:
        link = text(tag, attribute)
        if not link:
            raise ValueError(f"joint {name} has no <{tag} {attribute}=...>")
        return link

    def values(tag: str, attribute: str, *default: float) -> Array:
        words = text(tag, attribute)
        if words is None:
            return np.array(default)
        try:
            array = np.array([float(word) for word in words.split()])
        except ValueError:
            array = np.zeros(0)
        if array.shape != (len(default),) or not np.isfinite(array).all():
            count = {1: "a number", 3: "three numbers"}[len(default)]
            raise ValueError(
                f"{attribute} of <{tag}> of joint {name} must be {count}, got {words!r}"
                + (f": a {_XACRO}" if "${" in words else "")
            )
        return array

    if quaternion := text("origin", "quat_xyzw"):
        raise ValueError(
            f"<origin> of joint {name} must give its rotation as rpy in radians, got "
            f"quat_xyzw={quaternion!r}"
        )
    origin = np.eye(4)
    origin[:3, 3] = values("origin", "xyz", 0.0, 0.0, 0.0)
    turn = values("origin", "rpy", 0.0, 0.0, 0.0)
    origin[:3, :3] = Rotation.from_euler("xyz", turn).as_matrix()
    axis = values("axis", "xyz", 1.0, 0.0, 0.0)
    length = np.linalg.norm(axis)
    if _KINDS.get(kind) and not length > 0.0:
        raise ValueError(f"the axis of joint {name} must not be zero")
    mimic = None
    if element.find("mimic") is not None:
        times, plus = values("mimic", "multiplier", 1.0), values("mimic", "offset", 0.0)
        mimic = reference("mimic", "joint"), float(times[0]), float(plus[0])
    (low,), (high,) = values("limit", "lower", 0.0), values("limit", "upper", 0.0)
    limited = kind in ("revolute", "prismatic") and low < high
    return Joint(
        name,
        _KINDS.get(kind, kind),
        reference("parent", "link"),
        reference("child", "link"),
        origin,
        axis / (length or 1.0),
        mimic,
        (float(low), float(high)) if limited else (-np.inf, np.inf),
    )


def led(
    joint: Joint, joints: Mapping[str, Joint], locked: Mapping[str, float]
) -> tuple[str | None, float, float]:
    """The joint whose command moves this one, None where it stands still; how far; its
    value at zero in degrees and metres."""
    if joint.kind not in ("R", "P", ""):
        raise ValueError(
            f"type of joint {joint.name} must be one of {', '.join(_KINDS)}, "
            f"got {joint.kind!r}"
        )
    times, plus, unit = 1.0, 0.0, _unit(joint)
    followed = [joint.name]
    while joint.name not in locked:
        if not joint.kind:
            return None, 0.0, plus / unit
        if joint.mimic is None:
            return joint.name, times * _unit(joint) / unit, plus / unit
        leader, by, more = joint.mimic
        if leader not in joints or leader in followed:
            raise ValueError(
                f"joint {joint.name} must mimic another joint of the file, "
                f"got {leader!r}"
            )
        plus += times * more
        times *= by
        joint = joints[leader]
        followed.append(leader)
    return None, 0.0, (plus + times * locked[joint.name] * _unit(joint)) / unit


def _unit(joint: Joint) -> float:
    """Ours in the file's: degrees in radians, metres in metres."""
    return float(np.radians(1.0)) if joint.kind == "R" else 1.0


class Part(NamedTuple):
    """A joint on the way, what moves it, and its transform without that."""

    joint: Joint
    down: bool
    leader: str | None  # the joint whose command moves it, None where it stands still
    times: float
    plus: float

    @property
    def stands(self) -> Array:
        """(4, 4) of a joint that is held somewhere, in degrees or metres."""
        matrix, way = np.eye(4), self.plus * self.joint.axis
        if self.joint.kind == "R" and self.leader is None:
            matrix[:3, :3] = Rotation.from_rotvec(way, degrees=True).as_matrix()
        elif self.joint.kind == "P" and self.leader is None:
            matrix[:3, 3] = way
        return matrix

    @property
    def matrix(self) -> Array:
        whole = self.joint.origin @ self.stands
        return np.asarray(whole if self.down else np.linalg.inv(whole))


def parts_of(source: Mapping[str, Any]) -> list[Part]:
    """The joints of an arm's file from its base to its tip."""
    joints, locked = joints_of(source["text"]), source["locked"]
    chain = walk(source["text"], source["base"], source["tip"], locked)
    return [Part(joint, down, *led(joint, joints, locked)) for joint, down in chain]


def described(source: Mapping[str, Any]) -> dict[str, Any]:
    """``table_of`` an arm's file, of its base and tip as they are there."""
    parts = parts_of(source)
    if not any(part.leader for part in parts):
        raise ValueError(
            f"no movable joint between base {source['base']!r} and tip "
            f"{source['tip']!r}"
        )
    return table_of(parts, joints_of(source["text"])) | {"source": dict(source)}


def table_of(parts: list[Part], joints: Mapping[str, Joint]) -> dict[str, Any]:
    frame = np.eye(4)
    lines = []
    for part in parts:
        if part.down:
            frame = frame @ part.matrix
        if part.leader:
            axis = frame[:3, :3] @ part.joint.axis
            lines.append((axis if part.down else -axis, frame[:3, 3]))
        if not part.down:
            frame = frame @ part.matrix
    driven = [part for part in parts if part.leader]
    _, _, leaders, times, plus = zip(*driven, strict=True)
    columns = list(dict.fromkeys(leaders))
    drive = np.equal.outer(leaders, columns) * np.array(times)[:, None]
    limits = [np.array(joints[c].limits) / _unit(joints[c]) for c in columns]
    base = np.eye(4)
    base[:3, :3], base[:3, 3] = turn_of_z(lines[0][0]), lines[0][1]
    rows, reached = [], base
    for axis, point in lines[1:]:
        rows.append(_row(reached, axis, point))
        reached = reached @ row_matrix(rows[-1])
    return {
        "table": np.array([*rows, np.zeros(5)]),
        "joints": "".join(part.joint.kind for part in driven),
        "joint_names": tuple(columns),
        "base": base,
        "tool": np.linalg.inv(reached) @ frame,
        "drive": drive,
        "offset": np.array(plus),
        "limits": np.array(limits),
    }


UR = {  # sections of Universal Robots' file, and the joints that they are of
    "shoulder": "shoulder_pan_joint",
    "upper_arm": "shoulder_lift_joint",
    "forearm": "elbow_joint",
    "wrist_1": "wrist_1_joint",
    "wrist_2": "wrist_2_joint",
    "wrist_3": "wrist_3_joint",
}


def read_ur_kinematics(path: AnyPath) -> dict[str, Any]:
    """Arguments of ``from_dh``, of Universal Robots' kinematics file."""
    text = pathlib.Path(path).read_text(encoding="utf-8")
    poses: dict[str, dict[str, float]] = {}
    link, parts = "", []
    for line in text.splitlines():
        key, _, value = line.partition("#")[0].strip().partition(":")
        if key in UR:
            link = key
        elif link and key in ("x", "y", "z", "roll", "pitch", "yaw"):
            poses.setdefault(link, {})[key] = float(value)
    for link, name in UR.items():
        if len(poses.get(link, ())) != 6:
            raise ValueError(
                f"{os.fspath(path)}: {link} needs x, y, z, roll, pitch, yaw, as in the "
                "kinematics file of Universal Robots' ROS description"
            )
        origin, pose = np.eye(4), poses[link]
        angles = [pose[angle] for angle in ("roll", "pitch", "yaw")]
        origin[:3, :3] = Rotation.from_euler("xyz", angles).as_matrix()
        origin[:3, 3] = [pose[axis] for axis in "xyz"]
        axis, ends = np.array([0.0, 0.0, 1.0]), (-2.0 * np.pi, 2.0 * np.pi)
        joint = Joint(name, "R", "", link, origin, axis, None, ends)
        parts.append(Part(joint, True, name, 1.0, 0.0))
    return table_of(parts, {part.joint.name: part.joint for part in parts})


def turn_of_z(axis: Array) -> Array:
    """(3, 3) the smallest rotation that takes z to ``axis``."""
    x, y, z = axis
    across = x * x + y * y
    if across < 1e-60:
        return np.diag([1.0, np.sign(z), np.sign(z)])
    share = (1.0 - z) / across  # 1 / (1 + z), exact near -1 too
    return np.array(
        [
            [1.0 - share * x * x, -share * x * y, x],
            [-share * x * y, 1.0 - share * y * y, y],
            [-x, -y, z],
        ]
    )


def _row(frame: Array, axis: Array, point: Array) -> Array:
    """a, alpha, d, theta, beta from ``frame`` to one with its z on the next axis."""
    axis = frame[:3, :3].T @ axis
    point = frame[:3, :3].T @ (point - frame[:3, 3])
    normal = np.array([-axis[1], axis[0], 0.0])  # z x axis
    sine = np.linalg.norm(normal)
    if sine > _PARALLEL:
        normal /= sine
        a = float(normal @ point)
        if a < -1e-12 or (abs(a) <= 1e-12 and normal[0] < 0.0):
            normal, a = -normal, -a
        # The foot of the common normal on the next axis has this height on ours.
        across = np.array([-normal[1], normal[0], 0.0])
        along = -(point @ across) / (axis @ across)
        d = point[2] + along * axis[2]
    else:
        normal = np.array([point[0], point[1], 0.0])
        a = float(np.linalg.norm(normal))
        normal = normal / a if a > 1e-12 else np.array([1.0, 0.0, 0.0])
        d = point[2]
    theta = np.arctan2(normal[1], normal[0])
    across = np.array([-normal[1], normal[0], 0.0])
    beta = np.arcsin(np.clip(axis @ normal, -1.0, 1.0))
    alpha = np.arctan2(-(axis @ across), axis[2])
    row = np.array([a, np.degrees(alpha), d, np.degrees(theta), np.degrees(beta)])
    return np.where(np.abs(row) < 1e-13, 0.0, row)


def row_matrix(row: Array) -> Array:
    """(4, 4) of a row a, alpha, d, theta, beta at a command of zero."""
    a, alpha, d, theta, beta = row
    matrix, about = np.eye(4), np.radians(theta)
    turn = Rotation.from_euler("ZXY", [theta, alpha, beta], degrees=True)
    matrix[:3, :3] = turn.as_matrix()
    matrix[:3, 3] = a * np.cos(about), a * np.sin(about), d
    return matrix
