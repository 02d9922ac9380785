"""Cost of sharing an update among devices and processes of this machine.

    XLA_FLAGS=--xla_force_host_platform_device_count=8 python benchmarks/scaling.py
    python benchmarks/scaling.py --devices 1 --seeds 1
    python benchmarks/scaling.py --devices 2 --seeds 8
    python benchmarks/scaling.py --devices 1 --updates 0 --candidates 1000

prints, for 1, 2, 4 ... devices or for seeds side by side, seconds of wall and processor
time an update, the gigabytes that it needs and the megabytes that each device exchanges
in it. Forced devices share the same cores, so for one seed this measures what sharding
adds, not what it gains; of several seeds each core, which is then a device, trains its
own.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import time
from typing import Any

import jax
import jax.numpy as jnp

from jaxcal.learning.core import ppo
from jaxcal.learning.runtime import devices
from jaxcal.learning.training import presets
from jaxcal.learning.training.run import compiled_update


def measure(config: Any, number: int, seeds: int, num_updates: int) -> dict[str, float]:
    """What an update on so many devices of so many seeds takes; 0 updates: no time."""
    learner = config.learners[0]
    mesh = devices.make_mesh(config.ppo.rows_per_minibatch, number, seeds)
    keys = jax.vmap(jax.random.key)(jnp.arange(seeds))
    begin = jax.vmap(lambda key: ppo.begin(config.ppo, learner, key))
    state = devices.replicate(jax.jit(begin)(keys), mesh)
    update: Any = compiled_update(config.ppo, learner, mesh, seeds)
    used = time.process_time()
    update = update.lower(state).compile()
    used, memory = time.process_time() - used, update.memory_analysis()
    numbers = exchanged(update.as_text())
    needs: dict[str, float] = {
        "devices": number,
        "seeds": seeds,
        "compile_cpu_s": used,
        "exchanged_mb": 4e-6 * numbers * config.ppo.steps_per_update,
        "memory_gb": 1e-9 * (memory.temp_size_in_bytes + memory.argument_size_in_bytes),
    }
    if not num_updates:
        return needs
    for count in (1, num_updates):
        wall, used = time.perf_counter(), time.process_time()
        for _ in range(count):
            state, _ = update(state)
        jax.block_until_ready(state.num_updates)
        wall, used = time.perf_counter() - wall, time.process_time() - used
    return needs | {
        "wall_s": wall / num_updates,
        "cpu_s": used / num_updates,
        "episodes_per_s": seeds * config.ppo.episodes_per_update * num_updates / wall,
    }


def exchanged(text: str) -> int:
    """Numbers that come out of the collectives of a compiled program, once each.

    All but a few of them are those of a gradient step.
    """
    # Of one that begins and ends apart, what its end gives.
    ends = r"= (.*?) (?:all-|collective-|reduce-scatter)[a-z-]*(?<!-start)\("
    made = re.findall(ends, text)
    shapes = [shape for line in made for shape in re.findall(r"\[([0-9,]*)\]", line)]
    return sum(math.prod(int(n) for n in shape.split(",") if n) for shape in shapes)


def main() -> None:
    """A JSON line for each number of devices."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--preset", choices=presets.names(), default="compact")
    parser.add_argument("--devices", default="1,2,4,8", help="comma separated")
    parser.add_argument("--seeds", default="1", help="comma separated")
    parser.add_argument("--updates", type=int, default=10, help="0: not timed")
    parser.add_argument("--candidates", type=int, help="of an episode")
    arguments = parser.parse_args()
    devices.a_device_for_each_core(max(map(int, arguments.seeds.split(","))))
    values = {"num_episodes": 10**8}
    if arguments.candidates:
        values["num_candidates"] = arguments.candidates
    config = presets.with_values(presets.load(arguments.preset), values)
    for number in map(int, arguments.devices.split(",")):
        for seeds in map(int, arguments.seeds.split(",")):
            if number <= jax.device_count():
                found = measure(config, number, seeds, arguments.updates)
                print(json.dumps(found), flush=True)


if __name__ == "__main__":
    main()
