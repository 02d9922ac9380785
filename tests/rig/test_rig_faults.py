"""The fault matrix: a few cells always, all of them among the slow tests."""

import numpy as np
import pytest
from fault_matrix import calibration, cells, run_cell, uninterrupted
from harness import fast_config, session, simulator

from rig_workbench.simulator import parse_fault

QUICK = {  # cell: how its first session ends
    ("wrong_gearing", "start"): "refused",
    ("imu_wrong_order", "zeroing"): "stopped",
    ("sigkill", "moving"): "killed",
}


@pytest.fixture(scope="module")
def truth(tmp_path_factory) -> np.ndarray:
    return uninterrupted(tmp_path_factory.mktemp("uninterrupted") / "run")


@pytest.mark.parametrize(("fault", "phase"), QUICK)
def test_a_spoilt_run_ends_as_it_should_and_resumes_to_the_same(
    fault, phase, truth, tmp_path
):
    outcome = run_cell(fault, phase, truth, tmp_path / "run")  # checks stop and journal
    assert outcome.word == QUICK[fault, phase]
    over = outcome.word == "ridden out" or phase in ("start", "axes")
    assert outcome.resumes >= (0 if over else 1)
    assert outcome.worst < 1e-6  # of A and b, from the uninterrupted run


@pytest.mark.slow
def test_a_coupling_that_slips_a_little_before_it_is_seen(truth, tmp_path):
    """The posture measured in between was kept: A was wrong by .109, without a word."""
    begun: list[str] = []
    with simulator(fast_config()) as sim:

        def slip(run, phase):
            if phase == "settling" and len(run.postures()) == 2 and not begun:
                begun.append(phase)
                sim.plant.slip[2] += 0.109
                sim.faults.add(parse_fault("slipping_axis,axis=roll"))

        served = sim.start()
        assert session(served, tmp_path, sim, listeners=[slip]) == 3 and begun
        sim.repair()
        assert session(served, tmp_path, sim) == 0
    assert np.abs(calibration(tmp_path) - truth).max() < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "phase"), [cell for cell in cells() if cell not in QUICK]
)
def test_every_other_cell_of_the_matrix(fault, phase, truth, tmp_path):
    outcome = run_cell(fault, phase, truth, tmp_path / "run")  # checks stop and journal
    assert outcome.worst < 1e-6  # of A and b, from the uninterrupted run
    over = outcome.word == "ridden out" or phase in ("start", "axes")
    assert (outcome.resumes == 0) == over


def test_the_quick_cells_are_cells_of_the_matrix():
    assert QUICK.keys() <= set(cells())
    assert len(cells()) == len(set(cells()))
