"""Is it still calibrated? Two or three chosen postures of a real UR5.

    python examples/drift.py           # three draws of what is offered
    python examples/drift.py --full    # as in drift.md

The arm is calibrated from 40 measured poses. Then something changes: the zero of a
joint, the tool or the base, by as much as moves the tip by 0.15 to 0.25 mm.
Readings of other poses, with what the change does to them, are checked.
"""

from __future__ import annotations

import sys
import warnings

import common
import numpy as np
import ur5
from numpy.typing import NDArray

import jaxcal

Array = NDArray[np.float64]

MOVES = (0.15, 0.2, 0.25)  # mm of the tip, root mean square; the robot repeats to 0.1
PLANS = {"2 chosen": 2, "3 chosen": 3, "3 random": 3, "6 random": 6, "12 random": 12}
CHANGED = (
    *(f"theta{i}" for i in range(1, 6)),  # the reflector is on the axis of joint 6
    *(f"tool {axis}" for axis in "xyz"),
    *(f"base {axis}" for axis in ("x", "y", "z", "rx", "ry")),
)


def calibrated(seed: int = 0) -> tuple[jaxcal.Calibration, Array, Array]:
    """From 40 of the poses; joints and real readings of those left."""
    joints, measured = ur5.load("ur5_grid_1000.csv")
    rows = np.random.default_rng(seed).permutation(len(joints))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        found = jaxcal.identify(joints[rows[:40]], measured[rows[:40]], model=ur5.arm())
    return found, joints[rows[40:]], measured[rows[40:]]


def study(full: bool) -> dict[tuple[str, float], float]:
    """(plan, mm) to the share of changes that are seen; 0 mm: false alarms."""
    seen: dict[tuple[str, float], list[bool]] = {}
    for seed in range(20 if full else 3):
        found, joints, measured = calibrated(seed)
        slopes = found.model.jacobian(joints, found.parameters)
        sizes = np.sqrt((slopes**2).sum(axis=1).mean(axis=0))
        at = [found.names.index(name) for name in CHANGED]
        for draw in range(10):
            rng = np.random.default_rng(draw)
            offered = rng.choice(len(joints), 100, replace=False)
            for plan, count in PLANS.items():
                rows = offered[:count]
                if "chosen" in plan:
                    rows = offered[found.verification(joints[offered], count)]
                changes = [(0.0, np.zeros((count, 3)))]
                if not draw:
                    moves = slopes[rows][..., at] / sizes[at]
                    changes += [(by, by * move) for by in MOVES
                                for move in np.moveaxis(moves, -1, 0)]  # fmt: skip
                for size, change in changes:
                    told = found.check(joints[rows], measured[rows] + change)
                    alarm = told.says == "does not hold"
                    seen.setdefault((plan, size), []).append(alarm)
    cells = [(plan, move) for plan in PLANS for move in (0.0, *MOVES)]
    return {cell: float(np.mean(seen[cell])) for cell in cells}


def rows(found: dict[tuple[str, float], float]) -> common.Rows:
    """A row a plan and a change."""
    return [
        common.row({"postures": plan, "change_mm": move}, ["seen"], [share], ".2f")
        for (plan, move), share in found.items()
    ]


def draw(axes, rows: common.Rows) -> None:
    """Share seen against the size of the change."""
    from jaxcal.reports.plots import numbered

    for i, plan in enumerate(PLANS):
        points = [(float(r["change_mm"]), float(r["seen"])) for r in rows
                  if r["postures"] == plan]  # fmt: skip
        axes.plot(*zip(*points, strict=True), label=plan, **numbered(i))
    axes.set(xlabel="the change moves the tip by, mm", ylabel="share seen")
    axes.legend(frameon=False)


if __name__ == "__main__":
    common.main(sys.modules[__name__])
