"""The robot drawn by matplotlib, for machines where MuJoCo cannot draw.

The boxes and rods of the compiled scene, in the perspective of its camera: a rod is a
ribbon, a face of a box is cut into patches, and far ones are painted first.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Drawing"]

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

_PATCH_M = 0.04  # large faces are cut up, so that sorting by depth works
_LAYER_M = 0.015  # boxes of the last link lie flat on one another
_LIGHT = np.array([0.35, 0.85, 0.40])


class Drawing:
    """Draws one model as ``mujoco.Renderer`` does: the same three methods.

    Args:
        model: ``mujoco.MjModel`` whose geoms are boxes and capsules.
        width: pixels.
        height: pixels.
    """

    def __init__(self, model: Any, width: int, height: int) -> None:
        import mujoco
        from matplotlib.figure import Figure

        figure = Figure(figsize=(width / 100.0, height / 100.0), dpi=100)
        self._axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        self._aspect = width / height
        self._zoom = 1.0 / np.tan(np.radians(model.cam_fovy[0]) / 2.0)
        self._colours = model.geom_rgba[:, :3].astype(np.float64)
        self._size = model.geom_size
        box = model.geom_type == mujoco.mjtGeom.mjGEOM_BOX
        self._layer = _LAYER_M * np.cumsum(box & (model.geom_bodyid == 3))
        self._rods = np.flatnonzero(~box)
        patches = [
            (i, *p) for i in np.flatnonzero(box) for p in _patches(self._size[i])
        ]
        of, corners, normals = zip(*patches, strict=True)
        self._boxes = np.array(of)  # (F,) index of the geom of each patch
        self._corners = np.array(corners)  # (F, 4, 3) in the frames of the geoms
        self._normals = np.array(normals)  # (F, 3)

    def update_scene(self, data: Any, camera: str) -> None:
        """Take the state of ``mujoco.MjData``; there is one camera only."""
        self._data = data

    def close(self) -> None:
        """Nothing is held."""

    def render(self) -> Image:
        """(height, width, 3) of the model in that state."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.collections import PolyCollection

        data, boxes, rods = self._data, self._boxes, self._rods
        turns, places = data.geom_xmat.reshape(-1, 3, 3), data.geom_xpos
        corners = self._corners @ np.matrix_transpose(turns[boxes])
        corners += places[boxes, None]
        normals = np.einsum("fij,fj->fi", turns[boxes], self._normals)
        seen = ((data.cam_xpos[0] - corners[:, 0]) * normals).sum(axis=1) > 0.0
        faces, depth = self._projected(corners[seen])
        bright = 0.55 + 0.45 * np.abs(normals[seen] @ _LIGHT)
        boxes = boxes[seen]
        far = self._layer[boxes] - depth.mean(axis=1)

        half = turns[rods, :, 2] * self._size[rods, 1, None]
        ends, depth = self._projected(places[rods, None] + half[:, None] * [[-1], [1]])
        along = ends[:, 1] - ends[:, 0]
        across = np.stack([-along[:, 1], along[:, 0]], axis=1)
        across /= np.linalg.norm(across, axis=1, keepdims=True) + 1e-12
        wide = across[:, None] * (self._zoom * self._size[rods, :1] / depth)[..., None]
        ribbons = np.concatenate([ends - wide, (ends + wide)[:, ::-1]], axis=1)

        shapes = np.concatenate([faces, ribbons])
        order = np.argsort(np.append(far, -depth.mean(axis=1)))
        bright = np.append(bright, np.full(len(rods), 0.85))[:, None]
        colours = np.minimum(bright * self._colours[np.append(boxes, rods)], 1.0)[order]
        axes = self._axes
        axes.clear()
        axes.set_axis_off()
        axes.set(xlim=(-self._aspect, self._aspect), ylim=(-1.0, 1.0))
        look = {"facecolors": colours, "edgecolors": colours, "linewidths": 0.4}
        axes.add_collection(PolyCollection(list(shapes[order]), **look))
        canvas = FigureCanvasAgg(axes.figure)
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()

    def _projected(self, points: Array) -> tuple[Array, Array]:
        """Places (..., 2) in the picture and depths (...) of points (..., 3)."""
        camera = self._data.cam_xmat[0].reshape(3, 3)
        placed = (points - self._data.cam_xpos[0]) @ camera  # right, up, backwards
        depth = -placed[..., 2]
        return placed[..., :2] / depth[..., None] * self._zoom, depth


def _patches(half: Array) -> list[tuple[Array, Array]]:
    """Corners (4, 3) and normals (3,) of the faces of a box about its centre."""
    found = []
    for axis in range(3):
        j, k = (axis + 1) % 3, (axis + 2) % 3
        for (a, b), (c, d) in itertools.product(_cuts(half[j]), _cuts(half[k])):
            for side in (-1.0, 1.0):
                patch = np.full((4, 3), side * half[axis])
                patch[:, j], patch[:, k] = (a, b, b, a), (c, c, d, d)
                found.append((patch, side * np.eye(3)[axis]))
    return found


def _cuts(half: float) -> list[tuple[float, float]]:
    ends = np.linspace(-half, half, 1 + max(1, round(2.0 * half / _PATCH_M)))
    return list(itertools.pairwise(ends.tolist()))
