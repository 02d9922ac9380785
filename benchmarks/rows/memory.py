"""Memory of many episodes at once, and over many updates.

Each measurement is a process of its own and reads its resident memory from the kernel.
"""

from __future__ import annotations

import json

from benchmarks.harness import Budget, Line, Row, Verdict, fresh_process

NAME = "memory"
TITLE = "Memory: 65,536 episodes in parallel, and 10,000 updates"

_RESIDENT = """
import json, pathlib
def mib(field):
    for line in pathlib.Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field):
            return int(line.split()[1]) / 1024
"""

_ENVIRONMENT = (
    _RESIDENT
    + """
import jax
from benchmarks.rows.steps import ours
jax.devices()
before = mib("VmRSS")
call, steps = ours(EPISODES, 1)
call()
first = mib("VmRSS")
for _ in range(UPDATES):
    call()
print(json.dumps({"before": before, "first": first, "last": mib("VmRSS"),
                  "peak": mib("VmHWM")}))
"""
)

_UPDATE = (
    _RESIDENT
    + """
import dataclasses, jax
from jaxcal.learning.runtime import processes
from jaxcal.learning.core import ppo
from jaxcal.learning.training import presets
from jaxcal.learning.training.run import compiled_update
processes.keep_compiled_programs()
config = presets.with_values(presets.load("compact"), {
    "episodes_per_update": EPISODES, "num_minibatches": EPISODES // 512})
jax.devices()
before = mib("VmRSS")
state = ppo.begin(config.ppo, config.learners[0], jax.random.key(0))
update = compiled_update(config.ppo, config.learners[0])
for _ in range(2):
    state, metrics = update(state)
    float(metrics["reward_mean"])
print(json.dumps({"before": before, "last": mib("VmRSS"), "peak": mib("VmHWM")}))
"""
)

_MANY = (
    _RESIDENT
    + """
import dataclasses, tempfile
from jaxcal.learning.runtime import processes
from jaxcal.learning.training import postures as training, presets
processes.keep_compiled_programs()
config = presets.with_values(presets.load("compact"), {
    "episodes_per_update": 16, "episodes_per_set": 4, "num_minibatches": 1,
    "num_epochs": 1, "width": 8, "encoder_rounds": 1, "num_candidates": 8,
    "num_episodes": 16 * UPDATES})
config = dataclasses.replace(config, save_every=5.0, validate_every=0.0)
seen = {}
def look(report):
    for wanted in (UPDATES // 5, UPDATES // 2, UPDATES):
        if report.update >= wanted and wanted not in seen:
            seen[wanted] = mib("VmRSS")
with tempfile.TemporaryDirectory() as folder:
    training.train(config, folder, report=look)
print(json.dumps({"updates": list(seen), "resident": list(seen.values()),
                  "peak": mib("VmHWM")}))
"""
)


def measured(code: str, **sizes: int) -> dict[str, float]:
    for name, size in sizes.items():
        code = code.replace(name.upper(), str(size))
    # brax says what it could not import before the result.
    printed = fresh_process(code, timeout=3000.0)
    return dict(json.loads(printed.splitlines()[-1]))


def run(budget: Budget) -> Row:
    row = Row(NAME, TITLE)
    episodes = budget.pick(65_536, 2048)
    rollouts = budget.pick(500, 5)
    updates = budget.pick(10_000, 50)
    found = measured(_ENVIRONMENT, episodes=episodes, updates=rollouts)
    case = f"environment, {episodes:,} episodes, {rollouts} times over"
    row.lines += [
        Line(case, "before", found["before"], "MiB", "Python and JAX"),
        Line(case, "after the first", found["first"], "MiB"),
        Line(case, "after the last", found["last"], "MiB"),
        Line(case, "highest", found["peak"], "MiB"),
    ]
    # Observation, candidates and a copy of each: what the episodes themselves need.
    state = episodes * (210 + 150) * 4 / 2**20
    row.lines.append(Line(case, "candidates and observations alone", state, "MiB"))
    row.verdicts += [
        Verdict(
            "environment: highest less the start, in states and observations",
            (found["peak"] - found["before"]) / state,
            8.0,
            larger=False,
        ),
        Verdict(
            "environment: growth from the first to the last",
            max(found["last"] - found["first"], 0.0) / state,
            1.0,
            larger=False,
        ),
    ]
    found = measured(_UPDATE, episodes=episodes)
    case = f"compact preset, {episodes:,} episodes an update"
    row.lines += [
        Line(case, "before", found["before"], "MiB", "Python and JAX"),
        Line(case, "highest", found["peak"], "MiB"),
    ]
    row.verdicts.append(
        Verdict(
            "PPO update: highest",
            found["peak"] / 1024,
            12.0,
            larger=False,
            unit="GiB",
        )
    )
    found = measured(_MANY, updates=updates)
    case = f"{updates:,} updates of a small run"
    early, middle, late = found["resident"]  # type: ignore[misc]
    row.lines += [
        Line(case, "after a fifth", early, "MiB"),
        Line(case, "after a half", middle, "MiB"),
        Line(case, "after all", late, "MiB", "saved every 5 s on the way"),
    ]
    row.verdicts.append(
        Verdict(
            "growth over the last four fifths",
            (late - early) / early * 100,
            5.0,
            larger=False,
            unit="%",
        )
    )
    return row
