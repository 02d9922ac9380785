"""Postures under Gymnasium's vector interface."""

from __future__ import annotations

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")


@pytest.mark.slow
def test_make_vec_plays_episodes_that_pay_their_log_det():
    envs = gymnasium.make_vec(
        "jaxcal.learning.gym:jaxcal/Postures-v0", num_envs=3, num_candidates=8
    )
    obs, infos = envs.reset(seed=0)
    assert obs.shape == envs.observation_space.shape and obs.dtype == np.float32
    rng, sets, chosen = np.random.default_rng(0), obs[:, :24].reshape(3, 8, 3), []
    for step in range(4):
        actions = np.array(
            [rng.choice(np.flatnonzero(m)) for m in infos["action_mask"]]
        )
        chosen.append(actions)
        before = infos["action_mask"]
        obs, reward, ended, cut, infos = envs.step(actions)
        assert ended.all() == (step == 3) and not cut.any()
        if step < 3:
            assert (before & ~infos["action_mask"]).sum() == 3
    for i, indices in enumerate(np.array(chosen).T):
        z = np.column_stack([sets[i][indices], np.ones(4)])
        assert reward[i] == pytest.approx(0.3 * np.linalg.slogdet(z.T @ z)[1], abs=1e-3)
    np.testing.assert_array_equal(infos["final_obs"][:, :24].reshape(3, 8, 3), sets)
    assert not np.array_equal(obs[:, :24].reshape(3, 8, 3), sets)
    again, _ = envs.reset(seed=0)
    np.testing.assert_array_equal(again[:, :24].reshape(3, 8, 3), sets)


def test_a_bad_option_and_a_bad_step_are_one_line():
    from jaxcal.learning.environments.functional import PosturesEnv
    from jaxcal.learning.gym import JaxVector, postures

    with pytest.raises(
        ValueError, match=r"^options must be of num_candidates, .* nope"
    ):
        postures(nope=3)
    envs = JaxVector(PosturesEnv(), num_envs=3)
    for actions in (np.zeros(2, int), 0, np.zeros((3, 1), int)):
        with pytest.raises(ValueError, match=r"^actions must be .* \(3,\), got shape"):
            envs.step(actions)
