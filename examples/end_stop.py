"""Train the decider of a task of one's own, in a minute, and compare it.

python examples/end_stop.py           # 12 updates
python examples/end_stop.py --full    # 150

Where does the end stop of an axis lie? A push either hits it or does not. A push takes
time by how far the axis travels; a hit takes 3 s more, and only one or two are allowed.
"""

from __future__ import annotations

import dataclasses
import sys
import tempfile
import time

import common
import numpy as np

from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.policy.config import PPO, PolicyConfig
from jaxcal.adaptive.policy.run import train
from jaxcal.adaptive.rules import StateRule
from jaxcal.adaptive.tasks import Entry
from jaxcal.evaluation import sequential

METHODS = ("gain", "shares", "ahead", "state", "policy")


def end_stop(cells: int = 40, noise: float = 0.02) -> GridTask:
    """The stop lies in one of ``cells``; a push says so wrongly with this chance."""
    at = (np.arange(cells) + 0.5) / cells
    push = np.arange(1, cells) / cells
    hit = noise + (1.0 - 2.0 * noise) * (push[:, None] > at)
    return GridTask.make(
        at, push, np.stack([1.0 - hit, hit], axis=1),
        travel=1.0, extra=[0.0, 3.0], uses=[0, 1], seconds=(5.0, 20.0),
        num_uses=(1, 2), horizon=20,
    )  # fmt: skip


# Made by `jaxcal.adaptive.tuning.tune` in a minute.
TUNED = StateRule(0.23, 1.0, 2.14, -0.25, -0.12, 0.48)
ENTRY = Entry(end_stop, about="an end stop", rules={"state": TUNED})


def study(full: bool) -> sequential.Result:
    """All methods on the same sessions; the policy is trained before."""
    ppo = dataclasses.replace(PPO, num_updates=150 if full else 12)
    config = PolicyConfig(task=__file__, base=ENTRY.rules["state"], ppo=ppo)
    with tempfile.TemporaryDirectory() as folder:
        begun = time.perf_counter()
        train(config, folder)
        print(f"trained in {time.perf_counter() - begun:.0f} s")
        return sequential.evaluate(
            __file__, ENTRY, {}, METHODS, checkpoint=folder,
            episodes=4096 if full else 1024,
        )  # fmt: skip


def rows(found: sequential.Result) -> common.Rows:
    """Nats that each method gains in a session, and less those of ``ahead``."""
    return [
        common.row({"method": name, "sessions": found.found.gain.shape[1]},
                   ("nats", "error", "less_ahead", "its_error"),
                   [*found.found.mean(name), *found.found.paired(name, "ahead")], ".3f")
        for name in METHODS
    ]  # fmt: skip


def draw(axes, rows: common.Rows) -> None:
    """Nats by method, with 95 % intervals."""
    from jaxcal.plots.style import COLOURS

    names = [row["method"] for row in rows]
    nats, error = (np.array([float(r[n]) for r in rows]) for n in ("nats", "error"))
    axes.errorbar(names, nats, yerr=1.96 * error, fmt="o", color=COLOURS[0], capsize=3)
    axes.set_ylabel("information gained in a session, nats")


if __name__ == "__main__":
    common.main(sys.modules[__name__])
