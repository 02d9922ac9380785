"""The fault matrix: a few cells always, all of them among the slow tests."""

import numpy as np
import pytest
from fault_matrix import cells, run_cell, uninterrupted

QUICK = {  # cell: how its first session ends
    ("lost_write_reply,count=1", "moving"): "stopped",
    ("slipping_axis,axis=roll", "settling"): "stopped",
    ("imu_wrong_order", "zeroing"): "stopped",
    ("sigkill", "moving"): "killed",
    ("full_disk", "saving"): "stopped",
}


@pytest.fixture(scope="module")
def truth(tmp_path_factory) -> np.ndarray:
    return uninterrupted(tmp_path_factory.mktemp("uninterrupted") / "run")


@pytest.mark.parametrize(("fault", "phase"), QUICK)
def test_a_spoilt_run_ends_stopped_and_resumes_to_the_same(
    fault, phase, truth, tmp_path
):
    outcome = run_cell(fault, phase, truth, tmp_path / "run")  # checks stop and journal
    assert outcome.word == QUICK[fault, phase]
    assert outcome.resumes >= 1
    assert outcome.worst < 1e-6  # of A and b, from the uninterrupted run


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "phase"), [cell for cell in cells() if cell not in QUICK]
)
def test_every_other_cell_of_the_matrix(fault, phase, truth, tmp_path):
    outcome = run_cell(fault, phase, truth, tmp_path / "run")  # checks stop and journal
    assert outcome.worst < 1e-6  # of A and b, from the uninterrupted run
    assert (outcome.resumes == 0) == (outcome.word == "ridden out")


def test_the_quick_cells_are_cells_of_the_matrix():
    assert QUICK.keys() <= set(cells())
    assert len(cells()) == len(set(cells()))
