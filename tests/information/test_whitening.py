"""Whitened blocks against a factor in extended precision, however conditioned."""

import numpy as np
import pytest

from jaxcal.information.blocks import triangle, whiten


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
