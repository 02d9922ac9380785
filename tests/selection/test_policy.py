"""The shipped policy behind ``select``: rules it must keep, and how good it must be."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxcal
from jaxcal.information.regression import log_det_gram
from jaxcal.learning.runtime import weights
from jaxcal.selection import exact_batch
from jaxcal.selection.policy import DECODINGS, select_batch


def values(sets, indices):
    return log_det_gram(np.take_along_axis(sets, indices[..., None], axis=1))


def optimum(sets, k, **options):
    return np.asarray(exact_batch(sets, k, num_outputs=1, **options).log_det)


def test_select_uses_the_shipped_policy_when_asked(rng):
    candidates = rng.uniform(size=(50, 3))
    chosen = jaxcal.select(candidates, method="policy")
    assert chosen.method == "policy"
    assert len(set(chosen.indices.tolist())) == 4
    rows = jaxcal.regression_matrix(candidates[chosen.indices])
    assert chosen.log_det == pytest.approx(np.linalg.slogdet(rows.T @ rows)[1])
    assert 0.9 < chosen.efficiency <= 1.0


def test_the_shipped_policy_is_near_the_proven_optimum(rng):
    sets = rng.uniform(size=(400, 50, 3))
    gap = values(sets, select_batch(sets, 4)) - optimum(sets, 4)
    assert np.exp(3 * gap).mean() >= 0.985
    assert (gap > -1e-9).mean() >= 0.93


def test_best_of_sixteen_first_picks_is_the_optimum(rng):
    sets = rng.uniform(size=(200, 50, 3))
    chosen = select_batch(sets, 4, decoding="first", num=16)
    gap = values(sets, chosen) - optimum(sets, 4)
    assert np.exp(3 * gap).mean() >= 0.999
    assert (gap > -1e-9).mean() >= 0.99


@pytest.mark.parametrize("k", [5, 8])
def test_one_checkpoint_serves_other_numbers_of_postures(rng, k):
    sets = rng.uniform(size=(60, 50, 3))
    gap = values(sets, select_batch(sets, k)) - optimum(sets, k)
    assert np.exp(3 * gap).mean() >= 0.97


@settings(max_examples=15)
@given(st.integers(0, 2**31))
def test_an_affine_map_or_another_order_changes_no_pick(seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(size=(1, 50, 3))
    order = rng.permutation(50)
    matrix = rng.normal(size=(3, 3)) + 2.0 * np.eye(3)
    shift = rng.normal(size=3) * 100.0
    plain = values(points, select_batch(points, 4))
    mapped = select_batch(points @ matrix.T * 1e4 + shift, 4)
    mixed = select_batch(points[:, order], 4)
    # Equal by value: candidates that tie may be exchanged for each other.
    np.testing.assert_allclose(values(points, mapped), plain, atol=1e-9)
    np.testing.assert_allclose(values(points[:, order], mixed), plain, atol=1e-9)


@pytest.mark.parametrize("decoding", DECODINGS)
def test_masks_and_required_postures_are_kept(rng, decoding):
    sets = rng.uniform(size=(20, 30, 3))
    available = rng.uniform(size=(20, 30)) > 0.4
    required = np.stack([np.flatnonzero(row)[:2] for row in available])
    chosen = select_batch(
        sets,
        5,
        available=available,
        required=required,
        decoding=decoding,
        num=4,
    )
    assert np.take_along_axis(available, chosen, axis=1).all()
    np.testing.assert_array_equal(chosen[:, :2], required)
    assert all(len(set(row)) == 5 for row in chosen.tolist())


def test_going_on_from_a_partial_selection_is_near_the_conditional_optimum(rng):
    sets = rng.uniform(size=(100, 50, 3))
    required = rng.permuted(np.tile(np.arange(50), (100, 1)), axis=1)[:, :1]
    chosen = select_batch(sets, 4, required=required)
    gap = values(sets, chosen) - optimum(sets, 4, required=required)
    assert np.exp(3 * gap).mean() >= 0.97


@pytest.mark.slow
def test_trying_more_is_never_worse(rng):
    sets = rng.uniform(size=(40, 50, 3))
    plain = values(sets, select_batch(sets, 6))
    first = values(sets, select_batch(sets, 6, decoding="first", num=8))
    climbed = values(sets, select_batch(sets, 6, decoding="exchange"))
    assert (first >= plain - 1e-6).all()
    assert (climbed >= plain - 1e-9).all()


def test_a_batch_is_its_sets_one_by_one(rng):
    sets = rng.uniform(size=(7, 20, 3))
    whole = select_batch(sets, 4)
    alone = np.concatenate([select_batch(sets[i : i + 1], 4) for i in range(7)])
    np.testing.assert_allclose(values(sets, whole), values(sets, alone), atol=1e-9)


def test_bad_requests_are_named(rng, tmp_path):
    sets = rng.uniform(size=(1, 10, 3))
    with pytest.raises(ValueError, match="decoding must be one of"):
        select_batch(sets, 4, decoding="beam")
    with pytest.raises(ValueError, match="num must be at least 1"):
        select_batch(sets, 4, num=0)
    with pytest.raises(ValueError, match="does not exist"):
        select_batch(sets, 4, checkpoint=tmp_path / "none")
    with pytest.raises(ValueError, match="k must"):
        select_batch(sets, 11)


def test_the_shipped_checkpoint_says_how_it_was_made():
    found = weights.read(weights.locate(None))
    assert found.meta["preset"] == "general"
    assert found.meta["progress"]["episodes"] >= 200_000
    assert found.network["kind"] == "compact"


def test_importing_jaxcal_loads_nothing_heavy():
    code = (
        "import sys, jaxcal, jaxcal.calibration, jaxcal.information, jaxcal.selection\n"
        "import jaxcal.selection.policy\n"
        "heavy = {'jax', 'brax', 'mujoco', 'matplotlib', 'flax', 'orbax'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "[]"


def test_the_learner_imports_neither_brax_nor_the_study():
    code = (
        "import sys, jaxcal.learning.training.run, jaxcal.learning.training.presets\n"
        "names = {'brax', 'mujoco', 'matplotlib', 'jaxcal.paper', 'jaxcal.selection'}\n"
        "print(sorted(names & set(sys.modules)))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "[]"
