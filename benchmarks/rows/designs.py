"""What the rows "optimum" and "exchange" share: sets, solvers, judging."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from benchmarks.harness import Budget, available
from benchmarks.peers import designs
from jaxcal import log_det_information, select

CASES = tuple((m, k) for m in (50, 500) for k in (4, 8, 12))
HIT = 1e-8  # log det S this near the optimum is the optimum

Candidates = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclasses.dataclass
class Solver:
    """One way to choose, and whether it may repeat a candidate."""

    who: str
    repeats: bool
    choose: Callable[[Candidates, int], Indices]
    note: str = ""
    seconds: list[float] = dataclasses.field(default_factory=list)
    behind: list[float] = dataclasses.field(default_factory=list)  # log det S - best
    only_k: int | None = None  # the only k it can do
    only_m: int | None = None

    def fits(self, m: int, k: int) -> bool:
        return self.only_k in (None, k) and self.only_m in (None, m)

    @property
    def ratio(self) -> float:
        """Mean det S / det S*."""
        return float(np.exp(self.behind).mean())

    @property
    def hits(self) -> float:
        """Share of sets where the optimum is found."""
        return float((np.abs(self.behind) <= HIT).mean())

    @property
    def quality(self) -> str:
        return f"ratio {self.ratio:.4f}, optimum in {self.hits:.0%}" + (
            f"; {self.note}" if self.note else ""
        )


def own(method: str, repeats: bool) -> Solver:
    """``jaxcal.select`` with its defaults."""

    def choose(candidates: Candidates, k: int) -> Indices:
        cap = k if repeats else 1
        return select(candidates, k, method, max_replicates=cap).indices

    with_repeats = ", repeats allowed" if repeats else ""
    return Solver(f"jaxcal {method}{with_repeats}", repeats, choose)


def peers() -> tuple[list[Solver], list[str]]:
    """The packages that are installed, and a note for each that is not."""
    out: list[Solver] = []
    notes: list[str] = []
    if available("pyoptex"):
        out.append(Solver("pyoptex", True, designs.by_pyoptex, "10 tries, its default"))
    else:
        notes.append("pyoptex is not installed")
    if available("pydoe"):
        out.append(
            Solver("pydoe modified_fedorov", True, designs.by_pydoe, "one start")
        )
        out.append(
            Solver(
                "pydoe sequential",
                True,
                lambda c, k: designs.by_pydoe(c, k, "sequential"),
                "its default",
            )
        )
    else:
        notes.append("pydoe is not installed")
    return out, notes


def sets_of(m: int, budget: Budget) -> NDArray[np.float64]:
    """(B, M, 3) uniform in [0, 1]^3."""
    number = budget.pick(20 if m == 50 else 5, 2)
    return np.random.default_rng([m, 20261121]).random((number, m, 3))


def measure(solvers: list[Solver], sets: NDArray[np.float64], k: int) -> None:
    """Fill in seconds and quality, all solvers in turn on every set."""
    for solver in solvers:
        solver.seconds, solver.behind = [], []
        solver.choose(sets[0], k)  # imports and compilation
    for candidates in sets:
        best = {
            repeats: select(
                candidates, k, "exact", max_replicates=k if repeats else 1
            ).log_det
            for repeats in (False, True)
        }
        for solver in solvers:
            begun = time.perf_counter()
            indices = solver.choose(candidates, k)
            solver.seconds.append(time.perf_counter() - begun)
            judge(solver, candidates, indices, best)


def judge(
    solver: Solver, candidates: Candidates, indices: Indices, best: dict[bool, float]
) -> None:
    """Compare with the proven optimum of what the solver was allowed."""
    value = float(log_det_information(candidates[indices]))
    solver.behind.append(value - best[solver.repeats])


def measure_algdesign(sets: NDArray[np.float64], k: int, repeats: int) -> Solver | None:
    """R's AlgDesign in one R process, timed by R; None where it is not installed."""
    if not designs.has_algdesign():
        return None
    solver = Solver(
        f"AlgDesign optFederov, {repeats} starts", False, lambda c, k: np.zeros(k, int)
    )
    found, solver.seconds = designs.by_algdesign(sets, k, repeats)
    for candidates, indices in zip(sets, found, strict=True):
        best = select(candidates, k, "exact").log_det
        judge(solver, candidates, indices, {False: best})
    return solver
