"""A real arm, a UR5 measured by a laser tracker: examples/ur5, lengths in mm."""

from __future__ import annotations

import numpy as np
import pytest
import ur5

from jaxcal.calibration import identify
from jaxcal.models import Prior

ARM = ur5.arm()

JOINTS, MEASURED = ur5.load("ur5_grid_1000.csv")
TEST_JOINTS, TEST = ur5.load("ur5_random_20.csv")


def error(found: object) -> float:
    predicted = found.predict(TEST_JOINTS)  # type: ignore[attr-defined]  # calibration
    return float(np.linalg.norm(predicted - TEST, axis=1).mean())


@pytest.mark.slow
@pytest.mark.parametrize("loss", ["gaussian", "student"])
def test_all_poses_leave_a_tenth_of_a_millimetre(loss: str) -> None:
    found = identify(
        JOINTS,
        MEASURED,
        model=ARM,
        noise_std=0.1,
        loss=loss,
        prior=ARM.default_prior(),
    )
    assert error(found) < 0.102
    assert found.from_data[ARM.names.index("a2")] > 0.99
    assert found.from_data[ARM.names.index("theta6")] < 0.01
    back = found.command_for(TEST, start=TEST_JOINTS)
    np.testing.assert_allclose(found.predict(back), TEST, atol=1e-6)
    assert np.abs(back - TEST_JOINTS).max() < 0.1


@pytest.mark.filterwarnings("ignore:.*far outside the measurements")
@pytest.mark.slow
def test_one_outlier_in_twelve_poses_is_named_and_costs_little() -> None:
    rng = np.random.default_rng(0)
    clean, least, student = [], [], []
    for _ in range(4):
        at = rng.choice(1000, 12, replace=False)
        spoilt, row, way = MEASURED[at].copy(), rng.integers(12), rng.normal(size=3)
        spoilt[row] += 5.0 * way / np.linalg.norm(way)
        found = identify(JOINTS[at], spoilt, model=ARM, noise_std=0.1)
        assert list(found.outliers) == [row] and found.outliers[row] < 0.1
        student.append(error(found))
        clean.append(
            error(identify(JOINTS[at], MEASURED[at], model=ARM, noise_std=0.1))
        )
        found = identify(JOINTS[at], spoilt, model=ARM, noise_std=0.1, loss="gaussian")
        least.append(error(found))
    assert np.mean(student) < 1.25 * np.mean(clean) < 0.3 < np.mean(least)


@pytest.mark.slow
def test_harmonics_of_its_joints_explain_what_the_table_does_not() -> None:
    assert error(identify(JOINTS, MEASURED, model=ARM)) < 0.09


def test_no_search_fails_with_a_vague_prior_from_afar() -> None:
    rng = np.random.default_rng(1)
    std = np.asarray(ARM.default_prior().std)
    for _ in range(8):
        at = rng.choice(1000, 8, replace=False)
        far = ARM.nominal.copy()
        far[30:] += std[30:] * rng.normal(size=9)  # base and tool
        prior = Prior(30 * std, far)
        found = identify(
            JOINTS[at], MEASURED[at], model=ARM, prior=prior, noise_std=0.1
        )
        assert np.abs(found.residuals).max() < 0.1


@pytest.mark.filterwarnings("ignore:.*far outside the measurements")
@pytest.mark.parametrize("noise_std", [0.1, None])
@pytest.mark.parametrize("count", [12, 20, 40])
def test_without_any_prior_the_search_ends(count: int, noise_std: float | None) -> None:
    for seed in range(3):  # the valley d2 = d3 = d4 is closed by second-order terms
        at = np.random.default_rng(seed).choice(1000, count, replace=False)
        found = identify(
            JOINTS[at],
            MEASURED[at],
            model=ARM,
            prior=Prior(np.inf),
            noise_std=noise_std,
        )
        assert error(found) < 1.0
        assert found.unidentified is not None
