"""A model of ``jaxcal.models`` to be measured one by one: ``ParticleTask.of``.

A design is the index of a candidate; its reading (q,), or a number where q = 1, is the
model's prediction and normal noise. A function of ``FromJax`` and a model that is
linear in its parameters are compiled with the belief; any other model is asked on the
host, once for each particle, for all candidates.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from numpy.typing import ArrayLike

from jaxcal.adaptive.grid_tables import single
from jaxcal.adaptive.session import Session, on_host
from jaxcal.checks import Array, numbers, one_or_each, table
from jaxcal.models.from_jax import FromJax
from jaxcal.models.function import FromFunction
from jaxcal.models.model import Model, as_commands, as_model, by_name
from jaxcal.models.predictions import derivative, predict
from jaxcal.models.uncertainty import Noise, Prior

Draw = Callable[[jax.Array], jax.Array]  # p standard normal numbers -> parameters (p,)


@struct.dataclass
class Candidates:
    """A model's candidates as a ``ParticleModel``; made by ``candidates_of``."""

    commands: jax.Array  # (M, n)
    mean: jax.Array  # (p,) of the prior
    std: jax.Array  # (p,) 0 where fixed
    white: jax.Array  # (M, q, q): ``white @ noise`` is N(0, I)
    noise: jax.Array  # (M, q, q) its inverse
    log_scale: jax.Array  # (M,) log det of ``white``, less that of the normal law
    seconds: jax.Array  # (M,)
    at_mean: jax.Array  # (M, q) readings, by which journals tell models apart
    slope: jax.Array  # (M, q, p) by the parameters, of a model that is linear in them
    periods: jax.Array | None  # (q,) of readings that wrap, inf of the others
    draw: Draw | None = struct.field(pytree_node=False)
    outputs: Callable[..., jax.Array] | None = struct.field(pytree_node=False)
    names: tuple[str, ...] = struct.field(pytree_node=False)

    support = None

    @property
    def dim(self) -> int:
        """p."""
        return len(self.names)

    @property
    def outcome_shape(self) -> tuple[int, ...]:
        """() of one reading, (q,) of several."""
        q = self.at_mean.shape[1]
        return () if q == 1 else (q,)

    def unknowns(self, z: jax.Array) -> jax.Array:
        """(p,) parameters."""
        return self.mean + self.std * z if self.draw is None else self.draw(z)

    def predict(self, unknowns: jax.Array, design: jax.Array) -> Any:
        """Reading (q,) of a candidate, and its index."""
        if self.outputs is None:
            reading = self.at_mean[design] + self.slope[design] @ (unknowns - self.mean)
        else:
            reading = self.outputs(unknowns, design, self.commands[design])
        return reading, design

    def log_prob(self, prediction: Any, outcome: jax.Array) -> jax.Array:
        """() log density."""
        reading, design = prediction
        off = jnp.atleast_1d(outcome) - reading
        if self.periods is not None:
            whole = jnp.where(jnp.isinf(self.periods), 1.0, self.periods)
            turns = jnp.where(jnp.isinf(self.periods), 0.0, jnp.round(off / whole))
            off = off - whole * turns
        off = self.white[design] @ off
        density = self.log_scale[design] - 0.5 * (off * off).sum()
        return jnp.where(jnp.isnan(density), -jnp.inf, density)  # the model refused

    def sample(self, prediction: Any, key: jax.Array) -> jax.Array:
        """A reading, drawn."""
        reading, design = prediction
        drawn = reading + self.noise[design] @ jax.random.normal(key, reading.shape)
        return drawn.reshape(self.outcome_shape)

    def propose(
        self, unknowns: Any, session: Session, key: jax.Array, count: int
    ) -> jax.Array:
        """All candidates."""
        return jnp.arange(count, dtype=jnp.int32)

    def cost(self, session: Session, design: jax.Array) -> jax.Array:
        """() seconds."""
        return self.seconds[design]


def candidates_of(
    model: Any,
    prior: Prior | Draw | None,
    noise: Noise | None,
    candidates: ArrayLike,
    seconds: ArrayLike,
) -> Candidates:
    """``model`` at its candidates, with arrays in float32; refused are a prior or noise
    that is not given where the model has none of its own, or of which nothing can be
    drawn, and candidates or costs that are wrong."""
    model = as_model(model)
    if isinstance(model, FromJax | FromFunction):  # which count inputs by the first
        model.predict(table("candidates", by_name(model, candidates))[:1])
    commands = as_commands(model, candidates)
    if not len(commands):
        raise ValueError("candidates must hold at least one row")
    model = model.fitting.prepared(commands)
    mean, std, draw = _drawn(model, prior)
    at_mean = predict(model, commands, mean)
    white = _whitening(model, noise, commands, mean, at_mean.shape)
    linear = model.fitting.multiplicity > 0
    shape = (*at_mean.shape, len(mean))
    slope = derivative(model, commands, mean) if linear else np.zeros((*shape[:2], 0))
    costs = one_or_each("cost", numbers("cost", seconds), len(commands))
    if (costs < 0.0).any():
        raise ValueError(f"cost must be at least 0, got {costs.min():g}")
    outputs: Callable[..., jax.Array] | None = None
    if not linear:
        is_jax = isinstance(model, FromJax)
        outputs = _JaxReadings(model.f) if is_jax else _HostReadings(model, commands)
    scale = np.linalg.slogdet(white)[1] - shape[1] / 2 * np.log(2.0 * np.pi)
    return Candidates(
        commands=single(commands), mean=single(mean), std=single(std),
        white=single(white), noise=single(np.linalg.inv(white)),
        log_scale=single(scale),
        seconds=single(costs), at_mean=single(at_mean), slope=single(slope), draw=draw,
        periods=None if model.periods is None else single(model.periods),
        outputs=outputs, names=model.names,
    )  # fmt: skip


def _drawn(
    model: Model, prior: Prior | Draw | None
) -> tuple[Array, Array, Draw | None]:
    """Mean and standard deviation of the parameters, or how they are drawn."""
    p = len(model.names)
    if callable(prior):
        try:
            drawn = np.asarray(prior(jnp.zeros(p)), np.float64)
        except (TypeError, ValueError, IndexError) as error:
            raise ValueError(
                f"prior fails for {p} standard normal numbers: {error}"
            ) from error
        if drawn.shape != (p,) or not np.isfinite(drawn).all():
            raise ValueError(
                f"prior must return ({p},) finite parameters, got {drawn.tolist()}"
            )
        return drawn, np.zeros(p), prior
    resolved = (model.default_prior() if prior is None else prior).resolve(model)
    precision = resolved.precisions
    unknown = resolved.free & (precision == 0.0)
    if unknown.any():
        named = ", ".join(np.array(model.names)[unknown])
        raise ValueError(
            "prior must have a finite std for every parameter that is not fixed: "
            f"{named} cannot be drawn"
        )
    with np.errstate(divide="ignore"):
        return resolved.mean, np.where(resolved.free, precision**-0.5, 0.0), None


def _whitening(
    model: Model,
    noise: Noise | None,
    commands: Array,
    mean: Array,
    shape: tuple[int, ...],
) -> Array:
    """(M, q, q); noise of the commands is carried over at the prior's mean."""
    noise = model.default_noise() if noise is None else noise
    if noise is None:
        raise ValueError("noise is missing: the model has no usual noise")
    by_command = None
    if noise.command_std is not None:
        if np.isinf(noise.of_commands(*commands.shape)).any():
            raise ValueError(
                "command_std must be finite here: with an unknown command, a reading "
                "has no density"
            )
        inputs = tuple(f"u{i + 1}" for i in range(commands.shape[1]))
        by_command = derivative(model, commands, mean, inputs)
    return noise.whitening(shape[0], shape[1], by_command)


class _JaxReadings:
    def __init__(self, f: Callable[[Any, Any], Any]) -> None:
        self._f = f

    def __call__(
        self, unknowns: jax.Array, design: jax.Array, command: jax.Array
    ) -> jax.Array:
        return jnp.atleast_1d(self._f(command, unknowns))


class _HostReadings:
    """Readings of a model in numpy, asked on the host."""

    def __init__(self, model: Model, commands: Array) -> None:
        self._model, self._commands = model, commands
        self._tables = functools.lru_cache(maxsize=4)(self._readings)

    def __call__(
        self, unknowns: jax.Array, design: jax.Array, command: jax.Array
    ) -> jax.Array:
        shape = jax.ShapeDtypeStruct((self._model.num_outputs,), jnp.float32)
        return on_host(self._at, shape, unknowns, design)

    def _at(self, unknowns: Any, designs: Any) -> Any:
        """(..., q) of parameters (..., p) and designs (...) that broadcast."""
        parameters, design = np.asarray(unknowns), np.asarray(designs)
        rows = parameters.reshape(-1, parameters.shape[-1])
        # The designs of a history ask for the same parameters, one after the other.
        readings = self._tables(rows.tobytes(), rows.shape, rows.dtype.str)
        which = np.arange(len(rows)).reshape(parameters.shape[:-1])
        return readings[np.broadcast_arrays(which, design)[0], design]

    def _readings(self, data: bytes, shape: tuple[int, int], kind: str) -> Any:
        """(B, M, q) of parameters (B, p); NaN, which is never likely, where refused."""
        rows = np.frombuffer(data, np.dtype(kind)).reshape(shape).astype(np.float64)
        commands, model = self._commands, self._model
        every = [predict(model, commands, row, finite=False) for row in rows]
        return np.array(every, np.float32)
