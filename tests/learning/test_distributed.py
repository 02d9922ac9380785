"""Jobs of several real processes over loopback: together, and when one is killed."""

from __future__ import annotations

import argparse
import csv
import os
import pathlib
import shutil
import signal
import socket
import subprocess
import sys

import jaxlib
import numpy as np
import pytest

from jaxcal.learning.runtime import processes
from jaxcal.learning.training import checkpoint

ROOT = pathlib.Path(__file__).parents[2]
# Newer versions give NaN without their optimiser.
QUICK = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
QUICK *= jaxlib.__version__.startswith("0.10.")
TINY = (
    "--with episodes_per_update=64 episodes_per_set=4 num_minibatches=2 "
    "encoder_rounds=1 num_outputs=1 --width=8 --num-candidates=6 --num-selected=3 "
    "--num-inputs=1 --seed=3"
).split()
# At the preset's learning rate so small a run is chaotic: a difference in the last
# place grows some fivefold an update, and in the end another posture is drawn.
CALM = "--learning-rate=2e-5 --with final_learning_rate=2e-5".split()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def environment(**more: str) -> dict[str, str]:
    plain = {k: v for k, v in os.environ.items() if not k.lower().endswith("_proxy")}
    return plain | {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": QUICK} | more


def start(
    command: list[object], number: int, flags: bool = True
) -> list[subprocess.Popen[str]]:
    """So many processes of one job."""
    port = free_port()
    found = []
    for process in range(number):
        job: list[object] = []
        if flags:
            job = ["--coordinator", f"127.0.0.1:{port}", "--num-processes", number]
            job += ["--process-id", process]
        slurm = {
            "SLURM_JOB_ID": str(port),
            "SLURM_STEP_NODELIST": "localhost",
            "SLURM_NTASKS": str(number),
            "SLURM_PROCID": str(process),
            "SLURM_LOCALID": str(process),
        }
        found.append(
            subprocess.Popen(
                [sys.executable, *map(str, [*command, *job])],
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                cwd=ROOT,
                env=environment(**({} if flags else slurm)),
            )
        )
    return found


def finish(job: list[subprocess.Popen[str]]) -> list[tuple[int, str, str]]:
    """Exit code, output less that of JAX's transport, and errors of each."""
    results = []
    for process in job:
        output, errors = process.communicate(timeout=900)
        said = [line for line in output.splitlines() if "[Gloo]" not in line]
        results.append((process.returncode, "\n".join(said), errors))
    return results


def curve(folder: pathlib.Path) -> np.ndarray:
    """(updates, 4) rewards and losses."""
    names = ("reward_mean", "policy_loss", "value_loss", "kl")
    with (folder / "metrics.csv").open() as file:
        return np.array(
            [[float(row[n]) for n in names] for row in csv.DictReader(file)]
        )


def updates(folder: pathlib.Path) -> int:
    """Made by the run in a folder."""
    return int(checkpoint.load(folder).meta["progress"]["updates"])


WORK = """
import sys
import jax, numpy as np
from jaxcal.learning.core import ppo
from jaxcal.learning.runtime import devices, processes

def work():
    own = jax.process_index()
    assert jax.process_count() == 2
    some = jax.numpy.arange(3) + own
    given = devices.on_first(lambda: {"own": own, "some": some, "text": "the first"})
    assert given["own"] == 0 and given["text"] == "the first"
    assert given["some"].tolist() == [0, 1, 2]
    assert devices.any_process(own == 1) and not devices.any_process(False)
    mesh = devices.make_mesh(8)
    tree = devices.replicate({"x": np.arange(8.0, dtype=np.float32)}, mesh)
    total = jax.jit(lambda tree: ppo.placed(tree, mesh, "sets")["x"].sum())(tree)
    assert float(total) == 28.0 and len(devices.local(tree)["x"].devices()) == 1
    def fail():
        raise ValueError(f"only process {own} looked")
    try:
        devices.on_first(fail)
    except ValueError as error:
        print(f"both know: {error}")
    return 5

sys.exit(processes.run_job("job.py", None, work, "start again"))
"""


def test_two_processes_share_results_errors_and_sums(tmp_path: pathlib.Path) -> None:
    script = tmp_path / "job.py"
    script.write_text(WORK)
    for code, output, errors in finish(start([script], 2)):
        assert code == 5, errors
        assert output == "both know: only process 0 looked" and errors == ""


WAIT = """
import sys, time
from jaxcal.learning.runtime import devices, processes

def work():
    for turn in range(2000):
        devices.any_process(False)
        if turn == 5:
            print("going", flush=True)
        time.sleep(0.05)
    return 0

sys.exit(processes.run_job("job.py", None, work, "start every process again"))
"""


@pytest.mark.slow
@pytest.mark.parametrize("victim", [0, 1])
def test_a_killed_process_ends_the_other(tmp_path: pathlib.Path, victim: int) -> None:
    script = tmp_path / "job.py"
    script.write_text(WAIT)
    job = start([script], 2)
    for process in job:
        assert process.stdout is not None
        assert any("going" in line for line in process.stdout)
    job[victim].kill()
    other, _, errors = finish(job)[1 - victim]
    # With one line where a collective fails first, else by JAX's own watch.
    assert other in (processes.EXIT_LOST, -signal.SIGABRT)
    if other == processes.EXIT_LOST:
        assert errors.splitlines()[-1].endswith("; start every process again")


def arguments(**values: object) -> argparse.Namespace:
    empty = {"coordinator": None, "num_processes": None, "process_id": None}
    return argparse.Namespace(**(empty | values))


def test_a_job_is_recognised_by_flags_or_by_its_launcher() -> None:
    host = {"coordinator": "node1:4711", "num_processes": 2, "process_id": 1}
    assert processes.expected(arguments(**host), {})
    assert not processes.expected(arguments(), {})
    task = {"SLURM_NTASKS": "4", "SLURM_STEP_NODELIST": "node[1-4]"}
    assert processes.expected(arguments(), task)
    # A batch script without srun, a job step of one task, a user who says one.
    assert not processes.expected(arguments(), {"SLURM_NTASKS": "4"})
    assert not processes.expected(arguments(), task | {"SLURM_NTASKS": "1"})
    assert not processes.expected(arguments(num_processes=1), task)
    assert processes.expected(arguments(), {"OMPI_COMM_WORLD_SIZE": "2"})
    assert processes.expected(arguments(), {"TPU_WORKER_HOSTNAMES": "a,b"})
    assert not processes.expected(arguments(), {"TPU_WORKER_HOSTNAMES": "a"})


ALL = ["--num-processes", "2", "--process-id", "1", "--coordinator", "a:1"]


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        (
            [*ALL, "--num-processes", "0"],
            "--num-processes: must be a whole number",
        ),
        ([*ALL, "--process-id", "2"], "--process-id must be in [0, 2), got 2"),
        ([*ALL, "--coordinator", "n1"], "--coordinator must be HOST:PORT, got 'n1'"),
        (["--process-id", "0"], "--num-processes and --process-id must come together"),
        (["--num-processes", "2"], "--coordinator, --num-processes and --process-id"),
        (["--process-id", "x"], "--process-id: must be a whole number"),
    ],
)
@pytest.mark.parametrize("command", ["train.py"])
def test_an_incomplete_job_is_refused_in_one_line(
    command: str, flags: list[str], says: str
) -> None:
    done = subprocess.run(
        [sys.executable, command, *flags],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env=environment(),
    )
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
    assert done.stderr.startswith(f"{command}: ") and says in done.stderr


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    """The loss curve of one process: eight updates."""
    out = tmp_path_factory.mktemp("alone") / "run"
    command = [ROOT / "train.py", *TINY, *CALM, "--episodes=512", "--no-validation"]
    ((code, _, errors),) = finish(start([*command, "--out", out], 1))
    assert code == 0, errors
    found = curve(out)
    assert found.shape == (8, 4) and np.isfinite(found).all()
    return found


@pytest.mark.slow
@pytest.mark.parametrize(("number", "flags"), [(2, False), (4, True)])
def test_several_processes_have_the_loss_curve_of_one(
    tmp_path: pathlib.Path, alone: np.ndarray, number: int, flags: bool
) -> None:
    command = [ROOT / "train.py", *TINY, *CALM, "--episodes=512", "--no-validation"]
    several = finish(start([*command, "--out", tmp_path / "some"], number, flags))
    assert [code for code, _, _ in several] == [0] * number, several[0][2]
    np.testing.assert_allclose(curve(tmp_path / "some"), alone, atol=5e-5, rtol=1e-4)
    assert "saved" in several[0][1] and f"in {number} processes" in several[0][1]
    assert [output for _, output, _ in several[1:]] == [""] * (number - 1)
    assert updates(tmp_path / "some") == 8


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """A run of two processes that SIGTERM to one of them stopped: both save and end."""
    out = tmp_path_factory.mktemp("stopped") / "run"
    command = [ROOT / "train.py", *TINY, "--no-validation", "--out", out]
    job = start([*command, "--episodes=6400000"], 2)
    wait_for_update(job[0])
    job[1].send_signal(signal.SIGTERM)
    results = finish(job)
    assert [code for code, _, _ in results] == [0] * 2, results[0][2]
    return out


@pytest.mark.slow
@pytest.mark.parametrize("victim", [0, 1])
def test_a_killed_process_ends_the_job_and_leaves_what_was_saved(
    tmp_path: pathlib.Path, stopped: pathlib.Path, victim: int
) -> None:
    out, saved = tmp_path / "run", updates(stopped)
    shutil.copytree(stopped, out)
    job = start([ROOT / "train.py", "--resume", "--no-validation", "--out", out], 2)
    wait_for_update(job[0])
    job[victim].kill()
    results = finish(job)
    # A collective that fails ends a process with one line, JAX's own watch with a
    # signal, whichever is first.
    for number, (code, _, errors) in enumerate(results):
        if number == victim:
            assert code == -signal.SIGKILL
        else:
            assert code in (processes.EXIT_LOST, -signal.SIGABRT)
            assert code != processes.EXIT_LOST or "--resume" in errors
    assert updates(out) >= saved


@pytest.mark.slow
def test_a_run_goes_on_with_another_number_of_processes(
    tmp_path: pathlib.Path, alone: np.ndarray
) -> None:
    script = tmp_path / "part.py"
    script.write_text(PART)
    for number, last in ((2, 4), (1, 8)):
        results = finish(start([script, tmp_path / "run", last], number))
        assert [code for code, _, _ in results] == [0] * number, results[0][2]
        assert updates(tmp_path / "run") == last
    np.testing.assert_allclose(curve(tmp_path / "run"), alone, atol=5e-5, rtol=1e-4)


PART = """
import pathlib, sys
from jaxcal.learning.runtime import devices, processes
from jaxcal.learning.config import EpisodesConfig
from jaxcal.learning.training import postures as training
from jaxcal.learning.environments.selection import SelectionConfig
from jaxcal.learning.config import NetworkConfig
from jaxcal.learning.environments.task import Task
from jaxcal.learning.training.presets import TrainConfig

CONFIG = TrainConfig(
    network=NetworkConfig(width=8, encoder_rounds=1, close_up=True),
    ppo=EpisodesConfig(
        num_episodes=64 * 8, episodes_per_update=64, episodes_per_set=4,
        num_minibatches=2, learning_rate=2e-5, final_learning_rate=2e-5,
    ),
    seed=3,
    tasks=(Task(SelectionConfig(6, 3, 1, 1, reward_gain=True)),),  # as the flags
)

def work():
    folder, last = pathlib.Path(sys.argv[1]), int(sys.argv[2])
    held = devices.on_first(folder.exists)
    training.train(CONFIG, folder, resume=held, num_updates=last)
    return 0

sys.exit(processes.run_job("part.py", None, work, "start again"))
"""


def wait_for_update(process: subprocess.Popen[str]) -> None:
    """Until the first line of progress."""
    assert process.stdout is not None
    for line in process.stdout:
        if line.split()[:1] and line.split()[0].replace(",", "").isdigit():
            return
    raise AssertionError(process.stderr.read() if process.stderr else "")
