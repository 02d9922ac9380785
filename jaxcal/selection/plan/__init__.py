"""How many measurements a wanted accuracy takes."""

from jaxcal.selection.plan.api import Plan, PlanRow, plan

__all__ = ["Plan", "PlanRow", "plan"]
