"""The paper's network and its PPO update in plain PyTorch, as one would write it.

It computes the same function as ``jaxcal.paper.network.PaperNetwork`` and the same
update as the ``paper`` preset: 16 episodes, 10 epochs, Adam, clipping by global norm,
averaged weights. Attention projects every candidate to a key, as usual; with
``folded=True`` the key projection is applied to the query instead, as in jaxcal.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

M, K, N = 50, 4, 3
P = N + 1
SCALE = 0.1
_MASKED = -1e9


class PaperTorch(nn.Module):
    """Hidden 768, 3.5 M parameters."""

    def __init__(self, width: int = 768, folded: bool = False) -> None:
        super().__init__()
        self.width, self.folded = width, folded
        self.pose_1, self.pose_2 = nn.Linear(N, width), nn.Linear(width, width)
        self.pose_norm = nn.LayerNorm(width, eps=1e-6)
        self.key = nn.Linear(width, width)
        self.context_1 = nn.Linear(2 * N + 4, width)
        self.context_2 = nn.Linear(width, width)
        self.context_norm = nn.LayerNorm(width, eps=1e-6)
        self.query = nn.Linear(width, width)
        self.squeeze = nn.Linear(width, max(width * 3 // 32, 1))
        self.expand = nn.Linear(max(width * 3 // 32, 1), width)
        self.actor = nn.Linear(width, width)
        self.critic_1 = nn.Linear(width, max(width * 2 // 3, 1))
        self.critic_2 = nn.Linear(max(width * 2 // 3, 1), 1)

    def encode(self, candidates: Tensor) -> Tensor:
        """(B, M, 3) to keys, or folded to candidates, (B, M, width)."""
        poses = torch.relu(self.pose_1(2.0 * candidates - 1.0))
        poses = self.pose_norm(torch.relu(self.pose_2(poses)))
        return poses if self.folded else self.key(poses)

    def decode(
        self, memory: Tensor, context: Tensor, free: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Memory (B, M, width), context (B, T, 10), free (B, T, M).

        Returns:
            (B, T, M) masked logits and (B, T) value.
        """
        context = torch.relu(self.context_1(context))
        context = self.context_norm(torch.relu(self.context_2(context)))
        scale = self.width**-0.5
        scores = self._scores(self.query(context), memory) * scale
        weights = torch.softmax(scores.masked_fill(~free, _MASKED), -1)
        glimpse = weights @ memory
        if self.folded:
            glimpse = self.key(glimpse)
        shared = context + self.expand(torch.relu(self.squeeze(context + glimpse)))
        logits = self._scores(self.actor(shared), memory) * scale
        value = self.critic_2(torch.relu(self.critic_1(shared)))[..., 0]
        return logits.masked_fill(~free, _MASKED), value

    def _scores(self, query: Tensor, memory: Tensor) -> Tensor:
        if self.folded:
            bias = query @ self.key.bias
            query = query @ self.key.weight
            return query @ memory.transpose(-1, -2) + bias[..., None]
        return query @ memory.transpose(-1, -2)

    def load_flax(self, params: Any) -> None:
        """Take the weights of a ``PaperNetwork``."""
        with torch.no_grad():
            for name, part in params.items():
                layer = getattr(self, name)
                kernel = part.get("kernel", part.get("scale"))
                layer.weight.copy_(torch.tensor(np.asarray(kernel).T.copy()))
                layer.bias.copy_(torch.tensor(np.asarray(part["bias"]).copy()))


def context_of(chosen: Tensor, count: int) -> Tensor:
    """The ten context numbers of ``count`` chosen postures (B, count, 3)."""
    batch = chosen.shape[0]
    z = torch.cat([chosen, torch.ones(batch, count, 1)], -1)
    gram = z.transpose(-1, -2) @ z + 0.01 * torch.eye(P)
    pivots = torch.log(torch.diagonal(torch.linalg.cholesky(gram), dim1=-2, dim2=-1))
    if count:
        mean, std = chosen.mean(1), chosen.std(1, correction=0)
    else:
        mean = std = torch.zeros(batch, N)
    trace = torch.diagonal(gram, dim1=-2, dim2=-1).sum(-1)
    scalars = [
        torch.full((batch,), count / K),
        pivots.sum(-1) / (1.25 * P),
        trace / (K * P),
        (pivots.amin(-1) - pivots.amax(-1)) / 4.0,
    ]
    return torch.cat([mean, std, torch.stack(scalars, -1)], -1)


class TorchTrainer:
    """PPO with the numbers of the ``paper`` preset."""

    def __init__(self, folded: bool = False, seed: int = 0) -> None:
        torch.manual_seed(seed)
        self.network = PaperTorch(folded=folded)
        self.average = copy.deepcopy(self.network)
        self.optimiser = torch.optim.Adam(self.network.parameters(), 1e-4, eps=1e-5)

    def update(self, episodes: int = 16, epochs: int = 10) -> float:
        """One update; the mean reward of its episodes."""
        candidates = torch.rand(episodes, M, N)
        rows = torch.arange(episodes)
        free = torch.ones(episodes, M, dtype=torch.bool)
        picked: list[Tensor] = []
        record: dict[str, list[Tensor]] = {
            name: [] for name in ("context", "free", "action", "log_prob", "value")
        }
        with torch.no_grad():
            memory = self.network.encode(candidates)
            for step in range(K):
                chosen = (
                    torch.stack(picked, 1) if picked else torch.zeros(episodes, 0, N)
                )
                context = context_of(chosen, step)
                logits, value = self.network.decode(
                    memory, context[:, None], free[:, None]
                )
                choice = torch.distributions.Categorical(logits=logits[:, 0])
                action = choice.sample()
                for name, item in (
                    ("context", context),
                    ("free", free.clone()),
                    ("action", action),
                    ("log_prob", choice.log_prob(action)),
                    ("value", value[:, 0] * SCALE * N),
                ):
                    record[name].append(item)
                free[rows, action] = False
                picked.append(candidates[rows, action])
            z = torch.cat([torch.stack(picked, 1), torch.ones(episodes, K, 1)], -1)
            reward = SCALE * N * 2.0 * torch.linalg.slogdet(z)[1]
        batch = {name: torch.stack(items, 1) for name, items in record.items()}
        # One reward at the end, discount and lambda 1: every return is the reward.
        target = reward[:, None].expand(-1, K)
        advantage = target - batch["value"]
        advantage = (advantage - advantage.mean()) / (
            advantage.std(correction=0) + 1e-6
        )
        for _ in range(epochs):
            self._step(candidates, batch, advantage, target)
        return float(reward.mean())

    def _step(
        self,
        candidates: Tensor,
        batch: dict[str, Tensor],
        advantage: Tensor,
        target: Tensor,
    ) -> None:
        memory = self.network.encode(candidates)
        logits, value = self.network.decode(memory, batch["context"], batch["free"])
        log_probs = torch.log_softmax(logits, -1)
        log_prob = log_probs.gather(-1, batch["action"][..., None])[..., 0]
        ratio = torch.exp(log_prob - batch["log_prob"])
        surrogate = torch.minimum(
            ratio * advantage, torch.clamp(ratio, 0.8, 1.2) * advantage
        )
        error = value * SCALE * N - target
        entropy = -(log_probs.exp() * log_probs).sum(-1).mean()
        loss = -surrogate.mean() + 0.5 * (error**2).mean() - 0.01 * entropy
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(self.network.parameters(), 0.5)
        self.optimiser.step()
        with torch.no_grad():
            old, new = list(self.average.parameters()), list(self.network.parameters())
            torch._foreach_lerp_(old, new, 0.01)
