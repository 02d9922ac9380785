"""How many postures a wanted accuracy needs."""

from jaxcal.selection.plan.api import Plan, PlanRow, make_plan

__all__ = ["Plan", "PlanRow", "make_plan"]
