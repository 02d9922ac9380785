"""How many measurements a wanted accuracy takes."""

from jaxcal.selection.plan.fewest import Plan, PlanRow, plan

__all__ = ["Plan", "PlanRow", "plan"]
