"""Calibrate a real UR5 from a few of the 1,000 poses that a laser tracker measured.

    python examples/ur5/ur5.py            # table, errors.csv and errors.png, minutes
    python examples/ur5/ur5.py --quick    # two sub-pools instead of sixty

For K = 6 to 40 poses of sub-pools of 300, chosen by several rules, 39 parameters are
fitted from the chosen poses alone, and the position error is judged on the poses that
were not chosen and on 20 test poses that were in no pool.
"""

from __future__ import annotations

import argparse
import csv
import pathlib

import numpy as np
from numpy.typing import NDArray

import jaxcal
from jaxcal.models import SerialChain
from jaxcal.progress import Progress

HERE = pathlib.Path(__file__).parent
Array = NDArray[np.float64]

# The controller's Denavit-Hartenberg rows (a mm, alpha deg, d mm, theta deg): with them
# and the reflector 31 mm before the flange the targets come out to 0.003 mm.
DH = [
    (0.0, 90.0, 89.159, 0.0),
    (-425.0, 0.0, 0.0, 0.0),
    (-392.25, 0.0, 0.0, 0.0),
    (0.0, 90.0, 109.15, 0.0),
    (0.0, -90.0, 94.56, 0.0),
    (0.0, 0.0, 82.3, 0.0),
]
NOISE = jaxcal.Noise(std=0.1)  # mm: the robot's repeatability
RULES = ("random", "maximin", "D", "A", "I greedy", "I")
COUNTS = (6, 8, 12, 20, 40)
POOLS, POOL = 60, 300


def arm() -> SerialChain:
    """Five parameters a joint, six of the base, three of the reflector: 39."""
    return SerialChain.from_dh(DH, tool=(0.0, 0.0, 31.0))


def load(name: str) -> tuple[Array, Array]:
    """Joint angles (N, 6) in degrees and measured positions (N, 3) in mm."""
    with (HERE / name).open(newline="") as file:
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
        criterion=criterion,
    ).indices  # fmt: skip


def distances(calibration: jaxcal.Calibration, angles: Array, reached: Array) -> Array:
    """(N,) position errors of the calibrated model, mm."""
    return np.linalg.norm(calibration.predict(angles) - reached, axis=1)


def study(pools: int, draws: int) -> dict[tuple[str, int], Array]:
    """(rule, K) to (runs, 3): mean and largest error of the rest, mean of the tests."""
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
            for _ in range(draws if rule == "random" else 1):
                chosen = members[choose(rule, angles[members], k, rng)]
                rest = np.setdiff1d(np.arange(len(angles)), chosen)
                fit = jaxcal.identify(
                    angles[chosen], reached[chosen], model=arm(), noise=NOISE
                )
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
    loose = np.asarray(arm().default_prior().std, dtype=np.float64)
    known = {
        "a third of the default": jaxcal.Prior(loose / 3.0),
        "default": jaxcal.Prior(loose),
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
                fit = jaxcal.identify(
                    angles[chosen],
                    reached[chosen],
                    model=arm(),
                    noise=NOISE,
                    prior=prior,
                )
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
            fit = jaxcal.identify(
                angles[chosen], spoilt, model=arm(), noise=NOISE, loss=loss
            )
            found.append(float(distances(fit, *tests).mean()))
    return {loss: float(np.mean(found)) for loss, found in errors.items()}


def table(found: dict[tuple[str, int], Array]) -> str:
    """Rules down, K across: rest mean / rest max / test mean, mm."""
    lines = ["rule      " + "".join(f"{f'K = {k}':>20}" for k in COUNTS)]
    for rule in RULES:
        cells = ("/".join(f"{x:.3f}" for x in found[rule, k].mean(0)) for k in COUNTS)
        lines.append(f"{rule:<10}" + "".join(f"{cell:>20}" for cell in cells))
    return "\n".join(lines)


def save(found: dict[tuple[str, int], Array], folder: pathlib.Path) -> None:
    """errors.csv and errors.png."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "errors.csv").open("w", newline="") as file:
        write = csv.writer(file).writerow
        write(["rule", "k", "runs", "rest_mean_mm", "rest_max_mm", "test_mean_mm"])
        for (rule, k), rows in found.items():
            write([rule, k, len(rows), *(f"{x:.4f}" for x in rows.mean(axis=0))])
    figure, axes = plt.subplots(figsize=(6.4, 4.0), layout="constrained")
    for rule in RULES:
        axes.plot(
            COUNTS, [found[rule, k][:, 2].mean() for k in COUNTS], "o-", label=rule
        )
    axes.set(
        xlabel="poses measured, K", ylabel="error on the 20 test poses, mean, mm",
        xscale="log", yscale="log",
    )  # fmt: skip
    ticks = (0.1, 0.2, 0.3, 0.5, 0.8)
    axes.set_yticks(ticks, [str(tick) for tick in ticks])
    axes.set_yticks([], minor=True)
    axes.set_xticks(COUNTS, [str(k) for k in COUNTS], minor=False)
    axes.xaxis.minorticks_off()
    axes.axhline(0.1549, color="grey", linestyle=":")
    axes.annotate("thesis, 1,000 poses", (COUNTS[-1], 0.157), ha="right", va="bottom")
    axes.legend()
    figure.savefig(folder / "errors.png", dpi=160)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="two sub-pools of sixty")
    parser.add_argument(
        "--out", type=pathlib.Path, default=HERE, help="folder to write"
    )
    options = parser.parse_args()
    pools = 2 if options.quick else POOLS
    found = study(pools, draws=10)
    save(found, options.out)
    print("rest mean / rest max / test mean, mm")
    print(table(found))
    for k in (8, 20):
        error = found["I", k].std(axis=0) / np.sqrt(pools)
        print(f"I, K = {k}: standard errors", "/".join(f"{x:.4f}" for x in error))
        first = found["I", k][:20].mean(axis=0)
        print("  first 20 sub-pools", "/".join(f"{x:.3f}" for x in first))
    best, random = found["I", 8], found["random", 8]
    share = np.mean(random[:, 0] < best[:, 0].mean())
    print(f"random draws better than I at K = 8: {100 * share:.1f} %")
    print(f"test mean by prior, K = {', '.join(map(str, COUNTS[2:]))}:")
    for name, row in priors(pools).items():
        print(f"  {name:<24}" + "".join(f"{value:8.3f}" for value in row))
    means = outliers(pools)
    print(
        "one of 12 poses 5 mm off:", ", ".join(f"{k} {v:.3f}" for k, v in means.items())
    )


if __name__ == "__main__":
    main()
