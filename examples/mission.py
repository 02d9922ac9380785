"""The mission in one file: learn which postures to measure, measure them, calibrate.

    python examples/mission.py      # about a minute of training, then four moves

A machine does not reach what it is told: y = A u + b, twelve unknowns, u the angles of
three motors. Of 50 candidate postures four may be measured, those whose information
matrix S has the largest determinant. In this order: an environment that pays log det S,
a network, PPO, the choice, four moves over Modbus with a phone as the sensor, and A and
b by least squares. ``jaxcal-rig simulate``, a program of its own, is the device; a test
compares this file with jaxcal's functions number for number.
"""

from __future__ import annotations

import itertools
import select
import socket
import subprocess
import sys
import time
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
from pymodbus.client import ModbusTcpClient

M, N, K, OUTPUTS = 50, 3, 4, 3  # candidates, inputs, choices, measured axes

# -- the environment: one episode, pure functions; jax.vmap makes a batch --------------


class State(NamedTuple):
    poses: jax.Array  # (M, N) candidate commands in [0, 1]
    chosen: jax.Array  # (K,) int32, -1 where nothing is chosen yet
    available: jax.Array  # (M,) bool
    count: jax.Array  # () int32


def reset(key: jax.Array) -> State:
    poses = jax.random.uniform(key, (M, N))
    return State(poses, jnp.full(K, -1), jnp.ones(M, bool), jnp.int32(0))


def regressors(state: State) -> tuple[jax.Array, jax.Array]:
    """(K, N + 1) rows (u, 1) of what is chosen, zeros for the rest; (K,) which are."""
    present = state.chosen >= 0
    rows = jnp.c_[state.poses[state.chosen], jnp.ones(K)]
    return rows * present[:, None], present


def step(state: State, action: jax.Array) -> tuple[State, jax.Array, jax.Array]:
    """The next state, a tenth of log det S where the episode has ended, whether it has.

    S holds Z'Z, with rows (u, 1), once for each output.
    """
    chosen = state.chosen.at[state.count].set(action)
    available = state.available.at[action].set(False)
    state = State(state.poses, chosen, available, state.count + 1)
    z, _ = regressors(state)
    done = state.count == K
    log_det = 2.0 * jnp.maximum(jnp.linalg.slogdet(z)[1], -14.0)  # of Z'Z, finite
    return state, jnp.where(done, 0.1 * OUTPUTS * log_det, 0.0), done


def observe(state: State) -> jax.Array:
    """The paper's 210 numbers: 150 of poses, 50 of what is available, ten of progress.

    Of what is chosen the mean, deviation, share, and three numbers of its ridged Z'Z.
    """
    z, present = regressors(state)
    u, number = z[:, :N], jnp.maximum(present.sum(), 1)
    mean = u.sum(0) / number
    std = jnp.sqrt((((u - mean) * present[:, None]) ** 2).sum(0) / number)
    gram = z.T @ z + 0.01 * jnp.eye(N + 1)
    pivots = jnp.log(jnp.diag(jnp.linalg.cholesky(gram)))
    size, trace = pivots.sum() / (1.25 * (N + 1)), jnp.trace(gram) / (K * (N + 1))
    bent = (pivots.min() - pivots.max()) / 4.0
    scalars = jnp.stack([state.count / K, size, trace, bent])
    return jnp.concatenate([state.poses.ravel(), state.available, mean, std, scalars])


# -- the network: one weight for every candidate, so their order does not matter -------


class Policy(nn.Module):
    """An observation (210,) to masked logits (M,) and the expected reward ().

    Of each candidate it sees where it lies, how many are chosen, and by how much it
    would raise log det: a feature of geometry, without which PPO needs far longer.
    """

    @nn.compact
    def __call__(self, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
        poses = observation[: M * N].reshape(M, N) - 0.5
        available = observation[M * N : M * N + M] > 0.5
        z = jnp.c_[poses, jnp.ones(M)]
        chosen = z * ~available[:, None]
        inverse = jnp.linalg.inv(chosen.T @ chosen + 1e-3 * jnp.eye(N + 1))
        gain = jnp.log1p(((z @ inverse) * z).sum(1))  # of log det Z'Z
        count = jnp.broadcast_to(jax.nn.one_hot((~available).sum(), K), (M, K))
        seen = jnp.c_[poses, (poses**2).sum(1), gain, count]
        hidden = nn.tanh(nn.Dense(32)(nn.tanh(nn.Dense(32)(seen))))
        logits = nn.Dense(1, kernel_init=nn.initializers.normal(0.01))(hidden)[:, 0]
        best = jnp.where(available[:, None], hidden, -1.0).max(0)
        value = nn.Dense(1)(nn.tanh(nn.Dense(32)(jnp.r_[best, hidden.mean(0)])))
        return jnp.where(available, logits, -1e9), value[0]


# -- PPO -------------------------------------------------------------------------------

EPISODES, EPOCHS, MINIBATCHES, UPDATES = 512, 2, 4, 400
LAMBDA, CLIP, VALUE_WEIGHT, ENTROPY_WEIGHT = 0.95, 0.2, 0.5, 0.003


def rollout(policy: Policy, params: Any, key: jax.Array) -> tuple[jax.Array, ...]:
    """Observations, actions, their log probabilities, values and rewards, each
    (K, EPISODES, ...), of whole episodes."""

    def decide(state: State, key: jax.Array) -> tuple[State, tuple[jax.Array, ...]]:
        observation = jax.vmap(observe)(state)
        logits, value = jax.vmap(policy.apply, (None, 0))(params, observation)
        action = jax.random.categorical(key, logits)
        log_prob = jax.nn.log_softmax(logits)[jnp.arange(EPISODES), action]
        state, reward, _ = jax.vmap(step)(state, action)
        return state, (observation, action, log_prob, value, reward)

    key, first = jax.random.split(key)
    begun = jax.vmap(reset)(jax.random.split(first, EPISODES))
    return jax.lax.scan(decide, begun, jax.random.split(key, K))[1]


def advantages(reward: jax.Array, value: jax.Array) -> jax.Array:
    """(K, ...) how much better than expected: generalised advantage estimates."""
    later = jnp.concatenate([value[1:], jnp.zeros_like(value[:1])])
    delta = reward + later - value
    weights = LAMBDA ** jnp.maximum(jnp.arange(K) - jnp.arange(K)[:, None], 0)
    return jnp.tensordot(jnp.triu(weights), delta, axes=1)


def surrogate(
    logits: Any, value: Any, action: Any, log_prob: Any, advantage: Any, target: Any
) -> jax.Array:
    """PPO's loss: clipped gain, squared error of the value, bonus for entropy."""
    log_probs = jax.nn.log_softmax(logits)
    taken = jnp.take_along_axis(log_probs, action[..., None], axis=-1)[..., 0]
    ratio = jnp.exp(taken - log_prob)
    clipped = jnp.clip(ratio, 1.0 - CLIP, 1.0 + CLIP)
    gain = jnp.minimum(ratio * advantage, clipped * advantage).mean()
    entropy = -(jnp.exp(log_probs) * log_probs).sum(-1).mean()
    error = ((value - target) ** 2).mean()
    return VALUE_WEIGHT * error - gain - ENTROPY_WEIGHT * entropy


def train(key: jax.Array, updates: int = UPDATES) -> tuple[Policy, Any]:
    """A policy and its weights; prints the mean reward of the episodes played."""
    policy = Policy()
    rate = optax.cosine_decay_schedule(5e-3, updates * EPOCHS * MINIBATCHES)
    optimiser = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(rate))
    params = policy.init(key, observe(reset(key)))

    def loss(params: Any, rows: Any) -> jax.Array:
        return surrogate(*jax.vmap(policy.apply, (None, 0))(params, rows[0]), *rows[1:])

    @jax.jit
    def update(params: Any, state: Any, key: jax.Array) -> tuple[Any, Any, jax.Array]:
        play_key, order_key = jax.random.split(key)
        seen, action, log_prob, value, reward = rollout(policy, params, play_key)
        advantage = advantages(reward, value)
        target = advantage + value
        spread = advantage.std(1, keepdims=True) + 1e-6
        advantage = (advantage - advantage.mean(1, keepdims=True)) / spread
        rows = seen, action, log_prob, advantage, target
        rows = jax.tree.map(lambda x: x.reshape(K * EPISODES, *x.shape[2:]), rows)

        def descend(carry: Any, index: jax.Array) -> tuple[Any, None]:
            params, state = carry
            some = jax.tree.map(lambda x: x[index], rows)
            change, state = optimiser.update(jax.grad(loss)(params, some), state)
            return (optax.apply_updates(params, change), state), None

        shape = EPOCHS * MINIBATCHES, K * EPISODES // MINIBATCHES
        order = jax.random.randint(order_key, shape, 0, K * EPISODES)
        (params, state), _ = jax.lax.scan(descend, (params, state), order)
        return params, state, reward.sum(0).mean()

    state = optimiser.init(params)
    for number in range(updates):
        key, now = jax.random.split(key)
        params, state, reward = update(params, state, now)
        if number % 50 == 0 or number == updates - 1:
            print(f"update {number:3d}: mean reward {reward:.3f}", flush=True)
    return policy, params


# -- the choice ------------------------------------------------------------------------


def choose(policy: Policy, params: Any, poses: np.ndarray) -> list[int]:
    """The K postures that the policy finds likeliest, one after another."""
    state = reset(jax.random.key(0))._replace(poses=jnp.asarray(poses))
    for _ in range(K):
        logits, _ = policy.apply(params, observe(state))
        state, _, _ = step(state, logits.argmax())
    return [int(i) for i in state.chosen]


def share_of_optimum(poses: np.ndarray, chosen: list[int]) -> float:
    """det S of a choice over that of the best of all 230,300."""
    z = np.c_[poses, np.ones(M)]
    every = np.array(list(itertools.combinations(range(M), K)))
    best = np.abs(np.linalg.det(z[every])).max()
    return float((abs(np.linalg.det(z[chosen])) / best) ** (2 * OUTPUTS))


# -- the device: Leadshine drives over Modbus TCP, a phone with HyperIMU ---------------

PULSES = 10 * 10_000 / 360 * np.array([1, -1, 1])  # a degree; pitch, yaw, roll
LIMIT = 20.0  # degrees of each motor


def move(bus: ModbusTcpClient, degrees: np.ndarray) -> None:
    """Move the motors to absolute angles and wait until they stand."""
    for unit, pulses in enumerate(np.rint(PULSES * degrees).astype(int).tolist(), 1):
        # Path 0: absolute, position, 200 rpm, ramps, no pause; the last word runs it.
        path = [1, pulses >> 16 & 0xFFFF, pulses & 0xFFFF, 200, 50, 50, 0, 0x10]
        bus.write_registers(0x6200, path, device_id=unit)
    for unit in (1, 2, 3):
        while bus.read_holding_registers(0x1003, device_id=unit).registers[0] & 4:
            time.sleep(0.02)  # bit 2 of the status: it moves


def attitude(phone: socket.socket, count: int = 30) -> np.ndarray:
    """(3, 3) mean rotation that the phone reports from now on."""
    while select.select([phone], [], [], 0)[0] and phone.recv(1 << 16):
        pass  # what was sent before
    lines, total = phone.makefile(), np.zeros((3, 3))
    lines.readline()  # perhaps the rest of one
    for _ in range(count):
        angles = [float(x) for x in lines.readline().split(",")[1:4]]
        azimuth, pitch, roll = np.radians(angles)
        total += turn(2, -azimuth) @ turn(1, -roll) @ turn(0, -pitch)
    return np.linalg.svd(total)[0] @ np.linalg.svd(total)[2]


def turn(axis: int, angle: float) -> np.ndarray:
    matrix, i, j = np.eye(3), (axis + 1) % 3, (axis + 2) % 3
    matrix[i, i] = matrix[j, j] = np.cos(angle)
    matrix[j, i], matrix[i, j] = np.sin(angle), -np.sin(angle)
    return matrix


def joints(rotation: np.ndarray) -> np.ndarray:
    """(3,) pitch, yaw, roll in degrees, of R = Rz(yaw) Rx(pitch) Ry(roll)."""
    (_, sine, _), (_, cosine, _), (x, y, z) = rotation
    return np.degrees([np.arcsin(y), np.arctan2(-sine, cosine), np.arctan2(-x, z)])


def identify(u: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A and b of y = A u + b by least squares."""
    theta = np.linalg.lstsq(np.c_[u, np.ones(len(u))], y, rcond=None)[0]
    return theta[:-1].T, theta[-1]


def measure(commands: np.ndarray) -> np.ndarray:
    """(K, 3) joint angles that the simulated device takes at commands in degrees."""
    simulate = [sys.executable, "-m", "rig", "simulate", "--bus-port", "0"]
    with subprocess.Popen(simulate, stdout=subprocess.PIPE, text=True) as device:
        try:
            port = int(device.stdout.readline().split()[1].rpartition(":")[2])
            where = device.stdout.readline().strip().rpartition(":")[2]
            with socket.create_server(("127.0.0.1", int(where))) as server:
                phone = server.accept()[0]
                with ModbusTcpClient("127.0.0.1", port=port) as bus:
                    zero = attitude(phone)  # it stands upright in its jig
                    y = []
                    for u in commands:
                        move(bus, u)
                        y.append(joints(zero.T @ attitude(phone)))
                        print(f"u {np.round(u, 2)} deg: y {np.round(y[-1], 2)} deg")
                    move(bus, np.zeros(3))
        finally:
            device.kill()
    return np.array(y)


def main() -> None:
    policy, params = train(jax.random.key(0))
    sets = np.random.default_rng(0).random((20, M, N))
    shares = [share_of_optimum(poses, choose(policy, params, poses)) for poses in sets]
    print(f"20 unseen sets: {np.mean(shares):.3f} of the best det S in the mean")
    commands = LIMIT * (2.0 * sets[0][choose(policy, params, sets[0])] - 1.0)
    a, b = identify(commands, measure(commands))
    print(f"A\n{np.round(a, 3)}\nb {np.round(b, 2)} degrees")


if __name__ == "__main__":
    main()
