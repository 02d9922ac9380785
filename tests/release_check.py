"""Build wheel and sdist, install them in fresh environments, and use them there.

``make release-check`` runs it; it needs a package index. Each Python that is found of
those given (default 3.11, 3.12, 3.13) gets the wheel with all extras, the last one the
sdist too; a version that is not found fails the check.
"""

from __future__ import annotations

import pathlib
import re
import shutil
import subprocess
import sys
import tempfile

ROOT = pathlib.Path(__file__).parents[1]
PYTHONS = ("python3.11", "python3.12", "python3.13")
SNIPPET = """\
import numpy as np

import jaxcal
from jaxcal.models import SerialChain


def calibrate(candidates: np.ndarray) -> jaxcal.Calibration:
    chosen = jaxcal.select(candidates, k=4)
    reveal_type(chosen.proven)
    commands = candidates[chosen.indices]
    arm: SerialChain = SerialChain.from_dh([(100.0, 0.0, 0.0, 0.0)])
    assert arm.names
    return jaxcal.identify(commands, 0.5 * commands + 1.0)
"""
USE = SNIPPET.replace("    reveal_type(chosen.proven)\n", "") + (
    "\nfound = calibrate(np.random.default_rng(0).uniform(-20, 20, (50, 3)))\n"
    "assert abs(found.matrix[0, 0] - 0.5) < 1e-9\n"
    "print('jaxcal', jaxcal.__version__, 'answers')\n"
)


def run(*words: object, cwd: pathlib.Path = ROOT) -> str:
    """The output; the program's own words where it fails."""
    done = subprocess.run(
        list(map(str, words)), cwd=cwd, capture_output=True, text=True, check=False
    )
    if done.returncode:
        print(done.stdout + done.stderr, file=sys.stderr)
        raise SystemExit(f"failed: {' '.join(map(str, words))}")
    return done.stdout


def fresh(python: str, package: str, folder: pathlib.Path) -> pathlib.Path:
    """A new environment with a package in it; its interpreter."""
    run(python, "-m", "venv", folder)
    interpreter = folder / "bin" / "python"
    install(interpreter, package)
    return interpreter


def install(interpreter: pathlib.Path, package: str) -> None:
    """Into the interpreter's environment, by constraints.txt."""
    pins = ("-c", ROOT / "constraints.txt")
    run(interpreter, "-m", "pip", "install", "-q", *pins, package)


def main(pythons: list[str]) -> int:
    """Check; the exit code."""
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        builder = fresh(sys.executable, "hatchling", folder / "build")
        run(builder, "-m", "hatchling", "build", "-d", folder / "dist")
        wheel, sdist = (
            next((folder / "dist").glob(f"*.{s}")) for s in ("whl", "tar.gz")
        )
        (folder / "snippet.py").write_text(SNIPPET)
        cases = [(python, wheel, "[all]") for python in pythons]
        cases.append((pythons[-1], sdist, ""))
        for python, package, extra in cases:
            if shutil.which(python) is None:
                raise SystemExit(f"{python} is not on the path")
            env = folder / "env"
            interpreter = fresh(python, f"{package}{extra}", env)
            print(python, package.name + extra, run(interpreter, "-c", USE, cwd=folder))
            print(run(interpreter, "-m", "jaxcal", "doctor", cwd=folder))
            if extra:
                install(interpreter, "mypy")
                check = ("-m", "mypy", "--strict", "snippet.py")
                said = run(interpreter, *check, cwd=folder)
                if not re.search(r'Revealed type is "(builtins\.)?bool"', said):
                    raise SystemExit(f"mypy does not see the types of jaxcal: {said}")
            shutil.rmtree(env)
    print("wheel and sdist install and answer")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:] or list(PYTHONS)))
