"""How many postures a wanted accuracy needs."""

from jaxcal.selection.plan.api import Plan, PlanRow, plan

__all__ = ["Plan", "PlanRow", "plan"]
