"""The fast uniform numbers are jax's own."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from jaxcal.learning.environments import selection as randomness

# One program each: op by op a draw would be hundreds.
uniform = jax.jit(randomness.uniform, static_argnums=1)


@pytest.mark.parametrize("shape", [(), (7,), (3, 5, 2)])
def test_uniform_is_jaxs_bit_for_bit(key, shape):
    wanted = np.asarray(jax.random.uniform(key, shape))
    assert (np.asarray(uniform(key, shape)) == wanted).all()


def test_uniform_is_jaxs_for_many_keys_and_for_legacy_ones(key):
    keys = jax.random.split(key, 5)
    drawn = jax.jit(jax.vmap(lambda key: randomness.uniform(key, (4,))))(keys)
    wanted = jax.vmap(lambda key: jax.random.uniform(key, (4,)))(keys)
    assert (np.asarray(drawn) == np.asarray(wanted)).all()
    legacy = jax.random.PRNGKey(3)
    drawn = uniform(legacy, (4,))
    assert (np.asarray(drawn) == np.asarray(jax.random.uniform(legacy, (4,)))).all()


def test_another_generators_key_is_left_to_jax():
    key = jax.random.key(0, impl="rbg")
    drawn = uniform(key, (4,))
    assert (np.asarray(drawn) == np.asarray(jax.random.uniform(key, (4,)))).all()
