"""Calibrate a camera from 10 of 60 views of a board, against known truth.

    python examples/camera.py           # 24 cameras
    python examples/camera.py --full    # 100

Focal lengths, principal point and two terms of radial distortion are wanted. Where the
board stood in each view is not known well: its pose is six commands of the model with
``command_std=inf``, so selection counts only what a view says beyond its own pose, and
identification finds the ten poses with the six intrinsic parameters.
"""

from __future__ import annotations

import sys

import common
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

import jaxcal
from jaxcal.models import FromJax

Array = NDArray[np.float64]

NAMES = ("fx", "fy", "cx", "cy", "k1", "k2")
NOMINAL = np.array([1000.0, 1000.0, 640.0, 480.0, 0.0, 0.0])  # as the maker states them
IMAGE = np.array([1280.0, 960.0])  # pixels
SQUARE = 0.03  # m
CORNERS = SQUARE * np.array(
    [(x, y, 0.0) for y in np.arange(-2.0, 3.0) for x in np.arange(-3.0, 4.0)]
)  # 7 x 5 corners about the board's centre
NOISE = jaxcal.Noise(std=0.2, command_std=np.full(6, np.inf))  # pixels; pose unknown
VIEWS, COUNT = 60, 10
RULES = ("random", "cover the image", "D", "I")


def project(pose, theta):
    """(70,) pixels of the corners; pose: rotation vector (rad), translation (m)."""
    fx, fy, cx, cy, k1, k2 = theta
    corners = jnp.asarray(CORNERS)
    turn, shift = pose[:3], pose[3:]
    square = turn @ turn
    angle = jnp.sqrt(jnp.where(square > 0.0, square, 1.0))
    # Rodrigues; the limits of sin(a) / a and (1 - cos(a)) / a^2 at no turn at all
    first = jnp.where(square > 0.0, jnp.sin(angle) / angle, 1.0)
    second = jnp.where(square > 0.0, (1.0 - jnp.cos(angle)) / angle**2, 0.5)
    across = jnp.cross(turn[None, :], corners)
    points = corners + first * across + second * jnp.cross(turn[None, :], across)
    points = points + shift[None, :]
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    radius = x**2 + y**2
    stretch = 1.0 + k1 * radius + k2 * radius**2
    pixels = [fx * stretch * x + cx, fy * stretch * y + cy]
    return jnp.stack(pixels, axis=1).ravel()


MODEL = FromJax(project, NOMINAL, NAMES, num_inputs=6)


def views(rng: np.random.Generator, count: int, theta: Array) -> Array:
    """(count, 6) poses with the whole board in the image, tilted up to 45 degrees."""
    found: list[Array] = []
    while len(found) < count:
        depth = rng.uniform(0.25, 0.8, 100)
        aim = rng.uniform(0.0, IMAGE, (100, 2))
        shift = np.hstack([(aim - theta[2:4]) / theta[:2], np.ones((100, 1))])
        turn = rng.normal(size=(100, 3)) * [1.0, 1.0, 0.3]
        turn *= rng.uniform(0.0, np.pi / 4, (100, 1)) / np.linalg.norm(
            turn, axis=1, keepdims=True
        )
        poses = np.hstack([turn, depth[:, None] * shift])
        pixels = MODEL.predict(poses, theta).reshape(100, -1, 2)
        found += list(poses[((pixels > 0.0) & (pixels < IMAGE)).all(axis=(1, 2))])
    return np.array(found[:count])


def cover(pixels: Array) -> NDArray[np.int64]:
    """(10,) views: the next is the one whose corners fill most empty cells of 8 x 6."""
    cells = np.floor(pixels.reshape(len(pixels), -1, 2) / IMAGE * [8, 6]).astype(int)
    fills = np.zeros((len(pixels), 8, 6), dtype=bool)
    for fill, cell in zip(fills, cells, strict=True):
        fill[cell[:, 0].clip(0, 7), cell[:, 1].clip(0, 5)] = True
    chosen: list[int] = []
    empty = np.ones((8, 6), dtype=bool)
    while len(chosen) < COUNT:
        gain = (fills & empty).sum(axis=(1, 2)) + 0.01 * fills.sum(axis=(1, 2))
        gain[chosen] = -1.0
        chosen.append(int(gain.argmax()))
        empty &= ~fills[chosen[-1]]
    return np.array(chosen)


def choose(rule: str, poses: Array, pixels: Array, seed: int) -> NDArray[np.int64]:
    """(10,) views that a rule chooses, from rough poses and the corners seen."""
    if rule == "random":
        return np.random.default_rng(seed).choice(VIEWS, COUNT, replace=False)
    if rule == "cover the image":
        return cover(pixels)
    return jaxcal.select(
        poses, COUNT, "exchange", model=MODEL, noise=NOISE, criterion=rule
    ).indices


def study(full: bool) -> dict[str, Array]:
    """Rule to (cameras, 4): errors of fx, fy, centre, and of held-out pixels."""
    found: dict[str, list[list[float]]] = {rule: [] for rule in RULES}
    for seed in range(100 if full else 24):
        rng = np.random.default_rng(seed)
        theta = NOMINAL + rng.normal(size=6) * [20.0, 20.0, 10.0, 10.0, 0.05, 0.02]
        true = views(rng, VIEWS, theta)
        rough = true + rng.normal(size=true.shape) * ([0.02] * 3 + [0.005] * 3)
        pixels = MODEL.predict(true, theta)
        pixels += rng.normal(0.0, float(NOISE.std), pixels.shape)
        held = views(rng, 100, theta)
        for rule in RULES:
            chosen = choose(rule, rough, pixels, seed)
            fit = jaxcal.identify(
                rough[chosen], pixels[chosen], model=MODEL, noise=NOISE, loss="gaussian"
            )
            off = fit.parameters - theta
            pixel = MODEL.predict(held, fit.parameters) - MODEL.predict(held, theta)
            found[rule].append(
                [*np.abs(off[:2]), np.hypot(*off[2:4]), np.sqrt(np.mean(pixel**2))]
            )
    return {rule: np.array(rows) for rule, rows in found.items()}


def rows(found: dict[str, Array]) -> common.Rows:
    """Root mean square over the cameras, pixels."""
    names = ("fx_px", "fy_px", "centre_px", "held_out_px")
    return [
        common.row({"views": rule, "cameras": len(e)}, names, common.rms(e), ".4f")
        for rule, e in found.items()
    ]


PANELS = 2


def draw(axes, rows: common.Rows) -> None:
    """Errors of the focal length and of held-out pixels."""
    common.bars(axes[0], rows, "views", "fx_px", "error of fx, pixels")
    common.bars(axes[1], rows, "views", "held_out_px", "held-out pixels, error")


if __name__ == "__main__":
    common.main(sys.modules[__name__])
