"""How much longer than the proven fastest run the runs of other methods take.

    python benchmarks/travel_gap.py [--k 4] [--sets 100]

Sets of 50 candidates, uniform in +-20 degrees, moved as in ``benchmarks/pareto.py``.
At every least D-efficiency: the mean of the excess time, and the share of sets in which
the fastest run itself was found. ``greedy`` takes what adds most to log det less the
weighted time, K times, for the same 32 weights; where no weight reaches the efficiency
it answers with the D-optimum. The number beside ``lookahead`` is that of first postures
tried for each weight. The time to find the D-optimum, which all need, is not counted.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from pareto import HOME, MOTION

from jaxcal.selection.fastest.api import make_search
from jaxcal.selection.fastest.lookahead import PRICES, complete
from jaxcal.selection.fastest.task import Task, make_task

SHARES = (0.8, 0.9, 0.95, 0.99)


def greedy_runs(task: Task) -> np.ndarray:
    """(32, K) greedy choices by gain less weighted time, with a ridge of 0.01."""
    rows = task.blocks[:, 0]
    p = rows.shape[1]
    x = rows / np.sqrt((rows**2).sum() / rows.size)
    out = []
    for price in PRICES / task.times.mean():
        run: list[int] = []
        gram = 0.01 * np.eye(p)
        for _ in range(task.k):
            gain = np.log1p(np.einsum("ip,pq,iq->i", x, np.linalg.inv(gram), x))
            net = gain - price * (task.times[run[-1]] if run else task.start)
            net[run] = -np.inf
            run.append(int(np.argmax(net)))
            gram = gram + np.outer(x[run[-1]], x[run[-1]])
        out.append(run)
    return np.array(out)


def greedy_seconds(task: Task, finish: bool) -> list[float]:
    """Seconds of the greedy answer at every share; with the last two chosen again."""
    runs = greedy_runs(task)
    out = []
    for share in SHARES:
        wanted = task.wanted(share, None)
        if finish:
            found = complete(task, runs, wanted)
        else:
            enough = [run for run in runs if task.log_det(run) >= wanted]
            found = min(enough, key=lambda run: task.tour(run)[1], default=None)
        found = task.optimum if found is None else found
        out.append(task.tour(found)[1] + task.settle)
    return out


def optimum_seconds(task: Task) -> list[float]:
    """Seconds of the D-optimal subset in its best order, at every share."""
    return [task.tour(task.optimum)[1] + task.settle] * len(SHARES)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--k", type=int, default=4)
    parser.add_argument("--sets", type=int, default=100)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--limit", type=float, help="s after which no set is begun")
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

    def asked(task: Task, method: str, num: int | None = None) -> list[float]:
        solve = make_search(task, method, num, None)
        found = [solve(task.wanted(share, None)) for share in SHARES]
        return [task.tour(one.indices)[1] + task.settle for one in found]

    begun = time.perf_counter()
    for i, candidates in enumerate(sets):
        if arguments.limit and time.perf_counter() - begun > arguments.limit:
            break
        task = make_task(candidates, arguments.k, MOTION, start=HOME)
        assert task.exact.proven
        note("D-optimum in its best order", lambda t=task: optimum_seconds(t))
        note("exact", lambda t=task: asked(t, "exact"))
        note("greedy", lambda t=task: greedy_seconds(t, False))
        note("greedy, last two again", lambda t=task: greedy_seconds(t, True))
        for num in (1, 8):
            note(f"lookahead, {num}", lambda t=task, n=num: asked(t, "lookahead", n))
        note("heuristic", lambda t=task: asked(t, "heuristic"))
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
