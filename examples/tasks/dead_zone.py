"""A dead zone, as a task: ``python evaluate.py --task examples/tasks/dead_zone.py``."""

from backlash import DEAD_ZONE as ENTRY

__all__ = ["ENTRY"]
