"""python evaluate.py as a process: exit codes, what it writes, what it refuses."""

from __future__ import annotations

import dataclasses
import json
import os
import pathlib
import re
import signal
import subprocess
import sys

import numpy as np
import pytest

from benchmarks.paper.datasets import save_csv
from jaxcal.commands import evaluate as command
from jaxcal.commands import tables
from jaxcal.evaluation import figures
from jaxcal.evaluation.dataset import Dataset, save_npz
from jaxcal.information.regression import regression_matrix
from jaxcal.paper.datasets import make_dataset
from jaxcal.progress import Progress

ROOT = pathlib.Path(__file__).parents[2]


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(ROOT / "evaluate.py"), *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=ROOT,
    )


@dataclasses.dataclass
class Done:
    """How a command ended."""

    returncode: int
    stdout: str
    stderr: str


def call(capsys: pytest.CaptureFixture[str], *arguments: object) -> Done:
    """The command in this process, which is quicker."""
    try:
        code = command.main([str(argument) for argument in arguments], "evaluate.py")
    except SystemExit as leaving:
        code = int(str(leaving.code))
    return Done(code, *capsys.readouterr())


def test_a_table_is_a_pool_that_episodes_draw_from(tmp_path, capsys) -> None:
    """As ``train.py --candidates`` has it; only available rows are drawn."""
    rows = np.random.default_rng(0).uniform(-30.0, 30.0, (70, 2))
    free = np.arange(70) % 7 != 0
    lines = [f"{a},{b},{int(ok)}" for (a, b), ok in zip(rows, free, strict=True)]
    path = tmp_path / "mine.csv"
    path.write_text("\n".join(["pitch,yaw,available", *lines]) + "\n")
    out = tmp_path / "out.json"
    flags = ("--methods", "greedy,exact", "--k", 3, "--episodes", 5, "--indices")
    done = call(capsys, "--dataset", path, *flags, "--json", out, "--quiet")
    assert done.returncode == 0, done.stderr
    (result,) = json.loads(out.read_text())["results"]
    assert result["dataset"]["episodes"] == 5
    assert len(result["methods"]["exact"]["indices"]) == 5
    sets = tables.draw_sets(str(path), 5, 0)
    drawn = {tuple(row) for row in sets.reshape(-1, 2)}
    assert drawn <= {tuple(row) for row in rows[free]} and len(drawn) > 50
    assert all(len({tuple(row) for row in one}) == 50 for one in sets)


def test_the_json_says_what_the_full_matrices_say(tmp_path: pathlib.Path) -> None:
    data = make_dataset("dataset3", 4, 20)
    save_npz(data, tmp_path / "mine.npz")
    out = tmp_path / "deep" / "out.json"
    done = run(
        *("--dataset", tmp_path / "mine.npz", "dataset2", "--episodes", 20),
        *("--methods", "random,greedy,exact", "--draws", 7, "--json", out, "--indices"),
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == "" and "greedy" in done.stdout
    document = json.loads(out.read_text())
    assert document["command"][:2] == ["python", "evaluate.py"]
    mine, two = document["results"]
    assert mine["dataset"]["name"] == "mine.npz" and mine["dataset"]["sha256"]
    assert two["dataset"]["name"] == "dataset2" and two["dataset"]["seed"] == 0
    assert mine["checkpoint"] is None and mine["seed"] == 0 and mine["proven"] == 1.0
    log_det = {}
    for method in ("greedy", "exact"):
        chosen = mine["methods"][method]["indices"]
        matrices = [regression_matrix(data.candidates[e][chosen[e]]) for e in range(20)]
        log_det[method] = np.array([np.linalg.slogdet(a.T @ a)[1] for a in matrices])
    ratio = np.exp(log_det["greedy"] - log_det["exact"])
    row = mine["methods"]["greedy"]
    assert row["ratio_to_exact"] == pytest.approx(ratio.mean(), rel=1e-8)
    assert row["hit_rate"] == pytest.approx((ratio > 1 - 1e-8).mean())
    assert row["d_efficiency"] == pytest.approx((ratio ** (1 / 12)).mean(), rel=1e-8)
    assert row["det_s"]["mean"] == pytest.approx(np.exp(log_det["greedy"]).mean())
    assert row["log_det_s"]["std"] == pytest.approx(log_det["greedy"].std())
    ratio_of_means = row["det_s"]["mean"] / mine["methods"]["random"]["det_s"]["mean"]
    assert row["ratio_to_random"] == pytest.approx(ratio_of_means)


def test_csv_with_a_mask_and_two_inputs(
    tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(0)
    mask = np.ones((3, 9), bool)
    mask[:, ::4] = False
    save_csv(
        Dataset("x", rng.normal(size=(3, 9, 2)), available=mask), tmp_path / "d.csv"
    )
    out = tmp_path / "out.json"
    done = call(
        capsys,
        *("--dataset", tmp_path / "d.csv", "--k", 3, "--json", out, "--indices"),
        *("--methods", "greedy,exchange,exact"),
    )
    assert done.returncode == 0, done.stderr
    entry = json.loads(out.read_text())["results"][0]
    assert entry["dataset"]["num_inputs"] == 2 and entry["k"] == 3
    for row in entry["methods"].values():
        assert not np.isin(row["indices"], [0, 4, 8]).any()


def test_the_report_is_one_page_and_figures(
    tmp_path: pathlib.Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(  # all of them are drawn in test_evaluation.py
        figures, "evaluation_figures", lambda found: {"all": figures.det_means(found)}
    )
    folder = tmp_path / "run"
    (folder / "checkpoint" / "7").mkdir(parents=True)
    (folder / "metrics.csv").write_text("episodes,reward_mean\n16,-1\n32,-0.5\n")
    steps = [None, str(folder), str(folder / "checkpoint" / "7")]
    assert command._run_folders(steps) == [folder]
    monkeypatch.setattr(command, "_run_folders", lambda _: [folder])
    done = call(
        capsys,
        *("--dataset", "dataset3", "--episodes", 5, "--methods", "random,exact"),
        *("--report", tmp_path / "report"),
    )
    assert done.returncode == 0, done.stderr
    names = {path.name for path in (tmp_path / "report").iterdir()}
    assert "index.html" in names and "training_curves.png" in names
    assert {name for name in names if name.endswith(".svg")} == {
        f"{pathlib.Path(name).stem}.svg" for name in names if name.endswith(".png")
    }
    page = (tmp_path / "report" / "index.html").read_text()
    assert page.count("<img") == 2 and "dataset3" in page


def test_baselines_load_no_jax() -> None:
    script = (
        "import sys; sys.argv = ['evaluate.py']; import evaluate\n"
        "code = evaluate.main(['--episodes', '3', '--methods', 'greedy,exact'])\n"
        "bad = [m for m in ('jax', 'flax', 'brax', 'mujoco', 'matplotlib') "
        "if m in sys.modules]\n"
        "sys.exit(f'{code} {bad}' if code or bad else 0)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr


def test_help_teaches() -> None:
    done = run("--help")
    assert done.returncode == 0
    for word in ("examples:", "policy:first", "FILE.csv", "det S/det S*", "--json"):
        assert word in done.stdout


FLAT = np.random.default_rng(0).normal(size=(2, 6, 3))
FLAT[1, :, 2] = 1.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--k", "3"], "k must be at least 4"),
        (["--k", "51"], "available candidates, got 51"),
        (["--k", "x"], "--k: must be a whole number of at least 1, got 'x'"),
        (["--episodes", "0"], "--episodes: must be a whole number"),
        (["--seed", "-1"], "--seed: must be a whole number of at least 0"),
        (["--time-limit", "nan"], "--time-limit: must be a number of at least 0.001"),
        (["--methods", "best"], "method must be one of policy, .* got 'best'"),
        (["--methods", ""], "at least one method"),
        (["--dataset", "dataset7"], "--dataset takes .* got 'dataset7'"),
        (["--dataset", "{tmp}/none.npz"], "none.npz: No such file"),
        (["--dataset", "{tmp}/torn.npz"], "torn.npz: not a .npz file, or truncated"),
        (["--dataset", "{tmp}/key.npz"], 'key "candidates" is missing'),
        (["--dataset", "{tmp}/bad.csv"], "bad.csv: line 2, column 'u_y' must hold"),
        (["--dataset", "{tmp}/flat.npz"], "flat.npz: in set 1: .* lie in one plane"),
        (["--checkpoint", "x", "--methods", "exact"], "no policy is among --methods"),
        (["--bogus"], "unrecognized arguments: --bogus"),
        (["--report", "{tmp}/torn.npz/x"], "torn.npz is not a folder"),
        (["--report", "/proc/none/x"], "/proc"),
        (["--json", "{tmp}"], "--json takes a file"),
    ],
)
def test_every_error_is_one_line_and_code_2(
    tmp_path: pathlib.Path,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    (tmp_path / "torn.npz").write_bytes(b"PK\x03\x04 torn")
    (tmp_path / "bad.csv").write_text("episode,candidate,u_x,u_y\n0,0,1,two\n")
    np.savez(tmp_path / "key.npz", postures=np.ones((1, 5, 3)))
    np.savez(tmp_path / "flat.npz", candidates=FLAT)
    before = {path.name for path in tmp_path.iterdir()}
    given = [argument.format(tmp=tmp_path) for argument in arguments]
    outputs = ["--json", tmp_path / "o.json"] if "--json" not in given else []
    methods = ["--methods", "greedy"] if "--methods" not in given else []
    done = call(capsys, *methods, *outputs, *given)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert done.stderr.startswith("evaluate.py: ")
    assert re.search(message, done.stderr), done.stderr
    assert done.stdout == ""
    assert {path.name for path in tmp_path.iterdir()} == before


def test_a_missing_checkpoint_is_one_line_and_code_2(
    tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    done = call(
        capsys,
        *("--episodes", 2, "--methods", "policy", "--checkpoint", tmp_path / "none"),
        *("--json", tmp_path / "o.json", "--report", tmp_path / "report"),
    )
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1, done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("package", "arguments", "says"),
    [
        ("matplotlib", ["--report", "{tmp}/r"], "--report needs matplotlib"),
        ("jinja2", ["--report", "{tmp}/r"], "--report needs jinja2"),
    ],
)
def test_a_missing_extra_is_one_line_that_names_the_command(
    tmp_path: pathlib.Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    package: str,
    arguments: list[str],
    says: str,
) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    given = [argument.format(tmp=tmp_path) for argument in arguments]
    done = call(capsys, "--methods", "greedy", "--episodes", 2, *given)
    assert done.returncode == 2 and done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"evaluate.py: {says}, which is not installed: ")
    assert line.endswith("[plots]'")
    assert list(tmp_path.iterdir()) == []


def test_dataset0_says_how_it_is_made(capsys: pytest.CaptureFixture[str]) -> None:
    done = call(capsys, "--methods", "greedy", "--dataset", "dataset0")
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
    assert "python -m benchmarks.paper.datasets dataset0 --out DIR" in done.stderr


@pytest.mark.parametrize(
    ("number", "code", "says"),
    [(signal.SIGINT, 130, "interrupted"), (signal.SIGTERM, 143, "terminated")],
)
def test_a_stopped_command_writes_nothing(
    tmp_path: pathlib.Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    number: int,
    code: int,
    says: str,
) -> None:
    def stop(_: object, task: str, done: int, total: int) -> None:
        if done:
            signal.raise_signal(number)

    monkeypatch.setattr(Progress, "__call__", stop)
    out = tmp_path / "o.json"
    done = call(capsys, "--episodes", 3, "--methods", "greedy", "--json", out)
    assert done.returncode == code and done.stdout == ""
    assert done.stderr == f"evaluate.py: {says}, nothing was written\n"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_the_shipped_policy_has_a_row_for_each_decoding(
    tmp_path: pathlib.Path,
) -> None:
    out = tmp_path / "out.json"
    done = run("--episodes", 200, "--json", out)
    assert done.returncode == 0, done.stderr
    rows = json.loads(out.read_text())["results"][0]["methods"]
    assert rows["policy"]["ratio_to_exact"] > 0.9
    assert rows["policy:samples"]["ratio_to_exact"] > 0.9
    for name in ("first", "exchange"):
        better = rows[f"policy:{name}"]["ratio_to_exact"]
        assert better >= rows["policy"]["ratio_to_exact"] - 1e-3


@pytest.mark.parametrize(
    "command", ["evaluate", pytest.param("train", marks=pytest.mark.slow)]
)
def test_the_log_level_is_set_before_jax_is_loaded(command: str) -> None:
    # XLA reads it then; else each program from the cache is an error of 1.8 kB.
    code = f"""
import os, sys
class Watch:
    def find_spec(self, name, path=None, target=None):
        if name == "jaxlib":
            print(os.environ.get("TF_CPP_MIN_LOG_LEVEL"), flush=True)
            os._exit(0)
sys.meta_path.insert(0, Watch())
from jaxcal.commands.{command} import main
main(["--task", "knee", "--help"])
"""
    bare = {k: v for k, v in os.environ.items() if k != "TF_CPP_MIN_LOG_LEVEL"}
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=bare,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == "3\n"
