"""Steps from rest, and a dead zone read from a reference, against mechanisms played."""

import jax
import numpy as np
import pytest
from tasks.backlash import dead_zone, dead_zone_bins

from benchmarks.tasks.breakaway import Cautious, breakaway
from jaxcal.adaptive.episodes import play
from jaxcal.adaptive.grid import GridBelief
from jaxcal.adaptive.rules import Gain


def test_breakaway_is_a_joint_that_yields_late_and_a_noisy_reading():
    task = breakaway(0.8, 8, sigma=0.1, spread=0.03, outliers=0.0)
    rng = np.random.default_rng(0)
    designs, theta = np.asarray(task.designs), np.asarray(task.theta)
    table = np.asarray(task.likelihood)
    for _ in range(20):
        a, s = rng.integers(len(designs)), rng.integers(len(theta))
        (step, direction), (up, down) = designs[a], theta[s]
        threshold = rng.normal(up if direction > 0 else down, 0.03, 4000)
        moved = np.where(step > threshold, step, 0.0) + rng.normal(0, 0.1, 4000)
        share = np.mean(moved > step / 2.0)
        error = np.sqrt(table[a, 1, s] * table[a, 0, s] / 4000)
        assert abs(share - table[a, 1, s]) < 5.0 * error + 2e-3
    with pytest.raises(ValueError, match="directions must be 1 or 2, got 3"):
        breakaway(directions=3)


def test_a_dead_zone_is_read_from_a_reference_past_it():
    task = dead_zone(
        0.8, 0.2, reach=0.9, reference=0.9, sigma=0.01, outliers=0.0, cells=8,
        offset_cells=4, num_postures=9, bin_width=0.1,
    )  # fmt: skip
    bins = dead_zone_bins(0.8, 0.9, 0.1, relative=True)
    table = np.asarray(task.likelihood)

    def joint(u, width, centre):
        low, high = centre - width / 2, centre + width / 2
        return u - high if u > high else u - low if u < low else 0.0

    for a, (u,) in enumerate(np.asarray(task.designs)):
        for s, (width, centre) in enumerate(np.asarray(task.theta)):
            read = joint(u, width, centre) - joint(0.9, width, centre) - (u - 0.9)
            near = abs((read - bins.low) / 0.1 % 1.0 - 0.5) < 0.2  # not at an edge
            if near:
                assert table[a, bins.outcome(read), s] > 0.98


def test_a_cautious_step_is_the_best_of_those_that_are_not_risky():
    task = breakaway(0.64, 16, 1)
    steps = np.asarray(task.designs)[:, 0]
    theta = np.asarray(task.theta)[:, 0]
    session = task.session(np.inf, 9)
    flat, last = np.full(16, 1 / 16), np.eye(16)[15]
    # Of a flat belief 5 % is less than a cell of 0.04: at most 0.12, the first two.
    for weights, allowed in ((flat, steps < 0.13), (last, steps < 1.0)):
        belief = GridBelief(weights.astype(np.float32))
        options = task.options(belief, session)
        chosen = int(Cautious(0.1, 0.05)(task, belief, session, options, None))
        gains = np.asarray(belief.gains(task, options))
        risk = ((steps[:, None] - theta > 0.1) * weights).sum(axis=1)
        assert ((risk <= 0.05) == allowed).all()
        assert gains[chosen] == gains[allowed].max() and allowed[chosen]


@pytest.mark.slow
def test_a_cautious_step_hardly_ever_goes_far_past_the_threshold():
    task = breakaway(0.64, 32, 1, spread=0.008, measurements=14)
    keys = jax.random.split(jax.random.key(0), 200)
    truth, steps, found = {}, {}, {}
    for name, decider in (("free", Gain()), ("cautious", Cautious(0.1, 0.05))):
        played = play(task, decider, keys)
        truth[name] = np.asarray(task.theta)[np.asarray(played.truth), 0]
        steps[name] = np.asarray(task.designs)[np.asarray(played.designs), 0]
        found[name] = float(played.entropy_drop.mean())
    far = {n: steps[n] - truth[n][:, None] > 0.1 for n in steps}
    assert far["cautious"].mean() <= 0.05 < far["free"].any(axis=1).mean()
    assert found["cautious"] > 0.95 * found["free"]  # nearly all of log 32 nats
