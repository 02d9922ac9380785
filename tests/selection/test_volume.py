"""The largest volumes against brute force, with and without preparation."""

from __future__ import annotations

import itertools
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxcal.deadline import NEVER, Deadline
from jaxcal.selection import select
from jaxcal.selection.exact import exact
from jaxcal.selection.exact.exact import Volume, largest_volume

Array = np.ndarray


def sphere(seed: int, count: int, n: int = 3) -> Array:
    points = np.random.default_rng(seed).normal(size=(count, n))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def rows(points: Array) -> Array:
    return np.column_stack([points, np.ones(len(points))])


def determinants(vectors: Array, subsets: Array) -> Array:
    return np.abs(np.linalg.det(vectors[subsets]))


def brute_force(vectors: Array) -> float:
    h, q = vectors.shape
    return float(
        determinants(vectors, np.array(list(itertools.combinations(range(h), q)))).max()
    )


def prepared(
    monkeypatch: pytest.MonkeyPatch, vectors: Array, deadline: Deadline = NEVER
) -> Volume:
    """From a known volume, however few subsets there are."""
    with monkeypatch.context() as patch:
        patch.setattr(exact, "_PREPARED", 0)
        return largest_volume(vectors, deadline)


def make(kind: str, seed: int, h: int, q: int) -> Array:
    rng = np.random.default_rng(seed)
    vectors = rng.normal(size=(h, q))
    if kind == "ties":
        return np.round(vectors)
    if kind == "duplicates":
        return vectors[rng.integers(0, min(h, q + 1), h)]
    if kind == "coplanar":  # all but one in a subspace
        vectors[1:, -1] = 0.0
    if kind == "zeros":
        vectors[rng.permutation(h)[: h - q]] = 0.0
    if kind == "skewed":
        return vectors * 10.0 ** rng.uniform(-6, 6, q)
    if kind == "lengths":
        return vectors * 10.0 ** rng.uniform(-3, 3, (h, 1))
    if kind == "sphere":
        return rows(sphere(seed, h, q - 1)) if q > 2 else vectors
    return vectors


KINDS = (
    "plain", "ties", "duplicates", "coplanar", "zeros", "skewed", "lengths", "sphere",
)  # fmt: skip


@settings(max_examples=60)
@given(
    st.sampled_from(KINDS),
    st.integers(0, 10**6),
    st.integers(2, 5),
    st.integers(0, 7),
)
def test_the_search_finds_what_brute_force_finds(
    kind: str, seed: int, q: int, more: int
) -> None:
    vectors = make(kind, seed, q + more, q)
    h = len(vectors)
    subsets = np.array(list(itertools.combinations(range(h), q)))
    expected = np.sort(determinants(vectors, subsets))[::-1]
    with pytest.MonkeyPatch.context() as patch:
        answers = [prepared(patch, vectors)]
    answers.append(largest_volume(vectors))
    # A volume is known to the rounding of the longest vectors; where fewer than q are
    # not zero, it is zero to the rounding of the longest alone.
    lengths = np.sort(np.linalg.norm(vectors, axis=1))
    size = np.prod(np.where(lengths[-q:] > 0.0, lengths[-q:], 1e-3 * lengths[-1]))
    tolerance = {"rel": 1e-9, "abs": 1e-12 * size}
    for found in answers:
        assert found.complete and found.bound == found.size
        assert len(set(found.subset.tolist())) == q
        assert found.size == pytest.approx(expected[0], **tolerance)
        assert determinants(vectors, found.subset[None]) == pytest.approx(
            found.size, **tolerance
        )


@pytest.mark.parametrize("q", [2, 3, 4, 5])
@pytest.mark.parametrize("h", [8, 12])
def test_volumes_are_in_the_callers_unit(q: int, h: int) -> None:
    vectors = 7.0 * np.random.default_rng(q).normal(size=(h, q))
    assert largest_volume(vectors).size == pytest.approx(brute_force(vectors))


@pytest.mark.parametrize(("h", "q"), [(60, 4), (90, 3), (200, 3), (30, 5)])
@pytest.mark.parametrize("kind", ["plain", "sphere"])
def test_many_are_found_too(
    monkeypatch: pytest.MonkeyPatch, kind: str, h: int, q: int
) -> None:
    vectors = make(kind, h, h, q)
    subsets = np.array(list(itertools.combinations(range(h), q)))
    size = determinants(vectors, subsets)
    first = int(size.argmax())
    for found in (prepared(monkeypatch, vectors), largest_volume(vectors)):
        np.testing.assert_array_equal(found.subset, subsets[first])
        assert found.size == pytest.approx(size[first], rel=1e-11)
        assert found.examined < len(subsets) / 10


def test_the_search_for_pairs_ends_on_the_clock(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    angles = np.random.default_rng(0).uniform(0, np.pi, 200_000)
    vectors = np.column_stack([np.cos(angles), np.sin(angles)])
    begun = time.perf_counter()
    monkeypatch.setattr(exact, "_PREPARED", 10**12)
    found = largest_volume(vectors, Deadline(1.0))
    assert time.perf_counter() - begun < 5.0  # all pairs: 20 s
    assert not found.complete and found.bound >= found.size
    assert found.size > 0.9 or not found.examined  # a busy machine got no turn


@pytest.mark.parametrize("seconds", [0.0, 0.002, 0.02])
def test_a_deadline_leaves_an_honest_bound(
    monkeypatch: pytest.MonkeyPatch, seconds: float
) -> None:
    vectors = rows(sphere(4, 200, 6))
    optimum = prepared(monkeypatch, vectors).size
    found = prepared(monkeypatch, vectors, deadline=Deadline(seconds))
    if seconds == 0.0:
        assert not found.complete and found.examined == 0
    assert found.size <= optimum * (1 + 1e-12) and optimum <= found.bound
    assert found.size == pytest.approx(determinants(vectors, found.subset[None])[0])
    assert found.size > 0.9 * optimum


@pytest.mark.parametrize("vectors", [np.zeros((6, 3)), np.eye(4)[:3].repeat(3, axis=0)])
def test_no_volume_at_all(monkeypatch: pytest.MonkeyPatch, vectors: Array) -> None:
    for found in (largest_volume(vectors), prepared(monkeypatch, vectors)):
        assert found.size == pytest.approx(0.0, abs=1e-12)
        assert found.complete and found.subset.shape == vectors.shape[1:]


@pytest.mark.parametrize(("count", "n"), [(500, 3), (600, 3), (300, 4), (200, 7)])
def test_a_sphere_is_proven_within_seconds(count: int, n: int) -> None:
    candidates = sphere(0, count, n)
    found = select(candidates, n + 1, "exact", time_limit=20)
    assert found.proven and found.seconds < 10  # milliseconds once compiled
    assert found.log_det >= select(candidates, n + 1, "exchange").log_det - 1e-9
