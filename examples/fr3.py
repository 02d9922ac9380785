"""Hand and eye of a real Franka, from a few of 114 views of a fixed board.

    python examples/fr3.py           # 2 random draws
    python examples/fr3.py --full    # 10, and fr3.md

A camera on the hand of an FR3 looked at a board; of each view there are the joints and
the board's pose. Where camera and board are is fitted with the arm as its file has it,
and with the arm among the unknowns; the error is that of the views not used.
"""

from __future__ import annotations

import functools
import sys
import warnings

import common
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import jaxcal
from jaxcal.models import Board, SerialChain

Array = NDArray[np.float64]

COUNTS = (12, 20, 40)
NOISE = (1e-3, 1e-3, 1e-3, 0.15, 0.15, 0.15)  # m, degrees: a pose from one picture


@functools.cache
def arm() -> SerialChain:
    """The nominal arm to its flange, with a camera there, looking at a board."""
    path = common.HERE / "contacts" / "panda.urdf"
    sensor = Board("camera", noise=NOISE)
    return SerialChain.from_urdf(
        path,
        base="panda_link0",
        tip="panda_link8",
        sensor=sensor,
        limits={"panda_joint6": (-1.0, 260.0)},  # of an FR3; the file is a Panda's
    )


@functools.cache
def load() -> Array:
    """(114, 13) joints in degrees, the board's pose in the camera (tvec, rvec)."""
    rows = np.genfromtxt(common.HERE / "fr3" / "views.csv", delimiter=",", names=True)
    joints = np.degrees(np.column_stack([rows[f"q{i}_rad"] for i in range(1, 8)]))
    turns = np.column_stack([rows[f"cam_q{each}"] for each in "xyzw"])
    back = Rotation.from_quat(turns).inv()  # the camera's pose is the other way
    places = np.column_stack([rows[f"cam_{axis}_m"] for axis in "xyz"])
    return np.hstack([joints, -back.apply(places), back.as_rotvec(degrees=True)])


def held() -> jaxcal.Prior:
    """The arm as its file has it: only camera and board are unknown."""
    prior, size = arm().default_prior(), arm().table.size
    return jaxcal.Prior(prior.std, fixed=(*prior.fixed, *arm().names[:size]))


def fitted(rows: NDArray[np.int64], whole: bool) -> jaxcal.Calibration:
    """From these views alone, the arm too where ``whole``."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return jaxcal.identify(
            load()[rows],
            np.zeros((len(rows), 6)),
            model=arm(),
            prior=None if whole else held(),
        )


def errors(fit: jaxcal.Calibration, rows: NDArray[np.int64]) -> tuple[float, float]:
    """Mean distance (mm) and turn (degrees) of the board from where it was seen."""
    off = fit.predict(load()[rows])
    return (
        float(1e3 * np.linalg.norm(off[:, :3], axis=1).mean()),
        float(np.linalg.norm(off[:, 3:], axis=1).mean()),
    )


def choose(k: int) -> NDArray[np.int64]:
    """(k,) views: the first five show where all is, the rest are chosen."""
    rough = arm().located(load()[:5]).fitting.misfit_model()
    return jaxcal.select(load(), k, "exchange", model=rough, required=range(5)).indices


def study(full: bool) -> dict[tuple[str, str, int], list[tuple[float, float]]]:
    """(what is fitted, rule, K) to the errors of the other views."""
    every = np.arange(len(load()))
    found: dict[tuple[str, str, int], list[tuple[float, float]]] = {}
    for k in COUNTS:
        picks = {"chosen (I)": [choose(k)], "random": []}
        for seed in range(10 if full else 2):
            rng = np.random.default_rng(seed)
            picks["random"].append(rng.choice(len(every), k, replace=False))
        for whole, what in ((False, "hand-eye"), (True, "arm and hand-eye")):
            for rule, sets in picks.items():
                found[what, rule, k] = [
                    errors(fitted(some, whole), np.setdiff1d(every, some))
                    for some in sets
                ]
    return found


def rows(
    found: dict[tuple[str, str, int], list[tuple[float, float]]],
) -> common.Rows:
    """Mean over the draws."""
    return [
        common.row(
            {"fitted": what, "rule": rule, "k": k},
            ["error_mm", "error_deg"],
            np.mean(pairs, axis=0),
            ".3f",
        )
        for (what, rule, k), pairs in found.items()
    ]


def draw(axes, rows: common.Rows) -> None:
    """Error of the other views against K."""
    named = [row | {"name": f"{row['fitted']}, {row['rule']}"} for row in rows]
    common.curves(axes, named, "name", "k", "error_mm", "error of other views, mm")


if __name__ == "__main__":
    common.main(sys.modules[__name__])
