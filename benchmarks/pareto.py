"""The time of a run against its D-efficiency: the Pareto front, table and figure.

    python benchmarks/pareto.py [--candidates 50] [--k 4,5,6] [--least 0.7] [--seed 1]
                                [--beside lookahead] [--figure pareto.png]

Candidates are uniform in +-20 degrees on three axes that move at 20 deg/s, accelerate
at 100 deg/s^2 and settle for 1 s; the run starts at the zero posture. Beside each
proven front: what the D-optimal postures take in the order the solver lists them and in
the best order, what the policy's take likewise, and by how much the heuristic's runs
are longer than the proven ones at the efficiencies of the front. ``--beside`` draws the
fronts of other methods too and says how far they lie above the proven one.
"""

from __future__ import annotations

import argparse
import pathlib

import numpy as np

from jaxcal.reports import plots
from jaxcal.reports.plots.style import panels
from jaxcal.selection import Design, select
from jaxcal.selection.fastest import Motion, fastest_tour, travel_times
from jaxcal.selection.fastest.search import ParetoFront

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
    proof = "proven" if front.proven else "NOT proven"
    search = sum(point.search_seconds for point in front.points)
    print(f"K = {k}: {len(front.points)} points, {proof}, {search:.1f} s of search")
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
    excess = []
    for point in front.points:
        fast = Design(candidates).fastest(
            k,
            MOTION,
            start=HOME,
            least_efficiency=min(1.0, point.efficiency * (1 - 1e-9)),
            method="heuristic",
        )
        excess.append(fast.seconds / point.seconds - 1.0)
    print(
        f"  heuristic: {np.mean(excess):.2%} longer in the mean, {np.max(excess):.2%} "
        f"at worst, equal in {np.mean(np.array(excess) < 1e-9):.0%}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--candidates", type=int, default=50, help="M")
    parser.add_argument("--k", default="4,5,6", help="numbers of postures")
    parser.add_argument("--least", type=float, default=0.7, help="least D-efficiency")
    parser.add_argument("--time-limit", type=float, default=60.0, help="s for a point")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--beside", default="", help="other methods to draw a front of")
    parser.add_argument("--figure", type=pathlib.Path, help="write it to this .png")
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    candidates = rng.uniform(-20.0, 20.0, (arguments.candidates, 3))
    fronts = {}
    for k in map(int, arguments.k.split(",")):
        front = Design(candidates).pareto(
            k,
            MOTION,
            start=HOME,
            least_efficiency=arguments.least,
            method="exact",
            time_limit=arguments.time_limit,
        )
        show(candidates, k, front)
        fronts[f"K = {k}, exact" if arguments.beside else f"K = {k}"] = front
        for method in filter(None, arguments.beside.split(",")):
            other = Design(candidates).pareto(
                k,
                MOTION,
                start=HOME,
                least_efficiency=arguments.least,
                method=method,
            )
            fronts[f"K = {k}, {method}"] = other
            above = [
                min(
                    q.seconds
                    for q in other.points
                    if q.efficiency >= p.efficiency - 1e-9
                )
                / p.seconds
                - 1.0
                for p in front.points
            ]
            print(
                f"  {method}: {len(other.points)} points, {np.mean(above):.2%} above "
                f"the front in the mean, {np.max(above):.2%} at worst"
            )
    if arguments.figure:
        figure, axes = panels((6.4, 4.0))
        plots.pareto(axes, fronts)
        figure.savefig(arguments.figure, dpi=150)
        print(f"wrote {arguments.figure}")


if __name__ == "__main__":
    main()
