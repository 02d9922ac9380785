"""What is chosen from, under which rules, and by which criterion."""

from jaxcal.selection.problem.assembly import make_problems, problem_of
from jaxcal.selection.problem.blocks import Blocks, blocks_of, shares_regressor
from jaxcal.selection.problem.candidate_set import CandidateSet, Scenarios
from jaxcal.selection.problem.problem import (
    Constraints,
    Problem,
    ScenarioProblem,
    Solution,
    log_dets,
)

__all__ = [
    "Blocks",
    "CandidateSet",
    "Constraints",
    "Problem",
    "ScenarioProblem",
    "Scenarios",
    "Solution",
    "blocks_of",
    "log_dets",
    "make_problems",
    "problem_of",
    "shares_regressor",
]
