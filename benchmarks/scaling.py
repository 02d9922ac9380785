"""Cost of sharing an update among devices and processes of this machine.

    XLA_FLAGS=--xla_force_host_platform_device_count=8 python benchmarks/scaling.py
    python benchmarks/scaling.py --devices 1 --seeds 1
    python benchmarks/scaling.py --devices 2 --seeds 8

prints, for 1, 2, 4 ... devices or for seeds side by side, seconds of wall and processor
time an update. Forced devices share the same cores, so for one seed this measures what
sharding adds, not what it gains; of several seeds each core, which is then a device,
trains its own.
"""

from __future__ import annotations

import argparse
import json
import time

import jax
import jax.numpy as jnp

from jaxcal.learning.core import ppo
from jaxcal.learning.runtime import cache, devices
from jaxcal.learning.training import presets
from jaxcal.learning.training.run import updates


def measure(preset: str, number: int, seeds: int, num_updates: int) -> dict[str, float]:
    """Seconds an update on so many devices of so many seeds, compilation left out."""
    config = presets.with_values(presets.load(preset), {"num_episodes": 10**8})
    learner = config.learners[0]
    mesh = devices.make_mesh(config.ppo.rows_per_minibatch, number, seeds)
    keys = jax.vmap(jax.random.key)(jnp.arange(seeds))
    begin = jax.vmap(lambda key: ppo.begin(config.ppo, learner, key))
    state = devices.replicate(jax.jit(begin)(keys), mesh)
    update = updates(config.ppo, learner, mesh, num_updates, seeds)
    for warm in (True, False):
        wall, used = time.perf_counter(), time.process_time()
        state, _ = update(state, jnp.int32(1 if warm else num_updates))
        jax.block_until_ready(state.num_updates)
        wall, used = time.perf_counter() - wall, time.process_time() - used
        if warm:
            compiling = used
    return {
        "devices": number,
        "seeds": seeds,
        "compile_cpu_s": compiling,
        "wall_s": wall / num_updates,
        "cpu_s": used / num_updates,
        "episodes_per_s": seeds * config.ppo.episodes_per_update * num_updates / wall,
    }


def main() -> None:
    """A JSON line for each number of devices."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--preset", choices=presets.names(), default="compact")
    parser.add_argument("--devices", default="1,2,4,8", help="comma separated")
    parser.add_argument("--seeds", default="1", help="comma separated")
    parser.add_argument("--updates", type=int, default=10)
    arguments = parser.parse_args()
    cache.keep_compiled_programs()
    devices.a_device_for_each_core(max(map(int, arguments.seeds.split(","))))
    for number in map(int, arguments.devices.split(",")):
        for seeds in map(int, arguments.seeds.split(",")):
            if number <= jax.device_count():
                found = measure(arguments.preset, number, seeds, arguments.updates)
                print(json.dumps(found), flush=True)


if __name__ == "__main__":
    main()
