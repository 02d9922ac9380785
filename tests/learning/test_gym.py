"""Postures under Gymnasium's vector interface."""

from __future__ import annotations

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")
pytest.importorskip("jaxcal.learning.gym")  # registers them, whichever test is first


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
        with pytest.raises(
            ValueError, match=r"^actions must hold .* \(3,\), got shape"
        ):
            envs.step(actions)


NAME = "jaxcal/Postures-v0"


@pytest.mark.parametrize("asked", [{}, {"render_mode": None}])
@pytest.mark.parametrize("mode", ["vector_entry_point", "sync"])
def test_a_render_mode_of_none_is_taken(asked, mode):
    for env in (
        gymnasium.make(NAME, **asked),
        gymnasium.make(NAME, render_mode="rgb_array"),  # as Stable-Baselines3 does
        gymnasium.make_vec(NAME, num_envs=2, vectorization_mode=mode, **asked),
    ):
        assert env.reset(seed=1)[0].shape[-1] == 210
        assert env.unwrapped.render_mode is None
    with pytest.raises(ValueError, match=r"^render_mode must be None.* got 'human'$"):
        gymnasium.make(NAME, render_mode="human")


def test_each_environment_may_have_a_seed_of_its_own():
    envs = gymnasium.make_vec(NAME, num_envs=3, num_candidates=8)

    def begun(seed):
        return envs.reset(seed=seed)[0][:, :24]

    first, again, other = map(begun, ([1, 2, 3], np.array([1, 2, 3]), (3, 2, 9)))
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(first[1], other[1])  # the seeds that are the same
    assert len({row.tobytes() for row in [*first, *other]}) == 4
    after = [(begun(seed), begun(None))[1] for seed in ([1, 2, 3], [1, 2, 3], 4)]
    np.testing.assert_array_equal(after[0], after[1])
    assert not np.array_equal(after[0], first) and not np.array_equal(*after[1:])
    for seed in ([1, 2], [[1, 2, 3]]):
        with pytest.raises(ValueError, match=r"^seed must be one number, or 3, one"):
            envs.reset(seed=seed)


@pytest.mark.parametrize("value", [8, -1, 50, 2.5, np.nan, None])
def test_an_action_out_of_range_is_refused_in_a_batch_too(value):
    envs = gymnasium.make_vec(NAME, num_envs=3, num_candidates=8)
    envs.reset(seed=0)
    actions = np.array([0, 7, 2 if value is None else value])
    if value is None:
        assert envs.step(actions)[1].shape == envs.step([1, 2, 3])[1].shape == (3,)
        return
    with pytest.raises(
        ValueError, match=rf"^actions must be .*\[0, 8\), got {value} .* 2$"
    ):
        envs.step(actions)


def test_a_step_before_the_first_reset_is_one_line():
    single = gymnasium.make(NAME).unwrapped
    vector = gymnasium.make_vec(NAME, num_envs=3)
    for early in (
        lambda: single.step(1), single.action_masks, lambda: vector.step([1, 2, 3]),
    ):  # fmt: skip
        with pytest.raises(gymnasium.error.ResetNeeded, match=r"^call reset before"):
            early()


def test_gymnasiums_checker_finds_nothing_in_one(recwarn):
    from gymnasium.utils.env_checker import check_env

    env = gymnasium.make("jaxcal/Postures-v0", num_candidates=8)
    check_env(env.unwrapped)
    assert not [w for w in recwarn if issubclass(w.category, UserWarning)]
    _, info = env.reset(seed=1)
    np.testing.assert_array_equal(env.unwrapped.action_masks(), info["action_mask"])
    env.step(3)
    assert list(np.flatnonzero(~env.unwrapped.action_masks())) == [3]
    with pytest.raises(ValueError, match=r"^action must be a whole number in \[0, 8\)"):
        env.unwrapped.step(8)


@pytest.mark.parametrize("mode", ["SameStep", "NextStep"])
def test_a_batch_behaves_as_gymnasiums_own_of_single_ones(mode):

    name = "jaxcal/Postures-v0"
    ours = gymnasium.make_vec(
        name, num_envs=3, vectorization_mode="vector_entry_point",
        num_candidates=8, autoreset_mode=mode,
    )  # fmt: skip
    theirs = gymnasium.make_vec(
        name, num_envs=3, vectorization_mode="sync", num_candidates=8,
        vector_kwargs={"autoreset_mode": mode},
    )  # fmt: skip
    both = ours, theirs
    assert len({str(envs.metadata["autoreset_mode"]) for envs in both}) == 1
    infos = [envs.reset(seed=0)[1] for envs in both]
    for _ in range(11):
        steps = []
        for envs, info in zip(both, infos, strict=True):
            steps.append(envs.step(info["action_mask"].argmax(axis=1)))
            assert steps[-1][0] in envs.observation_space
        for one, other in zip(*(step[:4] for step in steps), strict=True):
            assert (one.shape, one.dtype) == (other.shape, other.dtype)
        for part in (2, 3):
            np.testing.assert_array_equal(steps[0][part], steps[1][part])
        np.testing.assert_array_equal(steps[0][1] != 0, steps[1][1] != 0)
        infos = [step[4] for step in steps]
        assert infos[0].keys() >= infos[1].keys()
