"""Which postures to measure, and in which order, so that the run takes least time.

``run`` has the searches, compiled; nothing here loads them.
"""

from jaxcal.designs.travel.motion import Motion, fastest_tour, travel_times

__all__ = ["Motion", "fastest_tour", "travel_times"]
