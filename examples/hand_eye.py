"""Hand and eye: where a camera sits on an arm, and where the board is that it sees.

    python examples/hand_eye.py           # two arms
    python examples/hand_eye.py --full    # ten arms, and hand_eye.md

Arms like a UR5 whose tables are wrong by half of the default tolerances look at a board
with a camera that is mounted anyhow. Views are chosen or drawn at random. The error is
how far from its pixels a corner is predicted in views that were not used.
"""

from __future__ import annotations

import sys
import warnings

import common
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import jaxcal
from jaxcal.models import Board, SerialChain

Array = NDArray[np.float64]

CORNERS = np.array(
    [[30.0 * x - 75.0, 30.0 * y - 60.0, 0.0] for x in range(6) for y in range(5)]
)
CAMERA = (900.0, 900.0, 640.0, 480.0)  # of a picture of 1280 x 960
PIXELS = 0.3  # noise
COUNTS = (5, 10, 20, 40)
OFFERED, JUDGED = 150, 60


def _frame(turn: Rotation, shift: list[float]) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn.as_matrix(), shift
    return matrix


# The true mounting, which the fit does not know: turned by 180 degrees on its flange.
MOUNT = _frame(Rotation.from_euler("zx", [180.0, 8.0], True), [20.0, -60.0, 45.0])
PLACE = _frame(Rotation.from_euler("z", 25.0, True), [-550.0, 100.0, 0.0])


def arm(mount: Array | None = None, place: Array | None = None) -> SerialChain:
    """A UR5 in mm, the camera and the board where they are said to be."""
    table = np.loadtxt(common.HERE / "ur5" / "dh.csv", delimiter=",", skiprows=1)
    sensor = Board("camera", place, CORNERS, CAMERA, noise=PIXELS)
    return SerialChain.from_dh(table, tool=mount, sensor=sensor)


def views(rng: np.random.Generator) -> Array:
    """(M, 6) joints from which the board is in the picture."""
    exact = arm(MOUNT, PLACE)
    home = np.array([10.0, -75.0, 95.0, -110.0, -90.0, 20.0])
    found = np.zeros((0, 6))
    while len(found) < OFFERED + JUDGED:
        joints = home + rng.uniform(-45.0, 45.0, (4000, 6))
        pixels = exact.predict(joints).reshape(len(joints), -1, 2)
        inside = (pixels > 0.0).all(axis=(1, 2)) & (pixels < [1280.0, 960.0]).all(
            axis=(1, 2)
        )
        frames = exact.measured_with(Board("camera", PLACE)).predict(
            np.hstack([joints, np.zeros((len(joints), 6))])
        )
        ahead = (frames[:, 2] > 200.0) & (frames[:, 2] < 700.0)
        found = np.vstack([found, joints[inside & ahead]])
    return found[: OFFERED + JUDGED]


def simulated(seed: int, off: float = 0.5) -> tuple[Array, Array]:
    """Joints of all views, and the pixels of an arm ``off`` by so many tolerances."""
    rng = np.random.default_rng(seed)
    exact = arm(MOUNT, PLACE)
    size = exact.table.size
    std = np.asarray(exact.default_prior().std)[:size]
    truth = exact.nominal.copy()
    truth[:size] += off * std * rng.normal(size=size)
    joints = views(rng)
    pixels = exact.predict(joints, truth)
    return joints, pixels + PIXELS * rng.normal(size=pixels.shape)


def closed_form(joints: Array, pixels: Array) -> SerialChain:
    """Where camera and board are by algebra, the arm as its table has it."""
    return arm().located(joints, pixels)


def choose(joints: Array, pixels: Array, count: int) -> Array:
    """(k,) views: five at random show where all is, the rest are chosen."""
    first = np.arange(min(5, count))
    if count <= len(first):
        return first
    rough = closed_form(joints[first], pixels[first])
    return jaxcal.select(
        joints, count, "exchange", model=rough, required=first, restarts=2
    ).indices


def error(predicted: Array, pixels: Array) -> float:
    """Mean distance of corners, pixels."""
    off = (predicted - pixels).reshape(len(pixels), -1, 2)
    return float(np.linalg.norm(off, axis=-1).mean())


def study(full: bool) -> dict[tuple[str, int], list[float]]:
    """(method, views) to the errors, an arm each."""
    found: dict[tuple[str, int], list[float]] = {}
    for seed in range(10 if full else 2):
        joints, pixels = simulated(seed)
        offered, seen = joints[:OFFERED], pixels[:OFFERED]
        for count in COUNTS if full else COUNTS[1:3]:
            some = np.arange(count)
            plain = closed_form(offered[some], seen[some])
            told = {"closed form, random": plain.predict(joints[OFFERED:])}
            picks = {"random": some, "chosen (I)": choose(offered, seen, count)}
            for name, at in picks.items():
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", UserWarning)
                    fit = jaxcal.identify(offered[at], seen[at], model=arm())
                told[name] = fit.predict(joints[OFFERED:])
            for name, predicted in told.items():
                off = error(predicted, pixels[OFFERED:])
                found.setdefault((name, count), []).append(off)
    return found


def rows(found: dict[tuple[str, int], list[float]]) -> common.Rows:
    """Mean over the arms."""
    return [
        common.row({"method": name, "views": count},
                   ["error_px"], [np.mean(errors)], ".2f")
        for (name, count), errors in sorted(found.items())
    ]  # fmt: skip


def draw(axes, rows: common.Rows) -> None:
    """Error against the number of views."""
    common.curves(axes, rows, "method", "views", "error_px", "error elsewhere, pixels")


if __name__ == "__main__":
    common.main(sys.modules[__name__])
