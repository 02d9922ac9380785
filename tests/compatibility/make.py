"""Write the files that every later version must read; run at a release.

``python tests/compatibility/make.py`` writes the folder of the version.
"""

from __future__ import annotations

import json
import pathlib
import platform
import shutil
import tempfile

import numpy as np

import jaxcal
from jaxcal.commands import train
from jaxcal.models import SerialChain
from rig.__main__ import main as rig

FOLDER = pathlib.Path(__file__).parent / jaxcal.__version__
CANDIDATES = np.random.default_rng(7).uniform(-20.0, 20.0, (12, 3))


def main() -> None:
    """Calibrations of both kinds, a checkpoint, a run folder, and what they answer."""
    FOLDER.mkdir()
    u = CANDIDATES[:8]
    y = u @ np.diag([0.43, 0.71, 0.87]) + [3.1, -5.8, 2.41]
    y += np.random.default_rng(8).normal(0.0, 0.01, y.shape)
    jaxcal.identify(u, y).save(FOLDER / "affine.json")
    arm = SerialChain.from_dh([(0, 90, 90, 0), (-425, 0, 0, 0), (-390, 0, 0, 0)])
    fit = jaxcal.identify(u, arm.predict(u) + 0.5, model=arm, noise_std=0.1)
    fit.save(FOLDER / "arm.json")
    with tempfile.TemporaryDirectory() as name:
        out = pathlib.Path(name)
        sizes = ["--num-candidates", "12", "--width", "8", "--encoder-rounds", "1"]
        sizes += ["--episodes", "4096", "--no-validation", "--out", str(out / "run")]
        train.main([*sizes, "--export", str(FOLDER / "checkpoint.npz")])
        rig(["calibrate", "--simulate", "--speedup", "20", "--arm", "--zero",
             "--out", str(out / "rig")])  # fmt: skip
        (run,) = (out / "rig").iterdir()
        shutil.copytree(run, FOLDER / "run")
        (FOLDER / "run" / "report.html").unlink()
        for checked in (FOLDER / "run").glob("axes-*"):
            shutil.rmtree(checked)
        journal = FOLDER / "run" / "journal.jsonl"
        own = {platform.node(): "bench", str(pathlib.Path.cwd().parent): "/rig"}
        text = journal.read_text()
        for here, instead in own.items():  # of this computer
            text = text.replace(json.dumps(here), json.dumps(instead))
        journal.write_text(text)
    answers = {
        "affine": jaxcal.Calibration.load(FOLDER / "affine.json").predict(u).tolist(),
        "arm": jaxcal.Calibration.load(FOLDER / "arm.json").predict(u).tolist(),
        "policy": jaxcal.select(
            CANDIDATES, 4, "policy", checkpoint=FOLDER / "checkpoint.npz"
        ).indices.tolist(),
    }
    (FOLDER / "answers.json").write_text(json.dumps(answers, indent=1) + "\n")


if __name__ == "__main__":
    main()
