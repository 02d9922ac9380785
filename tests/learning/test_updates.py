"""The kept update is ``ppo.update``, in the process that made it and in the next."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np

from jaxcal.learning.policies import networks
from jaxcal.learning.training import ppo, presets, updates

CONFIG = presets.with_values(
    presets.PRESETS["compact"],
    {
        "width": 4,
        "encoder_rounds": 1,
        "num_candidates": 8,
        "num_episodes": 192,
        "episodes_per_update": 64,
    },
)
NETWORK = networks.build(CONFIG.network)
TASK = CONFIG.tasks[0]


def leaves_of(state):
    return [
        np.asarray(
            jax.random.key_data(leaf)
            if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
            else leaf
        )
        for leaf in jax.tree.leaves(state)
    ]


def two_updates(update):
    state = ppo.init(CONFIG.ppo, TASK, NETWORK)
    for _ in range(2):
        state, metrics = update(state)
    return leaves_of(state) + leaves_of(metrics)


def test_the_kept_update_is_ppo_update(kept):
    plain = two_updates(lambda state: ppo.update(state, CONFIG.ppo, TASK, NETWORK))
    like = ppo.init(CONFIG.ppo, TASK, NETWORK)
    for _ in range(2):  # made, then read
        update = updates.updater(CONFIG.ppo, TASK, NETWORK, None, like)
        found = two_updates(update)
        assert len(found) == len(plain)
        for one, other in zip(found, plain, strict=True):
            np.testing.assert_array_equal(one, other)
    assert len(list(kept.iterdir())) == 1


def test_another_task_is_another_program(kept):
    like = ppo.init(CONFIG.ppo, TASK, NETWORK)
    updates.updater(CONFIG.ppo, TASK, NETWORK, None, like)
    masked = dataclasses.replace(TASK, masked=0.3)
    updates.updater(CONFIG.ppo, masked, NETWORK, None, like)
    assert len(list(kept.iterdir())) == 2


def test_the_state_is_given_up(kept):
    state = ppo.init(CONFIG.ppo, TASK, NETWORK)
    update = updates.updater(CONFIG.ppo, TASK, NETWORK, None, state)
    update(state)
    assert any(leaf.is_deleted() for leaf in jax.tree.leaves(state.params))
