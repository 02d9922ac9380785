"""Sequential measurement: the next one is chosen from the outcomes so far.

A task (``GridTask``, ``ParticleTask``) says what is unknown, what may be measured and
what it costs; a belief is what is known; a decider picks what comes next.
``next_measurement`` proposes one design, ``run`` is the closed loop, ``play`` and
``compare`` try deciders on thousands of sessions.
"""

from jaxcal.extras import needs

with needs("policy", "jaxcal.adaptive"):
    from jaxcal.adaptive.episodes import compare, play
    from jaxcal.adaptive.estimates import estimates
    from jaxcal.adaptive.grid import GridBelief, GridTask
    from jaxcal.adaptive.loop import Loop, next_measurement, run
    from jaxcal.adaptive.particles import ParticleBelief, ParticleTask

__all__ = [
    "GridBelief",
    "GridTask",
    "Loop",
    "ParticleBelief",
    "ParticleTask",
    "compare",
    "estimates",
    "next_measurement",
    "play",
    "run",
]
