"""The chain between two links of a URDF file, as a DH table.

The joint axes at zero are lines in space; the table follows from them alone, so every
arm gets the same five parameters a joint, whatever frames its file uses.
"""

from __future__ import annotations

import os
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

__all__ = ["Chain", "read_urdf"]

Array = NDArray[np.float64]

_PARALLEL = 1e-3  # sine; below it the common normal of two axes is ill defined


class Chain(NamedTuple):
    """A standard table with beta; angles in degrees, lengths in metres."""

    table: Array  # (n, 5)
    joints: str
    names: tuple[str, ...]
    base: Array  # (4, 4)
    tool: Array  # (4, 4)


class _Joint(NamedTuple):
    name: str
    kind: str  # "R", "P" or "" for fixed
    parent: str
    child: str
    origin: Array  # (4, 4)
    axis: Array  # (3,) unit
    mimics: bool


_KINDS = {"revolute": "R", "continuous": "R", "prismatic": "P", "fixed": ""}


def read_urdf(
    path: str | os.PathLike[str], tip: str | None = None, base: str | None = None
) -> Chain:
    """Raises:
    ValueError: the file is malformed, a joint is of another type or mimics another,
        the links form a loop, or ``tip`` and ``base`` are not links one above the
        other; the message names the link or joint.
    """
    try:
        robot = ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        raise ValueError(f"{path} is not a URDF file: {error}") from error
    if robot.tag != "robot":
        raise ValueError(f"{path} must hold a <robot>, got <{robot.tag}>")
    links = [_name(link, "link", path) for link in robot.findall("link")]
    above: dict[str, _Joint] = {}
    for element in robot.findall("joint"):
        joint = _read_joint(element, path)
        for link in (joint.parent, joint.child):
            if link not in links:
                raise ValueError(
                    f"{path}: joint {joint.name} names the link {link!r}, which the "
                    "file does not hold"
                )
        if joint.child in above:
            raise ValueError(
                f"{path}: link {joint.child} is the child of the joints "
                f"{above[joint.child].name} and {joint.name}; a chain cannot hold loops"
            )
        above[joint.child] = joint
    chain = _chain(above, links, tip, base, path)
    moving = [joint for joint in chain if joint.kind]
    if not moving:
        raise ValueError(f"{path}: no joint moves between the base and {tip!r}")
    for joint in moving:
        if joint.mimics:
            raise ValueError(
                f"{path}: joint {joint.name} mimics another one, which SerialChain "
                "does not do; name a tip before it, or use FromJax"
            )
    return _table(chain, moving)


def _name(element: ElementTree.Element, what: str, path: object) -> str:
    name = element.get("name")
    if not name:
        raise ValueError(f"{path}: a <{what}> has no name")
    return name


def _read_joint(element: ElementTree.Element, path: object) -> _Joint:
    name = _name(element, "joint", path)
    kind = element.get("type")
    if kind not in _KINDS:
        raise ValueError(
            f"{path}: type of joint {name} must be one of {', '.join(_KINDS)}, "
            f"got {kind!r}"
        )
    ends = {}
    for end in ("parent", "child"):
        found = element.find(end)
        link = None if found is None else found.get("link")
        if not link:
            raise ValueError(f"{path}: joint {name} has no <{end} link=...>")
        ends[end] = link
    origin = np.eye(4)
    origin[:3, 3] = _triple(element, "origin", "xyz", (0.0, 0.0, 0.0), name, path)
    turn = _triple(element, "origin", "rpy", (0.0, 0.0, 0.0), name, path)
    origin[:3, :3] = Rotation.from_euler("xyz", turn).as_matrix()
    axis = _triple(element, "axis", "xyz", (1.0, 0.0, 0.0), name, path)
    length = np.linalg.norm(axis)
    if _KINDS[kind] and not length > 0.0:
        raise ValueError(f"{path}: the axis of joint {name} must not be zero")
    return _Joint(
        name,
        _KINDS[kind],
        ends["parent"],
        ends["child"],
        origin,
        axis / (length or 1.0),
        element.find("mimic") is not None,
    )


def _triple(
    joint: ElementTree.Element,
    tag: str,
    attribute: str,
    default: tuple[float, float, float],
    name: str,
    path: object,
) -> Array:
    element = joint.find(tag)
    text = None if element is None else element.get(attribute)
    if text is None:
        return np.array(default)
    try:
        values = np.array([float(word) for word in text.split()])
        if values.shape != (3,) or not np.isfinite(values).all():
            raise ValueError
    except ValueError:
        raise ValueError(
            f"{path}: {attribute} of <{tag}> of joint {name} must be three numbers, "
            f"got {text!r}"
        ) from None
    return values


def _chain(
    above: dict[str, _Joint],
    links: list[str],
    tip: str | None,
    base: str | None,
    path: object,
) -> list[_Joint]:
    """Joints from ``base`` to ``tip``."""
    for argument, link in (("tip", tip), ("base", base)):
        if link is not None and link not in links:
            raise ValueError(
                f"{argument} must be a link of {path} ({', '.join(links)}), "
                f"got {link!r}"
            )
    if tip is None:
        parents = {joint.parent for joint in above.values()}
        leaves = [link for link in links if link not in parents]
        if len(leaves) != 1:
            raise ValueError(
                f"tip must be given: {path} has {len(leaves)} links without a joint "
                f"after them ({', '.join(leaves) or 'a loop'})"
            )
        tip = leaves[0]
    chain: list[_Joint] = []
    link = tip
    while link != base and link in above:
        if len(chain) == len(above):
            names = ", ".join(dict.fromkeys(joint.name for joint in chain))
            raise ValueError(f"{path}: the joints {names} form a loop")
        chain.insert(0, above[link])
        link = above[link].parent
    if base is not None and link != base:
        raise ValueError(f"base {base!r} is not above tip {tip!r} in {path}")
    return chain


def _table(chain: list[_Joint], moving: list[_Joint]) -> Chain:
    frame = np.eye(4)
    lines = []
    for joint in chain:
        frame = frame @ joint.origin
        if joint.kind:
            lines.append((frame[:3, :3] @ joint.axis, frame[:3, 3]))
    base = np.eye(4)
    base[:3, :3] = _turn_of_z(lines[0][0])
    base[:3, 3] = lines[0][1]
    rows = []
    reached = base.copy()
    for axis, point in lines[1:]:
        row = _row(reached, axis, point)
        rows.append(row)
        reached = reached @ _transform(row)
    rows.append(np.zeros(5))
    return Chain(
        np.array(rows),
        "".join(joint.kind for joint in moving),
        tuple(joint.name for joint in moving),
        base,
        np.linalg.inv(reached) @ frame,
    )


def _turn_of_z(axis: Array) -> Array:
    """(3, 3) the smallest rotation that takes z to ``axis``."""
    if axis[2] < -1.0 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    vector = np.cross([0.0, 0.0, 1.0], axis)
    hat = np.cross(np.eye(3), -vector)
    return np.eye(3) + hat + hat @ hat / (1.0 + axis[2])


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
        along = -(point @ np.array([-normal[1], normal[0], 0.0])) / (
            axis @ np.array([-normal[1], normal[0], 0.0])
        )
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
    row = np.array([a, *np.degrees([alpha]), d, *np.degrees([theta, beta])])
    return np.where(np.abs(row) < 1e-13, 0.0, row)


def _transform(row: Array) -> Array:
    a, alpha, d, theta, beta = row
    matrix = np.eye(4)
    turn = Rotation.from_euler("ZXY", [theta, alpha, beta], degrees=True)
    matrix[:3, :3] = turn.as_matrix()
    about = np.radians(theta)
    matrix[:3, 3] = a * np.cos(about), a * np.sin(about), d
    return matrix
