"""Sequential measurement: the next one is chosen from the outcomes so far.

A task (``GridTask``, ``ParticleTask``) says what is unknown, what may be measured and
what it costs; a belief is what is known; a decider picks what comes next.
``next_measurement`` proposes one design, ``run`` is the closed loop, ``play`` and
``compare`` try deciders on thousands of sessions.
"""

import importlib
from typing import TYPE_CHECKING, Any

from jaxcal.extras import needs

if TYPE_CHECKING:
    from jaxcal.adaptive.episodes import compare, play
    from jaxcal.adaptive.grid import GridTask
    from jaxcal.adaptive.loop import estimates, next_measurement, run
    from jaxcal.adaptive.particles import ParticleTask

__all__ = [
    "GridTask",
    "ParticleTask",
    "compare",
    "estimates",
    "next_measurement",
    "play",
    "run",
]

_HOME = {
    **dict.fromkeys(("compare", "play"), "episodes"),
    **dict.fromkeys(("GridBelief", "GridTask"), "grid"),
    **dict.fromkeys(("Loop", "estimates", "next_measurement", "run"), "loop"),
    **dict.fromkeys(("ParticleBelief", "ParticleTask"), "particles"),
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'jaxcal.adaptive' has no attribute {name!r}")
    with needs("policy", "jaxcal.adaptive"):
        home = importlib.import_module(f"jaxcal.adaptive.{_HOME[name]}")
    return getattr(home, name)
