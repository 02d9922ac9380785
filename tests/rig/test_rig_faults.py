"""The fault matrix: a few cells always, all of them among the slow tests."""

import numpy as np
import pytest
from fault_matrix import cells, run_cell, uninterrupted

QUICK = [
    ("lost_write_reply,count=1", "moving"),
    ("slipping_axis,axis=roll", "settling"),
    ("imu_wrong_order", "zeroing"),
    ("sigkill", "moving"),
    ("full_disk", "saving"),
]


@pytest.fixture(scope="module")
def truth(tmp_path_factory) -> np.ndarray:
    return uninterrupted(tmp_path_factory.mktemp("uninterrupted") / "run")


@pytest.mark.parametrize(("fault", "phase"), QUICK)
def test_a_spoilt_run_ends_stopped_and_resumes_to_the_same(
    fault, phase, truth, tmp_path
):
    run_cell(fault, phase, truth, tmp_path / "run")  # asserts what the cell promises


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "phase"), [cell for cell in cells() if cell not in QUICK]
)
def test_every_other_cell_of_the_matrix(fault, phase, truth, tmp_path):
    run_cell(fault, phase, truth, tmp_path / "run")  # asserts what the cell promises


def test_the_quick_cells_are_cells_of_the_matrix():
    assert set(QUICK) <= set(cells())
    assert len(cells()) == len(set(cells()))
