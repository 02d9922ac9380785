"""What a policy for block problems could win over greedy and exchange at equal time.

    python benchmarks/policy_headroom.py [--problems 120] [--train 120] [--json FILE]

Random problems of criterion D, seeded: p 4 to 40, q 1 to 6, M 20 to 1,000, K from half
of what identifies (with a prior; all of it without) to three times as many; blocks of
independent numbers, of derivatives of a smooth function of three commands, or clustered
around a few; no prior, a weak or a strong one. Three parts:

time       CPU time of the shipped, affine policy over that of greedy: the least that a
           policy with such features and such a network may be given here.
headroom   D-efficiency of greedy and of exchange against the best known (exchange with
           many starts, and branch and bound where it proves), and what is left above
           exchange in the time that a policy takes.
rules      what might start better than greedy does, before and after exchange from
           there, beside exchange in the same time: the best greedy completion of the
           eight largest gains, at every choice; greedy with a part of the pool as prior
           (one number); greedy in the metric that the choices to come will bring
           about; a linear score and a small network of four such gains, trained by
           imitation of exchange on other problems.

CPU times of one thread (the machine may be shared): run with OPENBLAS_NUM_THREADS=1.
Exchange may take a quarter more than the time it is compared in. The last three rules
are charged only greedy's pass and the matrix products of their metrics, which is less
than they would take.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import pathlib
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from numpy.typing import NDArray

from jaxcal.deadline import Deadline
from jaxcal.files import write_text
from jaxcal.selection import Design
from jaxcal.selection.exact.exact import solve_exact
from jaxcal.selection.exchange.exchange import (
    default_restarts,
    exchange_from,
    exchange_indices,
    greedy_indices,
)
from jaxcal.selection.policy import load_policy
from jaxcal.selection.problem import Problem

HIT = 1e-9  # of log det
GROUPS = ("M < 100", "M 100 to 300", "M > 300")
SHAPES = ("independent", "smooth", "clustered")
EXPECTED = (1.0, 0.3)  # multiples of the information that the choices to come bring
POOLED = (0.03, 0.1, 0.3, 1.0)  # of that of K average candidates, kept as a prior
STARTS = (2, 4, 8, 16, 32, 64, 128, 200)
SLACK = 1.25  # by which exchange may be over an equal time: single times vary
LONGEST = 0.1  # CPU seconds of the exchange of most starts
WIDTH = 16
_WORK = 1e9  # k M q^2 p of the starts of the best known: about 3 s

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Score = Callable[[Array, Array], Array]  # (M, 4) gains, (4,) scalars -> (M,)


def draw(rng: np.random.Generator, most: int = 1000) -> tuple[Problem, str]:
    """A random problem and the kind of its blocks."""
    while True:
        p = round(math.exp(rng.uniform(math.log(4), math.log(40))))
        q = int(rng.integers(1, 7))
        count = round(math.exp(rng.uniform(math.log(20), math.log(most))))
        prior = rng.choice([0.0, 0.01, 1.0])  # of the mean information of a candidate
        least = math.ceil(p / q) if prior == 0.0 else max(2, math.ceil(0.5 * p / q))
        k = round(math.exp(rng.uniform(math.log(least), math.log(max(3 * p / q, 3)))))
        if max(least, k) <= count / 2:
            break
    shape = str(rng.choice(SHAPES))
    if shape == "independent":
        blocks = rng.normal(size=(count, q, p))
    elif shape == "clustered":
        centres = rng.normal(size=(max(4, 2 * p // q), q, p))
        blocks = centres[rng.integers(len(centres), size=count)]
        blocks = blocks + 0.2 * rng.normal(size=blocks.shape)
    else:
        commands = rng.uniform(-1.0, 1.0, (count, 3))
        slope, phase = rng.normal(0.0, 1.5, (3, q, p)), rng.uniform(0, 6.3, (q, p))
        blocks = np.cos(np.einsum("mn,nqp->mqp", commands, slope) + phase)
    blocks = blocks * np.exp(rng.normal(0.0, 1.0, p))
    known = None
    if prior:
        spread = np.exp(rng.normal(0.0, 1.0, p))
        known = np.diag(prior * spread * (blocks**2).sum(axis=1).mean(axis=0))
    return Design.from_blocks(blocks, known).problem(max(least, k)), shape


def log_dets(problem: Problem, chosen: Indices) -> float:
    return float(problem.values(chosen[None])[1][0])


def cpu_seconds(call: Callable[[], Any], least: float = 0.004) -> float:
    """CPU seconds of a warm call: best of three, each long enough to be measured."""
    begun = time.process_time()
    call()
    times = max(1, min(50, math.ceil(least / max(time.process_time() - begun, 1e-6))))
    best = math.inf
    for _ in range(3 if times > 1 else 2):
        begun = time.process_time()
        for _ in range(times):
            call()
        best = min(best, (time.process_time() - begun) / times)
    return best


def policy_time() -> list[dict[str, float]]:
    """CPU time of the shipped policy and of greedy on the same affine problems."""
    choose = load_policy()
    rows = []
    for count, k in ((20, 4), (50, 4), (50, 8), (200, 8), (200, 20), (1000, 8)):
        candidates = np.random.default_rng(count).uniform(size=(count, 3))
        problem = Design(candidates).problem(k)
        greedy = cpu_seconds(lambda p=problem: greedy_indices(p))
        policy = cpu_seconds(lambda p=problem: choose([p], "greedy", 1, 0))
        rows.append({"M": count, "k": k, "greedy": greedy, "policy": policy})
    return rows


@dataclasses.dataclass
class Case:
    """A problem, what is best known of it, and what each way has reached."""

    problem: Problem
    shape: str
    best: float  # log det
    proven: bool
    reached: dict[str, float]  # log det
    seconds: dict[str, float]
    ladder: list[tuple[float, float]]  # seconds, log det: greedy, then exchange

    def note(self, who: str, chosen: Indices, seconds: float) -> None:
        self.reached[who] = log_dets(self.problem, chosen)
        self.seconds[who] = seconds
        self.best = max(self.best, self.reached[who])

    def efficiency(self, log_det: float) -> float:
        return math.exp((log_det - self.best) / self.problem.num_regressors)

    def in_time(self, seconds: float) -> float:
        """log det of greedy or exchange, whichever is the best that ends in time."""
        limit = SLACK * seconds
        done = [log_det for taken, log_det in self.ladder if taken <= limit]
        return max(done, default=self.ladder[0][1])


def work(problem: Problem) -> float:
    count, q, p = problem.blocks.shape
    return float(problem.k * count * q * q * p)


def headroom(problem: Problem, shape: str) -> Case:
    starts = int(np.clip(_WORK / work(problem), 20, 1000))
    best = exchange_indices(problem, starts, 12345)
    case = Case(problem, shape, log_dets(problem, best), False, {}, {}, [])
    if len(problem.blocks) <= 100:
        result = solve_exact(problem, deadline=Deadline(0.5))
        case.proven = result.proven
        case.best = max(case.best, float(result.value or 0.0))
    greedy = greedy_indices(problem)
    t_greedy = cpu_seconds(lambda: greedy_indices(problem))
    case.note("greedy", greedy, t_greedy)
    climb = exchange_from(problem, greedy)
    t_climb = cpu_seconds(lambda: exchange_from(problem, greedy))
    case.note("exchange, from greedy alone", climb, t_greedy + t_climb)
    case.ladder = list(zip(case.seconds.values(), case.reached.values(), strict=True))
    for share in POOLED:
        who = f"pool as prior, {share:g}"
        near = pooled(problem, share)
        start = greedy_indices(near)
        case.note(who, start, t_greedy)
        climb_after(case, who)(start)
    own = [who for who in case.reached if who.endswith("then exchange")]
    own.append("exchange, from greedy alone")
    who = "exchange, from greedy and all four"
    case.reached[who] = max(case.reached[each] for each in own)
    case.seconds[who] = sum(case.seconds[each] for each in own)
    chosen, taken = look_ahead(problem)
    case.note("look-ahead of 8", chosen, taken)
    climb_after(case, "look-ahead of 8")(chosen)
    for starts in (*STARTS, default_restarts(problem)):
        many = exchange_indices(problem, starts, 0)
        taken = cpu_seconds(lambda n=starts: exchange_indices(problem, n, 0))
        case.ladder.append((taken, log_dets(problem, many)))
        if starts == default_restarts(problem):
            case.note("exchange, default starts", many, taken)
            break
        if taken > LONGEST or starts > default_restarts(problem):
            many = exchange_indices(problem, None, 0)
            taken = cpu_seconds(lambda: exchange_indices(problem, None, 0))
            case.note("exchange, default starts", many, taken)
            break
    return case


def climb_after(case: Case, who: str) -> Callable[[Indices], None]:
    """Notes what exchange makes of a start, if it is not singular."""

    def noted(start: Indices) -> None:
        if not np.isfinite(case.reached[who]):
            case.note(f"{who}, then exchange", start, case.seconds[who])
            return
        chosen = exchange_from(case.problem, start)
        taken = cpu_seconds(lambda: exchange_from(case.problem, start))
        case.note(f"{who}, then exchange", chosen, case.seconds[who] + taken)

    return noted


def pooled(problem: Problem, share: float) -> Problem:
    """The problem with ``share`` of K average candidates as a further prior."""
    flat = problem.blocks.reshape(-1, problem.num_regressors)
    known = share * problem.k / len(problem.blocks) * flat.T @ flat
    white = problem.white._replace(prior=problem.prior + known)
    return dataclasses.replace(problem, white=white)


def look_ahead(problem: Problem, width: int = 8) -> tuple[Indices, float]:
    """At every choice the best greedy completion of the ``width`` largest gains.

    This is the feature that carries the affine policy. The CPU seconds are those of the
    completions alone.
    """
    chosen: list[int] = []
    spent = 0.0
    for _ in range(problem.k):
        gain = gains(problem, chosen)[:, 0]
        gain[chosen] = -np.inf
        ends = []
        for first in np.argsort(-gain)[:width]:
            start = np.array([*chosen, first], dtype=np.int64)
            rest = dataclasses.replace(problem, required=start)
            begun = time.process_time()
            end = greedy_indices(rest)
            spent += time.process_time() - begun
            ends.append((log_dets(problem, end), int(first)))
        chosen.append(max(ends)[1])
    return np.array(chosen, dtype=np.int64), spent


def products_seconds(problem: Problem) -> float:
    """CPU time of one product of all blocks and a metric at every choice."""
    flat = problem.blocks.reshape(-1, problem.num_regressors)
    metric = np.eye(problem.num_regressors)
    return problem.k * cpu_seconds(lambda: flat @ metric)


def gains(problem: Problem, chosen: list[int]) -> Array:
    """(M, 4) log det gains, relative to the best of each column.

    In the metric of what is chosen, of that and what the choices to come bring if they
    are like the average candidate (in full, or 0.3 of it), and of the pool.
    """
    blocks, count = problem.blocks, len(problem.blocks)
    flat = blocks.reshape(-1, blocks.shape[2])
    pool = flat.T @ flat / count
    now = problem.prior + 1e-6 * pool
    if chosen:
        rows = blocks[chosen].reshape(-1, blocks.shape[2])
        now = now + rows.T @ rows
    left = problem.k - len(chosen)
    metrics = [now, *(now + share * left * pool for share in EXPECTED)]
    metrics.append(problem.prior + problem.k * pool)
    out = np.empty((count, len(metrics)))
    for column, metric in enumerate(metrics):
        tall = flat @ np.linalg.inv(np.linalg.cholesky(metric)).T
        tall = tall.reshape(blocks.shape)
        inside = np.eye(blocks.shape[1]) + tall @ np.matrix_transpose(tall)
        out[:, column] = np.linalg.slogdet(inside)[1]
    return out - out.max(axis=0)


def scalars(problem: Problem, done: int) -> Array:
    _, q, p = problem.blocks.shape
    k = problem.k
    return np.array([done / k, k * q / p / 3.0, math.log(p) / 4.0, q / 6.0])


def rollout(problem: Problem, score: Score) -> Indices:
    chosen: list[int] = []
    for done in range(problem.k):
        rating = score(gains(problem, chosen), scalars(problem, done))
        rating[chosen] = -np.inf
        chosen.append(int(rating.argmax()))
    return np.array(chosen, dtype=np.int64)


def features(relative: Any, about: Any) -> Any:
    """(..., M, 16) inputs of the learned scores, of gains and scalars."""
    clipped = jnp.maximum(relative, -5.0)
    about = jnp.broadcast_to(about[..., None, :], (*clipped.shape[:-1], 4))
    parts = [clipped, jnp.exp(8.0 * clipped), clipped * about[..., :1], about]
    return jnp.concatenate(parts, axis=-1)


def rated(weights: Any, relative: Any, about: Any) -> Any:
    """Scores (..., M): linear, plus a hidden layer where there is one."""
    inputs = features(relative, about)
    out = inputs @ weights["linear"]
    if "into" in weights:
        hidden = jnp.tanh(inputs @ weights["into"] + weights["bias"])
        out = out + hidden @ weights["out"]
    return out


def decisions(num: int, seed: int) -> tuple[Array, Array, NDArray[np.bool_], Any]:
    """Gains, scalars, wanted and free (N, M) of four states a problem, M up to 200.

    A state is a part of greedy's selection, or of a random part of the best; wanted is
    what exchange completes it with.
    """
    rng = np.random.default_rng(seed)
    rows: list[tuple[Array, Array, Indices, list[int]]] = []
    for _ in range(num):
        problem, _ = draw(rng, 200)
        best, greedy = exchange_indices(problem), greedy_indices(problem)
        for turn in range(4):
            done = int(rng.integers(problem.k))
            if turn % 2:
                prefix = rng.choice(best, done, replace=False).tolist()
                wanted = np.setdiff1d(best, prefix)
            else:
                prefix = greedy[:done].tolist()
                rest = dataclasses.replace(
                    problem, required=np.array(prefix, dtype=np.int64)
                )
                wanted = np.setdiff1d(exchange_indices(rest), prefix)
            about = scalars(problem, done)
            rows.append((gains(problem, prefix), about, wanted, prefix))
    shape = (len(rows), 200)
    relative, about = np.full((*shape, 4), -5.0), np.zeros((len(rows), 4))
    wanted_mask, free = np.zeros(shape, bool), np.zeros(shape, bool)
    for at, (gain, scalar, want, prefix) in enumerate(rows):
        relative[at, : len(gain)], about[at] = gain, scalar
        free[at, : len(gain)] = True
        free[at, prefix] = False
        wanted_mask[at, want] = True
    return relative, about, wanted_mask, free


def trained(data: Any, hidden: bool, steps: int = 1500) -> Score:
    """A score whose likeliest candidates are the wanted ones, by Adam."""
    relative, about, wanted, free = (jnp.asarray(part) for part in data)
    weights = {"linear": jnp.zeros(16).at[0].set(4.0)}  # begins as greedy
    if hidden:
        key = jax.random.key(0)
        weights["into"] = 0.3 * jax.random.normal(key, (16, WIDTH))
        weights["bias"], weights["out"] = jnp.zeros(WIDTH), jnp.zeros(WIDTH)
    rate = optax.cosine_decay_schedule(0.02, steps)
    optimiser = optax.adam(rate)

    def loss(weights: Any) -> Any:
        score = jnp.where(free, rated(weights, relative, about), -1e9)
        right = jax.nn.logsumexp(jnp.where(wanted, score, -1e9), axis=1)
        return (jax.nn.logsumexp(score, axis=1) - right).mean()

    @jax.jit
    def step(weights: Any, state: Any) -> Any:
        updates, state = optimiser.update(jax.grad(loss)(weights), state)
        return optax.apply_updates(weights, updates), state

    state = optimiser.init(weights)
    for _ in range(steps):
        weights, state = step(weights, state)
    fixed = {name: np.asarray(value, np.float64) for name, value in weights.items()}

    def score(relative: Array, about: Array) -> Array:
        clipped = np.maximum(relative, -5.0)
        every = np.broadcast_to(about, clipped.shape)
        parts = [clipped, np.exp(8.0 * clipped), clipped * about[0], every]
        inputs = np.concatenate(parts, axis=1)
        out = inputs @ fixed["linear"]
        if hidden:
            out += np.tanh(inputs @ fixed["into"] + fixed["bias"]) @ fixed["out"]
        return np.array(out)

    return score


def group(case: Case) -> str:
    count = len(case.problem.blocks)
    return GROUPS[int(count >= 100) + int(count > 300)]


def row(
    cases: list[Case], log_det: list[float], seconds: list[float]
) -> dict[str, float]:
    """What a way has reached over some problems."""
    each = zip(cases, log_det, strict=True)
    found = np.array([case.efficiency(reached) for case, reached in each])
    gap = np.array([case.best for case in cases]) - log_det
    scale = np.maximum(1.0, [abs(case.best) for case in cases])
    over = [t / c.seconds["greedy"] for c, t in zip(cases, seconds, strict=True)]
    out = {
        "mean": found.mean(),
        "worst tenth": np.quantile(found, 0.1),
        "at .999": (found >= 0.999).mean(),
        "best known": (gap <= HIT * scale).mean(),
        "x greedy": np.median(over),
        "ms": 1e3 * np.median(seconds),
    }
    return {name: float(value) for name, value in out.items()}


def table(cases: list[Case], ways: list[str]) -> dict[str, dict[str, float]]:
    """Every way, and what exchange makes in the same time."""
    out = {}
    for who in ways:
        taken = [case.seconds[who] for case in cases]
        out[who] = row(cases, [case.reached[who] for case in cases], taken)
        same = [
            case.in_time(seconds) for case, seconds in zip(cases, taken, strict=True)
        ]
        equal = row(cases, same, taken)
        out[who] |= {f"exchange then: {n}": equal[n] for n in ("mean", "at .999")}
    return out


def show(title: str, rows: dict[str, dict[str, float]]) -> None:
    print(f"\n{title}\n")
    names = list(next(iter(rows.values())))
    print("| | " + " | ".join(names) + " |\n|" + "---|" * (len(names) + 1))
    for who, each in rows.items():
        shown = [
            f"{value:.3g}" if name in ("x greedy", "ms") else f"{value:.4f}"
            for name, value in each.items()
        ]
        print(f"| {who} | " + " | ".join(shown) + " |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--problems", type=int, default=120)
    parser.add_argument("--train", type=int, default=120, help="problems; 0: no rules")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=pathlib.Path)
    arguments = parser.parse_args()
    out: dict[str, Any] = {"time": policy_time()}
    for at in out["time"]:
        print(
            f"M = {at['M']}, K = {at['k']}: greedy {1e3 * at['greedy']:.3f} ms, "
            f"policy {1e3 * at['policy']:.2f} ms: {at['policy'] / at['greedy']:.1f}x"
        )
    rng = np.random.default_rng(arguments.seed)
    cases = []
    for turn in range(arguments.problems):
        cases.append(headroom(*draw(rng)))
        if turn % 40 == 39:
            print(f"  {turn + 1} problems", flush=True)
    ways = list(cases[0].reached)
    if arguments.train:
        data = decisions(arguments.train, arguments.seed + 1)
        rules = {
            "expected metric": (1, lambda gain, about: gain[:, 2].copy()),
            "linear score": (3, trained(data, False)),
            "network of 16": (3, trained(data, True)),
        }
        for who, (metrics, score) in rules.items():
            for case in cases:
                chosen = rollout(case.problem, score)
                taken = metrics * products_seconds(case.problem)
                case.note(who, chosen, case.seconds["greedy"] + taken)
                climb_after(case, who)(chosen)
            print(f"  {who}", flush=True)
    proven = sum(case.proven for case in cases)
    print(f"{len(cases)} problems, {proven} optima proven")
    out |= {"proven": proven, "problems": len(cases)}
    out["all"] = table(cases, list(cases[0].reached))
    show("All problems", out["all"])
    parts = {name: [c for c in cases if group(c) == name] for name in GROUPS}
    parts |= {name: [c for c in cases if c.shape == name] for name in SHAPES}
    parts |= {"p > 20": [c for c in cases if c.problem.num_regressors > 20]}
    parts = {name: some for name, some in parts.items() if some}
    for name, some in parts.items():
        out[name] = table(some, [w for w in ways if not w.startswith("pool")])
        show(f"{name}: {len(some)} problems", out[name])
    out["policy's time"] = policy = {}
    for name, some in {"all": cases, **parts}.items():
        taken = [case.seconds["greedy"] * least(case, out["time"]) for case in some]
        same = [case.in_time(t) for case, t in zip(some, taken, strict=True)]
        policy[f"{name} ({len(some)})"] = row(some, same, taken)
    show("Exchange in the least time of a policy's pass", policy)
    if arguments.json:
        write_text(arguments.json, json.dumps(out, indent=1) + "\n")


def least(case: Case, measured: list[dict[str, float]]) -> float:
    """The least ratio of policy to greedy of any measured M up to that of the case."""
    count = len(case.problem.blocks)
    largest = max(at["M"] for at in measured if at["M"] <= count)
    return min(at["policy"] / at["greedy"] for at in measured if at["M"] == largest)


if __name__ == "__main__":
    main()
