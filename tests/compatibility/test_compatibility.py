"""Files of every released version are read, and answer as they did."""

from __future__ import annotations

import json
import pathlib
import shutil

import numpy as np
import pytest

import jaxcal

VERSIONS = sorted(each.parent for each in pathlib.Path(__file__).parent.glob("*/run"))
CANDIDATES = np.random.default_rng(7).uniform(-20.0, 20.0, (12, 3))


@pytest.fixture(params=VERSIONS, ids=lambda folder: folder.name)
def folder(request):
    return request.param


@pytest.fixture
def answers(folder):
    return json.loads((folder / "answers.json").read_text())


@pytest.mark.parametrize("kind", ["affine", "arm"])
def test_a_calibration_predicts_as_it_did(folder, answers, kind):
    found = jaxcal.Calibration.load(folder / f"{kind}.json")
    np.testing.assert_allclose(found.predict(CANDIDATES[:8]), answers[kind], rtol=1e-9)


def test_a_checkpoint_chooses_as_it_did(folder, answers):
    chosen = jaxcal.select(
        CANDIDATES, 4, "policy", checkpoint=folder / "checkpoint.npz"
    )
    # The look-ahead takes the last two as a pair, whose order is a tie.
    first, last = chosen.indices[:2].tolist(), sorted(chosen.indices[2:])
    assert [*first, *last] == [*answers["policy"][:2], *sorted(answers["policy"][2:])]


def test_the_calibration_and_the_journal_of_a_run_are_read(folder):
    from rig.journal.run_folder import read_journal

    found = jaxcal.Calibration.load(folder / "run" / "calibration.json")
    np.testing.assert_allclose(np.diag(found.matrix), [0.43, 0.71, 0.87], atol=0.01)
    assert read_journal(folder / "run" / "journal.jsonl")[0]["event"] == "start"


@pytest.mark.slow
def test_a_run_folder_is_reported_and_fitted_anew(folder, tmp_path):
    from rig.__main__ import main

    run = tmp_path / "run"
    shutil.copytree(folder / "run", run)
    kept = jaxcal.Calibration.load(run / "calibration.json")
    assert main(["report", str(run)]) == 0
    assert (run / "report.html").stat().st_size > 5_000
    assert main(["refit", str(run)]) == 0
    (anew,) = set(tmp_path.glob("**/calibration.json")) - {run / "calibration.json"}
    again = jaxcal.Calibration.load(anew)
    np.testing.assert_allclose(again.matrix, kept.matrix, atol=1e-6)
    np.testing.assert_allclose(again.bias, kept.bias, atol=1e-6)


def test_this_version_is_kept():
    assert jaxcal.__version__ in {each.name for each in VERSIONS}
