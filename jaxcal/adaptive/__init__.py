"""The next measurement from the last: where information depends on what is measured.

A task (``GridTask``, ``ParticleTask``) says what is unknown, what may be measured and
what it costs; a belief is what is known; a decider picks what comes next.
``next_measurement`` answers at the bench, ``run`` closes the loop, ``play`` and
``compare`` try deciders on thousands of sessions. Names load on first use.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxcal.adaptive.episodes import compare, play
    from jaxcal.adaptive.grid import GridBelief, GridTask
    from jaxcal.adaptive.loop import next_measurement, run
    from jaxcal.adaptive.particles import ParticleBelief, ParticleTask

__all__ = [
    "GridBelief",
    "GridTask",
    "ParticleBelief",
    "ParticleTask",
    "compare",
    "next_measurement",
    "play",
    "run",
]

_HOME = {
    "GridBelief": "grid",
    "GridTask": "grid",
    "ParticleBelief": "particles",
    "ParticleTask": "particles",
    "compare": "episodes",
    "next_measurement": "loop",
    "play": "episodes",
    "run": "loop",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'jaxcal.adaptive' has no attribute {name!r}")
    home = importlib.import_module(f"jaxcal.adaptive.{_HOME[name]}")
    return getattr(home, name)
