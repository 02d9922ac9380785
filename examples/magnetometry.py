"""Find the centre of a resonance: each setting chosen from the readings before it.

python examples/magnetometry.py           # 20 peaks, 40 readings
python examples/magnetometry.py --full    # 100 peaks, 100 readings
"""

from __future__ import annotations

import sys

import common
import jax
import jax.numpy as jnp
import numpy as np

from jaxcal import Noise
from jaxcal.adaptive import ParticleTask
from jaxcal.adaptive.rules import Gain
from jaxcal.models import FromJax

WIDTH = 0.15
SETTINGS = np.linspace(1.5, 4.5, 30)[:, None]
RULES = ("random", "beforehand", "closed loop")
PANELS = 2


def peak(u, theta):
    """Signal at a setting: a Lorentzian of known width on a base."""
    centre, height, base = theta
    return base + height / (1.0 + ((u[0] - centre) / WIDTH) ** 2)


def prior(z):
    """Centre uniform in [2, 4], height exponential of mean 1, base in [-1, 1]."""
    share = jax.scipy.stats.norm.cdf(z)
    height = -jnp.log1p(-jnp.minimum(share[1], 1.0 - 1e-6))
    return jnp.stack([2.0 + 2.0 * share[0], height, 2.0 * share[2] - 1.0])


MODEL = FromJax(peak, [3.0, 1.0, 0.0], names=["centre", "height", "base"])


def beforehand(count: int, scenarios: int = 200) -> np.ndarray:
    """(count,) settings, one by one the largest mean of log det over draws of theta."""
    z = np.random.default_rng(0).normal(size=(scenarios, 3))
    drawn = np.array([prior(row) for row in z], np.float64)
    slopes = np.stack([MODEL.jacobian(SETTINGS, theta)[:, 0] for theta in drawn], 1)
    more = slopes[..., None] * slopes[..., None, :]  # (settings, scenarios, 3, 3)
    known = np.diag([3.0, 1.0, 3.0]) + np.zeros((scenarios, 3, 3))
    chosen = []
    for _ in range(count):
        chosen.append(int(np.linalg.slogdet(known + more)[1].mean(axis=1).argmax()))
        known = known + more[chosen[-1]]
    return np.array(chosen)


@jax.jit
def errors(task, fixed, use_fixed, key):
    """(T,) error of the centre after each reading of one session."""
    key_truth, key_begin, key_steps = jax.random.split(key, 3)
    truth = task.draw(key_truth)
    belief, session = task.begin(key_begin)

    def step(state, given):
        belief, session = state
        design, key = given
        keys = jax.random.split(key, 4)
        options = task.options(belief, session, keys[0])
        best = Gain()(task, belief, session, options, keys[1])
        design = jnp.where(use_fixed, design, best)
        reading = task.measure(truth, design, keys[2])
        belief = belief.update(task, design, reading, keys[3])
        centres = jax.vmap(task.model.unknowns)(belief.z)[:, 0]
        error = (jnp.exp(belief.log_weight) * centres).sum() - prior(truth)[0]
        return (belief, task.spend(session, design, reading)), error

    keys = jax.random.split(key_steps, task.horizon)
    return jax.lax.scan(step, (belief, session), (fixed, keys))[1]


def study(full: bool) -> dict[str, np.ndarray]:
    """Rule to (peaks, readings): error of the centre after each reading."""
    peaks, count = (100, 100) if full else (20, 40)
    task = ParticleTask.of(MODEL, prior, Noise(std=1.0), SETTINGS, measurements=count)
    rng = np.random.default_rng(1)
    settings = {
        "random": rng.integers(len(SETTINGS), size=(peaks, count)),
        "beforehand": np.tile(beforehand(count), (peaks, 1)),
        "closed loop": np.zeros((peaks, count), int),
    }
    keys = jax.random.split(jax.random.key(0), peaks)  # the same truths for every rule
    many = jax.jit(jax.vmap(errors, in_axes=(None, 0, None, 0)))
    return {
        rule: np.asarray(many(task, jnp.asarray(fixed), rule != "closed loop", keys))
        for rule, fixed in settings.items()
    }


def rows(found: dict[str, np.ndarray]) -> common.Rows:
    """Median of the absolute error and its root mean square over the peaks."""
    return [
        common.row({"settings": rule, "k": k, "peaks": len(every)},
                   ("median_error", "rms_error"),
                   [np.median(np.abs(every[:, k - 1])), common.rms(every)[k - 1]],
                   ".4f")
        for rule, every in found.items()
        for k in range(10, every.shape[1] + 1, 10)
    ]  # fmt: skip


def draw(axes, rows: common.Rows) -> None:
    """Both errors against the number of readings."""
    for one, name, label in zip(
        axes,
        ("median_error", "rms_error"),
        ("median error of the centre", "root mean square error"),
        strict=True,
    ):
        common.curves(one, rows, "settings", "k", name, label)


if __name__ == "__main__":
    common.main(sys.modules[__name__])
