"""Train a policy on postures of one's own machine, save it, and choose with it.

python examples/own_policy.py           # 20,000 episodes
python examples/own_policy.py --full    # 60,000
"""

from __future__ import annotations

import pathlib
import sys
import tempfile

import common
import numpy as np

import jaxcal
from jaxcal.commands import train

METHODS = ("random", "greedy", "policy that ships", "own policy")


def postures(rng: np.random.Generator, count: int) -> np.ndarray:
    """(count, 3) degrees that a machine reaches: tilt within a cone, twist apart."""
    tilt, turn = 25.0 * np.sqrt(rng.random(count)), rng.uniform(0.0, 2 * np.pi, count)
    return np.stack(
        [tilt * np.cos(turn), tilt * np.sin(turn), rng.uniform(-15.0, 15.0, count)],
        axis=1,
    )


def study(full: bool, episodes: int = 0) -> dict[str, np.ndarray]:
    """Method to (sets,) D-efficiency against the proven optimum."""
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        pool = folder / "postures.csv"
        np.savetxt(pool, postures(rng, 2000), delimiter=",", header="pitch,yaw,roll",
                   comments="")  # fmt: skip
        count = episodes or (60_000 if full else 20_000)
        flags = ["--candidates", str(pool), "--episodes", str(count)]
        code = train.main([*flags, "--no-validation", "--out", str(folder / "run")])
        if code:
            raise SystemExit(code)
        found: dict[str, list[float]] = {method: [] for method in METHODS}
        for seed in range(200):
            offered = postures(rng, 50)
            best = jaxcal.select(offered, 4, "exact").log_det
            for method in METHODS:
                options = {"method": method, "seed": seed}
                if "policy" in method:
                    options = {"method": "policy"}
                if method == "own policy":
                    options["checkpoint"] = folder / "run"
                if method == "greedy":
                    del options["seed"]
                chosen = jaxcal.select(offered, 4, **options).log_det
                found[method].append(np.exp((chosen - best) / 12.0))
    return {method: np.array(each) for method, each in found.items()}


def rows(found: dict[str, np.ndarray]) -> common.Rows:
    """Mean D-efficiency, and the share of sets where the optimum was found."""
    return [
        common.row({"method": method, "sets": len(each)}, ("efficiency", "optimum"),
                   [each.mean(), (each > 1.0 - 1e-6).mean()], ".4f")
        for method, each in found.items()
    ]  # fmt: skip


def draw(axes, rows: common.Rows) -> None:
    """Share of sets where the optimum was found."""
    label = "share of sets with the optimum found"
    common.bars(axes, rows, "method", "optimum", label)


if __name__ == "__main__":
    common.main(sys.modules[__name__])
