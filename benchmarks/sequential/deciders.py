"""Deciders that are only compared: two steps ahead, and rollouts of a rule."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from jaxcal.adaptive.rules import Rule, best, log_score, shortlist
from jaxcal.adaptive.session import Options, Session

__all__ = ["Rollouts", "TwoStep"]


@struct.dataclass
class TwoStep:
    """A priced rule over two measurements: the largest gain of both per price of both.

    Of each measurement that the base rule shortlists, every outcome is followed by the
    base rule's own choice. With ``Priced(1, 0, 0)`` it is the two-step expected
    information gain.
    """

    base: Rule
    per_group: int = struct.field(pytree_node=False, default=8)

    def __call__(
        self, task: Any, belief: Any, session: Session, options: Options, key: jax.Array
    ) -> jax.Array:
        key_gain, key_next = jax.random.split(key)
        gains, prices = self.base.judged(task, belief, session, options, key_gain)
        score = log_score(gains, prices)
        index, valid = shortlist(task, score, options, self.per_group)

        # Common random numbers for all candidates and outcomes.
        keys = jax.random.split(key_next, 4)

        def follow(index: jax.Array) -> tuple[jax.Array, jax.Array]:
            """Expected gain and price of the choice after a measurement."""
            design = jax.tree.map(lambda leaf: leaf[index], options.designs)
            outcomes, p = belief.outcomes(task, design, keys[0])

            def after(outcome: Any) -> tuple[jax.Array, jax.Array]:
                then = belief.update(task, design, outcome, keys[1])
                left = task.spend(session, design, outcome)
                follow = task.options(then, left, keys[2])
                gains, prices = self.base.judged(task, then, left, follow, keys[3])
                chosen = best(log_score(gains, prices), follow)
                going = ~task.over(left)
                # The price counts also where the session is over: no bonus for ending.
                return going * gains[chosen], prices[chosen]

            gain, price = jax.vmap(after)(outcomes)
            return p @ gain, p @ price

        gain, price = jax.vmap(follow)(index)
        score = log_score(gains[index] + gain, prices[index] + price)
        return index[jnp.argmax(jnp.where(valid, score, -jnp.inf))]


@struct.dataclass
class Rollouts:
    """The measurement after which a base rule gains most, by simulation.

    Each shortlisted measurement is followed by the base rule, ``rollouts`` times, for
    at most ``depth`` measurements in all. Every candidate is given the same truths and
    the same random numbers. The base rule's choice is kept unless another gains more
    by ``doubt`` standard errors of the difference: the largest of some noisy means is
    mostly the noisiest, and taking it is worse than the base rule.
    """

    base: Rule
    rollouts: int = struct.field(pytree_node=False, default=16)
    depth: int = struct.field(pytree_node=False, default=16)
    per_group: int = struct.field(pytree_node=False, default=4)
    doubt: Any = 2.0

    def __call__(
        self, task: Any, belief: Any, session: Session, options: Options, key: jax.Array
    ) -> jax.Array:
        key_gain, *keys = jax.random.split(key, 1 + self.rollouts)
        gains, prices = self.base.judged(task, belief, session, options, key_gain)
        score = log_score(gains, prices)
        index, valid = shortlist(task, score, options, self.per_group)

        def follow(index: jax.Array, key: jax.Array) -> jax.Array:
            """() nats gained after a measurement."""
            key_truth, key_steps = jax.random.split(key)
            truth = belief.draw(key_truth)
            design = jax.tree.map(lambda leaf: leaf[index], options.designs)
            return self._after(task, truth, belief, session, design, key_steps)

        alone = jax.vmap(follow, in_axes=(None, 0))
        later = jax.vmap(alone, in_axes=(0, None))(index, jnp.stack(keys))
        total = gains[index][:, None] + later
        own = jnp.argmax(jnp.where(valid, score[index], -jnp.inf))
        more = total - total[own][None]
        error = more.std(axis=1) / max(self.rollouts - 1, 1) ** 0.5
        least = more.mean(axis=1) - self.doubt * error
        return index[jnp.argmax(jnp.where(valid, least, -jnp.inf))]

    def _after(
        self,
        task: Any,
        truth: Any,
        belief: Any,
        session: Session,
        design: Any,
        key: Any,
    ) -> jax.Array:
        """() nats that the base rule gains after a first measurement."""

        def measured(belief: Any, session: Any, design: Any, key: Any) -> Any:
            key_outcome, key_update = jax.random.split(key)
            outcome = task.measure(truth, design, key_outcome)
            return (
                belief.update(task, design, outcome, key_update),
                task.spend(session, design, outcome),
            )

        def going(carry: Any) -> jax.Array:
            _, session, _, number = carry
            return ~task.over(session) & (number < self.depth)

        def step(carry: Any) -> Any:
            belief, session, total, number = carry
            keys = jax.random.split(jax.random.fold_in(key, number), 3)
            options = task.options(belief, session, keys[0])
            gains, prices = self.base.judged(task, belief, session, options, keys[1])
            chosen = best(log_score(gains, prices), options)
            design = jax.tree.map(lambda leaf: leaf[chosen], options.designs)
            belief, session = measured(belief, session, design, keys[2])
            return belief, session, total + gains[chosen], number + 1

        begun = measured(belief, session, design, jax.random.fold_in(key, 0))
        carry = (*begun, jnp.float32(0.0), jnp.int32(1))
        return jax.lax.while_loop(going, step, carry)[2]
