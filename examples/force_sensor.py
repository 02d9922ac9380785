"""Calibrate a six-axis force sensor with 18 of 100 loads, against known truth.

    python examples/force_sensor.py           # 40 sensors
    python examples/force_sensor.py --full    # 1,000

Six readings answer to a wrench, ``y = C f + b``: a 6 x 6 matrix with crosstalk and six
zeros, 42 parameters. A wrench is made by hanging a weight on a cross that is bolted to
the sensor, with the sensor mounted upright or on one of its sides.
"""

from __future__ import annotations

import itertools
import sys

import common
import numpy as np
from numpy.typing import NDArray

import jaxcal

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


def study(full: bool) -> dict[str, Array]:
    """Rule to (runs, 3): error of C, and of measured forces and torques, % of rated."""
    sensors, draws = (1000, 100) if full else (40, 10)
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


def rows(found: dict[str, Array]) -> common.Rows:
    """Root mean square over the sensors; forces also against one axis at a time."""
    names = ("matrix_percent", "force_percent", "torque_percent", "forces_relative")
    base = common.rms(found["one axis at a time"])[1]
    errors = {rule: common.rms(each) for rule, each in found.items()}
    return [
        common.row({"loads": rule, "sensors": len(found[rule])}, names,
                   [*each, each[1] / base], ".4f")
        for rule, each in errors.items()
    ]  # fmt: skip


def draw(axes, rows: common.Rows) -> None:
    """Error of the measured forces."""
    label = "error of measured forces, % of rated"
    common.bars(axes, rows, "loads", "force_percent", label)


if __name__ == "__main__":
    common.main(sys.modules[__name__])
