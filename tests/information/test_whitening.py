"""Whitened blocks against a factor in extended precision, however conditioned."""

import numpy as np
import pytest

from jaxcal.information.blocks import rank_of_blocks, triangle, whiten


def extended_log_det(rows):
    """log det of ``rows.T @ rows`` by Gram-Schmidt in 64 bits of mantissa, twice."""
    rest = rows.astype(np.longdouble)
    value = np.longdouble(0.0)
    for a in range(rest.shape[1]):
        for _ in range(2):
            for b in range(a):
                rest[:, a] -= (rest[:, b] @ rest[:, a]) * rest[:, b]
        size = np.sqrt(rest[:, a] @ rest[:, a])
        value += 2 * np.log(size)
        rest[:, a] /= size
    return float(value)


@pytest.mark.parametrize("with_root", [False, True])
@pytest.mark.parametrize("digits", [0, 2, 4, 6, 7, 9])
def test_whitened_information_is_the_identity(digits, with_root):
    """One factor of the Gram matrix, two, or rotations: none loses the answer."""
    rng = np.random.default_rng(digits)
    p, count, q = 7, 40, 3
    left = np.linalg.qr(rng.normal(size=(count * q, p)))[0]
    right = np.linalg.qr(rng.normal(size=(p, p)))[0]
    blocks = (left * np.logspace(0, -digits, p) @ right).reshape(count, q, p)
    blocks *= 10.0 ** np.arange(-3, 4)  # parameters in different units
    root = blocks[0] * 2.0 if with_root else np.zeros((0, p))
    usable = np.ones(count, dtype=bool)
    usable[3] = with_root
    white = whiten(blocks[None], usable[None], root)[0]
    chosen = white.blocks[usable].reshape(-1, p)
    total = chosen.T @ chosen + white.prior
    rounding = 3e-9 + 1e-16 * 10**digits  # a factor by rotations keeps its condition
    raw = blocks[usable].reshape(-1, p)
    exact = extended_log_det(np.concatenate([raw, root]))
    np.testing.assert_allclose(total, np.eye(p), rtol=0, atol=rounding)
    assert white.log_scale == pytest.approx(exact, abs=rounding * 100)
    np.testing.assert_allclose(
        (raw @ white.basis).ravel(), chosen.ravel(), rtol=0, atol=1e-6
    )


@pytest.mark.parametrize("shape", [(5, 9), (130, 3), (300, 60), (1000, 7)])
def test_a_triangle_made_in_parts_has_the_product_of_its_rows(shape):
    rows = np.random.default_rng(0).normal(size=shape)
    found = triangle(rows)
    assert found.shape == (min(shape), shape[-1])
    np.testing.assert_array_equal(found, np.triu(found))
    products = [each.T @ each for each in (found, rows)]
    np.testing.assert_allclose(*products, atol=1e-10)


@pytest.mark.parametrize("known", [0, 2])
@pytest.mark.parametrize("q", [1, 2])
@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_log_det_of_selections_clear_and_not(offset, q, known):
    """A batch of plain ones, tiny ones, nearly dependent ones and a singular one."""
    rng = np.random.default_rng(q)
    sets, root = rng.normal(size=(5, 6, q, 4)), rng.normal(size=(known, 4))
    sets[..., 0] += offset
    sets[..., -1] = 1.0
    sets[2] *= 0.1 if known else 1e-120
    sets[3, ..., 1] = sets[3, ..., 2] + 1e-6 * rng.normal(size=(6, q))
    sets[4, ..., 1] = sets[4, ..., 2]
    if known:
        root[:, 1] = root[:, 2]
    ranks, log_det = rank_of_blocks(sets, root)
    assert ranks == [4, 4, 4, 4, 3]
    assert log_det[4] == -np.inf
    for blocks, value in zip(sets[:4], log_det[:4], strict=True):
        exact = extended_log_det(np.concatenate([blocks.reshape(-1, 4), root]))
        assert value == pytest.approx(exact, abs=1e-8)


@pytest.mark.parametrize("count", [7, 60, 900])
def test_a_far_row_leaves_the_others_their_digits(count):
    x = np.random.default_rng(count).uniform(-1.0, 1.0, count)
    x[count // 2] = 1e9
    rows = np.stack([x, np.ones(count)], axis=1)[None, :, None]
    white = whiten(rows, np.ones((1, count), dtype=bool), np.zeros((0, 2)))[0]
    for pair in ([0, 1], [0, count - 1], [1, count - 2]):
        value = 2.0 * np.linalg.slogdet(white.blocks[pair, 0])[1] + white.log_scale
        exact = 2.0 * np.log(np.abs(x[pair[0]] - x[pair[1]]))
        assert value == pytest.approx(exact, abs=1e-7)


def test_a_prior_alone_is_what_is_left_without_the_only_measurement(rng):
    root = rng.normal(size=(3, 3))
    _, log_det = rank_of_blocks(np.zeros((2, 0, 1, 3)), root)
    np.testing.assert_allclose(log_det, 2.0 * np.linalg.slogdet(root)[1])


@pytest.mark.parametrize("p", [1, 4, 39])
def test_triangles_of_small_matrices_are_numpys(p):
    from jaxcal.information.rank_kernel import factors

    rows = np.random.default_rng(p).normal(size=(5, 3 * p, p))
    rows[2, :, 0] = 0.0  # no triangle with an inverse
    back, inverse, log_det = factors(rows.mT @ rows)
    assert np.isnan(back[2]).all() and np.isnan(inverse[2]).all()
    assert np.isnan(log_det[2])
    for n in (0, 1, 3, 4):
        square = rows[n].T @ rows[n]
        np.testing.assert_allclose(back[n], np.linalg.cholesky(square).T, atol=1e-10)
        np.testing.assert_allclose(inverse[n], np.linalg.inv(back[n]), atol=1e-10)
        np.testing.assert_allclose(log_det[n], np.linalg.slogdet(square)[1])
