"""Choose and calibrate for a function of your own: a thermistor, ten lines.

python examples/own_function.py           # 100 thermistors
python examples/own_function.py --full    # 1,000
"""

from __future__ import annotations

import sys

import common

# the ten lines
import jax.numpy as jnp
import numpy as np

import jaxcal
from jaxcal.models import FromJax


def resistance(u, theta):  # kilohm, at u[0] degrees Celsius
    r25, beta, offset = theta
    kelvin = u[0] + offset + 273.15
    return r25 * jnp.exp(beta * (1.0 / kelvin - 1.0 / 298.15))


model = FromJax(resistance, [10.0, 3950.0, 0.0], ["r25", "beta", "offset"], 1)
baths = np.arange(0.0, 101.0, 5.0)[:, None]  # degrees that can be set
prior = jaxcal.Prior([0.5, 100.0, 0.5])
noise = jaxcal.Noise(std=0.02)
chosen = jaxcal.select(
    baths, 5, model=model, prior=prior, noise=noise, max_replicates=5
)
# measure at baths[chosen.indices], then jaxcal.identify(...), as below


def study(full: bool) -> dict[str, np.ndarray]:
    """Rule to (thermistors, 101): errors of the resistance at 0 to 100 degrees, %."""
    ways = {"evenly spaced": np.array([0, 5, 10, 15, 20]), "selected": chosen.indices}
    used = np.linspace(0.0, 100.0, 101)[:, None]
    found: dict[str, np.ndarray] = {}
    for way, at in ways.items():
        errors = []
        for seed in range(1000 if full else 100):
            rng = np.random.default_rng(seed)
            theta = model.nominal + rng.normal(size=3) * [0.5, 100.0, 0.5]
            readings = model.predict(baths[at], theta) + rng.normal(0.0, 0.02, (5, 1))
            fit = jaxcal.identify(baths[at], readings, model=model, prior=prior,
                                  noise=noise, loss="gaussian")  # fmt: skip
            true = model.predict(used, theta)
            errors.append(100.0 * (fit.predict(used) - true)[:, 0] / true[:, 0])
        found[way] = np.array(errors)
    return found


def rows(found: dict[str, np.ndarray]) -> common.Rows:
    """Root mean square over the thermistors at some temperatures, percent."""
    return [
        common.row({"baths": way, "degrees": at}, ("error_percent",),
                   [common.rms(errors)[at]], ".3f")
        for way, errors in found.items()
        for at in range(0, 101, 10)
    ]  # fmt: skip


def draw(axes, rows: common.Rows) -> None:
    """Error by temperature."""
    label = "error of the resistance, %"
    common.curves(axes, rows, "baths", "degrees", "error_percent", label)
    axes.set(xlabel="temperature, °C", yscale="linear")


if __name__ == "__main__":
    print(f"baths to set: {baths[chosen.indices, 0].tolist()} degrees")
    common.main(sys.modules[__name__])
