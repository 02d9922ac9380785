"""The robot drawn by matplotlib: for machines where MuJoCo cannot draw.

The same parts as MuJoCo's, in the same perspective, turned by our own kinematics;
every face is a polygon, and far ones are painted first.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from jaxcal.paper.twin.robot import RobotConfig
from jaxcal.paper.twin.robot_parts import EYE_M, FIELD_DEG, Part, parts_of, view_axes

__all__ = ["Drawing"]

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

_PATCH_M = 0.04  # large faces are cut up, so that sorting by depth works
_LAYER_M = 0.015


class Drawing:
    """A figure to draw one robot on, as often as wanted."""

    def __init__(self, config: RobotConfig, width: int, height: int) -> None:
        from matplotlib.figure import Figure

        self._order = config.mechanism_order
        self._parts = parts_of(self._order)
        self._height = height
        self._figure = Figure(figsize=(width / 100.0, height / 100.0), dpi=100)
        self._axes = self._figure.add_axes((0.0, 0.0, 1.0, 1.0))
        self._aspect = width / height

    def picture(self, joints_deg: Array) -> Image:
        """(height, width, 3) of the robot at joint angles (3,) in degrees."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.collections import PolyCollection

        faces, colours, depths = [], [], []
        turns = _link_rotations(self._order, joints_deg)
        layer = 0.0  # phone and screen lie flat on what comes before them
        for part in self._parts:
            flat = part.link == 3 and part.kind == "box"
            layer = layer + _LAYER_M if flat else 0.0
            middle = (
                (np.array(part.start) + np.array(part.end)) / 2.0 @ turns[part.link].T
            )
            for corners, colour in _faces(part):
                placed = corners @ turns[part.link].T
                if not _faces_us(placed, middle):
                    continue
                points, depth = self._project(placed)
                faces.append(points)
                colours.append(_lit(placed, colour))
                depths.append(depth.mean() - layer)
        far_first = np.argsort(depths)[::-1]
        axes = self._axes
        axes.clear()
        axes.set_axis_off()
        axes.set_xlim(-self._aspect, self._aspect)
        axes.set_ylim(-1.0, 1.0)
        axes.add_collection(
            PolyCollection(
                [faces[i] for i in far_first],
                facecolors=[colours[i] for i in far_first],
                edgecolors=[colours[i] for i in far_first],
                linewidths=0.4,
            )
        )
        canvas = FigureCanvasAgg(self._figure)
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()

    def _project(self, points: Array) -> tuple[Array, Array]:
        right, up, back = view_axes()
        seen = (points - EYE_M) @ np.stack([right, up, back]).T
        depth = -seen[:, 2]
        scale = 1.0 / np.tan(np.radians(FIELD_DEG) / 2.0)
        return seen[:, :2] / depth[:, None] * scale, depth

    def close(self) -> None:
        """Let go of the figure."""
        self._figure.clear()


def _link_rotations(order: str, joints_deg: Array) -> list[Array]:
    """(3, 3) of the stand and of the links behind one, two and three axes."""
    turned = np.eye(3)
    turns = [turned]
    for letter in order:
        axis = "XYZ".index(letter)
        angle = np.radians(joints_deg[axis])
        step = np.eye(3)
        j, k = (axis + 1) % 3, (axis + 2) % 3
        step[j, j] = step[k, k] = np.cos(angle)
        step[k, j], step[j, k] = np.sin(angle), -np.sin(angle)
        turned = turned @ step
        turns.append(turned)
    return turns


def _faces(part: Part) -> Iterator[tuple[Array, tuple[float, float, float]]]:
    """Corners (4, 3) of every face; a rod is a prism of eight sides."""
    start, end = np.array(part.start), np.array(part.end)
    if part.kind == "box":
        low, high = np.minimum(start, end), np.maximum(start, end)
        for axis in range(3):
            j, k = (axis + 1) % 3, (axis + 2) % 3
            cuts_j, cuts_k = (_cuts(low[i], high[i]) for i in (j, k))
            for side in (low[axis], high[axis]):
                for a, b in itertools.pairwise(cuts_j):
                    for c, d in itertools.pairwise(cuts_k):
                        corners = np.empty((4, 3))
                        corners[:, axis] = side
                        corners[:, j] = (a, b, b, a)
                        corners[:, k] = (c, c, d, d)
                        yield corners, part.colour
        return
    along = end - start
    along /= np.linalg.norm(along)
    first = np.cross(along, np.eye(3)[int(np.argmin(np.abs(along)))])
    first *= part.radius / np.linalg.norm(first)
    second = np.cross(along, first)
    turns = np.linspace(0.0, 2.0 * np.pi, 9)
    round_it = np.cos(turns)[:, None] * first + np.sin(turns)[:, None] * second
    for one, two in itertools.pairwise(round_it):
        yield np.stack([start + one, start + two, end + two, end + one]), part.colour
    for place in (start, end):
        yield place + round_it[:-1], part.colour


def _cuts(low: float, high: float) -> Array:
    return np.linspace(low, high, 1 + max(1, round((high - low) / _PATCH_M)))


def _faces_us(corners: Array, middle: Array) -> bool:
    """Whether the outside of a face is seen; the parts are convex."""
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[1])
    outward = normal if normal @ (corners[0] - middle) > 0.0 else -normal
    return bool(outward @ (EYE_M - corners[0]) > 0.0)


def _lit(corners: Array, colour: Sequence[float]) -> tuple[float, float, float]:
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[1])
    length = np.linalg.norm(normal)
    light = np.array([0.35, 0.85, 0.40])
    bright = 0.55 + 0.45 * abs(float(normal @ light)) / max(float(length), 1e-12)
    red, green, blue = (min(1.0, bright * value) for value in colour)
    return red, green, blue
