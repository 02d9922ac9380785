"""What is chosen from, under which rules, and by which criterion."""

from jaxcal.selection.problem.candidate_set import CandidateSet
from jaxcal.selection.problem.making import make_problems
from jaxcal.selection.problem.problem import Problem, Solution, log_dets, values

__all__ = ["CandidateSet", "Problem", "Solution", "log_dets", "make_problems", "values"]
