"""The time of a run against its D-efficiency: the Pareto front, table and figure.

    python benchmarks/pareto.py [--candidates 50] [--k 4,5,6] [--least 0.7] [--seed 1]
                                [--figure pareto.png]

Candidates are uniform in +-20 degrees on three axes that move at 20 deg/s, accelerate
at 100 deg/s^2 and settle for 1 s; the run starts at the zero posture. Beside each
front: what the D-optimal postures take in the order the solver lists them and in the
best order, and what the policy's take likewise.
"""

from __future__ import annotations

import argparse
import pathlib

import numpy as np

from jaxcal.designs.travel import Motion, ParetoFront, fastest_tour, travel_times
from jaxcal.reports.plots import numbered, panels
from jaxcal.selection import Design, select

MOTION = Motion(speed=(20.0,), acceleration=(100.0,), settle=1.0)
HOME = np.zeros(3)


def run_seconds(postures: np.ndarray) -> tuple[float, float]:
    """Seconds of a run in the order given, and in the best order."""
    times = travel_times(postures, postures, MOTION)
    start = travel_times(HOME[None], postures, MOTION)[0]
    settle = len(postures) * MOTION.settle
    given = start[0] + np.diagonal(times, 1).sum()
    return float(given) + settle, fastest_tour(times, start)[1] + settle


def show(candidates: np.ndarray, k: int, front: ParetoFront) -> None:
    """The rows of one K."""
    search = sum(point.search_seconds for point in front.points)
    print(f"K = {k}: {len(front.points)} points ({front.method}), {search:.1f} s")
    print("  efficiency  seconds  postures in order")
    for point in front.points:
        print(f"  {point.efficiency:10.4f} {point.seconds:8.3f}  {point.indices}")
    for method in ("exact", "policy"):
        found = select(candidates, k, method)
        given, best = run_seconds(candidates[found.indices])
        print(
            f"  {method}: {given:.3f} s in the order returned, {best:.3f} s in the "
            f"best order (D-efficiency {found.efficiency:.4f} against its bound)"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--candidates", type=int, default=50, help="M")
    parser.add_argument("--k", default="4,5,6", help="numbers of postures")
    parser.add_argument("--least", type=float, default=0.7, help="least D-efficiency")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--figure", type=pathlib.Path, help="write it to this .png")
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    candidates = rng.uniform(-20.0, 20.0, (arguments.candidates, 3))
    fronts = {}
    for k in map(int, arguments.k.split(",")):
        design, least = Design(candidates), arguments.least
        front = design.pareto(k, MOTION, start=HOME, least_efficiency=least)
        show(candidates, k, front)
        fronts[f"K = {k}"] = front
    if arguments.figure:
        figure, axes = panels((6.4, 4.0))
        for i, (name, front) in enumerate(fronts.items()):
            efficiencies = [point.efficiency for point in front.points]
            seconds = [point.seconds for point in front.points]
            look = numbered(i) | {"linestyle": "-", "linewidth": 1.0, "markersize": 5}
            axes.step(efficiencies, seconds, where="pre", label=name, **look)
        axes.set(
            xlabel="D-efficiency against the optimum",
            ylabel="run time (s): travel and settling",
        )
        axes.legend(frameon=False)
        figure.savefig(arguments.figure, dpi=150)
        print(f"wrote {arguments.figure}")


if __name__ == "__main__":
    main()
