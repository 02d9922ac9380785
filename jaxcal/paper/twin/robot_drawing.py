"""The robot drawn by matplotlib, for machines where MuJoCo cannot draw.

The boxes and rods of the compiled scene, in the perspective of its camera: every face
is a polygon, and far ones are painted first.
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

        self._figure = Figure(figsize=(width / 100.0, height / 100.0), dpi=100)
        self._axes = self._figure.add_axes((0.0, 0.0, 1.0, 1.0))
        self._aspect = width / height
        self._zoom = 1.0 / np.tan(np.radians(model.cam_fovy[0]) / 2.0)
        corners, geoms = [], []
        for geom in range(model.ngeom):
            box = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX
            faces = (_box_faces if box else _rod_faces)(model.geom_size[geom])
            corners.append(faces)
            geoms.append(np.full(len(faces), geom))
        self._corners = np.concatenate(corners)  # (F, 4, 3) in the frames of the geoms
        self._geom = np.concatenate(geoms)  # (F,) index of the geom of each face
        normals = np.cross(
            self._corners[:, 1] - self._corners[:, 0],
            self._corners[:, 2] - self._corners[:, 1],
        )
        outward = np.sign((normals * self._corners[:, 0]).sum(axis=1, keepdims=True))
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        self._normals = normals * outward / length  # (F, 3)
        self._colours = model.geom_rgba[self._geom, :3].astype(np.float64)
        flat = (model.geom_type == mujoco.mjtGeom.mjGEOM_BOX) & (model.geom_bodyid == 3)
        self._layer = _LAYER_M * (np.cumsum(flat) * flat)[self._geom]

    def update_scene(self, data: Any, camera: str) -> None:
        """Take the state of ``mujoco.MjData``; there is one camera only."""
        self._data = data

    def close(self) -> None:
        """Nothing is held."""

    def render(self) -> Image:
        """(height, width, 3) of the model in that state."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.collections import PolyCollection

        data = self._data
        turns = data.geom_xmat.reshape(-1, 3, 3)[self._geom]
        corners = self._corners @ np.matrix_transpose(turns)
        corners += data.geom_xpos[self._geom][:, None]
        normals = np.einsum("fij,fj->fi", turns, self._normals)
        eye, camera = data.cam_xpos[0], data.cam_xmat[0].reshape(3, 3)
        seen = ((eye - corners[:, 0]) * normals).sum(axis=1) > 0.0
        placed = (corners[seen] - eye) @ camera  # to the right, up, backwards
        depth = -placed[..., 2]
        points = placed[..., :2] / depth[..., None] * self._zoom
        bright = 0.55 + 0.45 * np.abs(normals[seen] @ _LIGHT)
        colours = np.minimum(bright[:, None] * self._colours[seen], 1.0)
        far_first = np.argsort(self._layer[seen] - depth.mean(axis=1))
        axes = self._axes
        axes.clear()
        axes.set_axis_off()
        axes.set(xlim=(-self._aspect, self._aspect), ylim=(-1.0, 1.0))
        axes.add_collection(
            PolyCollection(
                points[far_first],
                facecolors=colours[far_first],
                edgecolors=colours[far_first],
                linewidths=0.4,
            )
        )
        canvas = FigureCanvasAgg(self._figure)
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _box_faces(half: Array) -> Array:
    """(F, 4, 3) patches of a box with half sides (3,) about its centre."""
    faces = []
    for axis in range(3):
        j, k = (axis + 1) % 3, (axis + 2) % 3
        for a, b in itertools.pairwise(_cuts(half[j])):
            for c, d in itertools.pairwise(_cuts(half[k])):
                patch = np.empty((4, 3))
                patch[:, j], patch[:, k] = (a, b, b, a), (c, c, d, d)
                for side in (-half[axis], half[axis]):
                    patch[:, axis] = side
                    faces.append(patch.copy())
    return np.array(faces)


def _cuts(half: float) -> Array:
    return np.linspace(-half, half, 1 + max(1, round(2.0 * half / _PATCH_M)))


def _rod_faces(size: Array) -> Array:
    """(14, 4, 3) faces of a prism of eight sides along z: radius, half length."""
    turns = np.linspace(0.0, 2.0 * np.pi, 9)
    low = np.stack([np.cos(turns), np.sin(turns), np.full(9, -1.0)], axis=1)
    low *= [size[0], size[0], size[1]]
    high = low * [1.0, 1.0, -1.0]
    sides = np.stack([low[:-1], low[1:], high[1:], high[:-1]], axis=1)
    ends = [end[cut] for end in (low, high) for cut in _CAP]
    return np.concatenate([sides, ends])


_CAP = ([0, 1, 2, 3], [0, 3, 4, 7], [4, 5, 6, 7])  # an octagon by its corners
