"""Any function ``f(u, theta)`` written in JAX as a model."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.checks import Array, table, whole_number
from jaxcal.extras import needs
from jaxcal.models.model import (
    FunctionModel,
    Theta,
    as_commands,
    as_parameters,
    checked_periods,
)


class FromJax(FunctionModel):
    """``y = f(u, theta)`` of one command; values and derivatives in float64 by JAX.

    The first call with a number of commands compiles f for it; the caller's JAX
    configuration is unchanged.

    Args:
        f: function of a command (n,) and parameters (p,) that returns (q,), or a scalar
            for one output; use ``jax.numpy``, no ``if`` on values.
        nominal: (p,) parameters of the machine as it was designed.
        names: of the parameters; by default t1, t2, ...
        num_inputs: n; by default that of the first commands.
        periods: (q,) or one for all readings that wrap: 360 degrees, inf of others.
    """

    _kind_written, _counted_by = "jax", "num_inputs"

    def __init__(
        self,
        f: Callable[[Any, Any], Any],
        nominal: ArrayLike,
        names: Sequence[str] | None = None,
        num_inputs: int | None = None,
        periods: ArrayLike | None = None,
    ) -> None:
        if not callable(f):
            raise ValueError(f"f must be a function of (u, theta), got {f!r}")
        self.f = f
        super().__init__(nominal, names, periods)
        with needs("policy", "FromJax"):
            import jax  # noqa: F401  # refused here where it is not installed
        if num_inputs is not None:
            self._trace(whole_number("num_inputs", num_inputs, 1))

    @property
    def num_outputs(self) -> int:
        """m; 0 before the first commands."""
        return self._num_outputs if self.num_inputs else 0

    def predict(self, commands: ArrayLike, parameters: Theta = None) -> Array:
        """Outputs (N, q) at commands (N, n)."""
        return self._run(0, commands, parameters)

    def jacobian(self, commands: ArrayLike, parameters: Theta = None) -> Array:
        """(N, q, p)."""
        return self._run(1, commands, parameters)

    def command_jacobian(self, commands: ArrayLike, parameters: Theta = None) -> Array:
        """(N, q, n)."""
        return self._run(2, commands, parameters)

    def _readings(self, command: Any, parameters: Any) -> Any:
        """(q,) f of one command, of a scalar too."""
        import jax.numpy as jnp

        return jnp.atleast_1d(self.f(command, parameters))

    def _trace(self, num_inputs: int) -> None:
        """Find q, and whether JAX can follow f at all."""
        import jax

        with jax.enable_x64(True):
            command = jax.ShapeDtypeStruct((num_inputs,), np.float64)
            parameters = jax.ShapeDtypeStruct(self.nominal.shape, np.float64)
            try:
                result = jax.eval_shape(self.f, command, parameters)
            except Exception as error:
                raise ValueError(
                    f"JAX cannot follow f for a command ({num_inputs},) and parameters "
                    f"{self.nominal.shape}; write it with jax.numpy, without if on "
                    f"values: {type(error).__name__}: {str(error).splitlines()[0]}"
                ) from error
            # JAX takes the last entry where an index is beyond it; numpy refuses it.
            plain, first = inspect.unwrap(self.f), np.zeros(num_inputs)
            for name, one, traced in (
                ("u", lambda theta: plain(first, theta), parameters),
                ("theta", lambda u: plain(u, self.nominal), command),
            ):
                try:
                    with np.errstate(all="ignore"):
                        jax.eval_shape(one, traced)
                except IndexError as error:
                    raise ValueError(
                        f"f must read entries of {name}: {error}"
                    ) from None
                except Exception:  # what only JAX's arrays can do
                    continue
        shape = getattr(result, "shape", None)
        if shape is None or len(shape) > 1 or shape == (0,):
            raise ValueError(
                "f must return an array (q,) for one command, got "
                f"{type(result).__name__ if shape is None else shape}"
            )
        count = shape[0] if shape else 1
        if self._given_periods is not None:
            checked_periods(self._given_periods, count)
        self._num_inputs, self._num_outputs = num_inputs, count

    @functools.cached_property
    def _compiled(self) -> tuple[Callable[..., Any], ...]:
        """f and its derivatives by parameters and commands, each of N commands."""
        import jax

        f = self._readings
        return tuple(
            jax.jit(jax.vmap(function, in_axes=(0, None)))
            for function in (f, jax.jacfwd(f, argnums=1), jax.jacfwd(f, argnums=0))
        )

    def _run(
        self, which: int, commands: ArrayLike, parameters: ArrayLike | None
    ) -> Array:
        if self._num_inputs is None:
            self._trace(table("commands", commands).shape[1])
        commands = as_commands(self, commands)
        parameters = as_parameters(self, parameters)
        import jax

        with jax.enable_x64(True):
            return np.array(self._compiled[which](commands, parameters))
