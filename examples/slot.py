"""Train the decider of a task of one's own, in a minute, and compare it.

python examples/slot.py           # 12 updates, one seed
python examples/slot.py --full    # 70 updates, three seeds

Where are the two walls of a slot? A probe moves along it, and a step either touches a
wall or does not. Way costs time, a touch costs more, and only a few are allowed.
"""

from __future__ import annotations

import dataclasses
import sys
import tempfile
import time

import common
import numpy as np
from scipy import special

from jaxcal.adaptive import evaluation as sequential
from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.policy.config import PPO, PolicyConfig
from jaxcal.adaptive.policy.training import train
from jaxcal.adaptive.rules import StateRule
from jaxcal.adaptive.tasks import Entry

METHODS = ("gain", "state", "shares", "ahead")


def slot(cells: int = 24) -> GridTask:
    """The task: theta = (left, right) distances of the walls from the middle, mm.

    Each is in one of ``cells`` up to 1 mm. The width is known better than the place, so
    where one wall is near the other is far: a Gaussian copula of correlation -0.6.
    """
    wall = (np.arange(cells) + 0.5) / cells
    walls = np.stack(np.meshgrid(wall, wall, indexing="ij"), axis=-1).reshape(-1, 2)
    z = special.ndtri(walls)
    excess = np.linalg.inv([[1.0, -0.6], [-0.6, 1.0]]) - np.eye(2)
    side, step = np.repeat([0, 1], cells - 1), np.tile(np.arange(1, cells) / cells, 2)
    past = special.ndtr((step[:, None] - walls[:, side].T) / 0.02)
    touch = 0.02 + 0.96 * past  # one reading in fifty is wrong
    stands = np.append(np.where(side == 0, -step, step), 0.0)  # the last: the middle
    middle = np.full_like(side, len(side))
    return GridTask.make(
        walls, np.column_stack([stands[:-1], step]), np.stack([1.0 - touch, touch], 1),
        prior=np.exp(-0.5 * np.einsum("si,ij,sj->s", z, excess, z)), groups=side,
        travel=0.5 + 2.0 * np.abs(stands[:, None] - stands[:-1]),  # seconds
        place_after=np.stack([np.arange(len(side)), middle], 1),  # a touch: back there
        extra=[0.0, 1.0], uses=[0, 1], num_uses=(1, 2, 3), seconds=(6.0, 24.0),
        horizon=24, theta_names=["left", "right"],
    )  # fmt: skip


# Made by `jaxcal.adaptive.tuning.tune` in a minute.
TUNED = StateRule(0.177, 1.0, 2.552, 0.55, -0.127, 3.921)
ENTRY = Entry(slot, about="the walls of a slot", rules={"state": TUNED})


@dataclasses.dataclass(frozen=True)
class Study:
    """Methods on the same sessions; a policy of each seed."""

    results: dict[str, sequential.DeciderResult]


def study(full: bool) -> Study:
    """Rules first, then each policy, all on the same sessions."""
    ppo = dataclasses.replace(PPO, num_updates=70 if full else 12)
    sessions = 4096 if full else 1024

    def played(methods: tuple[str, ...], checkpoint: str | None = None):
        evaluation = sequential.evaluate(
            __file__, ENTRY, {}, methods, checkpoint=checkpoint, episodes=sessions
        )
        return evaluation.results

    results = dict(zip(METHODS, played(METHODS), strict=True))
    for seed in range(3 if full else 1):
        config = PolicyConfig(__file__, ENTRY.rules["state"], ppo=ppo, seed=seed)
        with tempfile.TemporaryDirectory() as folder:
            begun = time.perf_counter()
            train(config, folder)
            print(f"trained in {time.perf_counter() - begun:.0f} s")
            (results[f"policy {seed}"],) = played(("policy",), folder)
    return Study(results)


def rows(found: Study) -> common.Rows:
    """Nats that each method gains in a session, those of ``ahead`` subtracted, and the
    time of a choice."""
    ahead = found.results["ahead"].values[:, 0]
    table = []
    for name, result in found.results.items():
        gain = result.values[:, 0]
        numbers = [mean for values in (gain, gain - ahead) for mean in _mean(values)]
        numbers.append(1e3 * result.seconds)
        table.append(
            common.row({"method": name, "sessions": len(gain)},
                       ("nats", "error", "less_ahead", "its_error", "ms"),
                       numbers, ".3f")
        )  # fmt: skip
    return table


def _mean(values: np.ndarray) -> tuple[float, float]:
    return values.mean(), values.std(ddof=1) / np.sqrt(len(values))


def draw(axes, rows: common.Rows) -> None:
    """Nats less those of ``ahead``, with 95 % intervals; ``gain`` is far below."""
    from jaxcal.reports.plots import COLOURS

    for row in (row for row in rows if row["method"] != "gain"):
        axes.errorbar(
            f"{row['method']}\n{row['ms']} ms", float(row["less_ahead"]), fmt="o",
            yerr=1.96 * float(row["its_error"]), capsize=3,
            color=COLOURS[row["method"].startswith("policy")],
        )  # fmt: skip
    axes.axhline(0.0, color="grey", linewidth=0.8)
    axes.set_xlabel("method, and its time of a choice")
    axes.set_ylabel("information less that of ahead, nats")


if __name__ == "__main__":
    common.main(sys.modules[__name__])
