"""A task of sequential measurement as a ``brax.envs.base.Env``; this loads brax.

``learning.brax.wrap_fresh`` makes the batch and draws a new session for every episode.
"""

from __future__ import annotations

from typing import Any

from jaxcal.adaptive.environment import TaskEnv
from jaxcal.adaptive.rules import SHARES, Rule
from jaxcal.learning.brax import EpisodeEnv


class SequentialEnv(EpisodeEnv):
    """Sessions of a task; arguments as of ``TaskEnv``."""

    def __init__(self, task: Any, base: Rule = SHARES, per_group: int = 6) -> None:
        super().__init__(TaskEnv(task, base, per_group))
