"""Find the backlash of an axis: each posture chosen from the readings before it.

python examples/backlash.py           # 20 axes
python examples/backlash.py --full    # 200
"""

from __future__ import annotations

import sys

import common
import numpy as np
from tasks.backlash import backlash, backlash_bins, residual

from jaxcal.adaptive import next_measurement

SIGMA, COUNT = 0.02, 6  # degrees; measurements
BINS = backlash_bins(1.0, 0.1, 0.04)
RULES = ("in order", "chosen")


def width(task, belief) -> tuple[float, float]:
    """Mean and standard deviation of the width, degrees."""
    values, weights = np.asarray(task.theta)[:, 0], np.asarray(belief.weights)
    mean = weights @ values
    return float(mean), float(np.sqrt(weights @ (values - mean) ** 2))


def study(full: bool) -> dict[str, np.ndarray]:
    """Rule to (axes, COUNT): error of the width after each measurement, degrees."""
    task = backlash(sigma=SIGMA)
    designs = np.asarray(task.designs)
    found: dict[str, list[list[float]]] = {rule: [] for rule in RULES}
    for seed in range(200 if full else 20):
        rng = np.random.default_rng(seed)
        true, offset = rng.uniform(0.05, 0.95), rng.uniform(-0.09, 0.09)
        noise = rng.normal(0.0, SIGMA, len(designs))
        for rule in RULES:
            history: list[tuple[int, int]] = []
            errors = []
            order = np.linspace(0, len(designs) - 1, COUNT).astype(int)
            step = next_measurement(task)
            for number in range(COUNT):
                design = int(step.design if rule == "chosen" else order[number])
                reading = residual(*designs[design], true, offset) + noise[design]
                history.append((design, int(BINS.outcome(reading))))
                step = next_measurement(task, history)
                errors.append(width(task, step.belief)[0] - true)
            found[rule].append(errors)
    return {rule: np.array(errors) for rule, errors in found.items()}


def rows(found: dict[str, np.ndarray]) -> common.Rows:
    """Root mean square over the axes, degrees."""
    return [
        common.row({"postures": rule, "k": k + 1, "axes": len(errors)}, ("error_deg",),
                   [error], ".4f")
        for rule, errors in found.items()
        for k, error in enumerate(common.rms(errors))
    ]  # fmt: skip


def draw(axes, rows: common.Rows) -> None:
    """Error of the width against the number of measurements."""
    common.curves(axes, rows, "postures", "k", "error_deg", "error of the width, °")


if __name__ == "__main__":
    common.main(sys.modules[__name__])
