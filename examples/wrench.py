"""Weigh the tool of a force and torque sensor from four postures, against known truth.

    python examples/wrench.py           # 10 arms
    python examples/wrench.py --full    # 100

A sensor between flange and tool reads the tool's weight and its own zeros. Four
postures at rest give the tool's mass and centre, the zeros, how the sensor is turned on
the flange and how far the arm's base is from level; forces are then read without them.
"""

from __future__ import annotations

import sys
import warnings

import common
import numpy as np
from numpy.typing import NDArray

import jaxcal
from jaxcal.models import SerialChain, Wrench

Array = NDArray[np.float64]

COUNTS = (4, 6, 10)
RULES = ("wrist alone", "random", "far apart", "chosen (I)")
OFFERED = 300
FORCE, TORQUE = 0.1, 0.006  # noise: N, N m
NOISE = jaxcal.Noise(std=[FORCE] * 3 + [TORQUE] * 3)
MASS, CENTRE = (0.5, 3.0), (0.02, 0.02, 0.08)  # kg, from to; m, as far as
ZERO = np.array([10.0] * 3 + [0.5] * 3)  # N, N m
DRAWS = 5
UPRIGHT = np.array([0.0, -90.0, 90.0, -90.0, -90.0, 0.0])  # tool down


def arm() -> SerialChain:
    """A UR5 in metres, with the sensor on its flange; the tool is not known."""
    table = np.loadtxt(common.HERE / "ur5" / "dh.csv", delimiter=",", skiprows=1)
    table[:, [0, 2]] *= 1e-3
    return SerialChain.from_dh(table, tool=(0.0, 0.0, 0.04), sensor=Wrench())


def postures(count: int, seed: int) -> Array:
    """(count, 6) joints in degrees."""
    return np.random.default_rng(seed).uniform(-170.0, 170.0, (count, 6))


def truth(model: SerialChain, rng: np.random.Generator) -> Array:
    """(p,) tool, zeros; mounting and base off to their priors, joints to 0.1 deg."""
    std = np.array(model.default_prior().std)
    std[: model.table.size] = 0.1
    theta = model.nominal.copy()
    for i, name in enumerate(model.names):
        if name.startswith(("theta", "tool", "base r")):
            theta[i] += std[i] * rng.normal()
    own = model.names.index("mass")
    theta[own] = rng.uniform(*MASS)
    theta[own + 1 : own + 4] = rng.uniform(-1.0, 1.0, 3) * CENTRE
    theta[own + 4 : own + 10] = ZERO * rng.normal(size=6)
    return theta


def choose(rule: str, model: SerialChain, offered: Array, k: int, seed: int) -> Array:
    """(k, 6) postures."""
    rng = np.random.default_rng(seed)
    if rule == "wrist alone":  # tool down, then tipped and turned by the last joints
        joints = np.tile(UPRIGHT, (k, 1))
        joints[1:, 4:] += rng.uniform(-90.0, 90.0, (k - 1, 2))
        return joints
    if rule == "random":
        return offered[rng.choice(len(offered), k, replace=False)]
    if rule == "far apart":  # each the farthest from those before, of all joints
        chosen = [int(rng.integers(len(offered)))]
        while len(chosen) < k:
            apart = np.linalg.norm(offered[:, None] - offered[chosen], axis=-1)
            chosen.append(int(apart.min(axis=1).argmax()))
        return offered[chosen]
    select = jaxcal.select(offered, k, "exchange", model=model, noise=NOISE)
    return offered[select.indices]


def study(full: bool) -> dict[tuple[str, int], Array]:
    """(rule, K) to (arms, 2): force and torque left at 200 other postures, N, N m."""
    model, offered, elsewhere = arm(), postures(OFFERED, 0), postures(200, 1)
    noise = np.array([FORCE] * 3 + [TORQUE] * 3)
    found: dict[tuple[str, int], Array] = {}
    for k in COUNTS:
        for rule in RULES:
            draws = 1 if rule == "chosen (I)" else DRAWS
            sets = [choose(rule, model, offered, k, seed) for seed in range(draws)]
            rows = []
            for one in range(100 if full else 10):
                rng = np.random.default_rng(one)
                theta = truth(model, rng)
                there = sets[one % draws]
                read = model.predict(there, theta) + noise * rng.normal(size=(k, 6))
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", UserWarning)
                    fit = jaxcal.identify(there, read, model=model)
                off = fit.predict(elsewhere) - model.predict(elsewhere, theta)
                rows.append([np.sqrt((each**2).sum(axis=1).mean())
                             for each in np.split(off, 2, axis=1)])  # fmt: skip
            found[rule, k] = np.array(rows)
    return found


def rows(found: dict[tuple[str, int], Array]) -> common.Rows:
    """Root mean square over the arms."""
    return [
        common.row({"rule": rule, "k": k}, ["force_N", "torque_Nm"],
                   common.rms(errors), ".3f")
        for (rule, k), errors in found.items()
    ]  # fmt: skip


def draw(axes, rows: common.Rows) -> None:
    """Force that is left against K."""
    common.curves(axes, rows, "rule", "k", "force_N", "force left elsewhere, N")


if __name__ == "__main__":
    common.main(sys.modules[__name__])
