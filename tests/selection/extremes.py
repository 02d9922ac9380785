"""Every compiled kernel over extreme inputs: a program for valgrind."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

import jaxcal
from jaxcal.models import Polynomial


def ask(question: Callable[[], object]) -> None:
    """A refusal by ValueError is an answer."""
    try:
        question()
    except ValueError:
        pass


def main() -> None:
    motion = jaxcal.Motion(speed=(1.0,), acceleration=(1.0,))
    rng = np.random.default_rng(0)
    plain = rng.random((12, 2))
    shapes = [plain * 10.0**e for e in (-300, -155, -12, 0, 12, 155, 300)]
    shapes += [plain.round(0), np.append(plain, [[1e15, -1e12]], axis=0)]
    for u in shapes:
        for criterion in ("D", "A", "E", "I"):
            for method in ("exchange", "greedy", "exact"):
                ask(
                    lambda u=u, c=criterion, m=method: jaxcal.select(
                        u, 4, m, criterion=c
                    )
                )
        blocks = np.stack([u, u[::-1] * 2.0, np.ones_like(u)], axis=1)
        for k in (1, 3, 70):
            ask(lambda b=blocks, k=k: jaxcal.select(
                blocks=b, k=k, method="exact", criterion="A", max_replicates=9,
                time_limit=0.5,
            ))  # fmt: skip
        ask(lambda u=u: jaxcal.select(u, 3, "exact", best=5))
        ask(lambda u=u: jaxcal.Design(u).select(3, method="policy"))
        ask(lambda u=u: jaxcal.Design(u).fastest(4, motion))
        for some in (jaxcal.As(["1"]), jaxcal.Ds(["x"])):
            ask(lambda u=u, c=some: jaxcal.select(
                u[:, :1], 3, "exact", criterion=c, model=Polynomial(1, 1)
            ))  # fmt: skip


main()
print("end")
