"""Which poses of a measured UR5: time against the figures wanted, and FIGAROH's rule.

The arm, its 1,000 poses and their measurements are those of examples/ur5; a pose is a
block of 3 readings of 39 parameters, known beforehand as the default prior says, with
0.1 mm of noise. FIGAROH's rule (benchmarks/peers/figaroh.py) chooses its own number of
poses, which jaxcal and random choices are given too.
"""

from __future__ import annotations

import functools
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.harness import ROOT, Budget, Line, Row, Verdict
from benchmarks.peers import figaroh
from jaxcal import identify, select
from jaxcal.models import Noise, SerialChain
from jaxcal.selection import Design
from jaxcal.selection.exact import branch_and_bound as search
from jaxcal.selection.exchange.exchange import (
    default_restarts,
    exchange_indices,
    greedy_indices,
)
from jaxcal.selection.problem import Problem

NAME = "blocks"
TITLE = "Poses of a measured UR5, and FIGAROH's rule"

_NOISE = 0.1  # mm
_UR5 = ROOT / "examples" / "ur5"
_PROOFS = ((1000, 20, 15.0), (200, 12, 8.0), (50, 8, 3.0))  # M, K, seconds wanted
_LONGEST = 40.0  # seconds of a proof

Array = NDArray[np.float64]


def poses(name: str) -> tuple[Array, Array]:
    """Joint angles (N, 6) in degrees and measured points (N, 3) in mm."""
    rows = _table(name)
    return rows[:, 7:13], rows[:, 1:4] + rows[:, 4:7]


def arm() -> SerialChain:
    return SerialChain.from_dh(_table("dh.csv"), tool=(0, 0, 31))


def _table(name: str) -> Array:
    return np.loadtxt(_UR5 / name, delimiter=",", skiprows=1)


def cpu_seconds(call: Callable[[], Any], rounds: int) -> float:
    """Median CPU seconds of a warm call: these calls use one thread."""
    call()
    seconds = []
    for _ in range(rounds):
        begun = time.process_time()
        call()
        seconds.append(time.process_time() - begun)
    return statistics.median(seconds)


def run(budget: Budget) -> Row:
    row = Row(NAME, TITLE)
    joints, measured = poses("ur5_grid_1000.csv")
    for criterion in ("D", "I"):
        _searches(row, joints, criterion, budget)
        _relaxation(row, joints, criterion, budget)
    for criterion in ("D", "I"):
        _proofs(row, joints, criterion, budget)
    _against_figaroh(row, joints, measured, budget)
    row.notes.append(
        "times are CPU seconds of the process, in which every call uses one thread, so "
        "that a shared machine does not change them; set OPENBLAS_NUM_THREADS=1"
    )
    return row


def _problem(joints: Array, k: int, criterion: str) -> Problem:
    prior = arm().default_prior()  # given: without harmonics of the joints
    return Design(joints, arm(), prior, Noise(_NOISE)).problem(k, criterion)


def _searches(row: Row, joints: Array, criterion: str, budget: Budget) -> None:
    rounds = budget.pick(9, 2)
    making = cpu_seconds(lambda: _problem(joints, 20, criterion), rounds)
    case = f"{criterion}, M = 1,000"
    row.lines.append(Line(case, "model to blocks", 1e3 * making, "ms", "once a call"))
    for k in (8, 20):
        problem = _problem(joints, k, criterion)
        starts = default_restarts(problem)
        alone: dict[str, tuple[Callable[[], Any], float]] = {
            "greedy": (functools.partial(greedy_indices, problem), 3.0),
            "exchange": (functools.partial(exchange_indices, problem), 15.0),
        }
        for method, (solver, wanted) in alone.items():
            whole = functools.partial(
                select, joints, k, method, model=arm(), noise=Noise(_NOISE),
                prior=arm().default_prior(), criterion=criterion,
            )  # fmt: skip
            seconds, all_of_it = (cpu_seconds(c, rounds) for c in (solver, whole))
            case = f"{criterion}, K = {k} of 1,000"
            who = f"{method}, starts: {starts}" if method == "exchange" else method
            note = f"value {whole().value:.5g}"
            row.lines += [
                Line(case, f"{who}, solver alone", 1e3 * seconds, "ms", note),
                Line(case, f"{who}, whole select", 1e3 * all_of_it, "ms", note),
            ]
            for what, value in (("solver", seconds), ("select", all_of_it)):
                title = f"{case}: {method}, {what}"
                row.verdicts.append(Verdict(title, 1e3 * value, wanted, False, "ms"))


def _relaxation(row: Row, joints: Array, criterion: str, budget: Budget) -> None:
    """The bound at the root, and how far above the relaxed optimum it stops."""
    for k in (8, 20):
        problem = _problem(joints, k, criterion)
        start = np.bincount(greedy_indices(problem), minlength=len(joints))
        solve = functools.partial(
            search.branch_and_bound,
            search.Scenario(problem.blocks, problem.prior, problem.criterion),
            problem.lower, problem.upper, start, root_only=True,
        )  # fmt: skip
        bound = solve().bound
        seconds = cpu_seconds(solve, budget.pick(5, 1))
        case = f"{criterion}, K = {k} of 1,000"
        note = f"solved to 1e-10; bound {problem.criterion.reported(bound):.6g}"
        row.lines.append(Line(case, "relaxation", 1e3 * seconds, "ms", note))
        row.verdicts.append(
            Verdict(f"{case}: relaxation", 1e3 * seconds, 250.0, False, "ms")
        )


def _proofs(row: Row, joints: Array, criterion: str, budget: Budget) -> None:
    rng = np.random.default_rng(0)
    limit = budget.pick(int(_LONGEST), 2)
    for count, k, wanted in _PROOFS:
        pool = joints if count == 1000 else joints[rng.choice(1000, count, False)]
        call = functools.partial(
            select, pool, k, "exact", model=arm(), noise=Noise(_NOISE),
            prior=arm().default_prior(),
            criterion=criterion,
        )  # fmt: skip
        call(time_limit=0.01)  # compiled
        begun = time.process_time()
        found = call(time_limit=float(limit))
        seconds = time.process_time() - begun
        case = f"{criterion}, K = {k} of {count:,}"
        note = f"proven, value {found.value:.5g}"
        if not found.proven:
            note = f"open, efficiency at least {found.efficiency:.4f}"
        row.lines.append(Line(case, "exact, whole select", seconds, "s", note))
        row.verdicts.append(
            Verdict(
                f"{case}: proof", seconds if found.proven else None, wanted, False, "s",
                "" if found.proven else f"{note} after {limit} s",
            )
        )  # fmt: skip


def _against_figaroh(row: Row, joints: Array, measured: Array, budget: Budget) -> None:
    """D-efficiency and error elsewhere at the rule's own K, on pools of 300 and 1,000.

    D-efficiency is that of the combinations that can be identified, without a prior;
    errors are of the arm identified from the chosen poses, with the default prior.
    """
    rng = np.random.default_rng(1)
    chain = arm()
    slopes = chain.jacobian(joints) / _NOISE
    pools = [rng.choice(1000, 300, replace=False) for _ in range(budget.pick(20, 1))]
    for title, some in (("M = 300", pools), ("M = 1,000", [np.arange(1000)])):
        figures: dict[str, list[list[float]]] = {}
        sizes, gaps, seconds = [], [], []
        for pool in some:
            blocks = figaroh.identified(slopes[pool])
            begun = time.process_time()
            weight, gap = figaroh.relaxed_weights(blocks)
            seconds.append(time.process_time() - begun)
            rule = figaroh.chosen(weight)
            k = len(rule)
            sizes.append(k)
            gaps.append(gap)
            model: dict[str, Any] = {"model": chain, "noise": Noise(_NOISE)}
            model["prior"] = chain.default_prior()
            plain = select(blocks=blocks, k=k, method="exchange", restarts=10)
            ways = {"FIGAROH's rule": [rule], "jaxcal exchange, D": [plain.indices]}
            for criterion in ("D", "I"):
                ways[f"jaxcal exchange, {criterion}, default prior"] = [
                    select(
                        joints[pool], k, "exchange", criterion=criterion, **model
                    ).indices
                ]
            draws = 3 if len(some) > 1 else 20
            ways["random"] = [rng.choice(len(pool), k, False) for _ in range(draws)]
            best = plain.log_det
            for who, subsets in ways.items():
                each = [
                    _judged(blocks, best, subset, joints, measured, pool, chain)
                    for subset in subsets
                ]
                figures.setdefault(who, []).append(np.mean(each, axis=0).tolist())
        mean = {who: np.mean(values, axis=0) for who, values in figures.items()}
        case = f"{title}, K = {min(sizes)}" + (
            f" to {max(sizes)}" if max(sizes) > min(sizes) else ""
        )
        for who, (efficiency, rest, worst, test) in mean.items():
            note = (
                f"D-efficiency against jaxcal's D; held-out error mean {rest:.4f}, "
                f"largest {worst:.3f}, on the test poses {test:.4f} mm"
            )
            row.lines.append(Line(case, who, float(efficiency), "", note))
        theirs = mean["FIGAROH's rule"]
        row.lines.append(
            Line(
                case, "FIGAROH's relaxation, solved here",
                1e3 * statistics.median(seconds), "ms",
                f"duality gap at most {max(gaps):.1g} of log det",
            )
        )  # fmt: skip
        row.verdicts += [
            Verdict(f"{case}: D-efficiency over the rule's", 1.0 / theirs[0], 1.0),
            Verdict(
                f"{case}: the rule's held-out error over ours (I)",
                theirs[1] / mean["jaxcal exchange, I, default prior"][1],
                1.0,
            ),
        ]


def _judged(
    blocks: Array,
    best: float,
    subset: NDArray[np.int64],
    joints: Array,
    measured: Array,
    pool: NDArray[np.int64],
    chain: SerialChain,
) -> tuple[float, float, float, float]:
    """D-efficiency; mean and largest error on the other poses, mean on the test's."""
    rows = blocks[subset].reshape(-1, blocks.shape[2])
    log_det = float(np.linalg.slogdet(rows.T @ rows)[1])
    chosen = pool[subset]
    found = identify(
        joints[chosen],
        measured[chosen],
        model=chain,
        noise_std=_NOISE,
        prior=chain.default_prior(),
    )
    rest = np.setdiff1d(np.arange(len(joints)), chosen)
    test_joints, test = poses("ur5_random_20.csv")
    error = np.linalg.norm(found.predict(joints[rest]) - measured[rest], axis=1)
    elsewhere = np.linalg.norm(found.predict(test_joints) - test, axis=1)
    efficiency = float(np.exp((log_det - best) / rows.shape[1]))
    return efficiency, float(error.mean()), float(error.max()), float(elsewhere.mean())
