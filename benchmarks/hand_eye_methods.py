"""Hand and eye: chosen views against OpenCV's five methods on the same simulated arms.

    python -m benchmarks.hand_eye_methods [arms]

Needs opencv-python-headless (the extra ``bench``). Views, pixels and the measure are
those of examples/hand_eye.py: mean error of predicted corners in views that were not
used, pixels, with exact arms and with arms whose tables are off by half of the default
tolerances. OpenCV gets the views drawn at random; its board is where the mean of the
views puts it.
"""

from __future__ import annotations

import pathlib
import sys
import warnings

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import jaxcal

sys.path.insert(0, str(pathlib.Path(__file__).parents[1] / "examples"))
import hand_eye as example

Array = NDArray[np.float64]

METHODS = ("TSAI", "PARK", "HORAUD", "ANDREFF", "DANIILIDIS")
COUNTS = (5, 10, 20, 40)


def opencv(method: str, joints: Array, pixels: Array, elsewhere: Array) -> Array:
    """Predicted pixels elsewhere, of the arm as its table has it."""
    import cv2

    inside = np.eye(3)
    inside[[0, 1, 0, 1], [0, 1, 2, 2]] = example.CAMERA
    turns, shifts = [], []
    for seen in pixels:
        _, turn, shift = cv2.solvePnP(
            example.CORNERS, seen.reshape(-1, 2), inside, None
        )
        turns.append(cv2.Rodrigues(turn)[0])
        shifts.append(shift)
    tips = frames(joints)
    mount = np.eye(4)
    mount[:3, :3], mount[:3, 3:] = cv2.calibrateHandEye(
        tips[:, :3, :3],
        tips[:, :3, 3],
        turns,
        shifts,
        method=getattr(cv2, f"CALIB_HAND_EYE_{method}"),
    )
    boards = np.tile(np.eye(4), (len(joints), 1, 1))
    boards[:, :3, :3], boards[:, :3, 3] = turns, np.array(shifts)[..., 0]
    seen_at = tips @ mount @ boards
    place = np.eye(4)
    place[:3, :3] = Rotation.from_matrix(seen_at[:, :3, :3]).mean().as_matrix()
    place[:3, 3] = seen_at[:, :3, 3].mean(axis=0)
    return example.arm(mount, place).predict(elsewhere)


def frames(joints: Array) -> Array:
    """(N, 4, 4) of the flange, nominal."""
    arm = example.arm().measured_with(jaxcal.models.Pose())
    found = np.tile(np.eye(4), (len(joints), 1, 1))
    found[:, :3, 3] = arm.predict(joints)[:, :3]
    found[:, :3, :3] = arm.rotations(joints, np.zeros((len(joints), 3)))
    return found


def main(arms: int) -> None:
    """Print the tables."""
    for off in (0.0, 0.5):
        found: dict[str, list[list[float]]] = {}
        for seed in range(arms):
            joints, pixels = example.simulated(seed, off)
            offered, seen = joints[: example.OFFERED], pixels[: example.OFFERED]
            elsewhere, there = joints[example.OFFERED :], pixels[example.OFFERED :]
            lines: dict[str, list[float]] = {}
            for count in COUNTS:
                some = np.arange(count)
                told = {
                    f"OpenCV {method}": opencv(
                        method, offered[some], seen[some], elsewhere
                    )
                    for method in METHODS
                }
                picks = {"random": some, "I": example.choose(offered, seen, count)}
                for name, at in picks.items():
                    with warnings.catch_warnings():
                        warnings.simplefilter("ignore", UserWarning)
                        fit = jaxcal.identify(
                            offered[at], seen[at], model=example.arm()
                        )
                    told[f"identify, {name}"] = fit.predict(elsewhere)
                for name, predicted in told.items():
                    lines.setdefault(name, []).append(example.error(predicted, there))
            for name, line in lines.items():
                found.setdefault(name, []).append(line)
        print(f"| tables off by {off:g} tolerances | " + " | ".join(
            f"{count} views" for count in COUNTS) + " |")  # fmt: skip
        print("| --- " * (1 + len(COUNTS)) + "|")
        for name, each in found.items():
            cells = " | ".join(f"{value:.2f}" for value in np.median(each, axis=0))
            print(f"| {name} | {cells} |")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10)
