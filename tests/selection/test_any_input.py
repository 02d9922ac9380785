"""Every criterion against brute force in exact fractions, for inputs of any kind.

Rows that come twice, commands far from zero, columns of very different scales, what is
known or measured before, replicates, required candidates and some not available. Each
call has a hard time limit: it runs in a process that is killed where it does not end.
"""

import dataclasses
import itertools
import math
import multiprocessing
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from questions import of

import jaxcal
from jaxcal.selection.batch import exact_batch
from jaxcal.selection.criteria import CRITERIA

LIMIT = 20.0  # seconds of a call


def _serve(pipe):
    import jaxcal

    while True:
        name, arguments, keywords = pipe.recv()
        try:
            if name == "score":
                indices, about, criterion = arguments
                found = jaxcal.Design.from_blocks(**about).score(indices, criterion)
            else:
                found = jaxcal.select(*arguments, **keywords)
            told = ("indices", "value", "bound", "efficiency", "proven", "reason")
            pipe.send([getattr(found, each) for each in told])
        except ValueError as error:
            pipe.send(error)


class Worker:
    """``jaxcal.select`` and others in a process that can be killed."""

    def __init__(self):
        self.start()

    def start(self):
        context = multiprocessing.get_context("spawn")
        self.pipe, other = context.Pipe()
        self.process = context.Process(target=_serve, args=(other,), daemon=True)
        self.process.start()
        rows = np.eye(4)[[0, 1, 2, 3, 3]]
        for kind in CRITERIA:  # whatever a first call has to load
            for blocks in (rows[:, None], rows[:, None].repeat(2, axis=1)):
                self(
                    "select", blocks=blocks, k=4, criterion=of(kind, [0]), limit=300.0,
                    prior=np.eye(4),
                )  # fmt: skip

    def __call__(self, name, *arguments, limit=LIMIT, **keywords):
        self.pipe.send((name, arguments, keywords))
        if not self.pipe.poll(limit):
            self.process.kill()
            self.start()
            pytest.fail(f"jaxcal.{name}{arguments}{keywords} took over {limit} s")
        answer = self.pipe.recv()
        if isinstance(answer, ValueError):
            raise answer
        return Answer(*answer)


@dataclasses.dataclass
class Answer:
    indices: np.ndarray
    value: float
    bound: float
    efficiency: float
    proven: bool
    reason: str


@pytest.fixture(scope="module")
def worker():
    made = Worker()
    yield made
    made.process.kill()


def fractions(array):
    return [[Fraction(float(x)) for x in row] for row in array]


def inverse_of(matrix):
    """Exact inverse and determinant of a matrix of fractions; None where singular."""
    p, det = len(matrix), Fraction(1)
    rows = [row + [Fraction(int(a == b)) for b in range(p)]
            for a, row in enumerate(matrix)]  # fmt: skip
    for a in range(p):
        pivot = next((b for b in range(a, p) if rows[b][a] != 0), None)
        if pivot is None:
            return None, Fraction(0)
        if pivot != a:
            rows[a], rows[pivot], det = rows[pivot], rows[a], -det
        det *= rows[a][a]
        rows[a] = [x / rows[a][a] for x in rows[a]]
        for b in range(p):
            if b != a and rows[b][a] != 0:
                weight = rows[b][a]
                rows[b] = [
                    x - weight * y for x, y in zip(rows[b], rows[a], strict=True)
                ]
    return [row[p:] for row in rows], det


def product_of(rows):
    p = len(rows[0])
    return [[sum(r[a] * r[b] for r in rows) for b in range(p)] for a in range(p)]


def added(*matrices):
    return [
        [sum(each) for each in zip(*rows, strict=True)]
        for rows in zip(*matrices, strict=True)
    ]


def log_of(x):
    """Natural log of a positive fraction of any size."""
    return math.log(x.numerator) - math.log(x.denominator)


LEAST = ("A", "As", "I", "G")  # the smaller the better


def worth(name, information, positions, region):
    """The criterion of exact information; -inf or inf where singular."""
    covariance, det = inverse_of(information)
    if det == 0:
        return np.inf if name in LEAST else -np.inf
    if name == "D":
        return log_of(det)
    if name in ("I", "G"):
        variances = [
            sum(r[a] * covariance[a][b] * r[b] for a in range(len(r))
                for b in range(len(r)))
            for r in region
        ]  # fmt: skip
        return float(max(variances) if name == "G" else sum(variances) / len(region))
    at = positions if name in ("Ds", "As") else range(len(covariance))
    part = [[covariance[a][b] for b in at] for a in at]
    if name in ("A", "As"):
        return float(sum(part[a][a] for a in range(len(part))))
    if name == "Ds":
        return -log_of(inverse_of(part)[1])
    return 1.0 / float(np.linalg.eigvalsh(np.array(part, dtype=float))[-1])


@dataclasses.dataclass
class Case:
    keywords: dict
    blocks: list  # (M, q, p) of fractions
    known: list  # (p, p)
    affine: bool
    k: int
    outputs: int = 1

    def brute(self, name, positions):
        m = len(self.blocks)
        grams = [product_of(block) for block in self.blocks]
        given = self.keywords.get("available")
        usable = range(m) if given is None else np.flatnonzero(given)
        required = set(self.keywords.get("required") or ())
        cap = self.keywords.get("max_replicates", 1)
        region = [row for i in usable for row in self.blocks[i]]
        found = {}
        for some in itertools.combinations_with_replacement(usable, self.k):
            if required <= set(some) and max(map(some.count, some)) <= cap:
                total = added(self.known, *(grams[i] for i in some))
                found[some] = worth(name, total, positions, region)
        return found


def drawn(seed, affine=True):
    """A problem of any kind, small enough for brute force; ``affine`` or of blocks."""
    rng = np.random.default_rng(seed)
    affine = bool(rng.random() < 0.5) and affine
    m = int(rng.integers(6, 9))
    keywords = {}
    if affine:
        n = int(rng.integers(1, 3))
        scale = 10.0 ** rng.choice([-12, -3, 0, 0, 5, 12], size=n)
        offset = rng.choice([0.0, 0.0, 1e3, 1e5, 1e8])
        make = lambda count: (rng.random((count, n)) + offset) * scale  # noqa: E731
        given, p, q = make(m), n + 1, 1
        blocks = lambda u: np.hstack([u, np.ones((len(u), 1))])[:, None]  # noqa: E731
        outputs = n
    else:
        q, p = int(rng.integers(1, 3)), int(rng.integers(2, 4))
        scale = 10.0 ** rng.choice([-12, -5, 0, 0, 5, 12], size=p)
        make = lambda count: rng.normal(size=(count, q, p)) * scale  # noqa: E731
        given, blocks, outputs = make(m), lambda b: b, 1
    if rng.random() < 0.6:
        twice = int(rng.integers(1, 4))
        given = np.concatenate([given[: m - twice], given[:twice]])
    known = np.zeros((p, p))
    exact = [[Fraction(0)] * p for _ in range(p)]
    if not affine and rng.random() < 0.5:
        diagonal = 10.0 ** rng.uniform(-6, 0, size=p) * scale**2
        known = np.diag(diagonal)
        keywords["prior"] = known
        exact = fractions(known)
    if rng.random() < 0.3:
        keywords["measured"] = make(int(rng.integers(1, 3)))
        rows = [r for b in blocks(keywords["measured"]) for r in fractions(b)]
        exact = added(exact, product_of(rows))
    if rng.random() < 0.3:
        keywords["available"] = rng.permutation(m) != 0
    if rng.random() < 0.3:
        keywords["max_replicates"] = 2
    if rng.random() < 0.3:
        usable = np.flatnonzero(keywords.get("available", np.ones(m, dtype=bool)))
        keywords["required"] = [int(rng.choice(usable))]
    keywords["candidates" if affine else "blocks"] = given
    exact_blocks = [fractions(b) for b in blocks(given)]
    k = int(rng.integers(-(-p // q), -(-p // q) + 3))
    return Case({**keywords, "k": k}, exact_blocks, exact, affine, k, outputs)


def share(name, value, best, size):
    """Efficiency of a value, of parameters counted once."""
    if name in ("D", "Ds"):
        return math.exp((value - best) / size)
    return best / value if name in LEAST else value / best


@pytest.mark.parametrize("name", CRITERIA)
@pytest.mark.parametrize("seed", range(24))
def test_no_call_hangs_and_what_is_proven_is_the_optimum(worker, seed, name):
    some = name in ("Ds", "As")  # the affine model's parameters are of every output
    case = drawn(seed, affine=not some)
    p = len(case.known)
    positions, keywords = None, dict(case.keywords, criterion=of(name, [0]))
    if some:
        positions = [0]
    found = case.brute(name, positions)
    least = name in LEAST
    best = (min if least else max)(found.values())
    times = case.outputs if case.affine and name in ("A", "D") else 1
    size = 1 if name == "Ds" else p
    for method in ("exact", "auto", "exchange", "greedy", "random"):
        answer = worker("select", method=method, **keywords)
        chosen = tuple(sorted(answer.indices.tolist()))
        true = found[chosen]
        reached = share(name, true, best, size)
        told = share(name, answer.value / times, true, size)
        assert told == pytest.approx(1.0, abs=1e-6), (method, answer.value, true)
        bound = share(name, best, answer.bound / times, size)
        assert bound <= 1.0 + 1e-6, (method, best, answer.bound)
        assert 0.0 < answer.efficiency <= 1.0
        if answer.proven:
            assert reached >= 1.0 - 1e-8, (method, true, best)
            assert told == pytest.approx(1.0, abs=1e-8)
        elif method == "exact":
            assert "double precision" in answer.reason
        if method in ("exact", "auto"):
            assert reached >= (1.0 - 1e-6 if method == "exact" else 0.999 - 1e-6)


@pytest.mark.parametrize("name", ["A", "I", "E", "D"])
@pytest.mark.parametrize("seed", range(5))
def test_rows_that_come_twice_never_hang(worker, seed, name):
    c = np.random.default_rng(seed).random((30, 3))
    c = np.vstack([c, c[:10]])
    answer = worker("select", c, 4, criterion=name, time_limit=1.0)
    assert len(set(answer.indices.tolist())) == 4
    if name == "A":
        alone = worker("select", c[:30], 4, criterion=name, time_limit=1.0)
        assert answer.value == pytest.approx(alone.value, rel=1e-3)


@pytest.mark.parametrize("offset", [1e5, 1e8])
@pytest.mark.parametrize("seed", range(5))
def test_the_proof_of_e_holds_far_from_zero(worker, seed, offset):
    u = np.random.default_rng(seed).random((9, 2)) + offset
    rows = np.hstack([u, np.ones((9, 1))])
    blocks = [fractions(row[None]) for row in rows]
    case = Case({}, blocks, fractions(np.zeros((3, 3))), True, 4)
    found = case.brute("E", None)
    answer = worker("select", u, 4, "exact", criterion="E")
    assert answer.proven
    assert found[tuple(sorted(answer.indices.tolist()))] == max(found.values())
    assert answer.value == pytest.approx(max(found.values()), rel=1e-9)


@pytest.mark.parametrize("name", CRITERIA)
def test_columns_of_very_different_scale(worker, name):
    blocks = np.random.default_rng(3).normal(size=(8, 1, 3)) * [1.0, 1e5, 1e10]
    case = Case(
        {}, [fractions(b) for b in blocks], fractions(np.zeros((3, 3))), False, 4
    )
    positions = [0] if name in ("Ds", "As") else None
    found = case.brute(name, positions)
    answer = worker("select", None, 4, "exact", blocks=blocks, criterion=of(name, [0]))
    best = (min if name in LEAST else max)(found.values())
    assert answer.proven
    assert found[tuple(sorted(answer.indices.tolist()))] == pytest.approx(
        best, rel=1e-9
    )
    assert answer.value == pytest.approx(best, rel=1e-9)


def test_what_double_precision_does_not_hold_is_not_called_proven(worker):
    """Columns equal but for 1e-8 of themselves, and no constant one to centre them."""
    rng = np.random.default_rng(0)
    common = rng.normal(size=(10, 1, 1))
    blocks = np.concatenate(
        [common, common + 1e-8 * rng.normal(size=(10, 1, 1))], axis=2
    )
    answer = worker("select", None, 3, "exact", blocks=blocks)
    assert not answer.proven
    assert "not proven in double precision" in answer.reason
    assert answer.efficiency < 1.0


def test_a_bound_of_the_root_alone_is_never_below_zero(worker):
    """The root of the search stopped at a share of its distance to the incumbent."""
    for seed in (103, 137):
        rng = np.random.default_rng(seed)
        m, q, p, k = [(30, 1, 5, 6), (20, 2, 6, 3), (20, 2, 6, 4), (15, 3, 4, 2),
                      (40, 1, 4, 4), (20, 2, 8, 4)][seed % 6]  # fmt: skip
        blocks = rng.normal(size=(m, q, p)) * 10.0 ** rng.integers(-3, 3, size=p)
        prior = 10.0 ** float(rng.integers(-8, 0)) * np.eye(p)
        rng.permutation(m)
        indices = rng.permutation(m)[:k]
        answer = worker("score", indices, {"blocks": blocks, "prior": prior}, "A")
        assert 0.0 < answer.efficiency <= 1.0
        answer = worker(
            "select", None, k, "greedy", blocks=blocks, criterion="A", prior=prior
        )
        assert 0.0 < answer.efficiency <= 1.0


@pytest.mark.parametrize("name", ["I", "A", "D", "E"])
def test_blocks_that_say_nothing_are_fine_with_a_prior(worker, name):
    answer = worker(
        "select", None, 2, blocks=np.zeros((5, 1, 2)), prior=np.eye(2), criterion=name
    )
    assert answer.efficiency == 1.0


@st.composite
def float32_tables(draw, dependent):
    """(M, 3) of float32, near 0 or far from it; the third a sum of two in float32."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    far = draw(st.sampled_from([0.0, 0.1, 30.0, 1e3]))
    size = 10.0 ** draw(st.integers(-6, 6))
    u = (size * (far + rng.random((draw(st.integers(5, 100)), 3)))).astype(np.float32)
    if dependent:
        a, b = rng.normal(size=2).astype(np.float32)
        u[:, 2] = a * u[:, 0] + b * u[:, 1]
    return u


@given(float32_tables(dependent=True))
def test_float32_candidates_in_a_plane_are_refused(u):
    with pytest.raises(ValueError, match="in one plane"):
        jaxcal.select(u, 4)
    with pytest.raises(ValueError, match="in one plane"):
        exact_batch(np.stack([u, u]), 4)
    with pytest.raises(ValueError, match=r"same in every row|not inform the direct"):
        jaxcal.Design(u, measured=u[:3]).select(4)
    rows = u[:, None, :]
    with pytest.raises(ValueError, match="not inform the direction"):
        jaxcal.Design.from_blocks(rows, measured=rows[:2]).select(3)
    with pytest.raises(ValueError, match="not inform the direction"):
        jaxcal.Design.from_blocks(np.stack([rows, rows])).select(3)
    assert len(jaxcal.Design.from_blocks(rows, prior=np.eye(3)).select(3).indices) == 3


def test_float32_is_judged_reading_by_reading_and_where_it_counts():
    rng = np.random.default_rng(3)
    whole, part = rng.random((2, 20)).astype(np.float32)
    pulses = 1e6 * np.stack([whole, whole], axis=1)  # a reading of the sum
    radians = 0.1 * np.stack([part, -part], axis=1)  # and one of the difference
    blocks = np.stack([pulses, radians], axis=1)
    noise = jaxcal.Noise(std=[1e6, 0.1])
    answer = jaxcal.Design.from_blocks(blocks, noise=noise).select(2)
    doubles = jaxcal.Design.from_blocks(blocks.astype(np.float64), noise=noise)
    assert answer.log_det == doubles.select(2).log_det
    u = rng.random((12, 3)).astype(np.float32)
    u[:10, 2] = u[:10, 0] + u[:10, 1]
    u[10] = np.nan
    available = np.arange(12) < 10
    with pytest.raises(ValueError, match="in one plane"):
        jaxcal.select(u, 4, available=available)
    assert jaxcal.select(u, 4, available=np.arange(12) != 10).proven
    scenarios = np.stack([u[:10, None], u[:10, None, [1, 0, 2]] ** 2])
    with pytest.raises(ValueError, match=r"in scenario 0: .*not inform the direction"):
        jaxcal.Design.from_blocks(scenarios).select(3)


@given(float32_tables(dependent=False))
def test_float32_candidates_are_the_numbers_that_they_hold(u):
    answer, exact = jaxcal.select(u, 4), jaxcal.select(u.astype(np.float64), 4)
    assert answer.log_det == exact.log_det
    assert np.array_equal(answer.indices, exact.indices)
