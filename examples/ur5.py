"""Calibrate a real UR5 from a few of the 1,000 poses that a laser tracker measured.

    python examples/ur5.py           # two sub-pools
    python examples/ur5.py --full    # sixty, and the tables of ur5.md

For K = 6 to 40 poses of sub-pools of 300, chosen by several rules, 39 parameters are
fitted from the chosen poses alone, and the position error is judged on the poses that
were not chosen and on 20 test poses that were in no pool.
"""

from __future__ import annotations

import csv
import sys
import warnings

import common
import numpy as np
from numpy.typing import NDArray

import jaxcal
from jaxcal.models import SerialChain
from jaxcal.progress import Progress
from jaxcal.reports.plots import plain_log

Array = NDArray[np.float64]

# The controller's Denavit-Hartenberg rows (a mm, alpha deg, d mm, theta deg): with them
# and the reflector 31 mm before the flange the targets come out to 0.003 mm.
DH = np.loadtxt(common.HERE / "ur5" / "dh.csv", delimiter=",", skiprows=1)
NOISE = jaxcal.Noise(std=0.1)  # mm: the robot's repeatability
RULES = ("random", "maximin", "D", "A", "I greedy", "I")
COUNTS = (6, 8, 12, 20, 40)
POOLS, POOL = 60, 300


def arm() -> SerialChain:
    """Five parameters a joint, six of the base, three of the reflector: 39."""
    return SerialChain.from_dh(DH, tool=(0.0, 0.0, 31.0))


def load(name: str) -> tuple[Array, Array]:
    """Joint angles (N, 6) in degrees and measured positions (N, 3) in mm."""
    with (common.HERE / "ur5" / name).open(newline="") as file:
        rows = list(csv.DictReader(file))

    def columns(*names: str) -> Array:
        return np.array([[float(row[each]) for each in names] for row in rows])

    angles = columns(*(f"joint_{i + 1}" for i in range(6)))
    return angles, columns("x_t", "y_t", "z_t") + columns("x_dif", "y_dif", "z_dif")


def maximin(candidates: Array, k: int, rng: np.random.Generator) -> Array:
    """(k,) a random pose, then always the one farthest from those chosen."""
    spread = (candidates - candidates.mean(axis=0)) / candidates.std(axis=0)
    chosen = [int(rng.integers(len(spread)))]
    distance = np.full(len(spread), np.inf)
    while len(chosen) < k:
        last = np.linalg.norm(spread - spread[chosen[-1]], axis=1)
        distance = np.minimum(distance, last)
        chosen.append(int(distance.argmax()))
    return np.array(chosen)


def choose(rule: str, candidates: Array, k: int, rng: np.random.Generator) -> Array:
    """(k,) indices of the poses that a rule chooses."""
    if rule == "random":
        return rng.choice(len(candidates), k, replace=False)
    if rule == "maximin":
        return maximin(candidates, k, rng)
    criterion, _, method = rule.partition(" ")
    return jaxcal.select(
        candidates, k, method or "exchange", model=arm(), noise=NOISE,
        prior=common.tolerances(arm()), criterion=criterion,
    ).indices  # fmt: skip


def distances(calibration: jaxcal.Calibration, angles: Array, reached: Array) -> Array:
    """(N,) position errors of the calibrated model, mm."""
    return np.linalg.norm(calibration.predict(angles) - reached, axis=1)


def identified(
    angles: Array, reached: Array, prior: jaxcal.Prior, loss: str = "student"
) -> jaxcal.Calibration:
    """A fit without its advice: most of these have too few readings, on purpose."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", jaxcal.CalibrationWarning)
        return jaxcal.identify(
            angles, reached, model=arm(), noise=NOISE, prior=prior, loss=loss
        )


def study(full: bool) -> dict[tuple[str, int], Array]:
    """(rule, K) to (runs, 3): mean and largest error of the rest, mean of the tests."""
    pools = POOLS if full else 2
    angles, reached = load("ur5_grid_1000.csv")
    tests = load("ur5_random_20.csv")
    found: dict[tuple[str, int], Array] = {}
    cells = [(rule, k) for k in COUNTS for rule in RULES]
    progress = Progress()
    for i, (rule, k) in enumerate(cells):
        progress("rules and counts", i, len(cells))
        rows = []
        for pool in range(pools):
            rng = np.random.default_rng(pool)
            members = rng.permutation(len(angles))[:POOL]
            for _ in range(10 if rule == "random" else 1):
                chosen = members[choose(rule, angles[members], k, rng)]
                rest = np.setdiff1d(np.arange(len(angles)), chosen)
                tolerances = common.tolerances(arm())
                fit = identified(angles[chosen], reached[chosen], tolerances)
                error = distances(fit, angles[rest], reached[rest])
                test = distances(fit, *tests)
                rows.append((error.mean(), error.max(), test.mean()))
        found[rule, k] = np.array(rows)
    progress.clear()
    return found


def priors(pools: int) -> dict[str, list[float]]:
    """Mean error on the test poses, mm, for K = 12, 20, 40 by what is known before."""
    angles, reached = load("ur5_grid_1000.csv")
    tests = load("ur5_random_20.csv")
    loose = np.asarray(common.tolerances(arm()).std, dtype=np.float64)
    known = {
        "a third of it": jaxcal.Prior(loose / 3.0),
        "that of the tables": jaxcal.Prior(loose),
        "none": jaxcal.Prior(np.inf),
    }
    errors: dict[str, list[float]] = {name: [] for name in known}
    for k in COUNTS[2:]:
        runs: dict[str, list[float]] = {name: [] for name in known}
        for pool in range(pools):
            rng = np.random.default_rng(pool)
            members = rng.permutation(len(angles))[:POOL]
            chosen = members[choose("I", angles[members], k, rng)]
            for name, prior in known.items():
                fit = identified(angles[chosen], reached[chosen], prior)
                runs[name].append(float(distances(fit, *tests).mean()))
        for name, found in runs.items():
            errors[name].append(float(np.mean(found)))
    return errors


def outliers(pools: int) -> dict[str, float]:
    """Mean error on the test poses, mm, where one of 12 poses is 5 mm off."""
    angles, reached = load("ur5_grid_1000.csv")
    tests = load("ur5_random_20.csv")
    errors: dict[str, list[float]] = {"gaussian": [], "student": []}
    for pool in range(pools):
        rng = np.random.default_rng(pool)
        members = rng.permutation(len(angles))[:POOL]
        chosen = members[choose("D", angles[members], 12, rng)]
        spoilt = reached[chosen].copy()
        direction = rng.normal(size=3)
        spoilt[rng.integers(12)] += 5.0 * direction / np.linalg.norm(direction)
        for loss, found in errors.items():
            tolerances = common.tolerances(arm())
            fit = identified(angles[chosen], spoilt, tolerances, loss)
            found.append(float(distances(fit, *tests).mean()))
    return {loss: float(np.mean(found)) for loss, found in errors.items()}


def rows(found: dict[tuple[str, int], Array]) -> common.Rows:
    """Errors of the poses that were not chosen and of the 20 test poses, mm."""
    names = ("rest_mean_mm", "rest_max_mm", "test_mean_mm")
    return [
        common.row({"rule": rule, "k": k, "runs": len(each)}, names,
                   each.mean(axis=0), ".4f")
        for (rule, k), each in found.items()
    ]  # fmt: skip


def draw(axes, rows: common.Rows) -> None:
    """Error on the test poses against K."""
    label = "error on the 20 test poses, mean, mm"
    common.curves(axes, rows, "rule", "k", "test_mean_mm", label)
    axes.axhline(0.1549, color="grey", linestyle=":")
    axes.annotate("thesis, 1,000 poses", (COUNTS[-1], 0.157), ha="right", va="bottom")
    plain_log(axes.yaxis)


def more(found: dict[tuple[str, int], Array]) -> None:
    """What ur5.md says beside the table."""
    angles, reached = load("ur5_random_20.csv")
    off = np.linalg.norm(arm().predict(angles) - reached, axis=1).mean()
    print(f"uncalibrated, mean of the test poses: {off:.3f}")
    pools = len(found["I", 8])
    for k in (8, 20):
        error = found["I", k].std(axis=0) / np.sqrt(pools)
        print(f"I, K = {k}: standard errors", "/".join(f"{x:.4f}" for x in error))
        first = found["I", k][:20].mean(axis=0)
        print("  first 20 sub-pools", "/".join(f"{x:.3f}" for x in first))
    share = np.mean(found["random", 8][:, 0] < found["I", 8][:, 0].mean())
    print(f"random draws better than I at K = 8: {100 * share:.1f} %")
    print(f"test mean by prior, K = {', '.join(map(str, COUNTS[2:]))}:")
    for name, row in priors(pools).items():
        print(f"  {name:<24}" + "".join(f"{value:8.3f}" for value in row))
    means = outliers(pools)
    values = ", ".join(f"{k} {v:.3f}" for k, v in means.items())
    print("one of 12 poses 5 mm off:", values)


if __name__ == "__main__":
    more(common.main(sys.modules[__name__]))
