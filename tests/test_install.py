"""Each extra alone in a fresh environment: the wheel installs and does its job.

Slow, and needs a package index: run by hand before a release.
"""

from __future__ import annotations

import pathlib
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).parents[1]

pytestmark = pytest.mark.slow

SELECT = """
import numpy as np, jaxcal
u = np.random.default_rng(0).uniform(-20, 20, (50, 3))
chosen = jaxcal.select(u, 4)
assert chosen.proven, chosen
commands = u[chosen.indices]
calibration = jaxcal.identify(commands, commands * 0.5 + 1.0)
assert abs(calibration.matrix[0, 0] - 0.5) < 1e-9
jaxcal.Design(u, max_replicates=2).plan(accuracy=0.2, noise_std=0.1)
"""
ABSENT = """
import importlib.util as i
found = [name for name in {names!r} if i.find_spec(name)]
assert not found, found
"""
HEAVY = ("jax", "flax", "orbax", "brax", "mujoco", "matplotlib", "pymodbus", "pydantic")
NEVER = ("numba", "llvmlite", "cython", "hatchling")

FORMULA = """
import jaxcal.models as m
try:
    print(m.Linear("1 + x + I(x**2)").names)
except ImportError as error:
    print(error)
"""

GYM = """
import gymnasium
envs = gymnasium.make_vec("jaxcal.learning.gym:jaxcal/Postures-v0", num_envs=3)
print(envs.reset(seed=0)[0].shape)
"""

# extra: packages that must not come with it; commands and what their output must hold
CASES = {
    "": (
        HEAVY,
        [
            (["jaxcal", "train"], 2, "[policy]'"),
            (["jaxcal-rig", "calibrate", "--simulate"], 2, "[workbench]'"),
            (["jaxcal", "evaluate", "--episodes", "5"], 0, "dataset2"),
            (["python", "-c", FORMULA], 0, "[models]'"),
        ],
    ),
    "models": (
        HEAVY,
        [(["python", "-c", FORMULA], 0, "I(x ** 2)")],
    ),
    "policy": (
        ("brax", "mujoco", "matplotlib", "pymodbus"),
        [
            (["jaxcal", "train", "--episodes", "2048", "--out", "run"], 0, "saved run"),
        ],
    ),
    "gym": (
        ("brax", "mujoco", "matplotlib", "pymodbus"),
        [(["python", "-c", GYM], 0, "(3, 210)")],
    ),
    "plots": (
        ("jax", "flax", "brax", "mujoco", "pymodbus"),
        [(["python", "-c", "import jaxcal.reports.plots, jinja2"], 0, "")],
    ),
    "rig": (
        ("jax", "flax", "brax", "mujoco", "matplotlib", "pymodbus"),
        [
            (["jaxcal-rig", "calibrate", "--simulate"], 2, "[workbench]'"),
            (["jaxcal-rig", "example", "simulate"], 0, "[bus]"),
        ],
    ),
    "workbench": (
        ("jax", "flax", "brax", "mujoco"),
        [(["jaxcal-rig", "calibrate", "--simulate"], 0, "report.html")],
    ),
    "live": (
        ("jax", "flax", "brax", "mujoco"),
        [(["jaxcal", "doctor"], 0, "nicegui")],
    ),
    "docs": (HEAVY, [(["mkdocs", "--version"], 0, "mkdocs")]),
    "study": (
        ("pymodbus", "pydantic"),
        [
            (
                ["jaxcal", "evaluate", "--episodes", "20", "--report", "report"],
                0,
                "policy",
            ),
        ],
    ),
}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w"]
    subprocess.run([*build, str(folder), str(ROOT)], check=True)
    return next(folder.glob("jaxcal-*.whl"))


def test_python_in_the_checkout_works_after_a_plain_install(tmp_path):
    """It imports the package that lies there, which needs kernels of its own."""
    checkout, python = tmp_path / "jaxcal", tmp_path / "env" / "bin" / "python"
    subprocess.run(["git", "clone", "-q", str(ROOT), str(checkout)], check=True)
    subprocess.run([sys.executable, "-m", "venv", str(tmp_path / "env")], check=True)
    for words, code, expected in (
        (["-m", "pip", "install", "-q", "--no-compile", "."], 0, ""),
        (["-c", SELECT + "print(jaxcal.__file__)"], 0, str(checkout)),
        (["evaluate.py", "--episodes", "5"], 0, "dataset2"),
        (["train.py"], 2, "/env/bin/python -m pip install '.[policy]'"),
    ):
        done = subprocess.run(
            [python, *words], cwd=checkout, capture_output=True, text=True, check=False
        )
        assert done.returncode == code, done.stdout + done.stderr
        assert expected in done.stdout + done.stderr


@pytest.mark.parametrize("extra", CASES)
def test_an_extra_alone(extra, wheel, tmp_path):
    absent, commands = CASES[extra]
    # Of pip one is enough, and what is not imported need not be compiled.
    venv = [sys.executable, "-m", "venv", "--without-pip", tmp_path / "env"]
    subprocess.run(venv, check=True)
    bin_folder = tmp_path / "env" / "bin"
    pip = [sys.executable, "-m", "pip", "--python", bin_folder / "python"]
    subprocess.run(
        [*pip, "install", "-q", "--no-compile", "-c", ROOT / "constraints.txt",
         f"{wheel}[{extra}]" if extra else wheel],
        check=True,
    )  # fmt: skip
    for code in (SELECT, ABSENT.format(names=absent + NEVER)):
        subprocess.run([bin_folder / "python", "-c", code], check=True, cwd=tmp_path)
    for (name, *arguments), code, expected in commands:
        done = subprocess.run(
            [bin_folder / name, *arguments],
            capture_output=True,
            text=True,
            cwd=tmp_path,
            check=False,
        )
        assert done.returncode == code, done.stdout + done.stderr
        assert expected in done.stdout + done.stderr
        assert "Traceback" not in done.stderr
