"""Calibrate an accelerometer triad: which orientations, against the textbook six.

    python examples/triad.py           # 20 triads
    python examples/triad.py --full    # 200

The sensor is held still in known orientations and reads ``y = C g + b``. Scale and
misalignment are an upper triangular C, so that the frame is fixed by the first axis:
three of its nine entries are held at zero by the prior, nine parameters are unknown.
"""

from __future__ import annotations

import sys

import common
import numpy as np
from numpy.typing import NDArray

import jaxcal
from jaxcal.models import Affine

Array = NDArray[np.float64]

MODEL = Affine(3, 3)
PRIOR = jaxcal.Prior(np.inf, fixed=["a21", "a31", "a32"])  # nominally zero
NOISE = jaxcal.Noise(std=0.001)  # g
TILTS = {"any": 180.0, "60 degrees": 60.0}  # largest angle to the upright orientation
COUNTS = (4, 6, 12)
RULES = ("random", "textbook", "D", "I")


def orientations(most: float) -> Array:
    """(M, 3) gravity in the sensor's axes, g: a table that stops every 15 degrees."""
    steps = np.radians(np.arange(-180.0, 180.0, 15.0))
    roll, pitch = np.meshgrid(steps, steps[6:19])
    x, across = -np.sin(pitch), np.cos(pitch)
    gravity = np.stack([x, across * np.sin(roll), across * np.cos(roll)], axis=-1)
    unique = np.unique(gravity.reshape(-1, 3).round(12), axis=0)
    return unique[unique[:, 2] >= np.cos(np.radians(most)) - 1e-9]


def textbook(most: float) -> Array:
    """(6, 3) each axis up and down; with limited tilt, four sides and level twice."""
    if most == 180.0:
        return np.vstack([np.eye(3), -np.eye(3)])
    side, up = np.sin(np.radians(most)), np.cos(np.radians(most))
    sides = [(side, 0, up), (-side, 0, up), (0, side, up), (0, -side, up)]
    return np.array([*sides, (0, 0, 1), (0, 0, 1)], dtype=float)


EVERYWHERE = orientations(180.0)


def asked(offered: Array, k: int) -> jaxcal.Design:
    """The choice of up to k readings at the orientations offered."""
    return jaxcal.Design(offered, MODEL, PRIOR, NOISE, max_replicates=k)


def choose(rule: str, most: float, k: int, seed: int) -> Array:
    """(k, 3) orientations that a rule chooses."""
    if rule == "textbook":
        return textbook(most)
    offered = orientations(most)
    if rule == "random":
        return offered[np.random.default_rng(seed).choice(len(offered), k, False)]
    criterion = jaxcal.I(EVERYWHERE) if rule == "I" else rule
    chosen = asked(offered, k).select(k, criterion, "exchange")
    return offered[chosen.indices]


def efficiency(most: float) -> float:
    """I-efficiency of the textbook's orientations, at least."""
    offered = np.vstack([orientations(most), textbook(most)])
    at = np.arange(len(offered) - 6, len(offered))
    return asked(offered, 6).score(at, jaxcal.I(EVERYWHERE)).efficiency


def study(full: bool) -> dict[tuple[str, int, str], Array]:
    """(tilt, K, rule) to (triads, 3): errors of bias, of C, of all directions; mg."""
    triads = 200 if full else 20
    found = {}
    for tilt, most in TILTS.items():
        for k in COUNTS:
            for rule in RULES:
                if rule == "textbook" and k != 6:
                    continue
                rows = []
                chosen = choose(rule, most, k, 0)
                for seed in range(triads):
                    rng = np.random.default_rng(seed)
                    if rule == "random":
                        chosen = choose(rule, most, k, seed)
                    matrix = np.triu(np.eye(3) + 0.02 * rng.normal(size=(3, 3)))
                    bias = 0.02 * rng.normal(size=3)
                    readings = chosen @ matrix.T + bias
                    readings += rng.normal(0.0, float(NOISE.std), readings.shape)
                    fit = jaxcal.identify(
                        chosen, readings, model=MODEL, prior=PRIOR, noise=NOISE,
                        loss="gaussian",
                    )  # fmt: skip
                    off = fit.predict(EVERYWHERE) - (EVERYWHERE @ matrix.T + bias)
                    errors = (fit.bias - bias, np.triu(fit.matrix - matrix), off)
                    rows.append([np.linalg.norm(x) / len(x) ** 0.5 for x in errors])
                found[tilt, k, rule] = 1000.0 * np.array(rows)
    return found


def rows(found: dict[tuple[str, int, str], Array]) -> common.Rows:
    """Root mean square over the triads, mg."""
    names = ("bias_mg", "matrix_mg", "directions_mg")
    return [
        common.row({"tilt": tilt, "k": k, "rule": rule, "triads": len(each)},
                   names, common.rms(each), ".3f")
        for (tilt, k, rule), each in found.items()
    ]  # fmt: skip


PANELS = 2


def draw(axes, rows: common.Rows) -> None:
    """Error in all directions by number of orientations."""
    for each, tilt in zip(axes, TILTS, strict=True):
        shown = [row for row in rows if row["tilt"] == tilt]
        label = "error in all directions, mg"
        common.curves(each, shown, "rule", "k", "directions_mg", label)
        each.set(title=f"tilt: {tilt}", xlabel="orientations")


if __name__ == "__main__":
    common.main(sys.modules[__name__])
    for tilt, most in TILTS.items():
        share = 100.0 * efficiency(most)
        print(f"tilt {tilt}: the textbook six are at least {share:.1f} % I-efficient")
