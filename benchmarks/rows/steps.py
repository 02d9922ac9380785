"""Environment steps a second, uniformly random policy, on every core there is.

A step returns the observation (210 numbers), reward and end, and an episode that ended
begins anew with fresh candidates, everywhere. An observation stays as it was when the
next step is taken, as a learner that keeps it needs: SyncVectorEnv copies by default,
NumPy by hand in a line of its own. In JAX every step is a turn of a loop that carries
its observation: each is written out, and overwritten by the next. So the NumPy that
jaxcal is compared with overwrites too. ``PosturesEnv.step`` is the public call, which
begins a new episode by itself; "jaxcal" is a loop over whole episodes. Everybody is
measured in one thread and in one a core, side by side, each with episodes of its own,
and keeps the better.
"""

from __future__ import annotations

import functools
import statistics
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import (
    CORES,
    Budget,
    Line,
    Row,
    Verdict,
    available,
    interleaved,
    median_ratio,
    side_by_side,
)
from jaxcal.learning.brax import SelectionEnv, wrap_fresh
from jaxcal.learning.environments import selection as environment
from jaxcal.learning.environments.functional import PosturesEnv
from jaxcal.learning.environments.selection import SelectionConfig

NAME = "steps"
TITLE = "Environment steps per second, random policy"
BATCHES = (256, 1024, 4096, 16384)  # episodes in lockstep; each keeps its best
PUBLIC = "jaxcal, PosturesEnv.step"
IN_PLACE = "NumPy, each observation overwritten by the next"
BRAX = "jaxcal through brax's wrappers"
WIDE = ", 512-bit vectors"
# XLA uses 256 bits unless asked; in elementwise work AVX-512 is worth asking for.
WIDE_OPTIONS = {"xla_cpu_prefer_vector_width": 512}
M, K = 50, 4

Run = tuple[Callable[[], Any], int]  # a call, and how many steps it makes


def random_action(chosen: jax.Array, count: jax.Array, unit: jax.Array) -> jax.Array:
    """Uniform among the candidates not chosen: a rank that steps over those that are.

    Args:
        chosen: (B, 4) int, -1 where nothing is chosen yet.
        count: choices made.
        unit: (B,) uniform in [0, 1).
    """
    taken = [jnp.where(chosen[:, i] < 0, M, chosen[:, i]) for i in range(K)]
    for i, j in ((0, 1), (2, 3), (0, 2), (1, 3), (1, 2)):  # sorts four numbers
        low, high = jnp.minimum(taken[i], taken[j]), jnp.maximum(taken[i], taken[j])
        taken[i], taken[j] = low, high
    action = jnp.floor(unit * (M - count)).astype(jnp.int32)
    for index in taken:
        action = action + (action >= index)
    return action


def ours(batch: int, episodes: int, options: dict[str, Any] | None = None) -> Run:
    """jaxcal's functions, vmapped: an episode is a reset and four steps."""
    config = SelectionConfig()
    see = jax.vmap(lambda state: environment.observe(state, config))
    move = jax.vmap(lambda state, action: environment.step(state, action, config))
    again = jax.vmap(lambda state: environment.reset(state.key, config))
    begin = jax.vmap(lambda key: environment.reset(key, config))

    def step(carry: Any, units: jax.Array) -> tuple[Any, None]:
        states, _, total = carry
        action = random_action(states.chosen, states.count[0], units)
        states, reward, _ = move(states, action)
        return (states, see(states), total + reward), None

    def episode(carry: Any, key: jax.Array) -> tuple[Any, None]:
        states, seen, total = carry
        units = environment.uniform(key, (K, batch))
        return jax.lax.scan(step, (again(states), seen, total), units)[0], None

    @functools.partial(jax.jit, compiler_options=options)
    def run(key: jax.Array) -> jax.Array:
        keys = jax.random.split(key, batch)
        carry = (begin(keys), see(begin(keys)), jnp.zeros(batch))
        _, seen, total = jax.lax.scan(episode, carry, jax.random.split(key, episodes))[
            0
        ]
        return seen.sum() + total.sum()

    key = jax.random.key(0)
    return lambda: run(key).block_until_ready(), batch * K * episodes


def public(batch: int, episodes: int, options: dict[str, Any] | None = None) -> Run:
    """``PosturesEnv.step`` under ``jax.vmap``, as loops written for gymnax call it."""
    env = PosturesEnv()

    def step(carry: Any, drawn: Any) -> tuple[Any, None]:
        _, state, total = carry
        key, units = drawn
        action = random_action(state.chosen, state.count[0], units)
        keys = jax.random.split(key, batch)
        obs, state, reward, *_ = jax.vmap(env.step)(keys, state, action)
        return (obs, state, total + reward), None

    @functools.partial(jax.jit, compiler_options=options)
    def run(key: jax.Array) -> jax.Array:
        key_reset, key_act, key_step = jax.random.split(key, 3)
        begun = jax.vmap(env.reset)(jax.random.split(key_reset, batch))
        units = environment.uniform(key_act, (episodes * K, batch))
        drawn = jax.random.split(key_step, episodes * K), units
        obs, _, total = jax.lax.scan(step, (*begun, jnp.zeros(batch)), drawn)[0]
        return obs.sum() + total.sum()

    key = jax.random.key(0)
    return lambda: run(key).block_until_ready(), batch * K * episodes


def through_brax(
    batch: int, episodes: int, options: dict[str, Any] | None = None
) -> Run:
    """Steps of the environment behind brax's wrappers, as brax's trainers step it."""
    config = SelectionConfig()
    env = wrap_fresh(SelectionEnv(config), episode_length=K)

    def step(carry: Any, units: jax.Array) -> tuple[Any, None]:
        state, total = carry
        inner = state.pipeline_state
        action = random_action(inner.chosen, inner.count, units)
        state = env.step(state, action)
        return (state, total + state.reward), None

    @functools.partial(jax.jit, compiler_options=options)
    def run(key: jax.Array) -> jax.Array:
        key_reset, key_act = jax.random.split(key)
        state = env.reset(jax.random.split(key_reset, batch))
        units = environment.uniform(key_act, (episodes * K, batch))
        state, total = jax.lax.scan(step, (state, jnp.zeros(batch)), units)[0]
        return state.obs.sum() + total.sum()

    key = jax.random.PRNGKey(0)
    return lambda: run(key).block_until_ready(), batch * K * episodes


def by_numpy(batch: int, episodes: int, copy: bool = True) -> Run:
    from benchmarks.peers.environments import SelectionNumpy

    env = SelectionNumpy(batch)

    def run() -> np.ndarray:
        for _ in range(episodes):
            env.reset()
            done = False
            while not done:
                seen, _, done = env.step(env.random_action())
                kept = seen.copy() if copy else seen
        return kept

    return run, batch * K * episodes


def by_gymnasium(batch: int, episodes: int) -> Run:
    """SyncVectorEnv, which resets what ended by itself (one more call an episode)."""
    import gymnasium

    from benchmarks.peers.environments import SelectionGym

    env = gymnasium.vector.SyncVectorEnv(
        [SelectionGym] * batch,
        autoreset_mode=gymnasium.vector.AutoresetMode.SAME_STEP,
    )
    rng = np.random.default_rng(0)

    def run() -> None:
        observation, _ = env.reset(seed=0)
        for _ in range(episodes * K):
            free = observation[:, 150:200] > 0
            rank = np.floor(rng.random(batch) * free.sum(1)).astype(int)
            action = np.argmax(np.cumsum(free, 1) > rank[:, None], axis=1)
            observation, *_ = env.step(action)

    return run, batch * K * episodes


def run(budget: Budget) -> Row:
    row = Row(NAME, TITLE)
    makers: dict[str, tuple[Callable[[int, int], Run], int, tuple[int, ...]]] = {
        "jaxcal": (ours, 400_000, BATCHES),
        "jaxcal" + WIDE: (
            functools.partial(ours, options=WIDE_OPTIONS),
            400_000,
            BATCHES,
        ),
        PUBLIC: (public, 200_000, BATCHES),
        PUBLIC + WIDE: (
            functools.partial(public, options=WIDE_OPTIONS),
            200_000,
            BATCHES,
        ),
        BRAX: (through_brax, 200_000, BATCHES),
        BRAX + WIDE: (
            functools.partial(through_brax, options=WIDE_OPTIONS),
            200_000,
            BATCHES,
        ),
        "NumPy, vectorised by hand": (by_numpy, 200_000, BATCHES),
        IN_PLACE: (functools.partial(by_numpy, copy=False), 200_000, BATCHES),
    }
    if available("gymnasium"):
        makers["Gymnasium SyncVectorEnv"] = (by_gymnasium, 4_000, (16, 64))
    if budget.quick:
        makers = {k: (f, n // 20, (256,)) for k, (f, n, _) in makers.items()}
    rounds = budget.pick(5, 2)
    runs: dict[tuple[str, int, int], Run] = {}
    for name, (maker, steps, batches) in makers.items():
        for batch in batches:
            for threads in sorted({1, CORES}):
                made = [
                    maker(batch, max(1, steps // (K * batch))) for _ in range(threads)
                ]
                call = side_by_side([each for each, _ in made])
                runs[name, batch, threads] = (call, sum(number for _, number in made))
    times = interleaved(
        {f"{n}|{b}|{t}": call for (n, b, t), (call, _) in runs.items()}, rounds
    )
    best: dict[str, list[float]] = {}  # seconds a step, a round
    for name in makers:
        tried = {
            (batch, threads): [s / steps for s in times[f"{who}|{batch}|{threads}"]]
            for (who, batch, threads), (_, steps) in runs.items()
            if who == name
        }
        for threads in sorted({1, CORES}):
            batch = min(
                (b for b, t in tried if t == threads),
                key=lambda b: statistics.median(tried[b, threads]),
            )
            seconds = tried[batch, threads]
            if name not in best or statistics.median(seconds) < statistics.median(
                best[name]
            ):
                best[name] = seconds
            row.lines.append(
                Line(
                    "M = 50, K = 4",
                    name,
                    1.0 / statistics.median(seconds),
                    "steps/s",
                    f"{threads} {'thread' if threads == 1 else 'threads'}, "
                    f"{batch} episodes in lockstep in each",
                )
            )
    for name in ("jaxcal", PUBLIC, BRAX):
        best[name] = min(best[name], best[name + WIDE], key=statistics.median)
    own = best["jaxcal"]
    targets = {
        "Gymnasium SyncVectorEnv": 50.0,
        IN_PLACE: 2.0,
        BRAX: 1.0,
    }
    for name, target in targets.items():
        if name not in best:
            row.notes.append(f"{name} is not installed: not measured")
            continue
        verdict = Verdict(f"against {name}", median_ratio(best[name], own), target)
        row.verdicts.append(verdict)
    ratio = median_ratio(best[IN_PLACE], best[PUBLIC])
    row.verdicts.append(Verdict(f"{PUBLIC} against {IN_PLACE}", ratio, 1.0))
    row.notes.append(
        "a verdict compares the better of one thread and one a core, on either side, "
        "and of both vector widths where XLA compiles"
    )
    return row
