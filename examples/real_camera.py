"""Which 15 of 46 views calibrate a real camera: corners of two cameras of caliscope.

    python examples/real_camera.py           # 5 random draws
    python examples/real_camera.py --full    # 100, and real_camera.md

The model is that of camera.py: the board's pose in a view is six unknown commands
(``command_std=inf``), so a view is worth what it adds once its own pose is fitted, and
it counts by its own scatter. The error is the mean distance of a corner from where the
camera has it, in the views that were not chosen, with their poses fitted.
"""

from __future__ import annotations

import dataclasses
import functools
import sys
import warnings

import common
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

import jaxcal
from jaxcal.models import FromJax

Array = NDArray[np.float64]

CAMERAS = ("cam0", "cam1")
NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")  # as OpenCV's
NOMINAL = np.array([1280.0, 1280.0, 640.0, 360.0, 0.0, 0.0, 0.0, 0.0])
STD = np.array([500.0, 500.0, 100.0, 100.0, 0.3, 0.3, 0.02, 0.02])  # beforehand
NOISE = 0.3  # pixels, before the views' own scatter is known
POOLED = 6  # readings of the usual scatter that a view's own is pooled with
K, LEAST = 15, 6  # views chosen; corners of a view that determine its pose
K_OF_HALF = 8  # of every second view, the others judging
RULES = ("chosen (error left)", "chosen (I)", "random")


def project(view, theta, places):
    """(2C,) pixels of the board's corners, zeros where a corner was not seen.

    view: the board's pose (rotation vector, shift in m), then (C,) 1 or 0, seen or not.
    """
    fx, fy, cx, cy, k1, k2, p1, p2 = theta
    turn, shift, seen = view[:3], view[3:6], view[6:]
    square = turn @ turn
    angle = jnp.sqrt(jnp.where(square > 0.0, square, 1.0))
    # Rodrigues; the limits of sin(a) / a and (1 - cos(a)) / a^2 at no turn at all
    first = jnp.where(square > 0.0, jnp.sin(angle) / angle, 1.0)
    second = jnp.where(square > 0.0, (1.0 - jnp.cos(angle)) / angle**2, 0.5)
    across = jnp.cross(turn[None, :], places)
    points = places + first * across + second * jnp.cross(turn[None, :], across)
    points = points + shift[None, :]
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r = x**2 + y**2
    stretch = 1.0 + k1 * r + k2 * r**2
    u = x * stretch + 2.0 * p1 * x * y + p2 * (r + 2.0 * x**2)
    v = y * stretch + p1 * (r + 2.0 * y**2) + 2.0 * p2 * x * y
    pixels = jnp.stack([fx * u + cx, fy * v + cy], axis=1)
    return (pixels * seen[:, None]).ravel()


@dataclasses.dataclass(frozen=True)
class Views:
    """What one camera saw, and roughly from where and by what."""

    model: FromJax  # about a rough camera, from five views
    pixels: Array  # (F, 2C), zeros where a corner was not seen
    seen: Array  # (F, C) 1 or 0
    poses: Array  # (F, 6) rough, by that camera
    scatter: Array  # (F,) of a corner in each direction, pixels

    @property
    def commands(self) -> Array:
        """(F, 6 + C) rough poses, and which corners were seen."""
        return np.hstack([self.poses, self.seen])

    @property
    def noise(self) -> jaxcal.Noise:
        """Pixels by the scatter of their view, poses by nothing."""
        unknown = np.where(np.arange(self.commands.shape[1]) < 6, np.inf, 0.0)
        std = np.tile(self.scatter[:, None], self.pixels.shape[1])
        return jaxcal.Noise(std=std, command_std=unknown)

    @property
    def blocks(self) -> Array:
        """(F, 2C, 8) what each view says of the camera beyond its own pose."""
        rows = self.model.jacobian(self.commands)
        return self.noise.weigh(rows, self.model.command_jacobian(self.commands))

    def fit(
        self, chosen: NDArray[np.int64], loss: str = "gaussian"
    ) -> jaxcal.Calibration:
        """The camera from these views alone, by weighted least squares."""
        offered = np.isin(np.arange(len(self.seen)), chosen)
        chosen = np.flatnonzero(offered)
        with warnings.catch_warnings():  # of outliers, which least squares keeps
            warnings.simplefilter("ignore", UserWarning)
            return jaxcal.identify(
                self.commands[chosen],
                self.pixels[chosen],
                model=self.model,
                prior=jaxcal.Prior(STD),
                noise=self.noise.of(offered),
                loss=loss,
            )

    def posed(self, camera: Array) -> Array:
        """(F, 6) poses by least squares, the camera known."""
        commands = self.commands
        for _ in range(20):
            off = self.pixels - self.model.predict(commands, camera)
            slopes = self.model.command_jacobian(commands, camera)[..., :6]
            turned = slopes.swapaxes(1, 2)
            step = np.linalg.solve(turned @ slopes, turned @ off[..., None])[..., 0]
            commands[:, :6] += step
            if np.abs(step).max() < 1e-9:
                break
        return commands[:, :6]

    def distances(self, camera: Array) -> Array:
        """(F, C) pixels between corners and where this camera has them."""
        commands = np.hstack([self.posed(camera), self.seen])
        off = self.pixels - self.model.predict(commands, camera)
        return np.linalg.norm(off.reshape(*self.seen.shape, 2), axis=-1)

    def scattered(self, camera: Array) -> Array:
        """(F,) pixels: RMS of a corner in each direction about this camera, pooled."""
        squares = (self.distances(camera) ** 2).sum(axis=1)
        readings = 2.0 * self.seen.sum(axis=1) - 6.0  # beyond the pose
        usual = np.median(squares / readings)
        return np.sqrt((squares + POOLED * usual) / (readings + POOLED))

    def part(self, rows: slice) -> Views:
        """Some of the views."""
        parts = (self.pixels, self.seen, self.poses, self.scatter)
        return Views(self.model, *(values[rows] for values in parts))

    def others(self, distances: Array, chosen: NDArray[np.int64]) -> float:
        """Mean over the corners of the views that were not chosen."""
        rest = np.setdiff1d(np.arange(len(distances)), chosen)
        return float(distances[rest][self.seen[rest] > 0.0].mean())


def first_pose(pixels: Array, places: Array, camera: Array) -> Array:
    """(6,) of a board by its homography (Zhang, 2000)."""
    from scipy.spatial.transform import Rotation

    image = (pixels - camera[2:4]) / camera[:2]
    middle, size = places.mean(axis=0)[:2], np.ptp(places[:, :2])
    flat = np.column_stack([(places[:, :2] - middle) / size, np.ones(len(places))])
    none = np.zeros_like(flat)
    rows = [
        np.hstack([flat, none, -image[:, :1] * flat]),
        np.hstack([none, flat, -image[:, 1:] * flat]),
    ]
    plane = np.linalg.svd(np.vstack(rows))[2][-1].reshape(3, 3)
    plane *= np.sign(plane[2, 2])
    scale = np.sqrt(np.linalg.norm(plane[:, 0]) * np.linalg.norm(plane[:, 1]))
    x, y, shift = (plane / scale).T
    left, _, right = np.linalg.svd(np.column_stack([x, y, np.cross(x, y)]))
    turn = left @ right
    # The homography is that of the middle of the corners.
    shift = shift * size - turn @ [*middle, 0.0]
    return np.append(Rotation.from_matrix(turn).as_rotvec(), shift)


@functools.cache
def load(path: str) -> Views:
    """Views of six corners or more: of "cam0", "cam1" or a file with their columns."""
    file = common.HERE / "caliscope" / f"{path}.csv" if path in CAMERAS else path
    rows = np.genfromtxt(file, delimiter=",", names=True)
    corners, first = np.unique(rows["corner"], return_index=True)
    places = np.column_stack([rows["x_m"], rows["y_m"], 0.0 * rows["x_m"]])[first]
    frames, counts = np.unique(rows["frame"], return_counts=True)
    frames = frames[counts >= LEAST]
    pixels = np.zeros((len(frames), len(corners), 2))
    seen = np.zeros(pixels.shape[:2])
    for row in rows[np.isin(rows["frame"], frames)]:
        at = (
            np.searchsorted(frames, row["frame"]),
            np.searchsorted(corners, row["corner"]),
        )
        pixels[at], seen[at] = (row["u_px"], row["v_px"]), 1.0
    of_board = functools.partial(project, places=places)

    def about(camera: Array) -> FromJax:
        return FromJax(of_board, camera, NAMES, 6 + len(corners))

    def starts(camera: Array) -> Array:
        each = zip(pixels, seen > 0.0, strict=True)
        return np.array([first_pose(p[s], places[s], camera) for p, s in each])

    # A camera from five views far apart in the picture, then all views' poses from it.
    flat = pixels.reshape(len(frames), -1)
    usual = np.full(len(frames), NOISE)
    views = Views(about(NOMINAL), flat, seen, starts(NOMINAL), usual)
    middles = pixels.sum(axis=1) / seen.sum(axis=1, keepdims=True)
    five = [int(seen.sum(axis=1).argmax())]
    while len(five) < 5:
        apart = np.linalg.norm(middles[:, None] - middles[five], axis=-1).min(axis=1)
        five.append(int((apart * (seen.sum(axis=1) >= 0.8 * len(corners))).argmax()))
    camera = np.asarray(views.fit(np.array(five), "student").parameters)
    views = Views(about(camera), flat, seen, starts(camera), usual)
    views = dataclasses.replace(views, poses=views.posed(camera))
    return dataclasses.replace(views, scatter=views.scattered(camera))


def choose(
    views: Views, rule: str = RULES[0], seed: int = 0, count: int = K
) -> NDArray[np.int64]:
    """(count,) views, by the rough camera.

    I is the variance of what the views show beyond their own poses: those of other
    views are fitted too. It counts all views alike.
    """
    if rule not in RULES:
        raise ValueError(f"rule must be one of {', '.join(RULES)}, got {rule!r}")
    if rule == "random":
        return np.random.default_rng(seed).choice(len(views.seen), count, replace=False)
    if rule == "chosen (error left)":
        return least_left(views, choose(views, "chosen (I)", count=count))
    alike = dataclasses.replace(views, scatter=np.full(len(views.seen), NOISE))
    design = jaxcal.Design.from_blocks(alike.blocks, prior=np.diag(STD**-2.0))
    return design.select(count, "I", "exchange").indices


def least_left(views: Views, start: NDArray[np.int64]) -> NDArray[np.int64]:
    """(count,) views without which the rest has the least error, by exchange.

    The error in a view that is left is its own scatter and, as much as the views that
    were chosen leave it uncertain, the camera's. The errors of a view's corners are
    alike, so its corners count as one: the variance of the camera is that of as many
    times fewer.
    """
    corners = views.seen.sum(axis=1)
    scatter = views.distances(views.model.nominal).sum(axis=1) / corners
    blocks = views.blocks
    informations = np.matrix_transpose(blocks) @ blocks
    shown = informations * (views.scatter**2 / corners * corners.mean())[:, None, None]

    def left(chosen: list[int]) -> float:
        known = np.diag(STD**-2.0) + informations[chosen].sum(axis=0)
        unsure = np.einsum("ij,nji->n", np.linalg.inv(known), shown)
        errors = corners * np.sqrt(scatter**2 + unsure)
        rest = np.setdiff1d(np.arange(len(corners)), chosen)
        return float(errors[rest].sum() / corners[rest].sum())

    best, before = start.tolist(), np.inf
    while left(best) < before:
        before = left(best)
        for at in range(len(best)):
            offered = set(range(len(corners))).difference(best)
            trials = [[*best[:at], i, *best[at + 1 :]] for i in sorted(offered)]
            best = min([best, *trials], key=left)
    return np.array(best)


def in_other_half(views: Views, rule: str, seed: int) -> float:
    """Error in every second view of the camera from 8 of the others, mean of both ways.

    Whatever is chosen, the same views judge it.
    """
    errors = []
    for first in (0, 1):
        offered = views.part(slice(first, None, 2))
        judges = views.part(slice(1 - first, None, 2))
        fit = offered.fit(choose(offered, rule, seed, K_OF_HALF))
        distances = judges.distances(np.asarray(fit.parameters))
        errors.append(distances[judges.seen > 0.0].mean())
    return float(np.mean(errors))


def study(full: bool) -> dict[tuple[str, str], Array]:
    """(camera, rule) to (draws, 3) errors.

    Of the other views; that less the error of the camera that all views were fitted
    for, on the same views: what is lost by having 15 views; in the other half.
    """
    found = {}
    for name in CAMERAS:
        views = load(name)
        best = views.distances(
            np.asarray(views.fit(np.arange(len(views.seen))).parameters)
        )
        for rule in RULES:
            draws = (100 if full else 5) if rule == "random" else 1
            errors = []
            for seed in range(draws):
                chosen = choose(views, rule, seed)
                fit = views.fit(chosen)
                off = views.others(views.distances(fit.parameters), chosen)
                beyond = off - views.others(best, chosen)
                errors.append([off, beyond, in_other_half(views, rule, seed)])
            found[name, rule] = np.array(errors)
    return found


NAMES_OF_ERRORS = (
    *("error_px", "worse", "beyond_all_px", "worse_beyond"),
    *("other_half_px", "worse_other_half"),
)


def rows(found: dict[tuple[str, str], Array]) -> common.Rows:
    """Means over the draws; the share of random draws that are worse."""
    lines = []
    for (name, rule), errors in found.items():
        draws = found[name, "random"]
        worse = (draws > errors.mean(axis=0)).mean(axis=0)
        lines.append(
            common.row(
                {"camera": name, "rule": rule},
                NAMES_OF_ERRORS,
                np.column_stack([errors.mean(axis=0), worse]).ravel(),
                ".4f",
            )
        )
    return lines


PANELS = 2


def draw(axes, rows: common.Rows) -> None:
    """Both errors, a bar each."""
    names = [f"{row['camera']}, {row['rule']}" for row in rows]
    for panel, column, title in (
        (axes[0], "error_px", "error in other views, pixels"),
        (axes[1], "beyond_all_px", "beyond that of all views"),
    ):
        panel.barh(names, [float(row[column]) for row in rows])
        panel.set_xlabel(title)
        panel.invert_yaxis()
    axes[1].set_yticks([])


if __name__ == "__main__":
    common.main(sys.modules[__name__])
