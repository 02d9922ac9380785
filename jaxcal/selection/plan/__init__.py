"""How many postures a wanted accuracy needs."""

from jaxcal.selection.plan.api import Plan, Planned, PlanRow

__all__ = ["Plan", "PlanRow", "Planned"]
