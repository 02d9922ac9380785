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
    interleaved,
    median_ratio,
)
from jaxcal.learning import networks, ppo, presets

NAME = "throughput"
TITLE = "Training throughput, paper preset (3.5 M parameters)"
EPISODES = 16  # of an update
_WIDTH, _M, _EPOCHS = 768, 50, 10


def ours() -> Callable[[], None]:
    """An update of the paper preset."""
    config = presets.PRESETS["paper"]
    network = networks.build(config.network)
    held = [ppo.init(config.ppo, config.tasks[0], network)]

    def update() -> None:
        state, metrics = ppo.update(held[0], config.ppo, config.tasks[0], network)
        held[0] = state
        jax.block_until_ready(metrics["reward_mean"])

    return update


def floor_gigaflops() -> float:
    """Matrix products of an update that no arrangement avoids, 10^9 operations.

    Encoding 16 x 50 candidates, 768 to 768, is all but a few per cent: forward, and
    twice as much backward, in each of 10 epochs, and forward once to play.
    """
    encode = 2.0 * EPISODES * _M * _WIDTH * (_WIDTH + 3)
    return encode * (3 * _EPOCHS + 1) / 1e9


def peak_gigaflops() -> float:
    """10^9 operations a second of a large matrix product here, through XLA."""
    n = 1600
    a = jax.random.normal(jax.random.key(0), (n, n))
    product = jax.jit(lambda x: x @ x)
    seconds = interleaved({"gemm": lambda: product(a).block_until_ready()}, 7)["gemm"]
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
            f"PyTorch eager, {torch.get_num_threads()} threads, its default here"
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
    flops, peak = floor_gigaflops(), peak_gigaflops()
    achieved = flops / statistics.median(times["jaxcal"])
    row.lines += [
        Line("floor", "operations of an update", flops, "Gflop", "encoder only"),
        Line("floor", "large matrix product, XLA", peak, "Gflop/s"),
        Line("floor", "share reached by jaxcal", achieved / peak, "of that product"),
    ]
    return row
