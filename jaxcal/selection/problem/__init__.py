"""What is chosen from, under which rules, and by which criterion."""

from jaxcal.selection.problem.asked import Asked
from jaxcal.selection.problem.making import make_problems
from jaxcal.selection.problem.problem import Found, Problem, log_dets, values

__all__ = ["Asked", "Found", "Problem", "log_dets", "make_problems", "values"]
