"""The policy: begins as its rule, learns, and its runs and checkpoints."""

import dataclasses
import json
import sys
import textwrap

import jax
import numpy as np
import pytest

from jaxcal.adaptive.episodes import compare, play
from jaxcal.adaptive.policy import training
from jaxcal.adaptive.policy.config import PPO, PolicyConfig
from jaxcal.adaptive.policy.network import PolicyDecider, initial
from jaxcal.adaptive.rules import SHARES, Gain, Priced, StateRule
from jaxcal.adaptive.tasks import registry
from jaxcal.adaptive.tasks.knee import STATE_RULE, knee
from jaxcal.commands import evaluate as evaluate_command
from jaxcal.commands import train as train_command
from jaxcal.learning.core.ppo import make_train
from jaxcal.learning.runtime import weights
from jaxcal.learning.runtime.weights import CheckpointError
from jaxcal.learning.training import checkpoint

SMALL = {"cells": 4, "sigma": 0.05, "seconds": (5.0, 9.0)}
CONFIG = PolicyConfig(
    task="knee",
    base=STATE_RULE,
    options=SMALL,
    per_group=2,
    width=8,
    ppo=dataclasses.replace(
        PPO, num_updates=4, decisions_per_update=128, num_minibatches=2
    ),
)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    return folder, training.train(CONFIG, folder)


def leaves(state):
    return [np.asarray(x) for x in jax.tree.leaves(state)]


@pytest.mark.slow
@pytest.mark.parametrize("rule", [STATE_RULE, SHARES], ids=["state", "shares"])
def test_a_policy_begins_as_its_rule(rule):
    task = knee(**SMALL)
    keys = jax.random.split(jax.random.key(3), 32)
    policy = PolicyDecider(initial(jax.random.key(0), 2, 2, 8), rule, 2, 8)
    mine, rules = (play(task, decider, keys) for decider in (policy, rule))
    np.testing.assert_array_equal(
        mine.designs * mine.alive, rules.designs * rules.alive
    )


@pytest.mark.slow
def test_resume_equals_an_uninterrupted_run_bit_for_bit(finished, tmp_path):
    _, whole = finished
    training.train(CONFIG, tmp_path, num_updates=1)
    resumed = training.train(CONFIG, tmp_path, resume=True)
    for one, other in zip(leaves(whole), leaves(resumed), strict=True):
        np.testing.assert_array_equal(one, other)
    rows = (tmp_path / "metrics.csv").read_text().splitlines()
    assert rows[0] == (
        "update,decisions,seconds,reward_mean,choices,entropy,policy_loss,value_loss,"
        "kl,kl_after,clip_fraction,explained_variance,grad_norm,learning_rate,nats,"
        "nats_over_base"
    )
    assert len(rows) == 5


@pytest.mark.slow
def test_the_run_trains_what_the_pure_function_does_and_tasks_are_arguments(finished):
    _, state = finished
    train = jax.jit(make_train(CONFIG))
    pure, metrics = train(jax.random.key(0), training.exercise(CONFIG))
    for a, b in zip(leaves(pure.average), leaves(state.average), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)
    assert metrics["reward_mean"].shape == (4,)
    other = dataclasses.replace(CONFIG, options=SMALL | {"rho": 0.2})
    train(jax.random.key(1), training.exercise(other))
    assert train._cache_size() == 1


@pytest.mark.slow
def test_a_checkpoint_gives_back_the_policy_and_its_configuration(finished, tmp_path):
    folder, state = finished
    trained = training.load(folder)
    assert trained.meta["progress"]["updates"] == 4
    assert trained.config == CONFIG
    for one, other in zip(leaves(trained.params), leaves(state.average), strict=True):
        np.testing.assert_array_equal(one, other)
    weights.write(tmp_path / "alone.npz", trained.weights)
    alone = training.load(tmp_path / "alone.npz")
    assert alone.config == CONFIG
    for one, other in zip(leaves(trained.params), leaves(alone.params), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.slow
def test_checkpoints_of_another_kind_are_refused(finished):
    folder, _ = finished
    with pytest.raises(CheckpointError, match="must be jaxcal-sequential-policy"):
        training.load(weights.shipped("default"))
    with pytest.raises(CheckpointError, match="must be jaxcal-policy"):
        checkpoint.load(folder)


@pytest.mark.slow
def test_a_policy_mends_a_rule_that_ignores_trips(tmp_path):
    config = dataclasses.replace(
        CONFIG,
        base=Priced(0.1, 0.2, 0.0),
        per_group=3,
        ppo=dataclasses.replace(
            PPO, num_updates=60, decisions_per_update=1024, num_minibatches=4
        ),
    )
    training.train(config, tmp_path)
    deciders = {"rule": config.base, "policy": training.load(tmp_path).decider}
    mean, error = compare(knee(**SMALL), deciders, 2048, seed=7).paired(
        "policy", "rule"
    )
    assert mean > 5.0 * error


FILE = '''
import numpy as np
from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.tasks import Entry

def sides(sides=5, noise=0.1):
    """Which side of a die is heavy: one is weighed at a time."""
    hit = np.full((sides, sides), noise) + (1 - 2 * noise) * np.eye(sides)
    return GridTask.make(
        np.arange(sides), np.arange(sides), np.stack([1 - hit, hit], axis=1),
        travel=1.0, seconds=(2.0, 4.0), horizon=4,
    )

ENTRY = Entry(sides, about="a heavy side")
'''


@pytest.fixture
def own(tmp_path):
    path = tmp_path / "own.py"
    path.write_text(textwrap.dedent(FILE))
    return path


@pytest.mark.slow
def test_a_users_task_is_one_file(own):
    entry = registry.load(str(own))
    assert entry.about == "a heavy side"
    options = registry.options_from(entry, ["sides=3", "noise=0.2"])
    task = entry.make(**options)
    found = compare(task, {"gain": Gain(), "state": StateRule(0.1, 1.0, 1.0)}, 256)
    assert (found.gain > 0.0).all()


def test_a_users_file_imports_what_lies_beside_it(own):
    (own.parent / "beside_own.py").write_text("ABOUT = 'a heavy die'")
    own.write_text(
        "from beside_own import ABOUT\n" + FILE.replace('"a heavy side"', "ABOUT")
    )
    before = list(sys.path)
    assert registry.load(str(own)).about == "a heavy die"
    assert sys.path == before


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["sides"], "--with must be NAME=VALUE with NAME of sides, noise, got 'sides'"),
        (["size=3"], "got 'size=3'"),
        (["sides=x"], "--with sides must be a number, as 5, got 'x'"),
    ],
)
def test_bad_options_are_refused(own, given, message):
    with pytest.raises(ValueError, match=message):
        registry.options_from(registry.load(str(own)), given)


def test_tasks_that_are_not_there_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"task must be one of .*knee.*, got 'nee'"):
        registry.load("nee")
    with pytest.raises(ValueError, match=r"nowhere\.py does not exist"):
        registry.load(str(tmp_path / "nowhere.py"))
    (tmp_path / "empty.py").write_text("")
    with pytest.raises(ValueError, match="must define ENTRY"):
        registry.load(str(tmp_path / "empty.py"))
    (tmp_path / "fails.py").write_text("1 / 0")
    with pytest.raises(ValueError, match=r"fails\.py: ZeroDivisionError: division by"):
        registry.load(str(tmp_path / "fails.py"))


@pytest.mark.slow
def test_commands_train_resume_and_compare(tmp_path, capsys):
    small = ["--with", "cells=4", "sigma=0.05", "seconds=(5.0, 9.0)"]
    out = str(tmp_path / "run")
    flags = ["--with", "num_minibatches=2", "num_epochs=1", "--width", "8"]
    start = ["--task", "knee", "--out", out]
    assert (
        train_command.main([*start, *small, *flags, "--updates", "1"], "train.py") == 0
    )
    assert train_command.main([*start, "--updates", "2"], "train.py") == 2
    assert "already holds a run" in capsys.readouterr().err
    exported = str(tmp_path / "alone.npz")
    again = [*start, "--resume", "--export", exported]
    assert train_command.main(again, "train.py") == 0
    document = tmp_path / "out.json"
    report = tmp_path / "report"
    arguments = ["--task", "knee", *small, "--checkpoint", exported, "--episodes", "64"]
    arguments += ["--methods", "random,gain,state,policy", "--quiet"]
    arguments += ["--json", str(document), "--report", str(report)]
    assert evaluate_command.main(arguments, "evaluate.py") == 0
    shown = capsys.readouterr().out
    assert "policy" in shown and "less state, paired" in shown
    found = json.loads(document.read_text())
    assert found["format"] == "jaxcal-evaluation"
    methods = found["results"][0]["methods"]
    assert set(methods) == {"random", "gain", "state", "policy"}
    assert methods["policy"]["paired"]["state"]["mean"] == pytest.approx(
        methods["policy"]["nats"]["mean"] - methods["state"]["nats"]["mean"], abs=1e-9
    )
    assert (report / "index.html").is_file() and (report / "sequential.svg").is_file()


@pytest.mark.parametrize(
    ("task", "arguments", "message"),
    [
        ("knee", ["--seed", "3"], "takes its configuration from"),  # not another schema
        ("knee", ["--preset", "paper"], "--task knee does not use --preset"),
        ("gone.py", [], "does not exist. Give its file: --task FILE"),
        ("a/own.py", ["--task", "{}/other.py"], "--task must be a/own.py"),
        ("a/own.py", ["--task", "{}/own.py"], "it begins"),  # the file that moved
    ],
)
def test_a_run_knows_the_task_that_it_goes_on_with(
    task, arguments, message, tmp_path, capsys, monkeypatch
):
    meta = CONFIG.as_meta() | {"task": task, "num_seeds": 1}
    meta |= {"schema": training.SCHEMA, "version": checkpoint.VERSION}
    folder = tmp_path / "checkpoint" / "6" / "meta"
    folder.mkdir(parents=True)
    (folder / "metadata").write_text(json.dumps(meta))
    for name in ("own", "other"):
        text = "from jaxcal.adaptive.tasks.knee import ENTRY"
        (tmp_path / f"{name}.py").write_text(text)

    def began(config, *_):
        assert config.task == str(tmp_path / "own.py")
        raise ValueError("it begins")

    monkeypatch.setattr(train_command, "_train", began)
    given = [each.format(tmp_path) for each in arguments]
    again = ["--resume", "--out", str(tmp_path), *given]
    assert train_command.main(again, "train.py") == 2
    line = capsys.readouterr().err
    assert message in line and line.startswith("train.py: ") and line.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--task", "nee"], "task must be one of"),
        (["--task", "knee", "--methods", "best"], "methods must be of random"),
        (["--task", "knee", "--with", "cell=3"], "--with must be NAME=VALUE"),
        (["--task", "knee", "--checkpoint", "x", "--methods", "gain"], "not among"),
        (["--task", "knee", "--checkpoint", "nowhere"], "does not exist"),
    ],
)
def test_a_bad_evaluation_is_one_line(arguments, message, capsys):
    assert evaluate_command.main(arguments, "evaluate.py") == 2
    line = capsys.readouterr().err
    assert message in line and line.count("\n") == 1
