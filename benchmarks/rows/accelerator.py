"""Steps, updates and a whole training on the device that JAX finds, with its roofline.

On a CPU the sizes are small, so that the row runs in a minute anywhere; on another
device they are those that a training there has.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.harness import Budget, Line, Row, Verdict, interleaved
from jaxcal.learning.core import ppo
from jaxcal.learning.environments import selection
from jaxcal.learning.training import presets

NAME = "accelerator"
TITLE = "Steps, updates and a training on the device at hand"
_SMALL = {"width": 8, "encoder_rounds": 1, "num_candidates": 20}
PRECISIONS = ("float32", "bfloat16")  # of matrix products; sums are float32 in both


def best_of(call: Callable[[], Any], rounds: int) -> float:
    """Seconds of the quickest call."""
    return min(interleaved({"it": lambda: jax.block_until_ready(call())}, rounds)["it"])


def peaks(size: int, rounds: int) -> dict[str, float]:
    """Operations a second of a large product by precision, and bytes a second."""
    reached = {}
    for name in PRECISIONS:
        a = jnp.ones((size, size), name)
        product = jax.jit(lambda a: a @ a)
        reached[name] = 2.0 * size**3 / best_of(functools.partial(product, a), rounds)
    flat = jnp.ones(4 * size * size)
    moved = jax.jit(lambda x: x + 1.0)
    seconds = best_of(functools.partial(moved, flat), rounds)
    return reached | {"bytes": 2.0 * flat.nbytes / seconds}


def steps(batch: int, rounds: int) -> float:
    """Environment steps a second: whole episodes with random choices, observed."""
    config = selection.SelectionConfig()

    def episode(key: jax.Array) -> jax.Array:
        state, total = selection.reset(key, config), 0.0
        for number in range(config.num_selected):
            draw = jax.random.fold_in(key, number)
            action = jax.random.categorical(draw, jnp.log(state.available))
            state, reward, _ = selection.step(state, action, config)
            total += reward + selection.observe(state, config)[-1]
        return total

    play = jax.jit(jax.vmap(episode))
    keys = jax.random.split(jax.random.key(0), batch)
    return batch * config.num_selected / best_of(functools.partial(play, keys), rounds)


def updated(episodes: int, small: bool) -> tuple[Any, Any]:
    """A state of the compact preset before training, and its compiled update."""
    sized = {"episodes_per_update": episodes}
    config = presets.with_values(
        presets.load("compact"), sized | (_SMALL if small else {})
    )
    (learner,) = config.learners
    begin = jax.jit(ppo.begin, static_argnums=(0, 1))
    state = begin(config.ppo, learner, jax.random.key(0))
    update = jax.jit(ppo.make_update(config.ppo, learner))
    return state, update.lower(state).compile()


def lines(small: bool) -> Iterator[Line]:
    """Every figure; ``small`` sizes are for a CPU, or to show that it runs."""
    rounds = 2 if small else 10
    roof = peaks(512 if small else 8192, rounds)
    for name in PRECISIONS:
        yield Line("roofline", f"products in {name}", roof[name] / 1e9, "GFLOP/s")
    yield Line("roofline", "memory", roof["bytes"] / 1e9, "GB/s")
    for batch in (1024,) if small else (1024, 16_384, 262_144):
        yield Line(f"{batch:,} episodes", "steps", steps(batch, rounds), "steps/s")
    for episodes in (64,) if small else (2048, 16_384):
        for name in PRECISIONS:
            with jax.default_matmul_precision(name):
                state, update = updated(episodes, small)
            cost: Any = update.cost_analysis() or {}
            seconds = best_of(functools.partial(update, state), rounds)
            # A loop's body is counted once, so the least time is a lower bound.
            least = max(
                cost.get("flops", 0.0) / roof[name],
                cost.get("bytes accessed", 0.0) / roof["bytes"],
            )
            note = f"at least {1e3 * least:.3g} ms by the roofline of this program"
            case = f"update of {episodes:,} episodes"
            yield Line(case, name, 1e3 * seconds, "ms", note)
    number = 5 if small else 100
    begun = time.perf_counter()
    for _ in range(number):
        state, _ = update(state)
    jax.block_until_ready(state.params)
    seconds = time.perf_counter() - begun
    yield Line(f"training of {number * episodes:,} episodes", name, seconds, "s")


def run(budget: Budget) -> Row:
    """The row; its promise is that bfloat16 loses nothing."""
    device = jax.devices()[0]
    row = Row(NAME, f"{TITLE}: {device.device_kind}")
    row.lines += lines(budget.quick or device.platform == "cpu")
    times = [line for line in row.lines if line.case.startswith("update")]
    row.verdicts.append(
        Verdict(
            "bfloat16 against float32, the smallest update",
            (times[0].value or 0.0) / (times[1].value or 1.0),
            0.9,
            note="products are few here: no gain is promised, only no loss",
        )
    )
    row.notes.append(
        "compilation is left out; the operations and bytes of an update are XLA's own "
        "count, with loops counted once"
    )
    return row
