"""Training by A, I and E: what is paid, what is looked ahead, what is chosen."""

from __future__ import annotations

import itertools
import json
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcal
from jaxcal.information.regression import log_worth
from jaxcal.learning.criteria import inverse_of, regressors, worth_of_inverse
from jaxcal.learning.environments.selection import SelectionConfig, start, step
from jaxcal.learning.environments.task import Task
from jaxcal.learning.policies.criterion import lookahead
from jaxcal.learning.policies.networks import NetworkConfig
from jaxcal.learning.training.config import TrainConfig

SETS = np.random.default_rng(0).uniform(size=(2, 12, 3))
OTHERS = ("A", "I", "E")


def covariance_size(criterion: str, candidates: np.ndarray, chosen) -> float:
    """Trace, mean over the candidates or largest eigenvalue of (Z.T Z)^-1."""
    z = np.column_stack([candidates, np.ones(len(candidates))])
    v = np.linalg.inv(z[chosen].T @ z[chosen])
    if criterion == "A":
        return float(np.trace(v))
    if criterion == "I":
        return float(np.mean([row @ v @ row for row in z]))
    return float(np.linalg.eigvalsh(v)[-1])


@pytest.mark.parametrize("criterion", OTHERS)
def test_the_worth_has_the_efficiencies_that_select_states(criterion: str) -> None:
    candidates = SETS[0]
    best = jaxcal.select(candidates, 5, "exact", criterion=criterion).indices
    some = np.array([[best, [0, 1, 2, 3, 4]]])
    worth = log_worth(criterion, candidates[None], some[0][None])[0]
    size = [covariance_size(criterion, candidates, few) for few in some[0]]
    assert np.exp((worth[1] - worth[0]) / 4) == pytest.approx(size[0] / size[1])


def test_a_policy_of_another_criterion_is_refused() -> None:
    with pytest.raises(ValueError, match="was trained for criterion D"):
        jaxcal.select(SETS[0], 4, "policy", criterion="A")


def test_a_configuration_has_one_criterion() -> None:
    by_a = (Task(SelectionConfig(criterion="A")),)
    with pytest.raises(ValueError, match=r"network.criterion must be A.*got D"):
        TrainConfig(tasks=by_a)
    with pytest.raises(ValueError, match="imitation must be 0 with criterion A"):
        TrainConfig(tasks=by_a, network=NetworkConfig(criterion="A"), imitation=0.5)
    with pytest.raises(ValueError, match="criterion must be D, A, I or E, got C"):
        NetworkConfig(criterion="C")


@pytest.mark.slow
@pytest.mark.parametrize("criterion", OTHERS)
def test_an_episode_is_paid_what_the_choice_is_worth(criterion: str) -> None:
    config = SelectionConfig(12, 5, criterion=criterion, reward_gain=True)
    free = np.arange(12) != 7
    for candidates in SETS:
        points = jnp.asarray(candidates, jnp.float32)
        state = start(points, jnp.asarray(free), config, jax.random.key(0))
        paid, chosen = 0.0, [2, 11, 5, 0, 9]
        for action in chosen:
            state, reward, done = step(state, jnp.int32(action), config)
            paid += float(reward)
        assert done
        rest = candidates[free]
        of_rest = [int(free[:action].sum()) for action in chosen]
        size = covariance_size(criterion, rest, of_rest)
        expected = -0.1 * 3 * 4 * np.log(size / (1 if criterion == "E" else 4))
        assert paid == pytest.approx(expected, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("criterion", OTHERS)
def test_many_candidates_are_looked_ahead_from_a_shortlist(
    criterion: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The 512 starts that alone are worth most have what they have among all."""
    points = np.random.default_rng(1).uniform(size=(1, 1100, 3))
    active = np.arange(1100)[None] % 7 != 3
    x, _ = regressors(criterion, jnp.asarray(points, jnp.float32), jnp.asarray(active))
    inverse = inverse_of(jnp.eye(4)[None] + x[:, :3].mT @ x[:, :3])

    def values() -> list[np.ndarray]:
        found = lookahead(criterion, x, inverse, jnp.asarray(active), 3)
        return [np.asarray(value)[0] for value in found]

    few = values()
    monkeypatch.setattr("jaxcal.learning.policies.criterion.ALL_START", 10**6)
    whole = values()
    starts = np.argsort(-whole[0], kind="stable")[:512]
    np.testing.assert_allclose(few[0], whole[0], rtol=1e-6)
    for some, every in zip(few[1:], whole[1:], strict=True):
        np.testing.assert_allclose(some[starts], every[starts], rtol=1e-4, atol=1e-4)
        assert (np.delete(some, starts) == -30.0).all()


@pytest.mark.slow
@pytest.mark.parametrize("criterion", OTHERS)
def test_the_lookahead_is_greedy_to_the_end(criterion: str) -> None:
    """Against greedy choices in float64, from every start."""
    active = np.arange(12) != 4
    x, _ = regressors(
        criterion, jnp.asarray(SETS, jnp.float32), jnp.ones((2, 12), bool)
    )
    held = np.array([1, 8, 10])
    gram = np.einsum("bki,bkj->bij", x[:, held], x[:, held]) + 0.01 * np.eye(4)
    ahead = lookahead(
        criterion, x, inverse_of(jnp.asarray(gram, jnp.float32)),
        jnp.asarray(np.broadcast_to(active, (2, 12))), 4,
    )  # fmt: skip

    def worth(gram: np.ndarray) -> float:
        values = 1.0 / np.linalg.eigvalsh(gram)
        return -4 * np.log(values[-1:].max() if criterion == "E" else values.mean())

    power = 2 if criterion == "E" else 1  # what greedy choices make least
    for b, first in itertools.product(range(2), np.flatnonzero(active)):
        rows, free = np.asarray(x[b], np.float64), set(np.flatnonzero(active))
        now, reached = gram[b], []
        choice = first
        for _ in range(4):
            free.discard(choice)
            now = now + np.outer(rows[choice], rows[choice])
            reached.append(
                worth(now) if criterion != "E"
                else -4 * np.log(1.0 / np.linalg.eigvalsh(now)[0])
            )  # fmt: skip
            choice = min(
                free,
                key=lambda i: (
                    np.linalg.eigvalsh(now + np.outer(rows[i], rows[i])) ** -power
                ).sum(),
            )
        start_worth = float(
            worth_of_inverse(criterion, inverse_of(jnp.asarray(gram[b])))
        )
        for number, values in zip((0, 1, 2, 3), ahead, strict=True):
            expected = reached[number] - start_worth
            assert float(values[b, first]) == pytest.approx(expected, abs=0.03)
    assert all(float(values[0, 4]) == -30.0 for values in ahead)


@pytest.mark.slow
@pytest.mark.trains
@pytest.mark.parametrize("criterion", OTHERS)
def test_a_short_training_is_above_greedy(
    criterion: str, tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The commands, from the training to the numbers and to ``select``."""
    from jaxcal.commands import evaluate, train

    run, out = str(tmp_path / "run"), tmp_path / "out.json"
    flags = ["--criterion", criterion, "--episodes", "8192", "--out", run]
    assert train.main(flags) == 0
    assert f"by criterion {criterion}, which" in capsys.readouterr().out
    flags = ["--checkpoint", run, "--episodes", "100", "--json", str(out), "--quiet"]
    assert evaluate.main(flags) == 0
    assert f"criterion {criterion}" in capsys.readouterr().out
    (result,) = json.loads(out.read_text())["results"]
    assert result["criterion"] == criterion and result["proven"] == 1.0
    reached = {m: n["efficiency"]["mean"] for m, n in result["methods"].items()}
    assert reached["random"] < 0.5 < reached["greedy"] < reached["policy"]
    assert reached["policy"] <= reached["policy:first"] <= reached["exact"] == 1.0

    sets = np.random.default_rng(5).uniform(size=(8, 50, 3))
    options = {"policy": {"checkpoint": run}, "greedy": {}}
    trained, greedy = (
        np.mean([
            jaxcal.select(rows, 4, method, criterion=criterion, **more).efficiency
            for rows in sets
        ])
        for method, more in options.items()
    )  # fmt: skip
    assert trained > greedy
    with pytest.raises(ValueError, match=f"was trained for criterion {criterion}"):
        jaxcal.select(sets[0], 4, "policy", checkpoint=run)
