"""Standard error at the tool of 90 arms: poses chosen by criterion or by an expert.

    python examples/tcp.py           # 6 arms
    python examples/tcp.py --full    # 90

After Jost, Kudruss, Koerkel and Walter (Journal of Mathematics in Industry 7:9, 2017),
who chose poses for the precision at the tool centre point (TCP) of three KUKA arms and
90 notional ones. tcp.md says where this differs.
"""

from __future__ import annotations

import sys

import common
import numpy as np
from numpy.typing import NDArray

import jaxcal
from jaxcal.models import SerialChain

Array = NDArray[np.float64]

# About the size of a KR 6, a KR 16 and a KR 210: a1, a2, a3, d1, d4, d6 in mm.
SIZES = np.array(
    [
        (25.0, 455.0, 35.0, 400.0, 420.0, 80.0),
        (260.0, 680.0, 35.0, 675.0, 670.0, 115.0),
        (350.0, 1250.0, 54.0, 750.0, 1500.0, 193.0),
    ]
)
HALF_RANGE = np.array([120.0, 50.0, 60.0, 150.0, 110.0, 150.0])  # degrees
MIDDLE = np.array([0.0, 10.0, 0.0, 0.0, 0.0, 0.0])
HOME = np.array([0.0, 20.0, 0.0, 0.0, -40.0, 0.0])
NOISE = jaxcal.Noise(std=0.05)  # mm: laser tracker and repeatability
COUNT, CANDIDATES, USED = 20, 300, 200
RULES = ("random", "expert", "spread", "D", "A", "I")


def arm(rng: np.random.Generator, number: int) -> SerialChain:
    """Arm ``number``: one of the three sizes, every dimension up to 20 % off."""
    sizes = SIZES[number % 3] * rng.uniform(0.8, 1.2, 6)
    a1, a2, a3, d1, d4, d6 = sizes
    rows = [
        (a1, -90.0, d1, 0.0),
        (a2, 0.0, 0.0, -90.0),
        (a3, -90.0, 0.0, 0.0),
        (0.0, 90.0, d4, 0.0),
        (0.0, -90.0, 0.0, 0.0),
        (0.0, 0.0, d6, 0.0),
    ]
    return SerialChain.from_dh(rows, tool=(0.1 * d4, 0.0, 0.2 * d4))


def reach(model: SerialChain) -> float:
    """Upper arm, forearm and flange, mm."""
    return float(model.table[[0, 1], 0].sum() + model.table[[3, 5], 2].sum())


def postures(
    rng: np.random.Generator, model: SerialChain, count: int, cell: bool
) -> Array:
    """(count, 6) joint angles with the tool above the floor; in the work cell only.

    The work cell is a box in front of the arm, 0.4 by 0.6 by 0.5 of its reach.
    """
    found = np.empty((0, 6))
    length = reach(model)
    least = np.array([0.4, -0.3, 0.1]) if cell else np.array([-9.0, -9.0, 0.0])
    most = np.array([0.8, 0.3, 0.6]) if cell else np.array([9.0, 9.0, 9.0])
    while len(found) < count:
        drawn = MIDDLE + HALF_RANGE * rng.uniform(-1.0, 1.0, (2000, 6))
        at = model.predict(drawn) / length
        found = np.vstack([found, drawn[((at > least) & (at < most)).all(axis=1)]])
    return found[:count]


def expert(model: SerialChain, offered: Array) -> Array:
    """(20, 6) every joint alone to both ends of its range, and the cell's corners."""
    ends = np.repeat(HOME[None], 12, axis=0)
    limits = np.stack([MIDDLE - HALF_RANGE, MIDDLE + HALF_RANGE], axis=1)
    ends[range(12), np.repeat(range(6), 2)] = limits.ravel()
    sides = np.meshgrid([0.4, 0.8], [-0.3, 0.3], [0.1, 0.6])
    corners = reach(model) * np.stack(sides, axis=-1).reshape(8, 3)
    at = model.predict(offered)
    nearest = np.linalg.norm(at - corners[:, None], axis=2).argmin(axis=1)
    return np.vstack([ends, offered[nearest]])


def spread(offered: Array) -> Array:
    """(20, 6) the first candidate, then always the one farthest from those chosen."""
    scaled = offered / HALF_RANGE
    distance = np.full(len(offered), np.inf)
    chosen = [0]
    while len(chosen) < COUNT:
        last = np.linalg.norm(scaled - scaled[chosen[-1]], axis=1)
        distance = np.minimum(distance, last)
        chosen.append(int(distance.argmax()))
    return offered[chosen]


def choose(rule: str, model: SerialChain, offered: Array, used: Array) -> Array:
    """(20, 6) postures that a rule chooses."""
    if rule == "random":
        return offered[:COUNT]
    if rule == "expert":
        return expert(model, offered)
    if rule == "spread":
        return spread(offered)
    found = jaxcal.select(
        offered, COUNT, "exchange", model=model, noise=NOISE, criterion=rule,
        prior=common.tolerances(model), region=used if rule == "I" else None,
    )  # fmt: skip
    return offered[found.indices]


def study(full: bool) -> dict[str, Array]:
    """Rule to (arms, 2): standard error and true error at the TCP in the cell, mm."""
    found: dict[str, list[tuple[float, float]]] = {rule: [] for rule in RULES}
    for number in range(90 if full else 6):
        rng = np.random.default_rng(number)
        model = arm(rng, number)
        offered = postures(rng, model, CANDIDATES, cell=False)
        used, held = (postures(rng, model, USED, cell=True) for _ in range(2))
        off = np.where(np.array(model.units) == "deg", 0.1, 1.0)  # degrees and mm
        true = model.nominal + off * rng.normal(size=len(off))
        for rule in RULES:
            chosen = choose(rule, model, offered, used)
            measured = model.predict(chosen, true)
            measured += rng.normal(0.0, float(NOISE.std), measured.shape)
            fit = jaxcal.identify(
                chosen,
                measured,
                model=model,
                noise=NOISE,
                prior=common.tolerances(model),
                loss="gaussian",
            )
            error = fit.predict(held) - model.predict(held, true)
            found[rule].append(
                tuple(
                    float(np.sqrt((x**2).sum(axis=1).mean()))
                    for x in (fit.predict_std(held), error)
                )
            )
    return {rule: np.array(rows) for rule, rows in found.items()}


def lower(found: dict[str, Array], rule: str, than: str) -> Array:
    """(arms,) by how many percent the standard error of a rule is lower."""
    return 100.0 * (1.0 - found[rule][:, 0] / found[than][:, 0])


def rows(found: dict[str, Array]) -> common.Rows:
    """Means over the arms in mm; by how much I is lower, percent."""
    names = (
        "standard_error_mm",
        "true_error_mm",
        "lower_percent",
        "lower_5",
        "lower_95",
    )
    table = []
    for rule, each in found.items():
        gain = lower(found, "I", rule)
        values = [*each.mean(axis=0), gain.mean(), *np.percentile(gain, (5, 95))]
        cells = {"poses": rule, "arms": len(each)}
        table.append(common.row(cells, names, values, ".4f"))
    return table


def draw(axes, rows: common.Rows) -> None:
    """How much lower the standard error is with I."""
    label = "standard error at the TCP with I, % lower"
    common.bars(axes, rows[:-1], "poses", "lower_percent", label)


if __name__ == "__main__":
    common.main(sys.modules[__name__])
