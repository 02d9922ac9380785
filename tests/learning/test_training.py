"""Training runs: resume, kills, damage, and what a checkpoint says of itself."""

from __future__ import annotations

import asyncio
import csv
import dataclasses
import functools
import json
import pathlib
import shutil
import signal
import subprocess
import sys
import textwrap
import time
import warnings

import jax
import numpy as np
import pytest

from jaxcal.commands import train as command
from jaxcal.commands import train_configuration
from jaxcal.learning.config import EpisodesConfig, NetworkConfig, named
from jaxcal.learning.core.network import build
from jaxcal.learning.environments.selection import SelectionConfig
from jaxcal.learning.environments.task import GivenCandidates, Task
from jaxcal.learning.policies.compact import CompactNetwork
from jaxcal.learning.runtime import weights
from jaxcal.learning.training import checkpoint, presets, run
from jaxcal.learning.training import postures as training
from jaxcal.learning.training.checkpoint import CheckpointError
from jaxcal.learning.training.postures import Validation
from jaxcal.learning.training.presets import TrainConfig
from jaxcal.learning.training.run import compiled_update
from jaxcal.selection.policy.by_checkpoint import load_policy

ROOT = pathlib.Path(__file__).parents[2]

CONFIG = TrainConfig(
    network=NetworkConfig(width=8, encoder_rounds=0),
    ppo=EpisodesConfig(
        num_episodes=64 * 6,
        episodes_per_update=64,
        episodes_per_set=4,
        num_minibatches=2,
        warmup_updates=1,
    ),
    seed=3,
    tasks=(Task(SelectionConfig(8, 3, 2, 2)),),
)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    return folder, training.train(CONFIG, folder)


def leaves(state):
    return [np.asarray(x) for x in jax.tree.leaves(state)]


def test_resume_equals_an_uninterrupted_run_bit_for_bit(finished, tmp_path):
    folder, whole = finished
    training.train(CONFIG, tmp_path, num_updates=2)
    training.train(CONFIG, tmp_path, resume=True, num_updates=3)
    resumed = training.train(CONFIG, tmp_path, resume=True)
    for one, other in zip(leaves(whole), leaves(resumed), strict=True):
        np.testing.assert_array_equal(one, other)

    def rows(path):
        with (path / "metrics.csv").open() as file:
            return [
                {k: v for k, v in row.items() if k != "seconds"}
                for row in csv.DictReader(file)
            ]

    assert rows(folder) == rows(tmp_path)
    assert len(rows(folder)) == 6
    np.testing.assert_array_equal(
        np.load(folder / "last_rewards.npy"), np.load(tmp_path / "last_rewards.npy")
    )


def test_updates_compile_once_and_change_every_weight(finished, tmp_path):
    (learner,) = CONFIG.learners
    assert compiled_update(CONFIG.ppo, learner, None, 0)._cache_size() == 1
    begun = training.train(CONFIG, tmp_path, num_updates=0).params
    moved = jax.tree.map(lambda a, b: (a != b).any(), begun, finished[1].params)
    # The value reads every part of the network, the policy all but the critic.
    assert all(jax.tree.leaves(moved))


def test_metrics_have_the_columns_that_figures_read(finished):
    folder, _ = finished
    header = (folder / "metrics.csv").read_text().splitlines()[0]
    assert header == (
        "update,episodes,seconds,reward_mean,reward_std,log_det_mean,entropy,"
        "policy_loss,value_loss,kl,kl_after,clip_fraction,explained_variance,grad_norm,"
        "learning_rate,ratio_to_exact,hit_rate"
    )


def test_rows_that_were_never_saved_are_dropped_on_resume(finished, tmp_path):
    folder, _ = finished
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    with (copy / "metrics.csv").open("a") as file:
        file.write("7,448,1.0,0.1\n8,51")
    training.train(CONFIG, copy, resume=True)
    assert len((copy / "metrics.csv").read_text().splitlines()) == 7


def test_a_checkpoint_names_its_configuration_seed_and_versions(finished):
    folder, state = finished
    policy = checkpoint.load(folder)
    assert policy.meta["seed"] == 3
    assert policy.meta["versions"]["jax"] == jax.__version__
    assert policy.meta["progress"]["episodes"] == 384
    assert TrainConfig.from_meta(policy.meta) == CONFIG
    for one, other in zip(
        jax.tree.leaves(policy.params), jax.tree.leaves(state.average), strict=True
    ):
        np.testing.assert_array_equal(one, other)


@pytest.mark.slow
def test_validation_of_the_optimum_itself_is_one():
    rng = np.random.default_rng(0)
    sets = rng.uniform(size=(6, 8, 2))

    from jaxcal.selection import exact_batch

    best = np.asarray(exact_batch(sets, 3, num_outputs=1).log_det)
    network = build(CONFIG.network)
    params = CONFIG.learners[0].init(jax.random.key(0))
    ratio, hits = Validation(sets, best, 3).measure(network, params, 3)
    assert 0.0 <= ratio <= 1.0 and 0.0 <= hits <= 1.0
    worse, none = Validation(sets, best + 1.0, 3).measure(network, params, 3)
    assert worse == pytest.approx(ratio * np.exp(-3.0), rel=1e-3) and none == 0.0


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda step: shutil.rmtree(step / "policy"), "weights are damaged"),
        (lambda step: (step / "meta" / "metadata").write_text("{"), "meta is damaged"),
        (lambda step: _edit(step, version=99), "version 99"),
        (lambda step: _edit(step, version=1), "version 1; this jaxcal reads version 2"),
        (lambda step: _edit(step, schema="other"), "not a jaxcal policy"),
        (
            lambda step: _edit(step, network={"kind": "compact", "size": 1}),
            "unknown network",
        ),
        (lambda step: _edit(step, network={"width": 16}), "do not fit the network"),
        (lambda step: shutil.rmtree(step), "holds no checkpoint"),
        (lambda step: _truncate(step), "damaged"),
    ],
)
def test_damage_is_told_in_one_error(finished, tmp_path, damage, says):
    folder, _ = finished
    shutil.copytree(folder / "checkpoint" / "6", tmp_path / "6")
    damage(tmp_path / "6")
    with pytest.raises(CheckpointError, match=says) as caught:
        checkpoint.load(tmp_path)
    assert str(tmp_path) in str(caught.value)
    assert "\n" not in str(caught.value)


def _edit(step: pathlib.Path, **values: object) -> None:
    path = step / "meta" / "metadata"
    path.write_text(json.dumps(json.loads(path.read_text()) | values))


def _truncate(step: pathlib.Path) -> None:
    data = [
        p for p in (step / "policy").rglob("*") if p.is_file() and p.parent.name == "d"
    ]
    assert data
    for path in data:
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.fixture(scope="module")
def brief(tmp_path_factory):
    """A run that was stopped after updates 2, 3 and 4 of 6."""
    folder = tmp_path_factory.mktemp("brief")
    for last in (2, 3, 4):
        training.train(CONFIG, folder, resume=last > 2, num_updates=last)
    return folder


@pytest.mark.parametrize(
    "damage",
    [
        None,
        lambda step: (step / "meta" / "metadata").write_text("{"),
        lambda step: shutil.rmtree(step / "meta"),
        lambda step: [shutil.rmtree(path) for path in step.iterdir() if path.is_dir()],
        lambda step: _truncate(step),
        lambda step: _exchange(step, "policy"),
    ],
)
def test_a_damaged_newest_step_is_put_aside(brief, finished, tmp_path, damage, capsys):
    """By --resume; evaluate reads the step before it, and says so."""
    copy = tmp_path / "copy"
    shutil.copytree(brief, copy)
    if damage is None:
        assert checkpoint.load(copy).meta["progress"]["updates"] == 4
    else:
        damage(copy / "checkpoint" / "4")
        with pytest.warns(UserWarning, match=r"4 cannot be read.*3 is read instead$"):
            assert checkpoint.load(copy).meta["progress"]["updates"] == 3
    line = ["--resume", "--out", str(copy), "--no-validation", "--episodes", "384"]
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        assert command.main(line) == 0, capsys.readouterr().err
    aside = [str(w.message) for w in warned if "damaged-4" in str(w.message)]
    assert len(aside) == (damage is not None)
    steps = {path.name for path in (copy / "checkpoint").iterdir()}
    assert ("damaged-4" in steps) == (damage is not None) and "6" in steps
    one, other = checkpoint.load(copy).params, checkpoint.load(finished[0]).params
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("step", ["3", "4"])
def test_a_step_that_is_named_is_the_one_that_chooses(brief, step):
    folder = brief / "checkpoint" / step
    arrays = checkpoint.load(folder).weights.arrays
    for name, used in load_policy(folder)._weights.items():
        np.testing.assert_array_equal(used, arrays[name])
    newest = load_policy(brief)._weights
    same = all(np.array_equal(newest[name], arrays[name]) for name in arrays)
    assert same == (step == "4")


def _exchange(step: pathlib.Path, part: str) -> None:
    """A part that reads well, but is of the step before."""
    shutil.rmtree(step / part)
    shutil.copytree(step.with_name(str(int(step.name) - 1)) / part, step / part)


@pytest.mark.parametrize("part", ["policy", "state"])
@pytest.mark.parametrize("summed", [True, False])
def test_other_arrays_than_were_saved_are_damage(brief, tmp_path, part, summed):
    steps = tmp_path / "checkpoint"
    shutil.copytree(brief / "checkpoint", steps)
    fresh = training.train(CONFIG, tmp_path / "fresh", num_updates=0)
    assert checkpoint.restore(tmp_path, fresh)[1]["progress"]["updates"] == 4
    _exchange(steps / "4", part)
    if not summed:  # as an earlier jaxcal saved it
        _edit(steps / "4", sha256={})
        assert checkpoint.restore(tmp_path, fresh)[1]["progress"]["updates"] == 4
        return
    if part == "policy":
        with pytest.raises(CheckpointError, match=r"damaged .*\(SHA-256 differs\)$"):
            checkpoint.load(steps / "4")
    else:
        checkpoint.load(steps / "4")  # without the state
    with pytest.warns(UserWarning, match=r"SHA-256 differs\); it is now damaged-4"):
        assert checkpoint.restore(tmp_path, fresh)[1]["progress"]["updates"] == 3


def test_sums_are_of_the_bits_that_are_read_again(tmp_path):
    trees = {"a": np.float32([-0.0, np.nan, 1e-42]), "b": {"c": np.zeros((2, 1))}}
    trees |= {"d": np.full((3, 2), -0.0, np.float32), "e": np.int32(-5)}
    checkpoint.save(tmp_path, 1, trees, {})
    meta = json.loads((tmp_path / "1" / "meta" / "metadata").read_text())
    again = checkpoint._read(tmp_path / "1" / "policy", meta, trees, "read")
    assert np.signbit(again["d"]).all()
    narrow = jax.tree.map(lambda x: np.asarray(x, np.float16), trees)
    checkpoint._read(tmp_path / "1" / "policy", meta, narrow, "read")  # other types


def test_results_that_arrive_after_a_failed_read_are_ignored():
    # Orbax closes its event loop while tensorstore still reads; without this, users
    # see "Event loop is closed" below the message about a damaged checkpoint.
    loop = checkpoint._TolerantPolicy().new_event_loop()
    loop.close()
    assert loop.call_soon_threadsafe(print) is None
    plain = asyncio.new_event_loop()
    plain.close()
    with pytest.raises(RuntimeError, match="Event loop is closed"):
        plain.call_soon_threadsafe(print)


def test_a_missing_folder_and_a_policy_without_state_are_told(finished, tmp_path):
    with pytest.raises(CheckpointError, match="does not exist"):
        checkpoint.load(tmp_path / "nowhere")
    policy = checkpoint.load(finished[0])
    checkpoint.save(tmp_path, 1, policy.params, CONFIG.as_meta())
    with pytest.raises(CheckpointError, match="no training state"):
        training.train(CONFIG, tmp_path, resume=True)


def test_a_full_disk_is_one_line(finished, tmp_path, monkeypatch):
    def full(*args, **kwargs):
        raise ValueError("RESOURCE_EXHAUSTED: Error writing: No space left on device")

    monkeypatch.setattr(checkpoint.ocp.CheckpointManager, "save", full)
    with pytest.raises(OSError, match=r"^\S+ cannot be written: the disk is full$"):
        checkpoint.save(tmp_path, 1, finished[1].average, CONFIG.as_meta())


def test_a_finished_run_is_prolonged(finished, tmp_path, capsys):
    copy = tmp_path / "copy"
    shutil.copytree(finished[0], copy)
    line = ["--resume", "--out", str(copy), "--no-validation", "--episodes"]
    assert command.main([*line, "383"]) == 2
    assert "--episodes must be at least 384, what the run already has, got 383" in (
        capsys.readouterr().err
    )
    assert command.main([*line, "384"]) == 0
    assert checkpoint.read_meta(copy)[1]["progress"]["updates"] == 6
    assert command.main([*line, "512"]) == 0
    _, meta = checkpoint.read_meta(copy)
    assert meta["progress"]["updates"] == 8 and meta["ppo"]["num_episodes"] == 512


def test_a_save_writes_nothing_twice(finished):
    """The averaged weights, the weights and Adam's two moments: four times as much."""
    folder, state = finished
    step = folder / "checkpoint" / "6"
    assert {path.name for path in step.iterdir() if path.is_dir()} == {
        *("policy", "state", "meta")
    }
    rows = dataclasses.replace(state, rollout_state=())  # and a key for each row
    held = sum(leaf.nbytes for leaf in jax.tree.leaves(rows))
    weights = sum(leaf.nbytes for leaf in jax.tree.leaves(state.average))
    assert held < 4 * weights + 100
    assert "average" not in (step / "state" / "_METADATA").read_text()


def test_exporting_writes_the_policy_to_one_file(finished, tmp_path):
    path = tmp_path / "policy.npz"
    for _ in range(2):  # the second replaces the first
        weights.write(path, checkpoint.load(finished[0]).weights)
    assert [p.name for p in tmp_path.iterdir()] == ["policy.npz"]
    one, other = checkpoint.load(finished[0]), checkpoint.load(path)
    assert one.weights.fingerprint == other.weights.fingerprint
    assert one.meta == other.meta
    for a, b in zip(
        jax.tree.leaves(one.params), jax.tree.leaves(other.params), strict=True
    ):
        np.testing.assert_array_equal(a, b)
    with pytest.raises(CheckpointError, match="no training state"):
        checkpoint.restore(path, finished[1])
    with pytest.raises(ValueError, match=r"one file NAME\.npz, got .*folder"):
        weights.write(tmp_path / "folder", one.weights)


def test_a_state_of_another_configuration_is_refused(finished, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(finished[0], copy)
    other = dataclasses.replace(
        CONFIG, network=NetworkConfig(width=16, encoder_rounds=0)
    )
    with pytest.raises(CheckpointError, match="cannot be resumed"):
        training.train(other, copy, resume=True)


@pytest.mark.parametrize(
    "pause", [0.05, *(pytest.param(s, marks=pytest.mark.slow) for s in (0.01, 0.11))]
)
def test_killed_save_leaves_the_previous_checkpoint(finished, tmp_path, pause):
    # Saves in a loop and is killed at a random moment; whatever step is newest loads.
    script = tmp_path / "save.py"
    script.write_text(
        textwrap.dedent(
            f"""
            import sys
            from jaxcal.learning.training import checkpoint
            policy = checkpoint.load({str(finished[0])!r})
            for step in range(1, 10_000):
                names = ("network", "tasks", "num_seeds")
                meta = {{k: policy.meta[k] for k in names}} | {{"step": step}}
                checkpoint.save(sys.argv[1], step, policy.params, meta)
                print(step, flush=True)
            """
        )
    )
    folder = tmp_path / "killed"
    process = subprocess.Popen(
        [sys.executable, script, folder],
        stdout=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    )
    for _ in range(2):
        seen = int(process.stdout.readline())
    time.sleep(pause)
    process.send_signal(signal.SIGKILL)
    rest = process.stdout.read().split()
    process.wait()
    last = int(rest[-1]) if rest else seen
    assert checkpoint.load(folder).meta["step"] in (last, last + 1)


@pytest.mark.parametrize("preset", presets.names())
def test_presets_survive_their_own_metadata(preset):
    config = presets.load(preset)
    meta = json.loads(json.dumps(config.as_meta()))
    again = TrainConfig.from_meta(meta)
    own = {"about": config.about, "validate_every": again.validate_every}
    assert dataclasses.replace(again, **own) == dataclasses.replace(config, **own)


def test_the_policy_that_ships_says_how_it_was_trained():
    """By a jaxlib that the requirements allow, and in a configuration that reads."""
    _, meta = checkpoint.read_meta(None)
    held, general = TrainConfig.from_meta(meta), presets.load("general")
    assert dataclasses.replace(held, about=general.about) == general
    assert meta["progress"]["updates"] == general.ppo.num_updates
    assert meta["versions"]["jaxlib"] != "0.10.2"


class Farthest(Task):
    """A task of one's own: it pays the last choice's first number."""

    def step(self, state, action):
        after, _, done = super().step(state, action)
        return after, state.candidates[action, 0], done


class Own(CompactNetwork):
    """A network of one's own."""


def test_a_task_and_a_network_of_ones_own_are_in_the_checkpoint(tmp_path):
    task = Farthest(SelectionConfig(8, 3, 2, 2))
    network = dataclasses.replace(CONFIG.network, kind=Own)
    config = dataclasses.replace(CONFIG, tasks=(task,), network=network)
    shapes = jax.eval_shape(config.learners[0].init, jax.random.key(0))
    params = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes)
    checkpoint.save(tmp_path, 1, params, config.as_meta())
    _, meta = checkpoint.read_meta(tmp_path)
    again = TrainConfig.from_meta(meta)
    assert again == config and type(again.tasks[0]) is Farthest
    assert isinstance(checkpoint.load(tmp_path).network, Own)
    with pytest.raises(
        ValueError, match=r"nowhere:Net must name an existing MODULE:NAME"
    ):
        build(NetworkConfig(kind="nowhere:Net"))
    with pytest.raises(ValueError, match="kind must be a Network"):
        build(NetworkConfig(kind="json:JSONDecoder"))


def test_a_network_and_a_task_may_be_in_a_file(tmp_path):
    """Named by ``file.py:Name``, on the command line and in a checkpoint."""
    file = tmp_path / "mine.py"
    file.write_text(
        "import dataclasses\n"
        "from jaxcal.learning import Task\n"
        "from jaxcal.learning.policies.compact import CompactNetwork\n"
        "class Net(CompactNetwork):\n    extra: int = 5\n"
        "@dataclasses.dataclass(frozen=True)\nclass Own(Task):\n"
        "    price: float = 2.0\n"
    )
    options = train_configuration.read("train.py", ["--kind", f"{file}:Net"])
    config = presets.with_values(CONFIG, options.values)
    assert build(config.network).extra == 5
    own = named(f"{file}:Own")(SelectionConfig(8, 3, 2, 2), price=3.0)
    assert Task.from_meta(json.loads(json.dumps(own.as_meta()))) == own
    with pytest.raises(
        ValueError, match=r"mine.py:Nat must name an existing .*FILE.py:NAME"
    ):
        build(NetworkConfig(kind=f"{file}:Nat"))


def test_the_paper_preset_is_table_2():
    paper = presets.load("paper")
    assert paper.ppo.episodes_per_update == 16
    assert paper.ppo.num_epochs == 10
    assert paper.ppo.num_episodes == 200_000
    assert paper.tasks[0].environment == SelectionConfig(50, 4, 3, 3, 0.1)
    assert (paper.network.kind, paper.network.width) == ("paper", 768)


def test_single_values_change_and_unknown_ones_are_named():
    config = presets.with_values(
        presets.load("compact"), {"num_candidates": 20, "width": 16, "seed": 5}
    )
    assert config.tasks[0].environment.num_candidates == 20
    assert (config.network.width, config.seed) == (16, 5)
    with pytest.raises(ValueError, match="wings"):
        presets.with_values(config, {"wings": 2})


def test_more_postures_than_parameters_are_paid_what_they_are_judged_by():
    compact = presets.load("compact")
    assert not compact.tasks[0].environment.reward_gain
    eight = presets.with_values(compact, {"num_selected": 8})
    assert eight.tasks[0].environment.reward_gain
    asked = {"num_selected": 8, "reward_gain": False}  # the paper's own rule
    assert not presets.with_values(compact, asked).tasks[0].environment.reward_gain
    four = presets.with_values(eight, {"num_selected": 4})
    assert not four.tasks[0].environment.reward_gain
    for config in map(presets.load, presets.names()):
        for task in config.tasks:
            env = task.environment
            assert env.reward_gain == (env.num_selected > env.num_inputs + 1)


def test_a_field_in_which_the_tasks_differ_is_not_changed_in_one_of_them():
    general = presets.load("general")
    with pytest.raises(ValueError, match=r"num_selected cannot .* 12 tasks have 3, 4"):
        presets.with_values(general, {"num_selected": 6})
    scaled = presets.with_values(general, {"reward_scale": 0.5})
    assert {task.environment.reward_scale for task in scaled.tasks} == {0.5}
    assert len(scaled.tasks) == 12


def test_an_unknown_network_or_preset_is_named():
    with pytest.raises(ValueError, match="preset must be one of compact, general, obs"):
        presets.load("large")
    with pytest.raises(ValueError, match=r"kind must be one of compact, .*, got 'big'"):
        NetworkConfig(kind="big")


def test_learning_finds_the_papers_network_without_importing_the_paper():
    code = (
        "import sys\n"
        "from jaxcal.learning.core.network import build\n"
        "from jaxcal.learning.training import presets\n"
        "assert not any(name.startswith('jaxcal.paper') for name in sys.modules)\n"
        "print(type(build(presets.load('paper').network)).__module__)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout == "jaxcal.paper.network\n", done.stderr


# The update that these flags compile is CONFIG's.
SHORT = (
    "--with episodes_per_update=64 episodes_per_set=4 num_minibatches=2 "
    "warmup_updates=1 encoder_rounds=0 close_up=false "
    "--episodes=384 --width=8 --num-candidates=8 --seed=3"
).split()
SMALL = [*SHORT, "--num-inputs=2", "--with=num_outputs=2", "--num-selected=3"]


def train(*arguments):
    """The command in this process; argparse leaves by SystemExit."""
    try:
        return command.main([str(argument) for argument in arguments], "train.py")
    except SystemExit as leaving:
        return leaving.code


@pytest.fixture(autouse=True)
def signals():
    """Who calls the command from Python keeps his handlers."""
    before = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)}
    yield
    assert before == {n: signal.getsignal(n) for n in before}


def test_train_command_trains_saves_and_refuses_to_overwrite(tmp_path, capsys):
    out = tmp_path / "run"
    exported = tmp_path / "policy.npz"
    assert train("--out", out, "--export", exported, *SMALL) == 0
    said = capsys.readouterr().out
    assert "ratio to exact" in said and "saved" in said
    assert checkpoint.load(out).meta["progress"]["updates"] == 6
    assert checkpoint.load(exported).meta["progress"]["updates"] == 6
    assert train("--out", out, *SMALL) == 2
    error = capsys.readouterr().err
    assert error.startswith("train.py: --out") and "--resume" in error
    assert train("--out", out, "--resume", "--seed", "4") == 2
    assert "--seed" in capsys.readouterr().err
    assert train("--out", out, "--resume", "--no-validation") == 0


def test_flags_of_0_2_that_are_settings_now_still_work(capsys):
    from jaxcal.commands import train_configuration as configuration

    words = ["--lookahead=2", "--no-close-up", "--mirrored", "--num-epochs", "3"]
    options = configuration.read("train.py", ["--with", "gae_lambda=0.9", *words])
    flags, others = configuration.given_settings(options, None)
    assert others == []
    assert flags == {
        "gae_lambda": 0.9, "lookahead": 2, "close_up": False, "mirrored": True,
        "num_epochs": 3,
    }  # fmt: skip
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == (
        "train.py: --lookahead is --with lookahead=2 since jaxcal 0.3; the old name "
        "goes with 0.4"
    )
    assert len(lines) == 4


def test_an_option_of_a_task_goes_before_a_setting():
    from jaxcal.commands import train_configuration as configuration

    words = ["--task", "knee", "--with", "clip_range=0.1", "num_epochs=3", "sigma=1"]
    options = configuration.read("train.py", words)
    flags, others = configuration.given_settings(options, {"num_epochs", "sigma"})
    assert flags == {"clip_range": 0.1}
    assert others == ["num_epochs=3", "sigma=1"]


BRAX = ["--trainer", "brax"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--episodes", "0"], "num_episodes must be at least 1"),
        (["--num-selected", "3"], "num_selected must be in"),
        (["--seed", "one"], "--seed: must be a whole number, got 'one'"),
        (["--resume"], "does not exist"),
        (["--out", "/proc/nowhere/run"], "cannot write in /proc"),
        (["--kind", "big"], "must be one of compact, observation, paper, got 'big'"),
        ([*BRAX, "--with", "num_epochs=3"], "does not use --with num_epochs: leave it"),
        (
            ["--with", "num_epoch=3"],
            "did you mean --with num_epochs",
        ),
        (["--with", "episode=3"], "got 'episode=3'; did you mean --episodes?"),
        (["--with", "lookahead"], "must be NAME=VALUE with a NAME"),
        (["--with", "lookahead=a"], "--with lookahead must be a whole number, got 'a'"),
        (["--with", "close_up=2"], "--with close_up must be true or false, got '2'"),
        (["--task", "knee", "--with", "mirrored=true"], "not use --with mirrored"),
        ([*BRAX, "--devices", "2", "--kind=paper"], "not use --devices, --kind"),
        ([*BRAX, "--preset", "general"], "trains on one task, preset general has 12"),
        ([*BRAX, "--resume", "--seeds=2"], "does not use --resume, --seeds"),
        (["--candidates", "nowhere.csv"], "nowhere.csv"),
        (["--export", "folder"], "--export takes a file NAME.npz, got folder"),
        (["--num-selected=2", "--num-inputs=1"], "num_selected must be at least 3"),
        (["--seeds", "2", "--no-validation"], "--seeds compares runs by validation"),
        (["--updates", "2"], "preset compact does not use --updates"),
        (["--task", "knee", "--episodes", "9"], "knee does not use --episodes"),
        (["--task", "nee"], "task must be one of"),
    ],
)
def test_train_command_refuses_in_one_line(arguments, says, tmp_path, capsys):
    if "--out" not in arguments:
        arguments = [*arguments, "--out", str(tmp_path / "none")]
    assert train(*arguments) == 2
    error = capsys.readouterr().err
    assert says in error and error.count("\n") == 1
    assert not (tmp_path / "none" / "checkpoint").exists()


def test_brax_saves_what_it_used_and_keeps_what_is_asked_for():
    brax_ppo = pytest.importorskip("jaxcal.learning.training.brax_ppo")
    adapted = brax_ppo.adapted(presets.load("compact"))
    assert (adapted.network.kind, adapted.network.width) == ("paper", 64)
    assert adapted.ppo.learning_rate == 1e-3
    assert adapted.ppo.num_episodes == 200_000
    asked = presets.with_values(adapted, {"learning_rate": 2e-3, "width": 32})
    assert (asked.ppo.learning_rate, asked.network.width) == (2e-3, 32)
    assert brax_ppo.adapted(presets.load("paper")).network.width == 768


def test_help_says_what_every_number_is(capsys):
    assert train("--help", "all") == 0
    text = capsys.readouterr().out
    parts = map(presets.settings_of, presets.PARTS.values())
    names = {field.name for fields in parts for field in fields}
    for name in names - {"num_episodes", "num_seeds"}:
        assert f"--{name.replace('_', '-')} " in text or f"\n  {name} " in text
    assert "what to try first" in text
    assert "passes over the decisions of an update [2]" in " ".join(text.split())
    for name in presets.names():
        assert f"\n  {name} " in text


@pytest.mark.slow
def test_one_trains_on_ones_own_pool_and_resumes_with_it(tmp_path, rng, capsys):
    pool = tmp_path / "mine.csv"
    rows = 1e4 * rng.uniform(size=(20, 2)) + 5e4  # pulses
    lines = ["pitch,yaw", *(f"{a:.3f},{b:.3f}" for a, b in rows)]
    pool.write_text("\n".join(lines) + "\n")
    out = tmp_path / "run"
    assert train("--candidates", pool, "--out", out, *SHORT) == 0
    assert "choose 3 of 8 from mine.csv" in capsys.readouterr().out
    meta = checkpoint.load(out).meta
    assert meta["tasks"][0]["given"]["name"] == "mine.csv"
    assert meta["tasks"][0]["environment"]["num_inputs"] == 2
    assert train("--resume", "--out", out) == 2
    assert "trained on mine.csv" in capsys.readouterr().err
    assert train("--resume", "--out", out, "--candidates", pool) == 0
    pool.write_text("\n".join(lines[:-1]) + "\n")
    assert train("--resume", "--out", out, "--candidates", pool) == 2
    assert "give the same file" in capsys.readouterr().err
    assert train("--candidates", pool, "--out", tmp_path / "b") == 2
    assert "num_candidates = 50 available candidates" in capsys.readouterr().err


def test_two_pools_differ_where_their_digest_is_not_given(rng):
    one, two = (
        GivenCandidates("mine", rng.uniform(size=(1, 60, 3)).astype(np.float32))
        for _ in range(2)
    )
    assert one != two and one == GivenCandidates("other name", one.values.copy())
    tasks = [Task(given=pool) for pool in (one, two)]
    sets = [np.asarray(drawn(task, jax.random.key(0))) for task in tasks]
    for pool, found in zip((one, two), sets, strict=True):
        assert {*map(tuple, found)} <= {*map(tuple, pool.values[0])}
    with pytest.raises(ValueError, match="values or sha256, got neither"):
        GivenCandidates("mine")


@functools.partial(jax.jit, static_argnums=0)
def drawn(task, key):
    return task.reset(key).candidates


def test_ones_own_sets_are_drawn_as_they_are(tmp_path, rng, key):
    sets, free = rng.uniform(-30, 30, size=(5, 7, 2)), rng.random((5, 7)) < 0.8
    free[:, :4] = True
    np.savez(tmp_path / "sets.npz", candidates=sets, available=free)
    given = train_configuration.candidates_of(str(tmp_path / "sets.npz"))
    low, high = sets[free].min(0), sets[free].max(0)
    np.testing.assert_allclose(given.values, (sets - low) / (high - low), rtol=1e-5)
    config = train_configuration.trained_on(presets.load("compact"), given, {})
    task = config.tasks[0]
    assert (task.environment.num_candidates, task.num_decisions) == (7, 3)
    states = jax.vmap(task.reset)(jax.random.split(key, 40))
    seen = set()
    for points, mask in zip(states.candidates, states.available, strict=True):
        which = int(np.argmin(abs(given.values - np.asarray(points)).sum((1, 2))))
        np.testing.assert_array_equal(points, given.values[which])
        np.testing.assert_array_equal(mask, free[which])
        seen.add(which)
    assert len(seen) == 5
    with pytest.raises(ValueError, match="--num-candidates must be 7, as in"):
        train_configuration.trained_on(
            presets.load("compact"), given, {"num_candidates": 9}
        )
    with pytest.raises(ValueError, match="one task"):
        train_configuration.trained_on(presets.load("general"), given, {})


def test_ctrl_c_saves_and_resume_goes_on(tmp_path, capsys, monkeypatch):
    out = tmp_path / "run"
    monkeypatch.setattr(command, "_show", lambda *_: signal.raise_signal(signal.SIGINT))
    assert train("--out", out, "--no-validation", *SMALL) == 0
    assert "stopped at update 1 of 6 and saved. To continue" in capsys.readouterr().out
    assert checkpoint.load(out).meta["progress"]["updates"] == 1
    assert len((out / "metrics.csv").read_text().splitlines()) - 1 == 1
    monkeypatch.undo()
    assert train("--out", out, "--resume", "--no-validation") == 0
    assert checkpoint.load(out).meta["progress"]["updates"] == 6


def test_an_update_is_compiled_by_options_that_change_only_rounding(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_backend_optimization_level=0")
    assert run._compiler_options() == {}
    monkeypatch.delenv("XLA_FLAGS")
    options = run._compiler_options()
    assert options == {"xla_backend_optimization_level": 2}
    passed: dict = {}
    with monkeypatch.context() as patch:
        patch.setattr(jax, "jit", lambda function, **rest: passed.update(rest))
        compiled_update.__wrapped__(CONFIG.ppo, CONFIG.learners[0])
    assert passed["compiler_options"] == options

    def sums(x: jax.Array) -> jax.Array:
        return (x - x.mean(-1, keepdims=True)) @ x.T / (x * x).sum()

    rows = np.random.default_rng(0).normal(size=(3, 5000)).astype(np.float32)
    exact = sums(rows.astype(np.float64))
    for chosen in ({}, options):
        found = jax.jit(sums, compiler_options=chosen)(rows)
        np.testing.assert_allclose(found, exact, atol=1e-6)


@pytest.mark.slow
def test_several_seeds_are_one_program_and_the_best_is_exported(tmp_path, capsys):
    out, exported = tmp_path / "run", tmp_path / "best.npz"
    seeds = ("--seeds", 3, "--devices", 1)  # an earlier test may have made two devices
    assert train("--out", out, *seeds, "--export", exported, *SMALL) == 0
    said = capsys.readouterr().out
    assert "+-" in said and "spread" in said and said.count("  best\n") == 1
    meta = checkpoint.read_meta(out)[1]
    reached = [each["ratio_to_exact"] for each in meta["progress"]["seeds"]]
    assert len(reached) == 3 and meta["progress"]["best"] == int(np.argmax(reached))
    # Each is what the command trains with that seed alone.
    best = checkpoint.load(exported)
    assert checkpoint.load(out).weights.fingerprint == best.weights.fingerprint
    seed = f"--seed={3 + meta['progress']['best']}"
    alone = [*(flag for flag in SMALL if "--seed" not in flag), seed]
    assert train("--out", tmp_path / "one", "--no-validation", *alone) == 0
    one = checkpoint.load(tmp_path / "one")
    for a, b in zip(
        jax.tree.leaves(one.params), jax.tree.leaves(best.params), strict=True
    ):
        np.testing.assert_allclose(a, b, atol=1e-5)
