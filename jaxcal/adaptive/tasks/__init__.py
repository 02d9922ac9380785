"""Tasks, one per file, and the registry that finds them by name."""

from jaxcal.adaptive.tasks.registry import Entry, load, names

__all__ = ["Entry", "load", "names"]
