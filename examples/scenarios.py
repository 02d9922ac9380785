"""Doses of a response curve whose middle is known to a factor of two only.

python examples/scenarios.py           # 20 experiments of each truth
python examples/scenarios.py --full    # 200
"""

from __future__ import annotations

import sys
import warnings

import common
import numpy as np

import jaxcal
from jaxcal.models import FromFunction

FACTORS = (0.25, 0.5, 1.0, 2.0, 4.0)  # of the true middle by the one that is expected
MIDDLE = 2  # the place of its logarithm among the parameters


def response(u, theta):
    """(N, 1) responses to doses u (N, 1)."""
    base, height, middle, slope = theta
    return base + height / (1.0 + np.exp(slope * (middle - np.log(u))))


model = FromFunction(
    response, [0.0, 1.0, 0.0, 2.0], [0.2, 0.2, 0.7, 0.3],
    ["base", "height", "log middle", "slope"], batch=True, quiet=True,
)  # fmt: skip
doses = np.geomspace(0.01, 100.0, 41)[:, None]
prior = jaxcal.Prior([0.2, 0.2, np.log(2.0), 0.3])
noise = jaxcal.Noise(std=0.05)


def designs() -> dict[str, np.ndarray]:
    """Eight doses each, by rule."""
    rules = {"max_replicates": 8, "noise": noise}
    one = jaxcal.Design(doses, model, prior, **rules)
    many = jaxcal.Design(doses, model, prior, scenarios=30, **rules)
    return {
        "evenly spaced": np.linspace(0, 40, 8).round().astype(int),
        "nominal": one.select(8, "D").indices,
        "30 scenarios": many.select(8, jaxcal.Mean("D")).indices,
        "worst of 30": many.select(8, jaxcal.Worst("D", efficiency=True)).indices,
    }


def study(full: bool) -> dict[str, np.ndarray]:
    """Rule to (truths, experiments): errors of the logarithm of the middle."""
    found = {}
    for rule, at in designs().items():
        errors = np.empty((len(FACTORS), 200 if full else 20))
        for i, factor in enumerate(FACTORS):
            truth = np.array([0.0, 1.0, np.log(factor), 2.0])
            exact = model.predict(doses[at], truth)
            for seed in range(errors.shape[1]):
                rng = np.random.default_rng(seed)
                read = exact + rng.normal(0.0, 0.05, exact.shape)
                with warnings.catch_warnings():  # of readings far off, some always
                    warnings.simplefilter("ignore", UserWarning)
                    fit = jaxcal.identify(
                        doses[at], read, model=model, prior=prior, noise=noise,
                        loss="gaussian",
                    )  # fmt: skip
                errors[i, seed] = fit.parameters[MIDDLE] - truth[MIDDLE]
        found[rule] = errors
    return found


def rows(found: dict[str, np.ndarray]) -> common.Rows:
    return [
        {"true middle": f"{factor:g}"}
        | {rule: f"{100 * common.rms(e[i]):.1f}" for rule, e in found.items()}
        for i, factor in enumerate(FACTORS)
    ]


def draw(axes, rows: common.Rows) -> None:
    from jaxcal.reports.plots import numbered

    at = [float(row["true middle"]) for row in rows]
    for i, rule in enumerate(list(rows[0])[1:]):
        axes.plot(at, [float(row[rule]) for row in rows], label=rule, **numbered(i))
    axes.set(
        xscale="log", xlabel="true middle, of the one expected",
        ylabel="error of the middle, %",
    )  # fmt: skip
    axes.set_xticks(at, [f"{x:g}" for x in at])
    axes.minorticks_off()
    axes.legend(frameon=False)


if __name__ == "__main__":
    common.main(sys.modules[__name__])
