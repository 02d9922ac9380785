"""Calibrate a six-axis force sensor with 18 of 100 loads, against known truth.

    python examples/force_sensor/force_sensor.py            # table, errors.csv and .png
    python examples/force_sensor/force_sensor.py --quick    # fewer sensors and draws

Six readings answer to a wrench, ``y = C f + b``: a 6 x 6 matrix with crosstalk and six
zeros, 42 parameters. A wrench is made by hanging a weight on a cross that is bolted to
the sensor, with the sensor mounted upright or on one of its sides.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import pathlib

import numpy as np
from numpy.typing import NDArray

import jaxcal

HERE = pathlib.Path(__file__).parent
Array = NDArray[np.float64]

AXES = ("fx", "fy", "fz", "tx", "ty", "tz")
WEIGHTS = (5.0, 10.0, 20.0, 50.0)  # N
HOOKS = ((0, 0, 50), (100, 0, 50), (-100, 0, 50), (0, 100, 50), (0, -100, 50))  # mm
DOWN = ((0, 0, -1), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0))  # five mountings
RATED = np.array([50.0, 50.0, 50.0, 5.0, 5.0, 5.0])  # N, N m
FULL_SCALE = 10_000.0  # digits at a rated load
NOISE = 5.0  # digits
COUNT = 18
RULES = ("random", "random, 50 N", "one axis at a time", "D", "I")


def wrenches() -> tuple[Array, list[tuple[int, int, float]]]:
    """(100, 6) loads in N and N m, and (mounting, hook, weight) of each."""
    combinations = itertools.product(range(len(DOWN)), range(len(HOOKS)), WEIGHTS)
    rows = list(combinations)
    force = np.array([weight * np.array(DOWN[down]) for down, _, weight in rows])
    point = np.array([HOOKS[hook] for _, hook, _ in rows]) / 1000.0
    return np.hstack([force, np.cross(point, force)]), rows


def one_axis_at_a_time() -> list[tuple[int, int, float]]:
    """Loads for fx, fy, fz, tx, ty, tz in turn, each with the three larger weights."""
    positions = [(1, 0), (3, 0), (0, 0), (0, 3), (0, 1), (1, 3)]
    return [(*position, w) for position in positions for w in WEIGHTS[1:]]


def choose(rule: str, seed: int) -> NDArray[np.int64]:
    """(18,) loads that a rule chooses."""
    loads, rows = wrenches()
    if rule == "one axis at a time":
        return np.array([rows.index(row) for row in one_axis_at_a_time()])
    if rule.startswith("random"):
        heavy = np.array([weight == WEIGHTS[-1] for *_, weight in rows])
        offered = heavy if rule == "random, 50 N" else None
        return jaxcal.select(
            loads, COUNT, "random", available=offered, seed=seed
        ).indices
    return jaxcal.select(
        loads, COUNT, criterion=rule, region=region(0) if rule == "I" else None
    ).indices


def region(seed: int, count: int = 200) -> Array:
    """(count, 6) wrenches in use: every component up to its rated load."""
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (count, 6)) * RATED


def sensor(rng: np.random.Generator) -> tuple[Array, Array]:
    """C (6, 6), 5 % off in every axis and with crosstalk of 3 %, and zeros b (6,)."""
    crosstalk = 0.03 * rng.normal(size=(6, 6))
    np.fill_diagonal(crosstalk, 0.05 * rng.normal(size=6))
    return FULL_SCALE * (np.eye(6) + crosstalk) / RATED, rng.normal(0.0, 100.0, 6)


def study(sensors: int, draws: int) -> dict[str, Array]:
    """Rule to (runs, 3): error of C, and of measured forces and torques, % of rated."""
    loads, _ = wrenches()
    used = region(1)
    found = {}
    for rule in RULES:
        rows = []
        repeats = draws if rule.startswith("random") else 1
        choices = [choose(rule, seed) for seed in range(repeats)]
        for seed in range(sensors):
            rng = np.random.default_rng(seed)
            matrix, zero = sensor(rng)
            chosen = choices[seed % len(choices)]
            readings = loads[chosen] @ matrix.T + zero
            readings += rng.normal(0.0, NOISE, readings.shape)
            fit = jaxcal.identify(loads[chosen], readings, noise_std=NOISE)
            measured = fit.command_for(used @ matrix.T + zero)
            off = (measured - used) / RATED
            entries = (fit.matrix - matrix) * RATED / FULL_SCALE
            rms = [np.sqrt(np.mean(x**2)) for x in (entries, off[:, :3], off[:, 3:])]
            rows.append(rms)
        found[rule] = 100.0 * np.array(rows)
    return found


def table(found: dict[str, Array]) -> str:
    """Markdown: root mean square over the sensors, and against one axis at a time."""
    base = np.sqrt((found["one axis at a time"] ** 2).mean(axis=0))
    lines = [
        "| loads | C | forces | torques | forces, relative |",
        "|---|---|---|---|---|",
    ]
    for rule in RULES:
        rms = np.sqrt((found[rule] ** 2).mean(axis=0))
        cells = " | ".join(f"{x:.4f}" for x in rms)
        lines.append(f"| {rule} | {cells} | {rms[1] / base[1]:.2f} |")
    return "\n".join(lines)


def save(found: dict[str, Array], folder: pathlib.Path) -> None:
    """errors.csv and errors.png."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "errors.csv").open("w", newline="") as file:
        write = csv.writer(file).writerow
        write(["loads", "sensors", "matrix_percent", "force_percent", "torque_percent"])
        for rule, rows in found.items():
            rms = np.sqrt((rows**2).mean(axis=0))
            write([rule, len(rows), *(f"{x:.5f}" for x in rms)])
    figure, axes = plt.subplots(figsize=(6.4, 3.6), layout="constrained")
    errors = [found[rule][:, 1] for rule in RULES]
    axes.boxplot(errors, whis=(5, 95), showfliers=False)
    axes.set_xticks(range(1, len(RULES) + 1), RULES, rotation=20)
    axes.set(ylabel="error of measured forces, % of rated", yscale="log")
    figure.savefig(folder / "errors.png", dpi=160)


def main(arguments: list[str] | None = None) -> dict[str, Array]:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="40 sensors, not 1,000")
    parser.add_argument(
        "--out", type=pathlib.Path, default=HERE, help="folder to write"
    )
    options = parser.parse_args(arguments)
    found = study(*((40, 10) if options.quick else (1000, 100)))
    save(found, options.out)
    print(table(found))
    return found


if __name__ == "__main__":
    main()
