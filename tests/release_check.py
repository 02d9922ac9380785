"""Build wheels and sdist, install them in fresh environments, and use them there.

``make release-check`` runs it; it needs a package index. Each Python of those given
(default 3.11, 3.12, 3.13) builds its wheel and gets it with all extras, the last one
the sdist too; a version that is not found fails the check.
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


def fresh(python: str, folder: pathlib.Path) -> pathlib.Path:
    """A new environment; its interpreter."""
    if shutil.which(python) is None:
        raise SystemExit(f"{python} is not on the path")
    run(python, "-m", "venv", folder)
    return folder / "bin" / "python"


def pip(interpreter: pathlib.Path, verb: str, *words: object) -> None:
    """By constraints.txt."""
    run(interpreter, "-m", "pip", verb, "-q", "-c", ROOT / "constraints.txt", *words)


def check(python: str, package: pathlib.Path | None, folder: pathlib.Path) -> None:
    """Use the package there; with None, a wheel of its own, with all extras."""
    interpreter = fresh(python, folder)
    wanted = str(package)
    if package is None:
        pip(interpreter, "wheel", "--no-deps", "-w", folder / "dist", ROOT)
        wheel = next((folder / "dist").glob("*.whl"))
        wanted = f"{wheel}[all]"
    pip(interpreter, "install", wanted)
    print(python, wanted, run(interpreter, "-c", USE, cwd=folder))
    print(run(interpreter, "-m", "jaxcal", "doctor", cwd=folder))
    if package is None:
        pip(interpreter, "install", "mypy")
        (folder / "snippet.py").write_text(SNIPPET)
        said = run(interpreter, "-m", "mypy", "--strict", "snippet.py", cwd=folder)
        if not re.search(r'Revealed type is "(builtins\.)?bool"', said):
            raise SystemExit(f"mypy does not see the types of jaxcal: {said}")


def main(pythons: list[str]) -> int:
    """Check; the exit code."""
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        for python in pythons:
            check(python, None, folder / "env")
            shutil.rmtree(folder / "env")
        builder = fresh(sys.executable, folder / "build")
        pip(builder, "install", "hatchling")
        run(builder, "-m", "hatchling", "build", "-t", "sdist", "-d", folder / "dist")
        sdist = next((folder / "dist").glob("*.tar.gz"))
        check(pythons[-1], sdist, folder / "env")
    print("wheels and sdist install and answer")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:] or list(PYTHONS)))
