"""What is chosen from, under which rules, and by which criterion."""

from jaxcal.selection.problem.assembly import make_problems
from jaxcal.selection.problem.candidate_set import CandidateSet
from jaxcal.selection.problem.losses import Loss, LossProblem
from jaxcal.selection.problem.problem import Problem, Solution, log_dets, values
from jaxcal.selection.problem.scenario_problem import ScenarioProblem

__all__ = [
    "CandidateSet",
    "Loss",
    "LossProblem",
    "Problem",
    "ScenarioProblem",
    "Solution",
    "log_dets",
    "make_problems",
    "values",
]
