"""KNEE: two thresholds, found by tests that may trip.

An axis, or two, yields above an unknown threshold: breakaway torque, an end stop, a
force limit. A test at u tells, with some noise, whether the threshold lies below; where
it does, the test trips: that costs time, and only a few trips are allowed.
"""

from __future__ import annotations

import numpy as np
from scipy import special

from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.rules import Priced, StateRule
from jaxcal.adaptive.tasks.registry import Entry

# Tuned on this task with its default constants.
PRICED = Priced(c0=0.015, c1=0.182, c2=2.392)
STATE_RULE = StateRule(
    c0=0.157, c1=0.272, c2=1.99, d0=-0.386, d1=-1.172, d2=3.20, scale=20.0
)


def knee(
    cells: int = 32,
    joints: int = 2,
    *,
    rho: float = 0.6,
    sigma: float = 0.02,
    slip: float = 0.01,
    seconds: float | tuple[float, float] = (8.0, 32.0),
    trips: int | tuple[int, ...] = (1, 2, 3),
    test_s: float = 1.0,
    travel_s: float = 2.0,
    change_s: float = 2.0,
    reset_s: float = 1.0,
    overrun: bool = True,
) -> GridTask:
    """The task.

    Args:
        cells: of [0, 1] on which each threshold lies, at their centres.
        joints: thresholds.
        rho: correlation of the thresholds' Gaussian copula.
        sigma: width of the step from no trip to trip; 0 is a sharp one.
        slip: probability of the wrong outcome far from the threshold.
        seconds: budget of a session, or (low, high) to draw it from.
        trips: that end a session, or the list it is drawn from.
        test_s: seconds of one test.
        travel_s: seconds over the full range.
        change_s: seconds to change to another joint, at its u = 0.
        reset_s: seconds after a trip.
        overrun: a test may begin while any time is left; False: only where the time
            left pays for it and for a trip.
    """
    tau = (np.arange(cells) + 0.5) / cells
    theta = np.stack(np.meshgrid(*[tau] * joints, indexing="ij"), axis=-1)
    theta = theta.reshape(-1, joints)
    z = special.ndtri(theta)
    shared = np.full((joints, joints), rho) + (1.0 - rho) * np.eye(joints)
    excess = np.linalg.inv(shared) - np.eye(joints)
    prior = np.exp(-0.5 * np.einsum("si,ij,sj->s", z, excess, z))
    levels = np.arange(1, cells) / cells
    joint = np.repeat(np.arange(joints), len(levels))
    u = np.tile(levels, joints)
    with np.errstate(divide="ignore"):
        step = special.ndtr((u[:, None] - theta[:, joint].T) / sigma)
    trip = slip + (1.0 - 2.0 * slip) * step
    # The last place is joint 0 at u = 0, where a session starts.
    at, here = np.append(joint, 0), np.append(u, 0.0)
    same = at[:, None] == joint
    way = np.where(same, np.abs(u - here[:, None]), u)
    return GridTask.make(
        theta,
        np.column_stack([joint, u]),
        np.stack([1.0 - trip, trip], axis=1),
        prior=prior,
        groups=joint,
        travel=test_s + travel_s * way + np.where(same, 0.0, change_s),
        extra=[0.0, reset_s],
        uses=[0, 1],
        seconds=seconds,
        num_uses=trips,
        horizon=int(np.ceil(np.max(seconds) / test_s)),
        overrun=overrun,
        theta_names=[f"tau{i + 1}" for i in range(joints)],
    )


ENTRY = Entry(
    knee,
    about="two thresholds, tested by readings that may end the test",
    rules={"priced": PRICED, "state": STATE_RULE},
)
