"""Calibrate an accelerometer triad: which orientations, against the textbook six.

    python examples/triad/triad.py            # table, errors.csv and errors.png
    python examples/triad/triad.py --quick    # fewer triads

The sensor is held still in known orientations and reads ``y = C g + b``. Scale and
misalignment are an upper triangular C, so that the frame is fixed by the first axis:
three of its nine entries are held at zero by the prior, nine parameters are unknown.
"""

from __future__ import annotations

import argparse
import csv
import pathlib

import numpy as np
from numpy.typing import NDArray

import jaxcal
from jaxcal.models import Affine

HERE = pathlib.Path(__file__).parent
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


def about(rule: str) -> dict:
    """What ``select`` and ``score`` are told; I is for readings in all directions."""
    region = orientations(180.0) if rule == "I" else None
    return {
        "model": MODEL, "prior": PRIOR, "noise": NOISE, "criterion": rule,
        "region": region,
    }  # fmt: skip


def choose(rule: str, most: float, k: int, seed: int) -> Array:
    """(k, 3) orientations that a rule chooses."""
    if rule == "textbook":
        return textbook(most)
    offered = orientations(most)
    if rule == "random":
        return offered[np.random.default_rng(seed).choice(len(offered), k, False)]
    chosen = jaxcal.select(offered, k, "exchange", max_replicates=k, **about(rule))
    return offered[chosen.indices]


def efficiency(most: float) -> float:
    """I-efficiency of the textbook's orientations, at least."""
    offered = np.vstack([orientations(most), textbook(most)])
    at = np.arange(len(offered) - 6, len(offered))
    return jaxcal.score(offered, at, max_replicates=6, **about("I")).efficiency


def study(triads: int) -> dict[tuple[str, int, str], Array]:
    """(tilt, K, rule) to (triads, 3): errors of bias, of C, of all directions; mg."""
    found = {}
    everywhere = orientations(180.0)
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
                    off = fit.predict(everywhere) - (everywhere @ matrix.T + bias)
                    errors = (fit.bias - bias, np.triu(fit.matrix - matrix), off)
                    rows.append([np.linalg.norm(x) / len(x) ** 0.5 for x in errors])
                found[tilt, k, rule] = 1000.0 * np.array(rows)
    return found


def table(found: dict[tuple[str, int, str], Array]) -> str:
    """Markdown: root mean square over the triads, mg."""
    lines = [
        "| tilt | orientations | chosen by | bias | C | all directions |",
        "|---|---|---|---|---|---|",
    ]
    for (tilt, k, rule), rows in found.items():
        cells = " | ".join(f"{x:.2f}" for x in np.sqrt((rows**2).mean(axis=0)))
        lines.append(f"| {tilt} | {k} | {rule} | {cells} |")
    return "\n".join(lines)


def save(found: dict[tuple[str, int, str], Array], folder: pathlib.Path) -> None:
    """errors.csv and errors.png."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "errors.csv").open("w", newline="") as file:
        write = csv.writer(file).writerow
        write(["tilt", "k", "rule", "triads", "bias_mg", "matrix_mg", "directions_mg"])
        for (tilt, k, rule), rows in found.items():
            rms = np.sqrt((rows**2).mean(axis=0))
            write([tilt, k, rule, len(rows), *(f"{x:.3f}" for x in rms)])
    figure, both = plt.subplots(1, 2, figsize=(7.4, 3.6), layout="constrained")
    for axes, tilt in zip(both, TILTS, strict=True):
        for rule in RULES:
            counts = [k for k in COUNTS if (tilt, k, rule) in found]
            rms = [np.sqrt((found[tilt, k, rule][:, 2] ** 2).mean()) for k in counts]
            style = "kx" if rule == "textbook" else "o-"
            axes.plot(counts, rms, style, label=rule, zorder=3 + (style == "kx"))
        axes.set(
            title=f"tilt: {tilt}", xlabel="orientations", yscale="log",
            ylabel="error in all directions, mg", xticks=COUNTS,
        )  # fmt: skip
    both[0].legend()
    figure.savefig(folder / "errors.png", dpi=160)


def main(arguments: list[str] | None = None) -> dict[tuple[str, int, str], Array]:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="20 triads, not 200")
    parser.add_argument(
        "--out", type=pathlib.Path, default=HERE, help="folder to write"
    )
    options = parser.parse_args(arguments)
    found = study(20 if options.quick else 200)
    save(found, options.out)
    print(table(found))
    for tilt, most in TILTS.items():
        share = 100.0 * efficiency(most)
        print(f"tilt {tilt}: the textbook six are at least {share:.1f} % I-efficient")
    return found


if __name__ == "__main__":
    main()
