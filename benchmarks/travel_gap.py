"""How much longer than the proven fastest run the runs of other methods take.

    python benchmarks/travel_gap.py [--k 4] [--sets 100] [--checkpoint DIR]

Sets of 50 candidates, uniform in +-20 degrees, never trained on, moved as in
``benchmarks/pareto.py``. At every least D-efficiency: the mean of the excess time, and
the share of sets in which the fastest run itself was found. ``greedy`` takes what adds
most to log det less the weighted time, K times, for the same 32 weights; where no
weight reaches the efficiency it answers with the D-optimum. ``lookahead`` and
``policy`` read the same look-ahead; only the policy has learned. The number is that of
first postures tried for each weight.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from pareto import HOME, MOTION

from jaxcal.selection import make_problem
from jaxcal.selection.exact.exact import solve_exact
from jaxcal.selection.fastest import fastest as cost
from jaxcal.selection.fastest.fastest import fastest_tour, travel_times
from jaxcal.selection.fastest.travel_policy import WEIGHTS, completed

SHARES = (0.8, 0.9, 0.95, 0.99)


def greedy_runs(problem, times: np.ndarray, start: np.ndarray) -> np.ndarray:
    """(32, K) greedy choices by gain less weighted time, with a ridge of 0.01."""
    rows, p = problem.rows, problem.num_regressors
    x = rows / np.sqrt((rows**2).sum() / rows.size)
    out = []
    for weight in WEIGHTS / times.mean():
        run: list[int] = []
        gram = 0.01 * np.eye(p)
        for _ in range(problem.k):
            gain = np.log1p(np.einsum("ip,pq,iq->i", x, np.linalg.inv(gram), x))
            net = gain - weight * (times[run[-1]] if run else start)
            net[run] = -np.inf
            run.append(int(np.argmax(net)))
            gram = gram + np.outer(x[run[-1]], x[run[-1]])
        out.append(run)
    return np.array(out)


def greedy_seconds(candidates: np.ndarray, k: int, finish: bool) -> list[float]:
    """Seconds of the greedy answer at every share; with the last two chosen again."""
    problem = make_problem(candidates, k)
    times = travel_times(candidates, candidates, MOTION)
    start = travel_times(HOME[None], candidates, MOTION)[0]
    runs = greedy_runs(problem, times, start)
    optimum = solve_exact(problem).subsets[0]
    rows, p = problem.rows, problem.num_regressors

    def value(chosen: np.ndarray) -> float:
        return float(np.linalg.slogdet(rows[chosen].T @ rows[chosen])[1])

    def seconds(chosen: np.ndarray) -> float:
        return fastest_tour(times[np.ix_(chosen, chosen)], start[chosen])[1]

    out = []
    for share in SHARES:
        wanted = value(optimum) + p * np.log(share) - 1e-12
        if finish:
            found = completed(runs, rows, times, start, wanted, 0)[1]
        else:
            reached = [seconds(run) for run in runs if value(run) >= wanted]
            found = min(reached, default=np.inf)
        found = found if np.isfinite(found) else seconds(optimum)
        out.append(found + k * MOTION.settle)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--k", type=int, default=4)
    parser.add_argument("--sets", type=int, default=100)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--limit", type=float, help="s after which no set is begun")
    parser.add_argument("--checkpoint", help="folder; the travel policy that ships")
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    sets = rng.uniform(-20.0, 20.0, (arguments.sets, 50, 3))
    seconds: dict[str, list[list[float]]] = {}
    spent: dict[str, float] = {}

    def note(name: str, answer) -> None:
        begun = time.perf_counter()
        seconds.setdefault(name, []).append(answer())
        # The first answer compiles.
        took = time.perf_counter() - begun if len(seconds[name]) > 1 else 0.0
        spent[name] = spent.get(name, 0.0) + took

    def asked(candidates: np.ndarray, method: str, num: int = 8):
        def answer() -> list[float]:
            # One call of ``select_fastest`` a share, but for what they have in common.
            problem = make_problem(candidates, arguments.k)
            task = cost._task(
                problem, MOTION, HOME, method, 60.0, 0, num, arguments.checkpoint
            )
            return [cost._fastest(task, share, None).seconds for share in SHARES]

        return answer

    begun = time.perf_counter()
    for i, candidates in enumerate(sets):
        if arguments.limit and time.perf_counter() - begun > arguments.limit:
            break
        note("exact", asked(candidates, "exact"))
        note("greedy", lambda c=candidates: greedy_seconds(c, arguments.k, False))
        note(
            "greedy, last two again",
            lambda c=candidates: greedy_seconds(c, arguments.k, True),
        )
        for num in (1, 8):
            for method in ("lookahead", "policy"):
                note(f"{method}, {num}", asked(candidates, method, num))
        note("heuristic", asked(candidates, "heuristic"))
        gone = time.perf_counter() - begun
        left = gone / (i + 1) * (len(sets) - i - 1)
        print(f"\r{i + 1} of {len(sets)} sets, {left:.0f} s left  ", end="", flush=True)
    print()
    best = np.array(seconds["exact"])
    print(f"M = 50, K = {arguments.k}, {len(best)} sets, seed {arguments.seed}")
    heads = [f"efficiency {share:g}" for share in SHARES]
    print(f"| method | {' | '.join(heads)} | time of the four |")
    print("|---" * (len(SHARES) + 2) + "|")
    for name, rows in seconds.items():
        excess = np.array(rows) / best - 1.0
        cells = [
            f"+{100 * e.mean():.2f} %, {100 * (e < 1e-9).mean():.0f} %"
            for e in excess.T
        ]
        each = 1e3 * spent[name] / max(len(rows) - 1, 1)
        print(f"| {name} | {' | '.join(cells)} | {each:.0f} ms |")


if __name__ == "__main__":
    main()
