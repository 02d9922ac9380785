"""The policy's geometry in float32, against float64 linear algebra written plainly."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcal.information import regression
from jaxcal.learning import small_matrices
from jaxcal.learning.policies import features as geometry
from jaxcal.selection.policy.policy_kernel import look_ahead

# One program for every depth; op by op it would be many.
lookahead = jax.jit(geometry.lookahead, static_argnums=1)


def log_det(rows: np.ndarray) -> float:
    return float(np.linalg.slogdet(rows.T @ rows)[1])


def whitened(rng, m=12, n=3):
    points = rng.uniform(size=(m, n)).astype(np.float32)
    x, offset = geometry.whiten(jnp.asarray(points), jnp.ones(m, bool))
    return points, np.asarray(x, np.float64), float(offset)


def test_cholesky_is_numpys(rng):
    rows = rng.normal(size=(5, 9, 4)).astype(np.float32)
    gram = np.matrix_transpose(rows) @ rows
    np.testing.assert_allclose(
        small_matrices.cholesky(jnp.asarray(gram)), np.linalg.cholesky(gram), rtol=2e-5
    )


def test_of_many_candidates_those_of_largest_gain_are_looked_ahead_from(
    rng, monkeypatch
):
    """As the float64 kernel of inference has it, and the same as from all for those."""
    y = rng.normal(size=(1100, 3)).astype(np.float32)
    active = rng.random(1100) < 0.9
    y[~active] = 0.0
    few = lookahead(jnp.asarray(y), True, jnp.asarray(active), 3)
    values = np.empty((4, 1100))
    given = np.ascontiguousarray(y.T, np.float64)
    look_ahead(given, active, True, 3, False, values)
    for mine, theirs in zip(few, values, strict=True):
        np.testing.assert_allclose(mine, theirs, atol=1e-4)
    assert (np.asarray(few[1]) > -30.0).sum() == 512
    monkeypatch.setattr(geometry, "ALL_START", 10**6)
    whole = geometry.lookahead(jnp.asarray(y), True, jnp.asarray(active), 3)
    shown = np.asarray(few[2]) > -30.0
    np.testing.assert_allclose(few[2][shown], whole[2][shown], atol=1e-5)


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_whitened_regressors_carry_the_hat_matrix_and_every_determinant(rng, n):
    points, x, offset = whitened(rng, 12, n)
    np.testing.assert_allclose(x.T @ x / 12, np.eye(n + 1), atol=2e-6)
    z = np.c_[points, np.ones(12)].astype(np.float64)
    hat = z @ np.linalg.inv(z.T @ z) @ z.T
    np.testing.assert_allclose(x @ x.T / 12, hat, atol=2e-6)
    subset = rng.permutation(12)[: n + 2]
    expected = regression.log_det_gram(points[subset])
    assert log_det(x[subset]) + offset == pytest.approx(expected, abs=1e-4)


def test_whitening_leaves_unusable_candidates_out(rng):
    points = rng.uniform(size=(10, 3)).astype(np.float32)
    usable = np.arange(10) < 7
    points[7:] = 1e3
    x, _ = geometry.whiten(jnp.asarray(points), jnp.asarray(usable))
    alone, _ = geometry.whiten(jnp.asarray(points[:7]), jnp.ones(7, bool))
    np.testing.assert_allclose(x[:7], alone, atol=1e-5)
    assert not np.asarray(x[7:]).any()


def test_projection_leaves_the_schur_complement(rng):
    _, x, _ = whitened(rng)
    x32 = jnp.asarray(x, jnp.float32)
    y, _ = geometry.projected(x32, x32[:2], 2)
    kernel = x @ x.T
    expected = kernel - kernel[:, :2] @ np.linalg.solve(kernel[:2, :2], kernel[:2])
    np.testing.assert_allclose(np.asarray(y @ y.T), expected, atol=1e-5)
    _, volume = geometry.projected(x32, x32[:3], 3)
    assert float(volume) == pytest.approx(np.linalg.slogdet(kernel[:3, :3])[1], 1e-4)


def test_a_repeated_direction_leaves_nothing_and_breaks_nothing():
    x = jnp.asarray([[1.0, 0.0], [1.0, 0.0], [0.0, 2.0]])
    y, _ = geometry.projected(x, x[:2], 2)
    np.testing.assert_allclose(y, [[0.0, 0.0], [0.0, 0.0], [0.0, 2.0]], atol=1e-6)


def test_the_metric_of_the_chosen_gives_every_gain(rng):
    _, x, _ = whitened(rng)
    y, value = geometry.normalised_by(
        jnp.asarray(x, jnp.float32), jnp.asarray(x[:5], jnp.float32), 0.0
    )
    assert float(value) == pytest.approx(log_det(x[:5]), abs=1e-4)
    for i in range(5, 12):
        grown = log_det(x[[0, 1, 2, 3, 4, i]])
        assert np.log1p(float((y[i] ** 2).sum())) == pytest.approx(
            grown - log_det(x[:5]), abs=1e-4
        )


@pytest.mark.parametrize("chosen", [0, 1, 2])
def test_lookahead_before_the_space_is_spanned_is_greedy(rng, chosen):
    _, x, _ = whitened(rng)
    kernel = x @ x.T
    depth = 4 - chosen
    active = np.arange(12) >= chosen
    y, _ = geometry.projected(
        jnp.asarray(x, jnp.float32), jnp.asarray(x[:chosen], jnp.float32), chosen
    )
    y = y * active[:, None]
    values = np.stack(lookahead(y, False, jnp.asarray(active), depth))

    def volume(picked):
        return np.linalg.slogdet(kernel[np.ix_(picked, picked)])[1] if picked else 0.0

    for start in range(chosen, 12):
        picked = [*range(chosen), start]
        for step in range(depth):
            if step:
                rest = [j for j in range(12) if j not in picked]
                picked = [*picked, max(rest, key=lambda j: volume([*picked, j]))]
            expected = volume(picked) - volume(list(range(chosen)))
            assert values[step, start] == pytest.approx(expected, abs=1e-4)


def test_lookahead_after_it_is_greedy_too_and_never_repeats(rng):
    _, x, _ = whitened(rng, m=8)
    y, _ = geometry.normalised_by(
        jnp.asarray(x, jnp.float32), jnp.asarray(x[:4], jnp.float32), 0.0
    )
    active = np.arange(8) >= 4
    values = np.stack(lookahead(y * active[:, None], True, active, 4))
    base = log_det(x[:4])
    for start in range(4, 8):
        picked = [0, 1, 2, 3, start]
        for step in range(4):
            if step:
                rest = [j for j in range(4, 8) if j not in picked]
                picked = [*picked, max(rest, key=lambda j: log_det(x[[*picked, j]]))]
            assert values[step, start] == pytest.approx(
                log_det(x[picked]) - base, abs=1e-4
            )
    # With every candidate chosen all starts end at the same set.
    assert np.ptp(values[3, 4:]) < 1e-4


def test_compiled_and_shared_over_a_mapped_axis_it_is_the_same(rng):
    # jaxlib 0.10.2 compiled the plain form of ``projected`` wrongly in this shape.
    x = jnp.asarray(rng.normal(size=(128, 50, 4)), jnp.float32)
    which = jnp.asarray(rng.integers(50, size=(2, 128, 3)))

    def project(index):
        chosen = jnp.take_along_axis(x, index[..., None], axis=-2)
        return geometry.projected(x, chosen, 3)[0]

    compiled = jax.jit(jax.vmap(project))(which)
    plain = jnp.stack([project(which[0]), project(which[1])])
    np.testing.assert_allclose(compiled, plain, atol=2e-5)


def test_log_det_gram_is_that_of_the_regressors(rng):
    points = rng.uniform(size=(6, 5, 3)).astype(np.float32)
    np.testing.assert_allclose(
        small_matrices.log_det_gram(jnp.asarray(points)),
        regression.log_det_gram(points),
        rtol=1e-4,
    )
    flat = jnp.asarray(points).at[..., 2].set(0.5)
    assert np.isfinite(np.asarray(small_matrices.log_det_gram(flat))).all()


@pytest.mark.parametrize("k", [5, 20])
def test_log_det_gram_counts_only_the_rows_present(rng, k):
    postures = rng.uniform(size=(3, k, 3))
    present = np.ones((3, k), bool)
    present[0, 4:] = False
    found = small_matrices.log_det_gram(jnp.asarray(postures, jnp.float32), present)
    for number in range(3):
        z = np.c_[postures[number][present[number]], np.ones(present[number].sum())]
        wanted = np.linalg.slogdet(z.T @ z)[1]
        np.testing.assert_allclose(found[number], wanted, rtol=2e-5, atol=2e-5)
