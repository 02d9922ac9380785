"""Tasks of continuous unknowns, and their belief: particles.

The unknowns of a ``ParticleModel`` are functions of d independent standard normal
coordinates z, so every prior is N(0, I) and information, which no change of coordinates
alters, is that of the unknowns themselves.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from numpy.typing import ArrayLike

from jaxcal.adaptive.model_task import Draw, candidates_of
from jaxcal.adaptive.particle_model import (
    FLOOR,
    ParticleModel,
    effective,
    gain_of,
    log_likelihood_of,
    log_prior,
    log_prob_of_all,
    outcome_shape,
    reweighted,
    systematic,
)
from jaxcal.adaptive.session import Options, Session, jit_by_class, pays
from jaxcal.checks import in_words, numbers, whole_number
from jaxcal.models.uncertainty import Noise, Prior

_ENOUGH = 0.5  # effective share of the particles below which they are moved
_HALVINGS = 10  # bisections for a temperature
_STEPS = 40  # temperatures that one outcome may take
_AT_ONCE = 2**25  # log probabilities that sessions played at once may hold
_DESIGNS = 512  # whose gains are computed at once


@struct.dataclass
class ParticleBelief:
    """N weighted draws of the coordinates, and the T measurements they follow from."""

    z: jax.Array  # (N, d)
    log_weight: jax.Array  # (N,) logs of weights that sum to one
    log_likelihood: jax.Array  # (N,) of the measurements made
    designs: Any  # leaves (T, ...)
    answers: jax.Array  # (T, ...) their outcomes
    made: jax.Array  # () int32 measurements made
    log_evidence: jax.Array  # () estimated log density of the measurements made
    model: ParticleModel

    def entropy(self) -> jax.Array:
        """() nats, of z: log evidence less the particles' mean log joint density."""
        joint = log_prior(self.z) + self.log_likelihood
        return self.log_evidence - (jnp.exp(self.log_weight) * joint).sum()

    def log_density(self, truth: jax.Array) -> jax.Array:
        """() estimated log posterior density at coordinates (d,)."""
        mine = self._history(truth[None])[0]
        return log_prior(truth) + mine - self.log_evidence

    def draws(self, count: int, key: jax.Array) -> jax.Array:
        """(count, d) equally weighted particles."""
        return self.z[systematic(self.log_weight, count, key)]

    def can_answer(self, design: Any, outcome: jax.Array) -> jax.Array:
        """() bool: some particle gives the outcome a probability above 0."""
        unknowns = jax.vmap(self.model.unknowns)(self.z)
        return jax.vmap(
            lambda u: log_likelihood_of(self.model, u, design, outcome) > FLOOR
        )(unknowns).any()

    def gains(self, task: ParticleTask, options: Options, key: jax.Array) -> jax.Array:
        """(A,) nats, from ``task.num_contrasts`` particles.

        Discrete outcomes are summed over. Of continuous ones, one is drawn for each
        particle, with common random numbers for all designs, and contrasted with all
        other particles.
        """
        key_draws, key_noise = jax.random.split(key)
        count = task.num_contrasts
        unknowns = jax.vmap(self.model.unknowns)(self.draws(count, key_draws))
        keys = jax.random.split(key_noise, count)

        def gain(design: Any) -> jax.Array:
            return gain_of(self.model, unknowns, design, keys)

        if len(options.seconds) <= _DESIGNS:
            return jax.vmap(gain)(options.designs)
        return jax.lax.map(gain, options.designs, batch_size=_DESIGNS)

    def gain(self, task: ParticleTask, design: Any, key: jax.Array) -> jax.Array:
        """() nats of one design: ``gains`` of it alone, by draws of its own."""
        alone = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], design)
        only = Options(alone, jnp.zeros(1), jnp.ones(1, bool))
        return self.gains(task, only, key)[0]

    def update(
        self, task: ParticleTask, design: Any, outcome: jax.Array, key: jax.Array
    ) -> ParticleBelief:
        """The belief after a measurement.

        The likelihood is tempered: its power rises from 0 to 1 in steps that keep half
        of the particles effective; between steps they are resampled and moved.
        """
        at = self.made
        observed = dataclasses.replace(
            self,
            designs=jax.tree.map(
                lambda old, new: old.at[at].set(new), self.designs, design
            ),
            answers=self.answers.at[at].set(outcome),
            made=at + 1,
        )
        new = observed._last(self.z)
        enough = _ENOUGH * len(self.z)
        whole = effective(self.log_weight + new) >= enough
        log_weight, evidence = reweighted(self.log_weight, jnp.where(whole, new, 0.0))
        begun = jnp.where(whole, 1.0, 0.0), jnp.int32(0), self.z, log_weight
        carry = (*begun, self.log_likelihood, new, evidence, key)

        def temper(carry: Any) -> Any:
            power, steps, z, log_weight, old, new, evidence, key = carry
            key, key_resample, key_move = jax.random.split(key, 3)
            low, high = jnp.zeros(()), 1.0 - power

            def halve(_: int, ends: Any) -> Any:
                low, high = ends
                middle = 0.5 * (low + high)
                fits = effective(log_weight + middle * new) >= enough
                return jnp.where(fits, middle, low), jnp.where(fits, high, middle)

            full = effective(log_weight + high * new) >= enough
            full = full | (steps + 1 >= _STEPS)
            part = jax.lax.fori_loop(0, _HALVINGS, halve, (low, high))[0]
            step = jnp.where(full, high, jnp.maximum(part, 1e-6 * high))
            log_weight, add = reweighted(log_weight, step * new)
            power = jnp.where(full, 1.0, power + step)
            index = systematic(log_weight, len(z), key_resample)
            z, old, new = observed._moved(
                z[index], old[index], new[index], power, key_move, task.num_moves
            )
            log_weight = jnp.full_like(log_weight, -jnp.log(len(z)))
            return power, steps + 1, z, log_weight, old, new, evidence + add, key

        _, _, z, log_weight, old, new, evidence, _ = jax.lax.while_loop(
            lambda carry: carry[0] < 1.0, temper, carry
        )
        return dataclasses.replace(
            observed,
            z=z,
            log_weight=log_weight,
            log_likelihood=old + new,
            log_evidence=self.log_evidence + evidence,
        )

    def _moved(
        self, z: Any, old: Any, new: Any, power: Any, key: jax.Array, num_moves: int
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Metropolis moves along differences of two other particles, of many sizes."""
        count, dim = z.shape

        def move(carry: Any, key: jax.Array) -> tuple[Any, None]:
            z, old, new = carry
            key_shift, key_size, key_accept = jax.random.split(key, 3)
            shift = jax.random.randint(key_shift, (2,), 1, count)
            size = jax.random.uniform(key_size, (count, 1), minval=-3.0, maxval=0.5)
            way = jnp.roll(z, shift[0], axis=0) - jnp.roll(z, shift[1], axis=0)
            there = z + jnp.exp(size) * (1.2 / dim**0.5) * way
            whole, last = self._history(there), self._last(there)
            before = whole - last
            change = log_prior(there) - log_prior(z)
            change = change + before - old + power * (last - new)
            level = jnp.log(jax.random.uniform(key_accept, (count,), minval=1e-30))
            take = level < change
            moved = jnp.where(take[:, None], there, z)
            likelihoods = jnp.where(take, before, old), jnp.where(take, last, new)
            return (moved, *likelihoods), None

        return jax.lax.scan(move, (z, old, new), jax.random.split(key, num_moves))[0]

    def _history(self, z: jax.Array) -> jax.Array:
        """(N,) log likelihood of the measurements made."""
        unknowns = jax.vmap(self.model.unknowns)(z)

        def one(at: jax.Array, total: jax.Array) -> jax.Array:
            return total + self._likelihood(unknowns, at)

        return jax.lax.fori_loop(0, self.made, one, jnp.zeros(len(z)))

    def _last(self, z: jax.Array) -> jax.Array:
        """(N,) log likelihood of the last measurement."""
        return self._likelihood(jax.vmap(self.model.unknowns)(z), self.made - 1)

    def _likelihood(self, unknowns: Any, at: jax.Array) -> jax.Array:
        """(N,) log likelihood of measurement ``at``."""
        design = jax.tree.map(lambda leaf: leaf[at], self.designs)
        return jax.vmap(
            lambda u: log_likelihood_of(self.model, u, design, self.answers[at])
        )(unknowns)


@struct.dataclass
class ParticleTask:
    """A model, the length of a session, and the effort of its belief; see ``make``."""

    model: ParticleModel
    seconds: jax.Array  # () budget of a session; inf where nothing costs
    horizon: int = struct.field(pytree_node=False)
    num_particles: int = struct.field(pytree_node=False)
    num_candidates: int = struct.field(pytree_node=False)
    num_contrasts: int = struct.field(pytree_node=False)
    num_moves: int = struct.field(pytree_node=False)

    @staticmethod
    def make(
        model: ParticleModel,
        horizon: int,
        *,
        seconds: float = float("inf"),
        particles: int = 600,
        candidates: int = 24,
        contrasts: int = 100,
        moves: int = 3,
    ) -> ParticleTask:
        """Check the numbers of a task; a ValueError names the argument, the rule and
        the value, or what is wrong with the model: costs below 0, or probabilities that
        do not sum to 1.

        Args:
            model: what is measured.
            horizon: measurements of a session.
            seconds: budget of a session, in what ``model.cost`` counts.
            particles: of the belief.
            candidates: designs that are compared for every measurement.
            contrasts: particles that gains are computed from.
            moves: Metropolis steps each time that particles are resampled.
        """
        budget = numbers("seconds", seconds, finite=False)
        if budget.ndim or not budget > 0.0:
            raise ValueError(f"seconds must be one number above 0, got {seconds}")
        task = ParticleTask(
            model=model,
            seconds=jnp.asarray(budget, jnp.float32),
            horizon=whole_number("horizon", horizon, 1),
            num_particles=whole_number("particles", particles, 2),
            num_candidates=whole_number("candidates", candidates, 1),
            num_contrasts=whole_number("contrasts", contrasts, 2),
            num_moves=whole_number("moves", moves, 1),
        )
        _check(task)
        return task

    @staticmethod
    def of(
        model: Any,
        prior: Prior | Draw | None,
        noise: Noise | None,
        candidates: ArrayLike,
        *,
        measurements: int,
        cost: ArrayLike = 0.0,
        **rest: Any,
    ) -> ParticleTask:
        """A model of ``jaxcal.models``, measured at one of its candidates at a time.

        A design is a row of ``candidates``, by its index, and may be measured again.
        Where the model is linear in its parameters and the prior normal, nothing
        depends on the readings: ``jaxcal.select`` chooses as well beforehand.

        Args:
            model: any, or an object with ``predict``, ``jacobian``,
                ``command_jacobian``.
            prior: normal and finite; or a function, written with ``jax.numpy``, of p
                independent standard normal numbers that returns the parameters. The
                model's own when None.
            noise: of a reading (q,); the model's usual one when None.
            candidates: (M, n) commands.
            measurements: of a session.
            cost: of a measurement: a number or (M,).
            rest: ``seconds``, ``particles``, ``contrasts``, ``moves`` of ``make``,
                whose errors are raised too.
        """
        of_model = candidates_of(model, prior, noise, candidates, cost)
        count = len(of_model.commands)
        return ParticleTask.make(of_model, measurements, candidates=count, **rest)

    @property
    def designs(self) -> jax.Array | None:
        """(A, e) the table of designs; None where they are proposed."""
        return getattr(self.model, "commands", None)

    @property
    def batch(self) -> int:
        """Sessions that are played at once, for the memory that their gains take."""
        support = self.model.support
        wide = self.num_contrasts if support is None else len(support)
        size = self.num_candidates * self.num_contrasts * wide
        return max(1, min(256, _AT_ONCE // size))

    def draw(self, key: jax.Array) -> jax.Array:
        """(d,) coordinates of the truth."""
        return jax.random.normal(key, (self.model.dim,))

    def begin(self, key: jax.Array) -> tuple[ParticleBelief, Session]:
        """Particles of the prior, and a session at a design that is proposed first."""
        key_z, key_place = jax.random.split(key)
        z = jax.random.normal(key_z, (self.num_particles, self.model.dim))
        unknowns = jax.vmap(self.model.unknowns)(z)
        whole = Session(
            place=None,
            seconds=jnp.asarray(jnp.inf),
            uses=jnp.int32(self.horizon),
            made=jnp.int32(0),
        )
        first = self.model.propose(unknowns, whole, key_place, 1)
        place = jax.tree.map(lambda leaf: leaf[0], first)
        belief = ParticleBelief(
            z=z,
            log_weight=jnp.full(len(z), -jnp.log(float(len(z)))),
            log_likelihood=jnp.zeros(len(z)),
            designs=jax.tree.map(
                lambda leaf: jnp.zeros((self.horizon, *leaf.shape), leaf.dtype), place
            ),
            answers=jnp.zeros((self.horizon, *outcome_shape(self.model))),
            made=jnp.int32(0),
            log_evidence=jnp.zeros(()),
            model=self.model,
        )
        return belief, dataclasses.replace(whole, place=place, seconds=self.seconds)

    def over(self, session: Session) -> jax.Array:
        """() bool: no time or no measurements are left."""
        return session.spent | (session.made >= self.horizon)

    def options(
        self, belief: ParticleBelief, session: Session, key: jax.Array
    ) -> Options:
        """Designs that the model proposes from draws of the belief."""
        key_draws, key_designs = jax.random.split(key)
        z = belief.draws(4 * self.num_candidates, key_draws)
        designs = self.model.propose(
            jax.vmap(self.model.unknowns)(z), session, key_designs, self.num_candidates
        )
        cost = jax.vmap(lambda design: self.model.cost(session, design))(designs)
        return Options(designs, cost, pays(session.seconds, cost))

    def measure(self, truth: jax.Array, design: Any, key: jax.Array) -> jax.Array:
        """() an outcome, drawn."""
        prediction = self.model.predict(self.model.unknowns(truth), design)
        return self.model.sample(prediction, key)

    def spend(self, session: Session, design: Any, outcome: jax.Array) -> Session:
        """The session after a measurement."""
        return Session(
            place=design,
            seconds=session.seconds - self.model.cost(session, design),
            uses=session.uses - 1,
            made=session.made + 1,
        )

    def expected(
        self, belief: ParticleBelief, session: Session, options: Options
    ) -> tuple[jax.Array, jax.Array]:
        """(A,) seconds and (A,) uses that each measurement is expected to take."""
        return options.seconds, jnp.ones_like(options.seconds)


def _check(task: ParticleTask) -> None:
    """Try the model on some designs and draws of the prior."""
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(task)):
        return
    cost, outcomes, log_prob, total = jax.device_get(_tried(task))
    if not (cost >= 0.0).all():
        raise ValueError(f"model.cost must be at least 0, got {in_words(cost)}")
    shape = outcome_shape(task.model)
    if outcomes.shape[1:] != shape or log_prob.ndim != 1:
        raise ValueError(
            f"model.sample must give shape {shape} and model.log_prob a number, got "
            f"shapes {outcomes.shape[1:]} and {log_prob.shape[1:]}"
        )
    if not (log_prob > FLOOR).all():
        raise ValueError(
            "model.log_prob must be finite for what model.sample draws, got "
            f"{log_prob.min():g} for the outcome "
            f"{in_words(outcomes[log_prob.argmin()])}"
        )
    if (np.abs(total - 1.0) > 1e-3).any():
        worst = total[np.abs(total - 1.0).argmax()]
        raise ValueError(
            "model.log_prob must be of probabilities that sum to 1 over model.support, "
            f"got {worst:.6g}"
        )


@jit_by_class
def _tried(task: ParticleTask) -> tuple[jax.Array, ...]:
    """(A,) costs, outcomes, their log probabilities, and the sum of all outcomes'."""
    model, keys = task.model, jax.random.split(jax.random.key(0), 4)
    belief, session = task.begin(keys[0])
    options = task.options(belief, session, keys[1])
    unknowns = jax.vmap(model.unknowns)(belief.draws(task.num_candidates, keys[2]))
    predictions = jax.vmap(model.predict)(unknowns, options.designs)
    outcomes = jax.vmap(model.sample)(
        predictions, jax.random.split(keys[3], task.num_candidates)
    )
    log_prob = jax.vmap(model.log_prob)(predictions, outcomes)
    if model.support is None:
        return options.seconds, outcomes, log_prob, jnp.ones(1)
    total = jnp.exp(log_prob_of_all(model, predictions)).sum(axis=-1)
    return options.seconds, outcomes, log_prob, total
