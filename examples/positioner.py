"""A two-axis positioner, 205 real poses of its target: what a few of them do.

    python examples/positioner.py           # 3 random draws
    python examples/positioner.py --full    # 10, and positioner.md

The poses were seen by a fixed metrology sensor (ros-industrial). Its authors fitted all
of them: 3.824 mm are left with the nominal table, 1.745 mm with a fitted one. Here 12,
20 and 40 poses are fitted, and the error is that of the poses that were not used.
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

TABLE = [(0.0, -90.0, 0.0, 0.0), (0.0, 0.0, -0.475, -90.0)]  # m, degrees
COUNTS = (12, 20, 40)


def arm() -> SerialChain:
    """The positioner with a target on it; where sensor and target are is found."""
    base = np.eye(4)
    base[:3, :3] = Rotation.from_euler("x", 90.0, degrees=True).as_matrix()
    base[:3, 3] = [2.2, 0.0, 1.6]
    noise = (1e-3, 1e-3, 1e-3, 0.1, 0.1, 0.1)
    return SerialChain.from_dh(TABLE, base=base, sensor=Board("board", noise=noise))


@functools.cache
def load() -> Array:
    """(205, 8) joints in degrees and the target's pose as it was seen."""
    rows = np.genfromtxt(
        common.HERE / "positioner" / "poses.csv", delimiter=",", names=True
    )
    joints = np.degrees(np.column_stack([rows["j1_rad"], rows["j2_rad"]]))
    turns = np.column_stack([rows[each] for each in ("qx", "qy", "qz", "qw")])
    vectors = Rotation.from_quat(turns).as_rotvec(degrees=True)
    places = np.column_stack([rows[f"{axis}_m"] for axis in "xyz"])
    return np.hstack([joints, places, vectors])


def fitted(rows: NDArray[np.int64], prior: jaxcal.Prior | None = None):
    """A calibration from these rows alone."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return jaxcal.identify(
            load()[rows], np.zeros((len(rows), 6)), model=arm(), prior=prior
        )


def rigid() -> jaxcal.Prior:
    """The table held: only where sensor and target are is fitted."""
    held = arm().names[: 5 * len(TABLE)]
    prior = arm().default_prior()
    return jaxcal.Prior(prior.std, fixed=(*prior.fixed, *held))


def error(fit: jaxcal.Calibration, rows: NDArray[np.int64]) -> float:
    """Mean distance of the target from where it was seen, mm."""
    return float(1e3 * np.linalg.norm(fit.predict(load()[rows])[:, :3], axis=1).mean())


def choose(k: int) -> NDArray[np.int64]:
    """(k,) poses: five far apart show where all is, the rest are chosen."""
    table = load()
    first = [0]
    while len(first) < 5:
        apart = np.abs(table[:, None, :2] - table[first, :2]).max(axis=-1).min(axis=1)
        first.append(int(apart.argmax()))
    rough = arm().located(table[first]).fitting.misfit_model()
    return jaxcal.select(table, k, "exchange", model=rough, required=first).indices


def study(full: bool) -> dict[tuple[str, int], list[float]]:
    """(rule, K) to the errors of the other poses."""
    every = np.arange(len(load()))
    found = {
        ("all, nominal table", 205): [error(fitted(every, rigid()), every)],
        ("all, fitted", 205): [error(fitted(every), every)],
    }
    for k in COUNTS:
        rest = np.setdiff1d(every, chosen := choose(k))
        found["chosen (I)", k] = [error(fitted(chosen), rest)]
        for seed in range(10 if full else 3):
            some = np.random.default_rng(seed).choice(len(every), k, replace=False)
            off = error(fitted(some), np.setdiff1d(every, some))
            found.setdefault(("random", k), []).append(off)
    return found


def rows(found: dict[tuple[str, int], list[float]]) -> common.Rows:
    """Mean over the draws."""
    return [
        common.row({"rule": rule, "k": k}, ["error_mm"], [np.mean(errors)], ".3f")
        for (rule, k), errors in found.items()
    ]


def draw(axes, rows: common.Rows) -> None:
    """Error of the poses that were not used against K."""
    some = [row for row in rows if row["k"] != "205"]
    common.curves(axes, some, "rule", "k", "error_mm", "error of other poses, mm")
    axes.axhline(1.745, color="grey", linestyle=":")
    axes.annotate("theirs, on all 205 fitted", (COUNTS[0], 1.745), va="bottom")


if __name__ == "__main__":
    common.main(sys.modules[__name__])
