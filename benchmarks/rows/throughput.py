"""Training throughput of the paper's network and schedule, against plain PyTorch."""

from __future__ import annotations

import statistics
from collections.abc import Callable

import jax

from benchmarks.harness import (
    Budget,
    Line,
    Row,
    Verdict,
    available,
    copy_bandwidth,
    interleaved,
    median_ratio,
)
from jaxcal.learning.core import ppo
from jaxcal.learning.training import presets
from jaxcal.learning.training.run import compiled_update

NAME = "throughput"
TITLE = "Training throughput, paper preset (3.5 M parameters)"
EPISODES = 16  # of an update
_WIDTH, _M, _K, _N, _EPOCHS = 768, 50, 4, 3, 10


def ours() -> Callable[[], None]:
    """An update of the paper preset."""
    config = presets.load("paper")
    learner = config.learners[0]
    step = compiled_update(config.ppo, learner)
    held = [ppo.begin(config.ppo, learner, jax.random.key(0))]

    def update() -> None:
        state, metrics = step(held[0])
        held[0] = state
        jax.block_until_ready(metrics["reward_mean"])

    return update


def floor_gigaflops() -> float:
    """Operations of an update's matrix products that no arrangement avoids, 10^9.

    Each weight matrix meets its rows once forward to play, and once forward and twice
    backward in each of 10 epochs: the poses' with 16 x 50 rows, the others with one for
    each of 16 x 4 decisions, those of the keys twice (scores) and once (glimpse).
    """
    w = _WIDTH
    poses = (_N + w) * w
    decisions = (10 + w + w + 3 * w + 2 * (w * 3 // 32) + w + w * 2 // 3) * w
    rows = EPISODES * (_M * poses + _K * decisions)
    return 2.0 * rows * (3 * _EPOCHS + 1) / 1e9


def floor_gigabytes(num_params: int) -> float:
    """Bytes that clipping, Adam and the average move in an update, 10^9.

    An epoch writes the gradients, reads them for their norm; Adam reads gradient, two
    moments and weight and writes the last three; the average is read and written.
    """
    return _EPOCHS * (1 + 1 + 7 + 2) * 4.0 * num_params / 1e9


def peak_gigaflops() -> float:
    """10^9 operations a second of a large matrix product here, through XLA."""
    n = 1600
    a = jax.random.normal(jax.random.key(0), (n, n))
    product = jax.jit(lambda x: x @ x)
    seconds = interleaved({"gemm": lambda: product(a).block_until_ready()}, 7)["gemm"]
    return 2.0 * n**3 / min(seconds) / 1e9


def torch_peak_gigaflops() -> float:
    """Peak of a matrix product through PyTorch, in gigaflops."""
    import torch

    n = 1600
    a = torch.randn(n, n)
    seconds = interleaved({"gemm": lambda: a @ a}, 7)["gemm"]
    return 2.0 * n**3 / min(seconds) / 1e9


def run(budget: Budget) -> Row:
    row = Row(NAME, TITLE)
    calls: dict[str, Callable[[], object]] = {"jaxcal": ours()}
    if available("torch"):
        import torch

        from benchmarks.peers.torch_ppo import TorchTrainer

        plain, folded = TorchTrainer(), TorchTrainer(folded=True)
        calls["PyTorch"] = plain.update
        calls["PyTorch, keys folded as in jaxcal"] = folded.update
        row.notes.append(
            f"PyTorch eager, {torch.get_num_threads()} threads, its default here; "
            "torch.compile was not tried"
        )
    else:
        row.notes.append("torch is not installed: not measured")
    times = interleaved(calls, budget.pick(25, 3), warm=2)
    for who, seconds in times.items():
        rate = EPISODES / statistics.median(seconds)
        row.lines.append(Line("an update of 16 episodes", who, rate, "episodes/s"))
    if "PyTorch" in times:
        row.verdicts.append(
            Verdict(
                "against PyTorch", median_ratio(times["PyTorch"], times["jaxcal"]), 2.0
            )
        )
    config = presets.load("paper")
    params = config.learners[0].init(jax.random.key(0))
    flops, peak = floor_gigaflops(), peak_gigaflops()
    moved = floor_gigabytes(sum(leaf.size for leaf in jax.tree.leaves(params)))
    bandwidth = copy_bandwidth() / 1e9
    floor = flops / peak + moved / bandwidth
    reached = floor / statistics.median(times["jaxcal"])
    row.lines += [
        Line("floor", "matrix products of an update", flops, "Gflop"),
        Line("floor", "a large matrix product, XLA", peak, "Gflop/s"),
        Line("floor", "bytes that the optimiser moves", moved, "GB"),
        Line("floor", "copying here, all cores", bandwidth, "GB/s"),
        Line("floor", "episodes at that speed", EPISODES / floor, "episodes/s"),
        Line("floor", "share reached by jaxcal", reached, "of that speed"),
    ]
    if available("torch"):
        own = torch_peak_gigaflops()
        row.lines.append(Line("floor", "that product, PyTorch", own, "Gflop/s"))
    return row
