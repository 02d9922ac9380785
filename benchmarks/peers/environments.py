"""The selection task as others would write it: Gymnasium, and NumPy over a batch.

Both give jaxcal's numbers: observation (210 for M = 50), reward and end are those of
``jaxcal.learning.environments.selection`` on the same candidates;
``tests/test_benchmarks.py``
compares them.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

M, K, N = 50, 4, 3
P = N + 1
RIDGE = 0.01
SCALE = 0.1  # reward per unit of log det S
_FLOOR = 1e-18  # least squared column length: flat postures stay finite

Array = NDArray[np.float32]


class SelectionGym(gymnasium.Env[Array, np.int64]):
    """One episode: four of fifty postures, plain NumPy."""

    def __init__(self) -> None:
        size = M * N + M + 2 * N + 4
        self.observation_space = gymnasium.spaces.Box(
            -np.inf, np.inf, (size,), np.float32
        )
        self.action_space = gymnasium.spaces.Discrete(M)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        super().reset(seed=seed)
        given = (options or {}).get("candidates")
        if given is None:
            given = self.np_random.random((M, N), dtype=np.float32)
        self.candidates = np.asarray(given, np.float32)
        self.available = np.ones(M, bool)
        self.chosen: list[int] = []
        return self._observation(), {}

    def step(self, action: np.int64) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        self.chosen.append(int(action))
        self.available[action] = False
        done = len(self.chosen) == K
        reward = 0.0
        if done:
            z = np.ones((K, P))
            z[:, :N] = self.candidates[self.chosen]
            with np.errstate(divide="ignore"):
                # N outputs share the regressor; four rows, so det(Z.T Z) = det(Z)^2.
                reward = SCALE * N * 2.0 * float(np.linalg.slogdet(z)[1])
        return self._observation(), reward, done, False, {}

    def action_masks(self) -> NDArray[np.bool_]:
        """What sb3-contrib's MaskablePPO asks for."""
        return self.available

    def _observation(self) -> Array:
        count = len(self.chosen)
        z = np.ones((count, P))
        z[:, :N] = self.candidates[self.chosen]
        gram = z.T @ z + RIDGE * np.eye(P)
        pivots = np.log(np.diag(np.linalg.cholesky(gram)))
        mean = z[:, :N].mean(0) if count else np.zeros(N)
        std = z[:, :N].std(0) if count else np.zeros(N)
        scalars = [
            count / K,
            pivots.sum() / (1.25 * P),
            np.trace(gram) / (K * P),
            (pivots.min() - pivots.max()) / 4.0,
        ]
        parts = (self.candidates.ravel(), self.available, mean, std, scalars)
        return np.concatenate(parts, dtype=np.float32)


class SelectionNumpy:
    """B episodes in lockstep, every array vectorised by hand over the batch."""

    def __init__(self, batch: int, seed: int = 0) -> None:
        self.rng = np.random.default_rng(seed)
        self.batch = batch
        self.rows = np.arange(batch)
        self.observation = np.zeros((batch, M * N + M + 2 * N + 4), np.float32)
        # Views: writing the state writes the observation.
        self.flat = self.observation[:, : M * N]
        self.free = self.observation[:, M * N : M * N + M]
        self.context = self.observation[:, M * N + M :]
        self.chosen = np.zeros((K, N, batch), np.float32)

    def reset(self, candidates: Array | None = None) -> Array:
        """Fresh candidates (B, M, N); the observation (B, 210), changed by ``step``."""
        if candidates is None:
            candidates = self.rng.random((self.batch, M, N), dtype=np.float32)
        self.flat[:] = candidates.reshape(self.batch, M * N)
        self.free[:] = 1.0
        self.count = 0
        self.total = np.zeros((N, self.batch), np.float32)
        self.gram = np.zeros((P, P, self.batch), np.float32)
        self._describe()
        return self.observation

    def step(self, action: NDArray[np.int64]) -> tuple[Array, Array, bool]:
        """Choose (B,) postures; observation, (B,) reward, whether all have ended."""
        for axis in range(N):
            self.chosen[self.count, axis] = self.flat[self.rows, action * N + axis]
        self.free[self.rows, action] = 0.0
        posture = self.chosen[self.count]
        self.total += posture
        self.gram[:N, :N] += posture[:, None] * posture[None]
        self.gram[:N, N] += posture
        self.gram[N, :N] += posture
        self.gram[N, N] += 1.0
        self.count += 1
        self._describe()
        if self.count < K:
            return self.observation, np.zeros(self.batch, np.float32), False
        return self.observation, self._reward(), True

    def _describe(self) -> None:
        number = max(self.count, 1)
        mean = self.total / number
        spread = self.chosen[: self.count] - mean
        self.context[:, :N] = mean.T
        self.context[:, N : 2 * N] = np.sqrt((spread**2).sum(0) / number).T
        lower = [[self.gram[i, j] for j in range(i + 1)] for i in range(P)]
        for i in range(P):
            lower[i][i] = lower[i][i] + RIDGE
        trace = sum(lower[i][i] for i in range(P))
        for i in range(P):
            for j in range(i + 1):
                for k in range(j):
                    lower[i][j] = lower[i][j] - lower[i][k] * lower[j][k]
                if i == j:
                    lower[i][i] = np.sqrt(np.maximum(lower[i][i], 1e-12))
                else:
                    lower[i][j] = lower[i][j] / lower[j][j]
        pivots = np.log(np.stack([lower[i][i] for i in range(P)]))
        self.context[:, 2 * N] = self.count / K
        self.context[:, 2 * N + 1] = pivots.sum(0) / (1.25 * P)
        self.context[:, 2 * N + 2] = trace / (K * P)
        self.context[:, 2 * N + 3] = (pivots.min(0) - pivots.max(0)) / 4.0

    def _reward(self) -> Array:
        """SCALE log det S: |det Z| is a triple product of differences."""
        a, b, c = (self.chosen[i] - self.chosen[K - 1] for i in range(K - 1))
        volume = (
            a[0] * (b[1] * c[2] - b[2] * c[1])
            - a[1] * (b[0] * c[2] - b[2] * c[0])
            + a[2] * (b[0] * c[1] - b[1] * c[0])
        )
        square = np.maximum(volume * volume, _FLOOR)
        return np.asarray(SCALE * N * np.log(square), np.float32)

    def random_action(self) -> NDArray[np.int64]:
        """(B,) uniform among the available: draw again where it was taken already."""
        action = self.rng.integers(0, M, self.batch)
        while True:
            taken = np.flatnonzero(self.free[self.rows, action] == 0.0)
            if not len(taken):
                return action
            action[taken] = self.rng.integers(0, M, len(taken))
