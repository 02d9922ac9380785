"""Which poses of an arm to measure: ``select(blocks=)`` against FIGAROH's rule.

FIGAROH (https://github.com/thanhndv212/figaroh) relaxes the D-optimal design to weights
that sum to one, without a number of poses, and measures every pose whose weight is
above 1e-5. Here on a UR5 whose joints, base and tool have 39 parameters, of which 25
can be identified; both are given those, in units of 0.1 mm of noise.
"""

from __future__ import annotations

import functools
import statistics
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.harness import Budget, Line, Row, Verdict, interleaved
from jaxcal import select

NAME = "blocks"
TITLE = "Poses of an arm, against relaxation without a number of poses"

LEAST_WEIGHT = 1e-5
_RULE = "FIGAROH's rule, NumPy"
_NOISE = 0.1  # mm
_A = np.array([0.0, -425.0, -392.25, 0.0, 0.0, 0.0])  # mm
_D = np.array([89.159, 0.0, 0.0, 109.15, 94.65, 82.3])
_TOOL = np.array([30.0, 20.0, 50.0])
_ALPHA = np.deg2rad([90.0, 0.0, 0.0, 90.0, -90.0, 0.0])

Array = NDArray[np.float64]


def _move(axis: int, angle: Any, shift: Any) -> Any:
    """(..., 4, 4) rotation about an axis and translation along it."""
    angle, shift = np.broadcast_arrays(angle, shift)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    out = np.zeros((*angle.shape, 4, 4), complex) + np.eye(4)
    out[..., i, i] = out[..., j, j] = np.cos(angle)
    out[..., j, i] = np.sin(angle)
    out[..., i, j] = -np.sin(angle)
    out[..., axis, 3] = shift
    return out


def _positions(joints: Array, change: Any) -> Any:
    """(M, 3) mm; ``change`` (39,) of a, d, alpha, theta, beta, base and tool."""
    a, d, alpha, theta, beta = change[:30].reshape(5, 6)
    pose = np.eye(4, dtype=complex)
    for axis in range(3):
        pose = pose @ _move(axis, change[33 + axis], change[30 + axis])
    for i in range(6):
        pose = pose @ _move(2, joints[:, i] + theta[i], _D[i] + d[i])
        pose = pose @ _move(0, _ALPHA[i] + alpha[i], _A[i] + a[i])
        pose = pose @ _move(1, beta[i], 0.0)
    return (pose @ np.append(_TOOL + change[36:], 1.0))[:, :3]


def arm_blocks(count: int, seed: int) -> Array:
    """(count, 3, 25) derivatives over the noise, by the complex step."""
    joints = np.random.default_rng(seed).uniform(-np.pi, np.pi, (count, 6))
    steps = 1e-20j * np.eye(39)
    columns = [_positions(joints, step).imag / 1e-20 for step in steps]
    blocks = np.stack(columns, axis=-1) / _NOISE
    size = np.sqrt((blocks**2).sum(axis=(0, 1)))
    right = np.linalg.svd((blocks / size).reshape(-1, 39), full_matrices=False)[2]
    return np.asarray(blocks / size @ right[:25].T)


def relaxed_rule(blocks: Array, iterations: int) -> NDArray[np.int64]:
    """Poses of weight above 1e-5 in the D-optimal measure (multiplicative steps)."""
    kept = np.arange(len(blocks))
    weight = np.full(len(kept), 1.0 / len(kept))
    for _ in range(iterations):
        rows = blocks[kept].reshape(-1, blocks.shape[2])
        gram = (rows * np.repeat(weight, 3)[:, None]).T @ rows
        gain = (rows @ np.linalg.inv(gram) * rows).sum(axis=1)
        weight = weight * gain.reshape(-1, 3).sum(axis=1) / blocks.shape[2]
        stays = weight > 0.01 * LEAST_WEIGHT
        kept, weight = kept[stays], weight[stays]
    return kept[weight > LEAST_WEIGHT]


def run(budget: Budget) -> Row:
    row = Row(NAME, TITLE)
    blocks = arm_blocks(300, 1)
    iterations = budget.pick(20_000, 2_000)
    theirs = relaxed_rule(blocks, iterations)
    k = len(theirs)
    case = f"M = 300, K = {k}"
    options: dict[str, dict[str, Any]] = {"exchange": {"restarts": 5}, "greedy": {}}
    calls = {
        f"jaxcal {method}": functools.partial(
            select, None, k, method, blocks=blocks, **more
        )
        for method, more in options.items()
    }
    log_det = {who: call().log_det for who, call in calls.items()}
    rows = blocks[theirs].reshape(-1, blocks.shape[2])
    log_det[_RULE] = float(np.linalg.slogdet(rows.T @ rows)[1])
    rule = functools.partial(relaxed_rule, blocks, iterations)
    seconds = interleaved({**calls, _RULE: rule}, budget.pick(3, 1), warm=0)
    best = max(log_det.values())
    for who, taken in seconds.items():
        efficiency = float(np.exp((log_det[who] - best) / rows.shape[1]))
        note = f"D-efficiency {efficiency:.4f} of the best found"
        row.lines.append(Line(case, who, 1e3 * statistics.median(taken), "ms", note))
    ratio = float(np.exp((log_det["jaxcal exchange"] - log_det[_RULE]) / rows.shape[1]))
    row.verdicts.append(Verdict(f"{case}: D-efficiency over the rule's", ratio, 1.0))
    row.notes.append(
        "the rule has no number of poses: K is what it chose, and its poses are meant "
        "to be measured by weight, not once each; its time is that of "
        f"{iterations} multiplicative steps, not of FIGAROH's own solver"
    )
    return row
