"""What every method promises, whatever it picks: rules, records and refusals."""

import json
import subprocess
import sys

import numpy as np
import pytest
from questions import criteria, make_problem, score

import jaxcal
from jaxcal.models import Affine
from jaxcal.selection import (
    exact_batch,
    exchange_batch,
    greedy_batch,
    random_batch,
    select,
)
from jaxcal.selection.solvers import METHODS

SOLVERS = ("random", "greedy", "exchange", "exact")
BATCHES = (random_batch, greedy_batch, exchange_batch, exact_batch)


def uniform(seed, m=20, n=3):
    return np.random.default_rng(seed).random((m, n))


def seeded(method, seed):
    return {} if method == "greedy" else {"seed": seed}


def log_det_of(candidates, indices, m=3):
    z = np.c_[candidates, np.ones(len(candidates))][indices]
    return np.linalg.slogdet(np.kron(z.T @ z, np.eye(m)))[1]


@pytest.mark.parametrize("method", SOLVERS)
@pytest.mark.parametrize("k", [4, 7])
def test_a_selection_says_what_it_is_worth(method, k):
    candidates = uniform(0) * 40 - 20
    found = select(candidates, k, method)
    assert found.indices.shape == (k,)
    assert len(set(found.indices.tolist())) == k
    assert found.method == method
    assert found.log_det == pytest.approx(log_det_of(candidates, found.indices))
    assert found.bound >= found.log_det
    assert found.gap == found.bound - found.log_det
    assert found.efficiency == pytest.approx(np.exp(-found.gap / 12))
    assert found.proven == (method == "exact")
    assert found.value == found.log_det
    assert found.seconds > 0
    assert found.criteria == criteria(candidates[found.indices], candidates)
    assert found.alternatives[0].log_det == found.log_det
    assert found.indices.dtype == np.int64


@pytest.mark.parametrize("method", SOLVERS)
@pytest.mark.parametrize(("k", "cap"), [(4, 1), (7, 1), (7, 3)])
def test_rules_are_kept_by_every_method(method, k, cap):
    for seed in range(5):
        rng = np.random.default_rng(seed)
        available = rng.random(20) < 0.6
        required = rng.permutation(np.flatnonzero(available))[: seed % 4]
        found = select(
            uniform(seed),
            k,
            method,
            available=available,
            required=required,
            max_replicates=cap,
            **seeded(method, seed),
        )
        assert available[found.indices].all()
        assert set(required.tolist()) <= set(found.indices.tolist())
        assert np.bincount(found.indices).max() <= cap


@pytest.mark.parametrize("method", SOLVERS)
@pytest.mark.parametrize("k", [4, 5, 8])
def test_no_method_is_singular_on_grids_and_duplicates(method, k):
    axis = np.linspace(0, 1, 3)
    grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    heap = np.concatenate([np.tile(grid[:2], (60, 1)), grid[[2, 6, 18]]])
    for candidates in (grid, heap):
        for seed in range(10):
            found = select(candidates, k, method, **seeded(method, seed))
            assert np.isfinite(found.log_det)


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("k", [4, 6])
def test_batches_keep_the_rules_and_report_their_worth(batch, k):
    candidates = np.random.default_rng(3).random((7, 15, 3))
    available = np.random.default_rng(4).random((7, 15)) < 0.7
    available[:, 0] = True
    required = np.zeros((7, 1), dtype=int)
    found = batch(candidates, k, available=available, required=required)
    assert found.indices.shape == (7, k)
    for b in range(7):
        assert available[b][found.indices[b]].all()
        assert 0 in found.indices[b]
        assert len(set(found.indices[b].tolist())) == k
        assert found.log_det[b] == pytest.approx(
            log_det_of(candidates[b], found.indices[b])
        )
    assert found.proven.all() == (batch is exact_batch)


def test_greedy_completes_a_partial_selection_by_the_largest_gain():
    candidates = uniform(1)
    found = select(candidates, 6, "greedy", required=[5, 2, 11]).indices
    np.testing.assert_array_equal(found[:3], [5, 2, 11])
    for size in (3, 4, 5):
        chosen = found[:size].tolist()
        ridge = 1e-7 * np.eye(4)
        z = np.c_[candidates - candidates.mean(axis=0), np.ones(20)]
        gains = [
            np.linalg.slogdet(z[[*chosen, j]].T @ z[[*chosen, j]] + ridge)[1]
            if j not in chosen
            else -np.inf
            for j in range(20)
        ]
        assert found[size] == np.argmax(gains)


def test_random_is_uniform_and_seeded():
    candidates = uniform(0, 12)
    counts = np.zeros(12)
    for seed in range(600):
        counts[select(candidates, 4, "random", seed=seed).indices] += 1
    assert counts.min() > 150  # 200 expected each
    assert counts.max() < 250
    one, same = (select(candidates, 4, "random", seed=9).indices for _ in range(2))
    np.testing.assert_array_equal(one, same)


def test_score_judges_a_subset_made_elsewhere():
    candidates = uniform(2)
    found = score(candidates, [3, 1, 4, 15, 9])
    assert found.method == "score"
    assert found.log_det == pytest.approx(log_det_of(candidates, [3, 1, 4, 15, 9]))
    assert 0 < found.efficiency < 1
    twice = score(candidates, [3, 1, 4, 15, 3], max_replicates=2)
    assert twice.log_det == pytest.approx(log_det_of(candidates, [3, 1, 4, 15, 3]))


def test_the_reference_may_be_the_proven_optimum():
    candidates = uniform(2)
    optimum = select(candidates, 6, "exact").log_det
    loose = select(candidates, 6, "greedy")
    found = score(candidates, loose.indices, reference="exact")
    assert found.bound == pytest.approx(optimum, abs=1e-9)
    assert loose.bound >= found.bound - 1e-9


def test_the_number_of_outputs_multiplies_the_log_det():
    candidates = uniform(2)
    three = select(candidates, 6, "exact").log_det
    one = select(candidates, 6, "exact", model=Affine(3, 1))
    assert three == pytest.approx(3 * one.log_det)
    assert one.efficiency == 1.0


def test_a_mask_may_be_as_tight_as_the_selection():
    candidates = uniform(3)
    available = np.zeros(20, dtype=bool)
    available[[2, 5, 7, 11]] = True
    for method in SOLVERS:
        found = select(candidates, 4, method, available=available)
        assert set(found.indices.tolist()) == {2, 5, 7, 11}


@pytest.mark.parametrize("method", SOLVERS)
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"candidates": [[0.0, np.nan, 1.0]] * 9},
            "candidates must be finite, got nan",
        ),
        ({"candidates": np.full((9, 3), np.inf)}, "candidates must be finite, got inf"),
        (
            {"candidates": np.ones(9)},
            r"candidates must have shape \(M, n\), .* got \(9,\)",
        ),
        ({"candidates": np.ones((2, 9, 3))}, r"candidates must have shape \(M, n\)"),
        ({"candidates": np.ones((9, 0))}, r"candidates must have shape \(M, n\)"),
        ({"candidates": np.ones((0, 3))}, r"candidates must have shape \(M, n\)"),
        ({"candidates": [["a", "b", "c"]]}, "candidates must be an array of numbers"),
        ({"candidates": [[1, 2, 3], [1, 2]]}, "candidates must be an array of numbers"),
        ({"k": 3}, "k must be at least 4, the number of regressors .* got 3"),
        ({"k": 0}, "k must be at least 1, got 0"),
        ({"k": 4.5}, "k must be a whole number, got 4.5"),
        ({"k": True}, "k must be a whole number, got True"),
        ({"k": 21}, "k must not exceed 20 available candidates, got 21"),
        (
            {"k": 41, "max_replicates": 2},
            "20 available candidates, each at most 2 times, got 41",
        ),
        ({"max_replicates": 0}, "max_replicates must be at least 1, got 0"),
        ({"available": np.zeros(20, bool)}, "available must leave at least 4 .* none"),
        ({"available": np.ones(19, bool)}, r"available must have shape \(20,\), got"),
        ({"available": np.full(20, 2)}, "available must hold True or 1 .* got 2"),
        (
            {"available": np.arange(20) < 3},
            "k must not exceed 3 available candidates, got 4",
        ),
        ({"required": [20]}, r"required must lie in \[0, 20\), got 20"),
        ({"required": [-1]}, r"required must lie in \[0, 20\), got -1"),
        ({"required": [1, 2, 1]}, "required must not repeat a candidate, got 1 twice"),
        ({"required": range(5)}, "required must name at most k = 4 candidates, got 5"),
        ({"required": [0.5]}, "required must hold whole numbers, got dtype float64"),
        ({"required": [[1], [2]]}, r"required must have shape \(r,\), got \(2, 1\)"),
        (
            {"required": [0], "available": np.arange(20) > 0},
            "required must be available, got 0, which is masked",
        ),
        ({"seed": -1}, "seed must be at least 0, got -1"),
        ({"seed": 0.5}, "seed must be a whole number, got 0.5"),
        ({"restarts": 0}, "restarts must be at least 1, got 0"),
        ({"best": 0}, "best must be at least 1, got 0"),
        ({"time_limit": 0}, "time_limit must be a number above 0 .* got 0"),
        ({"time_limit": "x"}, "time_limit must be a number above 0 .* got 'x'"),
        (
            {"reference": "exact"},
            "there is no argument .reference.; there are candidates, model",
        ),
    ],
)
def test_bad_input_is_one_clear_error(method, change, message):
    arguments = {"candidates": uniform(0), "k": 4, **change}
    with pytest.raises(ValueError, match=message):
        select(method=method, **arguments)


def test_a_mask_of_noughts_and_ones_is_one_of_bool():
    mask = np.arange(20) % 3 > 0
    expected = select(uniform(0), 5, available=mask).indices
    for kind in (int, float, np.uint8):
        given = select(uniform(0), 5, available=mask.astype(kind))
        np.testing.assert_array_equal(given.indices, expected)


def test_unknown_methods_are_answered_with_the_list():
    with pytest.raises(ValueError, match="method must be one of random, greedy"):
        select(uniform(0), 4, "best")
    with pytest.raises(ValueError, match="method must be one of"):
        select(uniform(0), 4, None)
    assert METHODS == ("random", "greedy", "exchange", "exact", "policy", "auto")


def test_what_only_one_method_can_do_is_refused_by_the_others():
    with pytest.raises(
        ValueError,
        match=r'restarts is not an option of method "greedy" \(only of exchange, '
        r"exact, auto\)",
    ):
        select(uniform(0), 4, "greedy", restarts=5)
    for method, option in [
        ("greedy", {"seed": 1}),
        ("random", {"time_limit": 1.0}),
        ("exchange", {"best": 2}),
        ("exact", {"num": 4}),
        ("policy", {"restarts": 7}),
        ("auto", {"checkpoint": "runs/a"}),
        ("auto", {"decoding": "samples"}),
        ("exact", {"least_efficiency": 0.9}),
    ]:
        with pytest.raises(ValueError, match=f"{next(iter(option))} is not an option"):
            select(uniform(0), 4, method, **option)
    with pytest.raises(ValueError, match="got max_replicates above 1"):
        select(uniform(0), 4, "policy", max_replicates=2)


@pytest.mark.parametrize("method", SOLVERS)
@pytest.mark.parametrize("scale", [1.0, 1e-9, 1e9])
def test_flat_candidates_name_the_missing_direction(method, scale):
    flat = uniform(0) * scale
    flat[:, 2] = flat[:, 0]
    with pytest.raises(
        ValueError,
        match=r"one plane; the same in every row: \(\+0.7071 u_x -0",
    ):
        select(flat, 4, method)
    flat[:, 2] = 7.0
    with pytest.raises(ValueError, match=r"the same in every row: u_z"):
        select(flat, 4, method)
    with pytest.raises(ValueError, match="lie in one plane"):
        select(np.ones((9, 3)) * scale, 4, method)
    with pytest.raises(ValueError, match=r"on one line; .*the same in every row"):
        select(np.c_[np.arange(9), 2 * np.arange(9)] * scale, 4, method)


def test_flat_among_the_available_is_flat():
    candidates = uniform(0)
    candidates[5:, 1] = 0.3
    select(candidates, 4, "exact")
    with pytest.raises(ValueError, match=r"15 available ones lie.* u_y"):
        select(candidates, 4, "exact", available=np.arange(20) >= 5)


def test_required_postures_that_leave_no_room_are_refused():
    candidates = uniform(0)
    candidates[:4, 1] = 0.3
    for method in SOLVERS:
        with pytest.raises(
            ValueError,
            match=r"required candidates leave too little room .* span 3 of 4",
        ):
            select(candidates, 4, method, required=[0, 1, 2, 3])
        found = select(candidates, 5, method, required=[0, 1, 2, 3])
        assert np.isfinite(found.log_det)


@pytest.mark.parametrize(
    ("indices", "message"),
    [
        ([0, 1, 2], "k must be at least 4"),
        ([], "indices must"),
        ([0, 1, 2, 20], r"indices must lie in \[0, 20\), got 20"),
        ([0, 1, 2, -1], r"indices must lie in \[0, 20\), got -1"),
        ([0.0, 1, 2, 3], "indices must be a .* whole numbers"),
        ([[0, 1, 2, 3]], r"indices must be .* got shape \(1, 4\)"),
        ([0, 1, 2, 2], "indices may repeat a candidate at most max_replicates = 1"),
    ],
)
def test_score_refuses_what_cannot_be_scored(indices, message):
    with pytest.raises(ValueError, match=message):
        score(uniform(0), indices)


def test_a_singular_subset_is_refused():
    with pytest.raises(ValueError, match="indices must give an invertible information"):
        score(uniform(0), [0, 1, 2, 2], max_replicates=2)


def test_score_respects_the_mask_and_the_cap():
    with pytest.raises(ValueError, match="indices must be available, got 3"):
        score(uniform(0), [1, 2, 3, 4], available=np.arange(20) != 3)
    with pytest.raises(ValueError, match="indices may repeat a candidate at most max"):
        score(uniform(0), [1, 2, 3, 4, 4])
    with pytest.raises(ValueError, match="reference must be one of bound, exact, got"):
        score(uniform(0), [1, 2, 3, 4], reference="best")


def test_batches_name_the_set_that_is_wrong():
    candidates = np.random.default_rng(0).random((3, 9, 3))
    candidates[1, :, 0] = 2.0
    for batch in BATCHES:
        with pytest.raises(ValueError, match=r"in set 1: .* lie in one plane.* u_x"):
            batch(candidates, 4)
        with pytest.raises(ValueError, match=r"candidates must have shape \(B, M, n\)"):
            batch(candidates[0], 4)
    candidates[2, 4, 1] = np.nan
    with pytest.raises(
        ValueError, match=r"candidates must be finite, got nan at \(2, 4"
    ):
        greedy_batch(candidates, 4)


def test_inputs_are_not_written_to():
    candidates = uniform(0)
    available = np.ones(20, dtype=bool)
    before = candidates.copy()
    candidates.flags.writeable = available.flags.writeable = False  # writing raises
    for method in SOLVERS:
        select(candidates, 5, method, available=available, required=(3,))
    assert (candidates == before).all() and available.all()


def test_whitened_rows_are_orthonormal_over_the_available():
    available = np.arange(20) % 4 > 0
    problem = make_problem(uniform(0) * [1, 50, 1e4] + 1e5, 4, available=available)
    np.testing.assert_allclose(problem.rows.T @ problem.rows, np.eye(4), atol=1e-9)
    assert not problem.rows[~available].any()
    assert problem.blocks.shape == (20, 1, 4) and problem.multiplicity == 3


@pytest.mark.parametrize("name", ["available", "max_replicates", "required"])
def test_a_masked_value_is_no_value(name):
    """numpy's mask says that nothing is known of row 9, not that it may be chosen."""
    values = np.ma.array(np.arange(10) if name == "required" else np.ones(10, int))
    values[9] = np.ma.masked
    x = np.random.default_rng(0).normal(size=(10, 2))
    with pytest.raises(ValueError, match=f"{name} must not be masked"):
        jaxcal.select(x, 3, **{name: values})


def test_a_masked_candidate_may_be_nan():
    candidates = uniform(0)
    available = np.arange(20) != 7
    plain = {m: select(candidates, 6, m, available=available) for m in SOLVERS}
    candidates[7] = np.nan
    for method in SOLVERS:
        found = select(candidates, 6, method, available=available)
        np.testing.assert_array_equal(found.indices, plain[method].indices)
        assert found.log_det == plain[method].log_det
        assert found.criteria == plain[method].criteria
    with pytest.raises(
        ValueError, match=r"candidates must be finite, got nan at \(7, 0"
    ):
        select(candidates, 6, available=np.arange(20) != 8)


def test_a_result_does_not_change_with_the_callers_arrays():
    candidates, available = uniform(0), np.arange(20) > 2
    found = select(candidates, 6, "greedy", available=available)
    expected = select(candidates.copy(), 6, "greedy", available=available.copy())
    candidates[:] = 7.0
    available[:] = False
    assert found.bound == expected.bound
    assert found.criteria == expected.criteria
    assert str(found).splitlines()[1:5] == str(expected).splitlines()[1:5]
    for array in (found.indices, found.problem.candidates, found.problem.blocks):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_the_fewest_that_identify_are_the_default():
    assert len(select(uniform(0)).indices) == 4
    assert len(select(uniform(0, n=2)).indices) == 3


def test_a_generator_may_be_the_seed():
    one, two = (
        select(uniform(0), 6, "random", seed=np.random.default_rng(3)) for _ in range(2)
    )
    np.testing.assert_array_equal(one.indices, two.indices)
    same = select(uniform(0), 6, "random", seed=one.seed)
    np.testing.assert_array_equal(one.indices, same.indices)
    assert select(uniform(0), 6, "exchange", seed=np.random.default_rng(0)).seed > 0


def test_a_selection_prints_as_a_table_with_the_callers_labels():
    names = [f"pose {i}" for i in range(20)]
    found = select(uniform(0) * 40, 4, names=names)
    first = found.indices[0]
    lines = repr(found).splitlines()
    assert lines[0] == "4 of 20 candidates, method exact"
    assert lines[1].split() == ["candidate", "name", "u_x", "u_y", "u_z"]
    assert lines[2].split()[:3] == [str(first), "pose", str(first)]
    assert f"{found.problem.candidates[first, 0]:.6g}" in lines[2]
    assert "proven optimal" in str(found) and "reason" in str(found)
    assert "or more" in str(select(uniform(0), 6, "random"))
    plain = json.loads(json.dumps(found.to_dict()))
    assert plain["indices"] == found.indices.tolist()
    assert plain["labels"] == [names[i] for i in found.indices]
    assert plain["candidates"] == found.problem.candidates[found.indices].tolist()
    assert (plain["proven"], plain["efficiency"]) == (True, 1.0)
    with pytest.raises(ValueError, match="names must be 20 texts, one for each cand"):
        select(uniform(0), names=["a", "b"])


class Frame:
    """As much of a data frame as is read."""

    def __init__(self, values):
        self.values = values
        self.columns = ["pitch", "yaw", "roll"]
        self.index = [f"p{i}" for i in range(len(values))]

    def to_numpy(self):
        return self.values

    def __array__(self, dtype=None, copy=None):
        return np.asarray(self.values, dtype=dtype)


def test_a_data_frame_keeps_its_labels():
    found = select(Frame(uniform(0)), 4)
    assert found.labels == tuple(f"p{i}" for i in found.indices)
    assert str(found).splitlines()[1].split()[2:] == ["pitch", "yaw", "roll"]
    assert score(Frame(uniform(0)), found.indices).labels == found.labels


def test_rooms_are_there_after_the_import_alone():
    code = "import jaxcal; print(jaxcal.models.Affine(1, 1).names, jaxcal.selection)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout.startswith("('a11', 'b1')")


def test_the_import_changes_no_environment_variable():
    code = (
        "import os; before = dict(os.environ)\n"
        "import jaxcal; jaxcal.select, jaxcal.models\n"
        "assert dict(os.environ) == before, set(os.environ) ^ set(before)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_names_are_exported_lazily():
    assert jaxcal.select is select
    code = (
        "import sys, numpy as np, jaxcal\n"
        "X = np.random.default_rng(0).random((50, 3))\n"
        "names = {'jax', 'brax', 'matplotlib', 'pandas'}\n"
        "jaxcal.select(X, 4, 'exact'), jaxcal.select(X).bound\n"
        "jaxcal.select(X, 4, 'greedy').bound, jaxcal.select(X, 8, 'random')\n"
        "print(sorted(names & set(sys.modules)))\n"
        "jaxcal.select(X, 8)\n"
        "print(sorted(names & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines() == ["[]", "[]"]


def test_a_design_keeps_its_own_numbers_between_questions():
    candidates, measured = uniform(0), uniform(1, m=2)
    available, required = np.arange(20) != 4, np.array([3])
    design = jaxcal.Design(
        candidates, measured=measured, available=available, required=required
    )
    first = design.select(5)
    for array in (candidates, measured, available, required):
        array[:] = 0
    again = design.select(5)
    np.testing.assert_array_equal(first.indices, again.indices)
    assert first.log_det == again.log_det
    assert design.score(first.indices).log_det == pytest.approx(first.log_det)
    assert {c: design.select(5, c).criterion for c in "DAIE"} == {c: c for c in "DAIE"}
