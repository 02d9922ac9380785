"""Every compiled kernel over extreme inputs: a program for valgrind."""

from __future__ import annotations

import importlib.util
import pathlib
from collections.abc import Callable
from importlib.machinery import EXTENSION_SUFFIXES

import numpy as np

import jaxcal
from jaxcal.models import Polynomial, SerialChain


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
        ask(lambda u=u: jaxcal.Design(u[-8:]).fastest(4, motion))
        for some in (jaxcal.As(["1"]), jaxcal.Ds(["x"])):
            ask(lambda u=u, c=some: jaxcal.select(
                u[:, :1], 3, "exact", criterion=c, model=Polynomial(1, 1)
            ))  # fmt: skip


def scenarios_and_losses() -> None:
    # Of the exchange five starts: of each kind one at least.
    short = {"exact": {"time_limit": 0.2}, "exchange": {"restarts": 5}, "greedy": {}}
    rng = np.random.default_rng(1)
    for e in (-300, -155, -12, 0, 12, 155, 300):
        blocks = rng.random((3, 70, 2, 3)) * 10.0**e  # two groups of the exchange
        blocks[1] *= 1e6
        design = jaxcal.Design.from_blocks(blocks, required=[69])
        for name in "DAEI":
            for joined in (jaxcal.Mean(name), jaxcal.Worst(name)):
                for method in ("greedy", "exchange", "exact"):
                    ask(lambda m=method, j=joined, d=design: d.select(
                        4, j, m, **short[m]
                    ))  # fmt: skip


def arms() -> None:
    rng = np.random.default_rng(2)
    table = [(0, 90, 90, 0), (-425, 0, 0, 0), (-390, 0, 0, 0)]
    for size in (1e-300, 1e-12, 1.0, 1e12, 1e300):
        arm = SerialChain.from_dh([(a * size, *rest) for a, *rest in table])
        for turn in (0.0, 1.0, 1e9, 1e300):
            for count in (1, 7, 2100):
                poses = turn * rng.uniform(-1.0, 1.0, (count, 3))
                ask(lambda m=arm, u=poses: m.predict(u))
                ask(lambda m=arm, u=poses: m.jacobian(u))


def trees() -> None:
    """Look-ahead on tables of every size, with outcomes that cannot be."""
    # From its file: the package around it loads JAX, which takes valgrind minutes.
    folder = pathlib.Path(jaxcal.__file__).parent / "adaptive"
    (path,) = folder.glob("search_kernel*" + EXTENSION_SUFFIXES[0])
    spec = importlib.util.spec_from_file_location("jaxcal.adaptive.search_kernel", path)
    kernel = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(kernel)
    rng = np.random.default_rng(3)
    for designs, outcomes, states in ((1, 1, 1), (3, 2, 5), (17, 4, 40), (8, 3, 2)):
        likelihood = rng.random((designs, outcomes, states)).astype(np.float32)
        likelihood[0] = 0.0
        likelihood[0, 0] = 1.0
        likelihood /= likelihood.sum(axis=1, keepdims=True)
        for price in (1e-30, 1.0, 1e30):
            for effort in (0.0, 1e6):
                tables = np.full((outcomes, designs), price, np.float32)
                tree = kernel.Tree(
                    likelihood, np.full((designs, designs), price, np.float32), tables,
                    np.ones((outcomes, designs), np.float32),
                    np.zeros((designs, outcomes), np.int32), tables[0],
                    np.ones(designs, np.float32), 6, [1.0, 1.0, 1.0, 1.0, 1.0, 0.3],
                    np.ones((1, designs), np.float32), effort,
                )  # fmt: skip
                beliefs = np.zeros((4, states), np.float32)
                beliefs[0] = 1.0 / states
                beliefs[1, 0] = 1.0  # and two that sum to nothing, or to more
                beliefs[3] = 1e30
                seconds = np.array([10.0, 1e30, 0.0, -1.0], np.float32)
                whole = np.array([0, 3, 1, 2], np.int32)
                tree.choose(
                    beliefs, np.zeros(4, np.int32), seconds, whole, whole,
                    np.zeros(4, np.int32),
                )  # fmt: skip


main()
scenarios_and_losses()
arms()
trees()
print("end")
