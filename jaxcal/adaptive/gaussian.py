"""Static models as tasks: normal prior, normal noise, linear about the prior's mean.

Here what a measurement tells does not depend on what it answers, so a plan of K at once
(:func:`jaxcal.select`) loses nothing to a choice of one at a time, and no decider beats
the static solvers. The task is there so that one interface holds both.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.scipy.linalg import solve_triangular
from numpy.typing import ArrayLike

from jaxcal.adaptive.session import Options, Session
from jaxcal.checks import in_words, table, whole_number
from jaxcal.models import Model, Noise, Prior

__all__ = ["GaussianBelief", "GaussianTask"]


@struct.dataclass
class GaussianBelief:
    """Information of z, the parameters less their mean, in standard deviations.

    ``root @ z = right`` is what least squares solves; the covariance of z is the
    inverse of ``root.T @ root``. Square roots keep what float32 can hold.
    """

    root: jax.Array  # (p, p) upper triangle
    right: jax.Array  # (p,)

    def gains(
        self, task: GaussianTask, options: Options, key: jax.Array | None = None
    ) -> jax.Array:
        """(A,) nats: half of log det after a measurement less that before."""
        blocks = task.blocks[options.designs]
        count, q, p = blocks.shape
        rows = solve_triangular(self.root, blocks.reshape(-1, p).T, trans="T").T
        rows = rows.reshape(count, q, p)
        whole = jnp.eye(q)[None] + rows @ jnp.matrix_transpose(rows)
        return jnp.maximum(0.5 * jnp.linalg.slogdet(whole)[1], 0.0)

    def update(
        self,
        task: GaussianTask,
        design: jax.Array,
        outcome: jax.Array,
        key: jax.Array | None = None,
    ) -> GaussianBelief:
        read = task.whitening[design] @ (outcome - task.expected_outcomes[design])
        stacked = jnp.block(
            [[self.root, self.right[:, None]], [task.blocks[design], read[:, None]]]
        )
        root = jnp.linalg.qr(stacked, mode="r")
        p = len(self.right)
        return GaussianBelief(root[:p, :p], root[:p, p])

    def draw(self, key: jax.Array) -> jax.Array:
        """(p,) z, drawn."""
        noise = jax.random.normal(key, self.right.shape)
        return solve_triangular(self.root, self.right + noise)

    def outcomes(
        self, task: GaussianTask, design: jax.Array, key: jax.Array | None = None
    ) -> tuple[jax.Array, jax.Array]:
        """(1, q) and (1,): whatever a design answers, what follows gains the same."""
        return task.expected_outcomes[design][None], jnp.ones(1)

    def entropy(self) -> jax.Array:
        """() nats of z."""
        p = len(self.right)
        return 0.5 * p * jnp.log(2.0 * jnp.pi * jnp.e) - self._log_root()

    def log_density(self, truth: jax.Array) -> jax.Array:
        """() of z (p,)."""
        off = self.root @ truth - self.right
        p = len(self.right)
        return -0.5 * (off @ off) - 0.5 * p * jnp.log(2.0 * jnp.pi) + self._log_root()

    def _log_root(self) -> jax.Array:
        return jnp.log(jnp.abs(jnp.diagonal(self.root))).sum()


@struct.dataclass
class GaussianTask:
    """A candidates of a model, each to be measured once or a few times.

    A design is an index in [0, A), an outcome the model's outputs (q,); the truth is
    z (p,).
    """

    designs: jax.Array  # (A, n) candidates
    blocks: jax.Array  # (A, q, p) derivative of whitened outputs by z
    whitening: jax.Array  # (A, q, q)
    colouring: jax.Array  # (A, q, q) its inverse, where it has one
    expected_outcomes: jax.Array  # (A, q) at the mean of the prior
    log_scale: jax.Array  # (A,) of the outcomes' density
    mean: jax.Array  # (p,) of the free parameters
    std: jax.Array  # (p,) of the free parameters
    replicates: int = struct.field(pytree_node=False)
    most: int = struct.field(pytree_node=False)
    parameter_names: tuple[str, ...] = struct.field(pytree_node=False)

    @staticmethod
    def make(
        model: Model,
        candidates: ArrayLike,
        *,
        most: int,
        prior: Prior | None = None,
        noise: Noise | None = None,
        replicates: int = 1,
    ) -> GaussianTask:
        """The task of a model of :mod:`jaxcal.models`.

        Args:
            model: linearised about the mean of the prior.
            candidates: (A, n) commands.
            most: measurements in a session.
            prior: the model's own by default; its std must be finite: under an
                unbounded prior the gain is infinite.
            noise: the model's own by default, else of unit variance.
            replicates: how often a candidate may be measured.
        """
        at = table("candidates", candidates)
        known = (model.default_prior() if prior is None else prior).resolve(model)
        precision = np.diag(known.precision)[known.free]
        names = [n for n, free in zip(model.names, known.free, strict=True) if free]
        if not (precision > 0.0).all():
            unknown = [n for n, w in zip(names, precision, strict=True) if w <= 0.0]
            raise ValueError(
                "prior must have a finite std for every free parameter of a task, got "
                f"none for {', '.join(unknown)}: give prior=Prior(std)"
            )
        if noise is None:
            default = getattr(model, "default_noise", Noise)
            noise = default()
        slopes = None
        if noise.command_std is not None:
            slopes = model.command_jacobian(at, known.mean)
        jacobian = model.jacobian(at, known.mean)
        white = noise.whitening(len(at), jacobian.shape[1], slopes)
        std = precision**-0.5
        blocks = white @ jacobian[..., known.free] * std
        if not np.isfinite(blocks).all():
            bad = at[np.argwhere(~np.isfinite(blocks))[0][0]]
            raise ValueError(
                f"model.jacobian must be finite, it is not at candidate {in_words(bad)}"
            )
        sizes = np.linalg.svd(white, compute_uv=False)
        heard = sizes > 1e-12 * sizes.max(axis=-1, keepdims=True)
        scale = np.log(np.where(heard, sizes / np.sqrt(2.0 * np.pi), 1.0)).sum(axis=-1)
        single = jnp.float32
        return GaussianTask(
            designs=jnp.asarray(at, single),
            blocks=jnp.asarray(blocks, single),
            whitening=jnp.asarray(white, single),
            colouring=jnp.asarray(np.linalg.pinv(white), single),
            expected_outcomes=jnp.asarray(model.predict(at, known.mean), single),
            log_scale=jnp.asarray(scale, single),
            mean=jnp.asarray(known.mean[known.free], single),
            std=jnp.asarray(std, single),
            replicates=whole_number("replicates", replicates, 1),
            most=whole_number("most", most, 1),
            parameter_names=tuple(names),
        )

    @property
    def outcome_shape(self) -> tuple[int, ...]:
        """(q,)."""
        return self.expected_outcomes.shape[1:]

    def parameters(self, belief: GaussianBelief) -> tuple[jax.Array, jax.Array]:
        """(p,) means and (p,) standard deviations of the free parameters."""
        inverse = solve_triangular(belief.root, jnp.eye(len(self.std)))
        spread = jnp.sqrt(jnp.square(inverse).sum(axis=1))
        return self.mean + self.std * (inverse @ belief.right), self.std * spread

    def draw(self, key: jax.Array) -> jax.Array:
        """(p,) z."""
        return jax.random.normal(key, self.std.shape)

    def begin(self, key: jax.Array) -> tuple[GaussianBelief, Session]:
        """The prior, and a session of ``most`` measurements."""
        p = len(self.std)
        there_are = self.replicates * len(self.designs)
        session = Session(
            place=jnp.full(len(self.designs), self.replicates, jnp.int32),
            seconds=jnp.float32(jnp.inf),
            uses=jnp.int32(min(self.most, there_are)),
            made=jnp.int32(0),
        )
        return GaussianBelief(jnp.eye(p), jnp.zeros(p)), session

    def options(
        self, belief: GaussianBelief, session: Session, key: jax.Array | None = None
    ) -> Options:
        """All candidates; those measured as often as may be are not allowed."""
        count = len(self.designs)
        return Options(
            designs=jnp.arange(count),
            seconds=jnp.ones(count),
            allowed=session.place > 0,
        )

    def measure(self, truth: jax.Array, design: jax.Array, key: jax.Array) -> jax.Array:
        """(q,) outputs, drawn."""
        white = self.blocks[design] @ truth
        noise = jax.random.normal(key, white.shape)
        return self.expected_outcomes[design] + self.colouring[design] @ (white + noise)

    def spend(self, session: Session, design: jax.Array, outcome: jax.Array) -> Session:
        """A measurement is a use; where it was made may be measured once less."""
        return Session(
            place=session.place.at[design].add(-1),
            seconds=session.seconds - 1.0,
            uses=session.uses - 1,
            made=session.made + 1,
        )

    def expected(
        self, belief: GaussianBelief, session: Session, options: Options
    ) -> tuple[jax.Array, jax.Array]:
        """(A,) seconds and (A,) uses that each measurement is expected to take."""
        return options.seconds, jnp.ones_like(options.seconds)

    def log_likelihood(
        self, truth: jax.Array, design: jax.Array, outcome: jax.Array
    ) -> jax.Array:
        """() log probability, or density, of an outcome."""
        white = self.whitening[design] @ (outcome - self.expected_outcomes[design])
        off = white - self.blocks[design] @ truth
        return self.log_scale[design] - 0.5 * (off @ off)
