"""The next measurement from the last: where information depends on what is measured.

A task (``GridTask``, ``ParticleTask``) says what is unknown, what may be measured and
what it costs; a belief is what is known; a decider picks what comes next.
``next_measurement`` answers at the bench, ``run`` closes the loop, ``play`` and
``compare`` try deciders on thousands of sessions.
"""

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
